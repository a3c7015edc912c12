"""`muster evaluate --race`, and what a racer's job can't be: submitted, refused, shown."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import pytest

from shared_store.volume.layout import Store
from tests.conftest import Serving
from tests.support.orchestrator.jobs import refusal
from tests.support.orchestrator.trained import SPEC, add_checkpoint, add_run

CHOICES = json.dumps({"action_space": [{"steering_angle": angle, "speed": 1.0} for angle in (-30, 0, 30)]})
TRAIN = {"task": "Racer", "worlds": 8, "iterations": 9, "config": {"track": "oval"}}
RACER: dict[str, Any] = {"name": "racer", "resources": {"cpus": 1, "memory": 64}, "train": TRAIN}
NAMED = "did you mean oval?"


@pytest.fixture(scope="module", autouse=True)
def store(full: Serving) -> Store:
    """It has trained runs."""
    store = Store(full.home / "store")
    add_run(store, "taught")
    add_checkpoint(store, "taught", 9)
    add_run(store, "fast-car", {**SPEC, "name": "fast-car", "train": {**SPEC["train"], "task": "Racer"}})
    add_checkpoint(store, "fast-car", 9, task="Racer", train={"task": "Racer", "config": {"track": "oval"}})
    add_run(store, "racer", RACER)  # with ranges of actions
    add_checkpoint(store, "racer", 9, task="Racer", train=TRAIN, settings={})
    return store


REFUSED = {
    "taught --race": "race: run taught trained Cartpole, which drives no laps; race only runs of a racer's",
    "fast-car --trials 3": "--trials: only races take it; add --race",
    "fast-car -o there": "--output: only races take it; add --race",
    "fast-car --race --episodes 3": "--episodes: a race takes --trials instead, one world each",
    "fast-car --race --trials 0": "race.trials: expected a value greater than or equal to 1, found 0",
    "fast-car --race --penalty -1": "race.off_track_penalty: expected a value greater than or equal to 0",
    "fast-car --race --set config.put_bakc=2.0": "race.config.put_bakc: RacerConfig has no such key; did you",
    "fast-car --race --set config.put_back=20.0": "race.config.put_back: expected a value less than",
    "fast-car --race --set race.traks=[oval]": "race.traks: unknown key; did you mean track?",
    "fast-car --race --set nodes=2": "race: it runs on one node with at most one GPU",
    "racer --race --track ovall": f"race.track: track ovall does not exist; {NAMED}\n",
    "racer --set config.track=ovall": f"evaluate.config.track: track ovall does not exist; {NAMED}\n",
}


@pytest.mark.parametrize("line", REFUSED)
def test_what_cannot_be_is_refused_at_submission_in_one_line(full: Serving, line: str) -> None:
    assert REFUSED[line] in refusal(full, "evaluate", *shlex.split(line))


def test_a_race_is_a_job_of_its_own_kind_with_the_rules_that_were_given(full: Serving, tmp_path: Path) -> None:
    spec = tmp_path / "race.yaml"
    race = {"run": "fast-car", "trials": 5, "continuous": True, "track": ["oval"]}
    spec.write_text(json.dumps({"name": "final", "race": race}))
    done = full.muster("submit", str(spec), "--json")
    assert done.returncode == 0, done.stderr
    detail = full.detail(json.loads(done.stdout)["jobId"])
    race = detail["spec"]["race"]
    assert (race["trials"], race["continuous"], race["off_track_penalty"], race["seconds"]) == (5, True, 1.0, 1200.0)
    shown = full.muster("show", detail["id"]).stdout
    assert "races" in shown and "fast-car" in shown


def test_copying_step_logs_replaces_no_file(full: Serving, tmp_path: Path) -> None:
    (tmp_path / "sim-trace").mkdir()
    output = refusal(full, "evaluate", "fast-car", "--race", "-o", str(tmp_path))
    assert "sim-trace exists; --overwrite replaces it" in output


@pytest.mark.parametrize(
    "line",
    [
        "submit job_specs/racer.yaml --set train.config.track=ovall",
        "submit job_specs/racer.yaml --set 'train.config.track=[chicane, ovall]'",
        "submit job_specs/racer.yaml --set train.config.track=ovall --dry-run",
        "clone racer --name other --set train.config.track=ovall",
        "clone racer --name other --set train.config.track=ovall --dry-run",
    ],
)
def test_a_training_on_an_unknown_track_is_refused_with_the_nearest_name(full: Serving, line: str) -> None:
    assert refusal(full, *shlex.split(line)).endswith(f"train.config.track: track ovall does not exist; {NAMED}\n")


@pytest.mark.parametrize("algorithm", ["sac", "rsl_rl"])
def test_what_learns_numbers_alone_takes_no_choices(full: Serving, algorithm: str) -> None:
    changes = (f"train.config.action_space={CHOICES}", f"train.algorithm={algorithm}", "train.ppo={}")
    for dry in ((), ("--dry-run",)):
        message = refusal(full, "submit", "job_specs/racer.yaml", *(f"--set={each}" for each in changes), *dry)
        assert f"train.{algorithm}: " in message and "choices; use ppo" in message


@pytest.mark.parametrize(
    ("change", "output"),
    [
        (f"action_space={CHOICES}", "ranges of 2 actions; with 3 actions to choose from, as in the clone"),
        ("waypoints=5", "8; with 5, as in the clone"),
        ("obstacles=[{distance: 3.0}]", "none; with some, as in the clone"),
        ("lidar={sectors: 4}", "none; with one of 4 numbers, as in the clone"),
    ],
)
def test_a_clone_whose_network_would_have_another_size_is_refused(full: Serving, change: str, output: str) -> None:
    for dry in ((), ("--dry-run",)):
        message = refusal(full, "clone", "racer", "--name", "other", "--set", f"train.config.{change}", *dry)
        assert (
            f"train.config.{change.partition('=')[0]}: {output}" in message and "leave the setting as it is" in message
        )


def test_a_clone_on_another_track_can_be_tried_without_one(full: Serving) -> None:
    changes = ("--set", "train.config.track=chicane", "--set", "train.config.rewards.off_track=-20", "--dry-run")
    plan = json.loads(full.muster("clone", "racer", "--name", "faster", *changes, "--json").stdout)
    assert '"track":"chicane"' in plan["nodes"][0]["environment"]["MUSTER_SPEC"]
