"""`muster evaluate`, `compare` and `checkpoints` through a real server: what is submitted, what is refused, what is shown."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow
import pyarrow.parquet
import pytest

from shared_store.files import write_json
from shared_store.layout import Store
from shared_store.metrics import MetricsWriter
from tests.conftest import Serving, call_muster
from tests.support.orchestrator.trained import SPEC, add_checkpoint, add_run

CONFIG = {"angle_limit": 0.2}


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    """A server whose only CPU is taken: what is submitted waits. Its store has trained runs."""
    server = Serving(tmp_path_factory.mktemp("home"), "--cpus", "1")
    blocker = server.gang("import time; time.sleep(3600)", cpus="1", name="blocker")
    server.wait(blocker, "RUNNING")
    store = Store(server.home / "store")
    for name, seed, reward in (("taught", 1, 10.0), ("taught-b", 2, 14.0), ("slow", 1, 3.0)):
        train = {**SPEC["train"], "seed": seed, **({"worlds": 2} if name == "slow" else {})}
        add_run(store, name, {**SPEC, "name": name, "train": train, "environment": {"LEVEL": "1"}})
        for iteration in (3, 6, 9):
            facts = {"train": {**train, "config": CONFIG}, "score": float(iteration)}
            add_checkpoint(store, name, iteration, **facts)
        with MetricsWriter(store.run(name), 1, 0) as metrics:
            for iteration in range(1, 10):
                metrics.write(
                    {"iteration": iteration, "env_steps": 100 * iteration, "reward": reward, "episode_length": 5}
                )
    add_run(store, "empty")
    add_run(store, "fast-car", {**SPEC, "name": "fast-car", "train": {**SPEC["train"], "task": "Racer"}})
    add_checkpoint(store, "fast-car", 9, task="Racer", train={"task": "Racer", "config": {"track": "oval"}})
    for iteration, mean in ((9, 21.0), (6, 29.0)):
        evaluated(store, "taught", f"{iteration:08d}-e1-0123abcd", mean)
    evaluated(store, "taught-b", "00000009-e1", 25.0)
    yield server
    server.close()


def evaluated(store: Store, run: str, name: str, mean: float, **facts: Any) -> None:
    figures = {
        "mean_return": mean,
        "mean_length": 9.0,
        "max_length": 10,
        "episodes": 100,
        "time": mean,
        "task": "Cartpole",
    }
    share = {"share": 0.75, "low": 0.66, "high": 0.82, "count": 75}
    interval = {"mean": mean, "std": 2.0, "low": mean - 0.5, "high": mean + 0.5}
    write_json(store.run(run).evaluations / f"{name}.json", {**figures, "success": share, "return": interval, **facts})


def submitted(server: Serving, tmp_path: Path, section: dict[str, Any], *options: str) -> Any:
    spec = tmp_path / "judge.yaml"
    spec.write_text(json.dumps({"name": "judge", "evaluate": section}))
    return call_muster("submit", str(spec), *options, home=server.home)


REFUSED = {
    ("nosuch",): (2, "run nosuch does not exist"),
    ("taugt",): (2, "did you mean taught"),
    ("taught@4",): (2, "run taught has no checkpoint of iteration 4; it has: 3, 6, 9"),
    ("taught@last",): (2, "expected an iteration, best or latest after @"),
    ("empty",): (2, "run empty has no checkpoint yet; train it first"),
    ("taught", "--episodes", "0"): (2, "evaluate.episodes: expected a value greater than or equal to 1, found 0"),
    ("taught", "--set", "config.angel_limit=1.0"): (2, "CartpoleConfig has no such key; did you mean angle_limit?"),
    ("taught", "--set", "config.angle_limit=wide"): (2, "evaluate.config.angle_limit: expected a number"),
    ("taught", "--set", "resource.cpus=1"): (2, "resource: unknown key; did you mean resources?"),
    ("taught", "--name", "a b"): (2, "name: expected letters"),
    ("taught", "--set", "resources.cpus=400"): (2, "lower nodes or resources"),
    ("taught", "--race"): (
        2,
        "race: run taught trained Cartpole, which drives no laps; race only runs of a racer's",
    ),
    ("fast-car", "--trials", "3"): (2, "--trials: only races take it; add --race"),
    ("fast-car", "-o", "there"): (2, "--output: only races take it; add --race"),
    ("fast-car", "--race", "--episodes", "3"): (2, "--episodes: a race takes --trials instead, one world each"),
    ("fast-car", "--race", "--trials", "0"): (2, "race.trials: expected a value greater than or equal to 1, found 0"),
    ("fast-car", "--race", "--penalty", "-1"): (
        2,
        "race.off_track_penalty: expected a value greater than or equal to 0",
    ),
    ("fast-car", "--race", "--set", "config.put_bakc=2.0"): (
        2,
        "race.config.put_bakc: RacerConfig has no such key; did you",
    ),
    ("fast-car", "--race", "--set", "config.put_back=20.0"): (2, "race.config.put_back: expected a value less than"),
    ("fast-car", "--race", "--set", "race.traks=[oval]"): (2, "race.traks: unknown key; did you mean track?"),
    ("fast-car", "--race", "--set", "nodes=2"): (2, "race: it runs on one node with at most one GPU"),
}


@pytest.mark.parametrize("options", REFUSED)
def test_what_can_not_be_is_refused_at_submission_in_one_line(full: Serving, options: tuple[str, ...]) -> None:
    code, said = REFUSED[options]
    jobs = json.loads(call_muster("list", "--json", home=full.home).stdout)
    done = call_muster("evaluate", *options, home=full.home)
    assert done.returncode == code and said in done.stderr and len(done.stderr.splitlines()) == 1, done.stderr
    assert json.loads(call_muster("list", "--json", home=full.home).stdout) == jobs


def test_a_job_from_yaml_is_checked_as_the_command_s_is(full: Serving, tmp_path: Path) -> None:
    for section, said in (
        ({"run": "taught", "checkpoint": 4}, "no checkpoint of iteration 4"),
        ({"run": "taught", "config": {"angel_limit": 1}}, "did you mean angle_limit?"),
        (
            {"run": "taught", "checkpoint": "newest"},
            "evaluate.checkpoint: expected an iteration, best or latest, found 'newest'",
        ),
    ):
        for options in ([], ["--dry-run"]):
            done = submitted(full, tmp_path, section, *options)
            assert done.returncode == 2 and said in done.stderr and len(done.stderr.splitlines()) == 1, done.stderr
    done = submitted(full, tmp_path, {"run": "taught", "checkpoint": "best", "config": {"angle_limit": 0.3}}, "--json")
    assert done.returncode == 0, done.stderr
    assert full.detail(json.loads(done.stdout)["jobId"])["spec"]["evaluate"]["checkpoint"] == "best"


def test_checkpoints_show_what_was_evaluated_and_the_best_follows_from_it(full: Serving) -> None:
    listed = call_muster("checkpoints", "taught", home=full.home).stdout.splitlines()
    third, sixth, ninth = listed[1:]
    assert "29.00 ± 0.50" in sixth and "the best" in sixth
    assert "21.00 ± 0.50" in ninth and "the best" not in ninth + third
    found = full.client.get("/api/runs/taught/evaluations")
    assert [each["checkpoint"] for each in found] == ["00000009-e1", "00000006-e1"]
    answer = json.loads(call_muster("clone", "taught@best", "--name", "of-best", "--json", home=full.home).stdout)
    assert answer["parent"]["iteration"] == 6
    shutil.rmtree(full.home / "store" / "runs" / "of-best")


def test_compare_puts_seeds_into_one_group_and_draws_curves(full: Serving, tmp_path: Path) -> None:
    picture = tmp_path / "curves.png"
    done = call_muster("compare", "taught*", "slow", "-o", str(picture), home=full.home)
    assert done.returncode == 0, done.stderr
    header, both, slow, drawn = done.stdout.splitlines()
    assert header.split() == ["RUNS", "SEEDS", "TASK", "ITERATION", "STEPS", "REWARD", "LENGTH", "EVALUATED", "SUCCESS"]
    assert "taught* (2)" in both and "1, 2" in both and "12.00 ± 2.83" in both and "27.00 ± 2.83" in both
    assert both.rstrip().endswith("75.0 %") and "3.00" in slow and slow.rstrip().endswith("-")
    assert drawn == f"written: {picture}" and picture.read_bytes().startswith(b"\x89PNG")
    (group, _) = json.loads(call_muster("compare", "taught*", "slow", "--json", home=full.home).stdout)
    assert group["runs"] == ["taught", "taught-b"] and group["evaluated"]["mean"] == 27.0


def test_single_runs_that_played_the_same_episodes_are_compared_pair_by_pair(full: Serving, tmp_path: Path) -> None:
    store = Store(full.home / "store")
    returns = {"fast": [10.0, 20.0, 30.0, 41.0], "sure": [11.0, 21.5, 31.0, 42.5, 99.0], "odd": [1.0, 2.0, 3.0, 4.0]}
    for worlds, (name, values) in enumerate(returns.items(), 5):
        add_run(store, name, {**SPEC, "name": name, "train": {**SPEC["train"], "worlds": worlds}})
        add_checkpoint(store, name, 9)
        table = store.run(name).evaluations / "00000009-e1-job.parquet"
        evaluated(
            store, name, "00000009-e1-job", sum(values) / len(values), seed=8 if name == "odd" else 7, iteration=9
        )
        columns = {"episode": list(range(len(values))), "return": values}
        pyarrow.parquet.write_table(pyarrow.table(columns), table)
    try:
        done = call_muster("compare", "fast", "sure", "odd", "-o", str(tmp_path / "curves.csv"), home=full.home)
        assert done.returncode == 2 and "so nothing can be drawn" in done.stderr
        done = call_muster("compare", "fast", "sure", "odd", home=full.home)
        # the differences are 1, 1.5, 1, 1.5: mean 1.25, s = 0.5 / sqrt(3), and t(3) = 3.182446, so that half is 0.459
        line = "sure@9 against fast@9: return +1.25 (+0.79 to +1.71, paired over 4 episodes): better"
        assert done.stdout.splitlines()[-1] == line, "other worlds are not paired"
        told = json.loads(call_muster("compare", "fast", "sure", "odd", "--json", home=full.home).stdout)
        assert [each["against"] and each["against"]["verdict"] for each in told] == [None, "better", None]
    finally:
        for name in returns:
            shutil.rmtree(store.run(name).path)


def test_the_curves_are_written_as_numbers_too(full: Serving, tmp_path: Path) -> None:
    table = tmp_path / "curves.csv"
    assert call_muster("compare", "taught", "slow", "-o", str(table), home=full.home).returncode == 0
    header, *rows = table.read_text().splitlines()
    assert header == "group,env_steps,return,std,runs" and len(rows) == 18
    assert rows[0] == "taught,100.0,10.0,0.0,1" and rows[-1] == "slow,900.0,3.0,0.0,1"


def test_compare_refuses_what_it_can_not_compare(full: Serving, tmp_path: Path) -> None:
    for options, said in (
        (["taught"], "that is one run, taught; name two or more to compare"),
        (["taught", "slwo"], "did you mean slow"),
        (["robot-*", "slow"], "no run matches robot-*"),
        (["taught", "slow", "-o", str(tmp_path / "no" / "x.png")], "is not a directory"),
        (
            ["taught", "slow", "-o", str(tmp_path / "x.xyz")],
            "unknown ending; use .png, .svg, .pdf",
        ),
        (["empty", "empty*", "of-*", "-o", str(tmp_path / "x.png")], "no run matches of-*"),
    ):
        done = call_muster("compare", *options, home=full.home)
        assert done.returncode == 2 and said in done.stderr and len(done.stderr.splitlines()) == 1, done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_race_is_a_job_of_its_own_kind_with_the_rules_that_were_given(full: Serving, tmp_path: Path) -> None:
    spec = tmp_path / "race.yaml"
    spec.write_text(
        '{"name": "final", "race": {"run": "fast-car", "trials": 5, "continuous": true, "track": ["oval"]}}'
    )
    done = call_muster("submit", str(spec), "--json", home=full.home)
    assert done.returncode == 0, done.stderr
    detail = full.detail(json.loads(done.stdout)["jobId"])
    race = detail["spec"]["race"]
    assert (race["trials"], race["continuous"], race["off_track_penalty"], race["seconds"]) == (5, True, 1.0, 1200.0)
    shown = call_muster("show", detail["id"], home=full.home).stdout
    assert "races" in shown and "fast-car" in shown


def test_copying_step_logs_replaces_no_file(full: Serving, tmp_path: Path) -> None:
    (tmp_path / "sim-trace").mkdir()
    done = call_muster("evaluate", "fast-car", "--race", "-o", str(tmp_path), home=full.home)
    assert done.returncode == 2 and "sim-trace exists; name another directory" in done.stderr
