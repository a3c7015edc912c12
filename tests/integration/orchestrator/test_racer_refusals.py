"""What a racer's job can't be is told before the job exists: tracks, actions that the algorithm can't learn, clones of another size."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from shared_store.layout import Store
from tests.conftest import Serving
from tests.support.orchestrator.trained import add_checkpoint, add_run

CHOICES = [{"steering_angle": angle, "speed": 1.0} for angle in (-30, 0, 30)]
TRAIN = {"task": "Racer", "worlds": 8, "iterations": 9, "config": {"track": "oval"}}
SPEC: dict[str, Any] = {"name": "racer", "resources": {"cpus": 1, "memory": 64}, "train": TRAIN}
NAMED = "did you mean oval?"


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    """A server whose only CPU is taken: what is submitted waits. Its store has the trained run ``racer``, with ranges of actions."""
    server = Serving(tmp_path_factory.mktemp("home"), "--cpus", "1")
    server.wait(server.gang("import time; time.sleep(3600)", cpus="1", name="blocker"), "RUNNING")
    store = Store(server.home / "store")
    add_run(store, "racer", SPEC)
    add_checkpoint(store, "racer", 9, task="Racer", train=TRAIN, settings={})
    yield server
    server.close()


def refused(server: Serving, *arguments: str) -> str:
    """The one line with which it refuses; no job is left."""
    before = len(jobs_of(server))
    done = server.muster(*arguments)
    assert done.returncode in (1, 2) and len(done.stderr.splitlines()) == 1, (done.returncode, done.stdout, done.stderr)
    assert len(jobs_of(server)) == before
    return done.stderr


def jobs_of(server: Serving) -> list[dict[str, Any]]:
    filters = [{"name": "AFTER_CREATED_AT", "values": ["0"]}]
    found: list[dict[str, Any]] = server.client.batch("ListJobs", jobQueue="default", filters=filters)["jobSummaryList"]
    return found


@pytest.mark.parametrize(
    "arguments",
    [
        ("submit", "job_specs/racer.yaml", "--set", "train.config.track=ovall"),
        ("submit", "job_specs/racer.yaml", "--set", "train.config.track=[chicane, ovall]"),
        ("submit", "job_specs/racer.yaml", "--set", "train.config.track=ovall", "--dry-run"),
        ("clone", "racer", "--name", "other", "--set", "train.config.track=ovall"),
        ("clone", "racer", "--name", "other", "--set", "train.config.track=ovall", "--dry-run"),
    ],
)
def test_a_training_on_an_unknown_track_is_told_the_nearest_name(full: Serving, arguments: tuple[str, ...]) -> None:
    assert refused(full, *arguments) == f"muster: train.config.track: track ovall does not exist; {NAMED}\n"


@pytest.mark.parametrize(
    ("options", "key"),
    [(("--race", "--track", "ovall"), "race.track"), (("--set", "config.track=ovall"), "evaluate.config.track")],
)
def test_an_evaluation_on_an_unknown_track_is_told_the_nearest(
    full: Serving, options: tuple[str, ...], key: str
) -> None:
    assert refused(full, "evaluate", "racer", *options) == f"muster: {key}: track ovall does not exist; {NAMED}\n"


@pytest.mark.parametrize("algorithm", ["sac", "rsl_rl"])
def test_what_learns_numbers_alone_takes_no_choices(full: Serving, algorithm: str) -> None:
    space = f"train.config.action_space={json.dumps({'action_space': CHOICES})}"
    asked = (
        "submit",
        "job_specs/racer.yaml",
        "--set",
        space,
        "--set",
        f"train.algorithm={algorithm}",
        "--set",
        "train.ppo={}",
    )
    for dry in ((), ("--dry-run",)):
        told = refused(full, *asked, *dry)
        assert f"train.{algorithm}: " in told and "choices; use ppo" in told


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            f"train.config.action_space={json.dumps({'action_space': CHOICES})}",
            "train.config.action_space: ranges of 2 actions, and the clone would have 3 actions to choose from",
        ),
        ("train.config.waypoints=5", "train.config.waypoints: 8, and the clone would have 5"),
        ("train.config.obstacles=[{distance: 3.0}]", "train.config.obstacles: none, and the clone would have some"),
        ("train.config.lidar={sectors: 4}", "train.config.lidar: none, and the clone would have one of 4 numbers"),
    ],
)
def test_a_clone_whose_network_would_have_another_size_is_refused(full: Serving, change: str, said: str) -> None:
    for dry in ((), ("--dry-run",)):
        told = refused(full, "clone", "racer", "--name", "other", "--set", change, *dry)
        assert said in told and "leave the setting as it is" in told


def test_a_clone_can_be_tried_without_one(full: Serving, tmp_path: Path) -> None:
    before = sorted(path.name for path in (full.home / "store" / "runs").iterdir())
    changes = ("--set", "train.config.track=chicane", "--set", "train.config.rewards.off_track=-20")
    shown = full.muster("clone", "racer", "--name", "faster", *changes, "--dry-run")
    assert shown.returncode == 0, shown.stderr
    assert shown.stdout.startswith("faster on the local engine, queue default; nothing was started\n")
    plan = json.loads(full.muster("clone", "racer", "--name", "faster", *changes, "--dry-run", "--json").stdout)
    assert '"track":"chicane"' in plan["nodes"][0]["environment"]["MUSTER_SPEC"]
    assert len(jobs_of(full)) == 1 and sorted(p.name for p in (full.home / "store" / "runs").iterdir()) == before
    assert "exists already" in refused(full, "clone", "racer", "--name", "racer", "--dry-run")


def test_a_job_is_submitted_under_another_name(full: Serving) -> None:
    done = full.muster("submit", "job_specs/racer.yaml", "--name", "second", "--json", "--set", "resources.cpus=1")
    assert done.returncode == 0, done.stderr
    submitted = json.loads(done.stdout)
    assert submitted["jobName"] == "second" and full.detail(submitted["jobId"])["spec"]["name"] == "second"
    full.client.batch("TerminateJob", jobId=submitted["jobId"], reason="seen")
    twice = refused(full, "submit", "job_specs/racer.yaml", "--name", "second", "--set", "name=third")
    assert twice == "muster: --set name=third: --name second names the job; give one of them\n"
    assert "--set: name: " in refused(full, "submit", "job_specs/racer.yaml", "--name", "a b")
