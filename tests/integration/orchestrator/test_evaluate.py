"""`muster evaluate`, `compare` and `checkpoints` through a real server."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest

from shared_store.volume.files import write_json
from shared_store.volume.layout import Store
from shared_store.volume.metrics import MetricsWriter
from tests.conftest import Serving
from tests.support.orchestrator.jobs import jobs_and_runs, nothing_changed, refusal
from tests.support.orchestrator.trained import SPEC, add_checkpoint, add_run

CONFIG = {"angle_limit": 0.2}


@pytest.fixture(scope="module", autouse=True)
def store(full: Serving) -> Store:
    """It has trained runs."""
    store = Store(full.home / "store")
    for name, seed, reward in (("taught", 1, 10.0), ("taught-b", 2, 14.0), ("slow", 1, 3.0)):
        train = {**SPEC["train"], "seed": seed, **({"worlds": 2} if name == "slow" else {})}
        add_run(store, name, {**SPEC, "name": name, "train": train, "environment": {"LEVEL": "1"}})
        for iteration in (3, 6, 9):
            facts = {"train": {**train, "config": CONFIG}, "score": float(iteration)}
            add_checkpoint(store, name, iteration, **facts)
        with MetricsWriter(store.run(name), 1, 0) as metrics:
            for i in range(1, 10):
                metrics.write({"iteration": i, "env_steps": 100 * i, "reward": reward, "episode_length": 5})
    add_run(store, "empty")
    gone = {**SPEC["train"], "task": "Vanished"}
    add_run(store, "gone", {**SPEC, "name": "gone", "train": gone})
    add_checkpoint(store, "gone", 9, task="Vanished", train=gone)
    for iteration, mean in ((9, 21.0), (6, 29.0)):
        evaluated(store, "taught", f"{iteration:08d}-e1-0123abcd", mean)
    evaluated(store, "taught-b", "00000009-e1", 25.0)
    return store


def evaluated(store: Store, run: str, name: str, mean: float, **facts: Any) -> None:
    figures = {"mean_return": mean, "mean_length": 9.0, "max_length": 10, "episodes": 100, "time": mean}
    figures["task"] = "Cartpole"
    share = {"share": 0.75, "low": 0.66, "high": 0.82, "count": 75}
    interval = {"mean": mean, "std": 2.0, "low": mean - 0.5, "high": mean + 0.5}
    write_json(store.run(run).evaluations / f"{name}.json", {**figures, "success": share, "return": interval, **facts})


REFUSED = {
    "nosuch": "run nosuch does not exist",
    "taugt": "did you mean taught",
    "taught@4": "run taught has no checkpoint of iteration 4; available: 3, 6, 9",
    "taught@last": "expected an iteration, best or latest after @",
    "empty": "run empty has no checkpoint yet; train it first",
    "taught --episodes 0": "evaluate.episodes: expected a value greater than or equal to 1, found 0",
    "taught --set config.angel_limit=1.0": "CartpoleConfig has no such key; did you mean angle_limit?",
    "taught --set config.angle_limit=wide": "evaluate.config.angle_limit: expected a number",
    "taught --set resource.cpus=1": "resource: unknown key; did you mean resources?",
    "taught --name 'a b'": "name: expected letters",
    "taught --set resources.cpus=400": "lower nodes or resources",
}


@pytest.mark.parametrize("line", REFUSED)
def test_what_cannot_be_is_refused_at_submission_in_one_line(full: Serving, line: str) -> None:
    assert REFUSED[line] in refusal(full, "evaluate", *shlex.split(line))


@pytest.mark.parametrize("kind", ["evaluate", "export", "render", "resume", "clone"])
def test_a_run_whose_task_is_not_installed_is_refused_with_the_same_line(full: Serving, kind: str) -> None:
    more = {"render": ("-o", "film.gif"), "clone": ("--name", "again")}.get(kind, ())
    output = refusal(full, kind, "gone", *more)
    assert "run gone: train.task: no task is called 'Vanished'; " in output
    assert output.rstrip().endswith("(your own: module:Class; if a plug-in provides it, install the plug-in's package)")


def test_a_job_from_yaml_is_checked_as_the_command_s_is(full: Serving, tmp_path: Path) -> None:
    spec = tmp_path / "judge.yaml"
    for section, output in (
        ({"run": "gone"}, "run gone: train.task: no task is called 'Vanished'"),
        ({"checkpoint": 4}, "no checkpoint of iteration 4"),
        ({"config": {"angel_limit": 1}}, "did you mean angle_limit?"),
        ({"checkpoint": "new"}, "evaluate.checkpoint: expected an iteration, best or latest, found 'new'"),
    ):
        spec.write_text(json.dumps({"name": "judge", "evaluate": {"run": "taught", **section}}))
        for options in ([], ["--dry-run"]):
            assert output in refusal(full, "submit", str(spec), *options)
    section = {"run": "taught", "checkpoint": "best", "config": {"angle_limit": 0.3}}
    spec.write_text(json.dumps({"name": "judge", "evaluate": section}))
    done = full.muster("submit", str(spec), "--json")
    assert done.returncode == 0, done.stderr
    assert full.detail(json.loads(done.stdout)["jobId"])["spec"]["evaluate"]["checkpoint"] == "best"


def test_checkpoints_show_what_was_evaluated_and_the_best_follows_from_it(full: Serving) -> None:
    listed = full.muster("checkpoints", "taught").stdout.splitlines()
    third, sixth, ninth = listed[1:]
    assert "29.00 ± 0.50" in sixth and "the best" in sixth
    assert "21.00 ± 0.50" in ninth and "the best" not in ninth + third
    found = full.client.get("/api/runs/taught/evaluations")
    assert [each["checkpoint"] for each in found] == ["00000009-e1", "00000006-e1"]
    answer = json.loads(full.muster("clone", "taught@best", "--name", "of-best", "--json").stdout)
    assert answer["parent"]["iteration"] == 6
    shutil.rmtree(full.home / "store" / "runs" / "of-best")


def test_compare_puts_seeds_into_one_group_and_draws_curves(full: Serving, tmp_path: Path) -> None:
    picture = tmp_path / "curves.png"
    done = full.muster("compare", "taught*", "slow", "-o", str(picture))
    assert done.returncode == 0, done.stderr
    header, both, slow, drawn = done.stdout.splitlines()
    assert header.split() == ["RUNS", "SEEDS", "TASK", "ITERATION", "STEPS", "REWARD", "LENGTH", "EVALUATED", "SUCCESS"]
    assert "taught* (2)" in both and "1, 2" in both and "12.00 ± 2.83" in both and "27.00 ± 2.83" in both
    assert both.rstrip().endswith("75.0 %") and "3.00" in slow and slow.rstrip().endswith("-")
    assert drawn == f"written: {picture}" and picture.read_bytes().startswith(b"\x89PNG")
    (group, _) = json.loads(full.muster("compare", "taught*", "slow", "--json").stdout)
    assert group["runs"] == ["taught", "taught-b"] and group["evaluated"]["mean"] == 27.0
    table = tmp_path / "curves.csv"
    assert full.muster("compare", "taught", "slow", "-o", str(table)).returncode == 0
    header, *rows = table.read_text().splitlines()
    assert header == "group,env_steps,return,std,runs" and len(rows) == 18
    assert rows[0] == "taught,100.0,10.0,0.0,1" and rows[-1] == "slow,900.0,3.0,0.0,1"


def test_compare_refuses_what_it_cannot_compare(full: Serving, tmp_path: Path) -> None:
    for options, output in (
        (["taught"], "that is one run, taught; name two or more to compare"),
        (["taught", "slwo"], "did you mean slow"),
        (["robot-*", "slow"], "no run matches robot-*"),
        (["taught", "slow", "-o", str(tmp_path / "no" / "x.png")], "is not a directory; create it"),
        (["taught", "slow", "-o", str(tmp_path / "x.xyz")], "unknown ending; use one of .png, .svg, .pdf"),
        (["empty", "empty*", "of-*", "-o", str(tmp_path / "x.png")], "no run matches of-*"),
    ):
        assert output in refusal(full, "compare", *options)
    assert list(tmp_path.iterdir()) == []


def test_a_clone_can_be_tried_without_one(full: Serving, store: Store) -> None:
    before = jobs_and_runs(full)
    changes = ("--set", "train.config.angle_limit=0.3", "--set", "train.config.rewards.alive=2")
    shown = full.muster("clone", "taught", "--name", "faster", *changes, "--dry-run")
    assert shown.returncode == 0, shown.stderr
    assert shown.stdout.startswith("faster on the local engine, queue default; nothing was started\n")
    plan = json.loads(full.muster("clone", "taught", "--name", "faster", *changes, "--dry-run", "--json").stdout)
    assert '"angle_limit":0.3' in plan["nodes"][0]["environment"]["MUSTER_SPEC"]
    assert nothing_changed(full, before)
    assert "exists already" in refusal(full, "clone", "taught", "--name", "taught", "--dry-run", code=1)


def test_a_job_is_submitted_under_another_name(full: Serving) -> None:
    submit = ("submit", "job_specs/cartpole.yaml", "--name")
    done = full.muster(*submit, "second", "--json", "--set", "resources.cpus=0.1")
    assert done.returncode == 0, done.stderr
    submitted = json.loads(done.stdout)
    assert submitted["jobName"] == "second" and full.detail(submitted["jobId"])["spec"]["name"] == "second"
    full.client.batch("TerminateJob", jobId=submitted["jobId"], reason="seen")
    twice = refusal(full, *submit, "second", "--set", "name=third")
    assert twice == "muster: --set name=third: --name sets name; use one of them\n"
    assert "--set: name: " in refusal(full, *submit, "a b")
