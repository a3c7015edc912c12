"""A volume that hangs: training goes on, and what was to be written comes afterwards."""

from __future__ import annotations

import fcntl
import json
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from shared_store.checkpoints import list_checkpoints
from shared_store.layout import Run, Store
from tests.support.waiting import wait_for
from tests.support.worker.ranks import training
from tests.support.worker.runs import runner
from worker.learning import saving

ITERATIONS = 60
PIPE = 4096
"""Bytes that the metrics file takes before a write to it blocks: a few records."""


@contextmanager
def hanging_metrics(run: Run) -> Iterator[int]:
    """A metrics file that blocks whoever writes to it until somebody reads from the descriptor: a pipe."""
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
    told = [each["iteration"] for each in records if "iteration" in each]
    assert told == list(range(1, ITERATIONS + 1)), "every record came, in order"
    assert list_checkpoints(run)[-1].iteration == ITERATIONS
