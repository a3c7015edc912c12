"""A volume that hangs, and a stop in an iteration that takes longer than a stopped job has: that iteration alone is lost."""

from __future__ import annotations

import fcntl
import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.epoch import raise_epoch
from shared_store.volume.layout import Run, Store
from tests.conftest import PATIENCE
from tests.support.waiting import wait_for
from tests.support.worker.ranks import free_port, start_rank, training
from tests.support.worker.runs import assert_same_bits, last, runner, train
from worker.learning import saving

ITERATIONS = 60
PIPE = 4096
"""Bytes that the metrics file takes before a write to it blocks: a few records."""


@contextmanager
def hanging_metrics(run: Run) -> Iterator[int]:
    """A metrics file that blocks whoever writes to it until someone reads from the descriptor: a pipe."""
    run.metrics.mkdir(parents=True)
    path = run.metrics / "metrics-e1.jsonl"
    os.mkfifo(path)
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    fcntl.fcntl(descriptor, fcntl.F_SETPIPE_SZ, PIPE)
    yield descriptor
    os.close(descriptor)


def read_all(descriptor: int, ended: threading.Event) -> list[dict[str, float]]:
    """What the reporter writes, until training has ended."""
    content = b""
    while True:
        try:
            chunk = os.read(descriptor, 65536)
        except BlockingIOError:
            chunk = None
        if chunk:
            content += chunk
        elif ended.is_set():
            return [json.loads(line) for line in content.splitlines()]
        else:
            time.sleep(0.002)


def test_training_goes_on_while_the_volume_hangs_and_what_was_written_comes_afterwards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(saving, "RECORDS_SECONDS", 3600.0)
    monkeypatch.setattr(saving, "PATIENCE", 0.2)
    run = Store(tmp_path).run("run")
    with hanging_metrics(run) as descriptor:
        loop = runner(training(tmp_path, iterations=ITERATIONS, every=5))
        ended, codes = threading.Event(), []

        def train() -> None:
            codes.append(loop.train())
            ended.set()

        threading.Thread(target=train, daemon=True).start()
        # 12 saves are due meanwhile; the records of the first of them do not fit into the pipe
        wait_for(lambda: loop.state.progress.iteration == ITERATIONS, 60, "all iterations, with a volume that hangs")
        assert not ended.is_set(), "the end of a training waits for its last checkpoint"
        records = [json.loads(line) for line in os.read(descriptor, PIPE).splitlines()]  # a line is written whole
        assert len(records) < 20, "the metrics hang"
        assert all(each.iteration <= len(records) for each in list_checkpoints(run)), "no commit before its records"
        records += read_all(descriptor, ended)
    assert codes == [0]
    reported = [each["iteration"] for each in records if "iteration" in each]
    assert reported == list(range(1, ITERATIONS + 1)), "every record came, in order"
    assert list_checkpoints(run)[-1].iteration == ITERATIONS


def train_slowly_from_the_third() -> int:
    """Body of a rank: its iterations take a second each, but the third, which takes minutes."""
    from tests.support.worker import ranks
    from tests.support.worker.point_task import Point

    step = Point.step

    def slow(self: Point, actions: object) -> None:
        import time

        time.sleep(30.0 if int(self._steps[0]) >= 16 else 0.15)
        step(self, actions)

    Point.step = slow
    return ranks.train()


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_stop_in_a_long_iteration_loses_that_iteration_alone(tmp_path: Path, ranks: int) -> None:
    env = training(tmp_path, run="stopped", iterations=6, every=100, keep=2)
    raise_epoch(Store(tmp_path).run("stopped"), 1)  # as the controller has, before it launches a gang
    body = "training.worker.test_slow_volumes_and_iterations:train_slowly_from_the_third"
    port = free_port()
    started = [start_rank(body, rank, ranks, port, {**env, "MUSTER_GRACE_SECONDS": "2"}) for rank in range(ranks)]
    outputs = stopped_after(started, 2)
    assert [rank.returncode for rank in started] == [75] * ranks, outputs
    assert "stop requested: iteration 3 did not end within 1.6 s and was left; checkpoint 00000002-e1 stands" in outputs
    (newest,) = list_checkpoints(Store(tmp_path).run("stopped"))
    assert not newest.is_scheduled, "the job asked for none before iteration 100"
    if ranks == 1:  # what goes on from it ends with the bits of a run that was never stopped
        train(training(tmp_path, run="stopped", iterations=6, epoch=2))
        train(training(tmp_path, run="straight", iterations=6))
        assert_same_bits(last(tmp_path, "straight"), last(tmp_path, "stopped"))


def stopped_after(ranks: list[subprocess.Popen[str]], iteration: int) -> str:
    """Ask all ranks to stop when the first one has reported an iteration; the first one's output."""
    try:
        assert ranks[0].stdout
        output = []
        for line in ranks[0].stdout:
            output.append(line)
            if line.startswith(f"iteration {iteration}/"):
                break
        for rank in ranks:
            os.kill(rank.pid, signal.SIGTERM)
        ends = [rank.communicate(timeout=10 * PATIENCE) for rank in ranks]
    finally:
        for rank in ranks:
            rank.kill()
    return "".join(output) + "".join(out + errors for out, errors in ends)


def test_short_iterations_are_saved_when_the_job_says_so_alone(tmp_path: Path) -> None:
    train(training(tmp_path, iterations=6, every=4))
    saved = list_checkpoints(Store(tmp_path).run("run"))
    assert [(each.iteration, each.is_scheduled) for each in saved] == [(4, True), (6, True)]


def test_saves_of_long_iterations_push_out_no_checkpoint_that_the_job_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUSTER_GRACE_SECONDS", "0.001")  # every iteration is too long
    train(training(tmp_path, iterations=9, every=3, keep=2))
    saved = list_checkpoints(Store(tmp_path).run("run"))
    best = max(saved, key=lambda each: each.manifest["score"] or -1e9).iteration
    assert [each.iteration for each in saved if each.iteration != best or each.is_scheduled] == [6, 9]
