"""`muster evaluate` with real ranks: the same episodes whatever the worlds and ranks, changed worlds, leaving when asked."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow.parquet
import pytest

from shared_store.epoch import raise_epoch
from shared_store.evaluations import list_evaluations
from shared_store.layout import Run, Store
from tests.conftest import PATIENCE
from tests.support.worker.ranks import ROOT, free_port
from worker.learning.randomness import held_out_seed

TRAIN = {"task": "Cartpole", "worlds": 16, "iterations": 2, "seed": 5, "config": {"episode_seconds": 1.0}}


def start(
    store: Path, kind: str, section: dict[str, Any], job: str, rank: int = 0, ranks: int = 1, port: int = 0
) -> Any:
    """One rank of a job, as the supervisor starts it."""
    spec = {"name": kind, kind: section, "checkpoint": {"every": 1, "keep": 5}}
    given = {
        **{"MUSTER_STORE": str(store), "MUSTER_RUN": "taught" if kind == "train" else "job", "MUSTER_EPOCH": "1"},
        **{"MUSTER_JOB_EPOCH": "1", "MUSTER_JOB_ID": job, "MUSTER_SPEC": json.dumps(spec)},
        **{"RANK": str(rank), "WORLD_SIZE": str(ranks), "LOCAL_RANK": "0", "LOCAL_WORLD_SIZE": "1"},
        **{"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port or free_port()), "OMP_NUM_THREADS": str(1 + rank)},
        **{"GLOO_SOCKET_IFNAME": "lo", "CUDA_VISIBLE_DEVICES": ""},
    }
    command = [sys.executable, "-m", f"worker.{kind}"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, env={**os.environ, **given}, cwd=ROOT, **pipes)


def ended(process: Any) -> tuple[int, str]:
    """Exit code and output."""
    output, errors = process.communicate(timeout=120 * PATIENCE)
    return process.returncode, output + errors


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """A run of two checkpoints."""
    store = Store(tmp_path_factory.mktemp("store")).open()
    made = store.run("taught")
    made.create({"run": "taught", "spec": {"train": TRAIN}})
    raise_epoch(made, 1)
    code, output = ended(start(store.path, "train", TRAIN, "trained"))
    assert code == 0, output
    yield made


def evaluate(run: Run, job: str, ranks: int = 1, **section: Any) -> tuple[int, str]:
    """Exit code of the main rank, and its output."""
    port, store = free_port(), run.path.parent.parent
    section = {"run": "taught", "episodes": 40, **section}
    processes = [start(store, "evaluate", section, job, rank, ranks, port) for rank in range(ranks)]
    main, *_ = [ended(process) for process in processes]
    return main


def test_the_same_episodes_are_the_same_bytes_on_one_rank_in_two_rounds_and_on_two_ranks_in_one(run: Run) -> None:
    drawn = {"config": {"randomize": {"mass": [0.5, 2.0]}}, "worlds": 1}  # each world when it is built
    outputs = [evaluate(run, "one", **drawn), evaluate(run, "two", ranks=2, **drawn)]
    assert [code for code, _ in outputs] == [0, 0], outputs
    one, two = (run.evaluations / f"00000002-e1-{job}.parquet" for job in ("one", "two"))
    assert one.read_bytes() == two.read_bytes()
    table = pyarrow.parquet.read_table(one).to_pydict()
    assert len(table["episode"]) == 40 and set(table["seed"]) == {held_out_seed(5)}
    assert "40 episodes of Cartpole, checkpoint 00000002-e1" in outputs[0][1]
    assert "compared with the evaluation" in outputs[1][1] and "paired over 40 episodes): within noise" in outputs[1][1]


def test_changed_worlds_an_older_checkpoint_and_another_seed_are_recorded(run: Run) -> None:
    changes = {"episode_seconds": 0.5, "angle_limit": 0.3}
    code, output = evaluate(run, "changed", checkpoint=1, seed=9, episodes=33, worlds=1, config=changes)
    assert code == 0, output
    (told,) = [each for each in list_evaluations(run) if each["job"] == "changed"]
    assert (told["iteration"], told["seed"], told["config"], told["max_length"]) == (1, 9, changes, 30)
    assert told["episodes"] == 33 and told["versions"]["torch"] and "with config.episode_seconds: 0.5" in output


def test_an_evaluation_that_is_asked_to_stop_leaves_with_75_and_records_nothing(run: Run) -> None:
    before = sorted(path.name for path in run.evaluations.iterdir())
    # 100 s of simulated time: it would take long
    section = {
        "run": "taught",
        "episodes": 1000,
        "config": {"episode_seconds": 100.0, "angle_limit": 3.0, "cart_limit": 1e3},
    }
    process = start(run.path.parent.parent, "evaluate", section, "stopped")
    while not _listens(process):
        assert process.poll() is None
    process.terminate()
    code, output = ended(process)
    assert code == 75 and "nothing was recorded" in output, output
    assert sorted(path.name for path in run.evaluations.iterdir()) == before


def _listens(process: Any) -> bool:
    """Whether it catches SIGTERM already."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    caught = int(next(line for line in status.splitlines() if line.startswith("SigCgt")).split()[1], 16)
    return bool(caught >> (signal.SIGTERM - 1) & 1)


@pytest.mark.parametrize(
    ("section", "said"),
    [
        ({"episodes": 0}, "episodes: expected a whole number of at least 1, got 0"),
        (
            {"config": {"angle_limt": 1.0}},
            "evaluate.config.angle_limt: CartpoleConfig has no such key; did you mean angle_limit?",
        ),
    ],
)
def test_what_came_without_a_check_at_submission_is_refused_in_one_line(run: Run, section: Any, said: str) -> None:
    code, output = evaluate(run, "wrong", **section)
    assert code == 2 and f"error: {said}" in output and "Traceback" not in output
