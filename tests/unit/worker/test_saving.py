"""Asynchronous saving: order, acknowledgement, a writer that dies, fencing, and how often ``auto`` saves."""

from __future__ import annotations

import os
import select
import signal
import threading
from pathlib import Path

import pytest
import torch

from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.epoch import StaleEpoch, raise_epoch
from shared_store.volume.layout import Run, Store
from tests.support.shared_store.operations import durable_operations
from tests.support.waiting import wait_for
from worker.checkpoint_writer import Orders, save
from worker.learning import saving
from worker.learning.reporter import Beacon
from worker.learning.saving import Cadence, Saver


@pytest.fixture
def run(tmp_path: Path) -> Run:
    run = Store(tmp_path).open().run("r")
    run.create({})
    raise_epoch(run, 1)
    return run


def content(iteration: int, size: int = 1000) -> dict[str, dict[str, torch.Tensor]]:
    return {"learner.pt": {"value": torch.full((size,), float(iteration))}}


def wait_for_file(run: Run, iteration: int) -> None:
    """Until the main rank's own files are durable."""
    wait_for((run.checkpoints / f".{iteration:08}-e1.tmp" / ".rank-0.json").exists)


def test_saves_are_committed_in_order_and_verify(run: Run) -> None:
    saver = Saver(run, 1, 0, 1, keep=None)
    for iteration in range(1, 8):
        saver.save(iteration, content(iteration), {"reward": None})
    lines = saver.wait()
    assert saver.committed == "00000007-e1"
    checkpoints = list_checkpoints(run)
    assert [c.iteration for c in checkpoints] == list(range(1, 8))
    assert len(lines) <= 7 and lines[-1] == "checkpoint 00000007-e1"
    for checkpoint in checkpoints:
        checkpoint.verify()
        loaded = torch.load(checkpoint.path / "learner.pt", weights_only=True)
        assert torch.equal(loaded["value"], torch.full((1000,), float(checkpoint.iteration)))
    assert sorted(os.listdir(run.checkpoints)) == [*[c.name for c in checkpoints], "LATEST"]
    live = torch.zeros(200_000)
    saver.save(8, {"learner.pt": saver.copy({"value": live})}, {})
    live.fill_(9.0)
    saver.wait()
    loaded = torch.load(list_checkpoints(run)[-1].path / "learner.pt", weights_only=True)
    assert torch.equal(loaded["value"], torch.zeros(200_000)), "the state at its order, not at its writing"
    saver.close()


def test_a_copy_that_is_still_being_written_is_not_written_over(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second copy waits for the thread, which writes the first one into memory."""
    saver, save, goes_on = Saver(run, 1, 0, 1, keep=None), torch.save, threading.Event()
    monkeypatch.setattr(torch, "save", lambda *supplied: (goes_on.wait(), save(*supplied)))
    saver.save(1, {"learner.pt": saver.copy({"value": torch.ones(3)})}, {})
    second = threading.Thread(target=saver.copy, args=({"value": torch.zeros(3)},))
    second.start()
    second.join(0.1)
    assert second.is_alive()
    goes_on.set()
    second.join()
    assert saver.wait() == ["checkpoint 00000001-e1"]
    loaded = torch.load(list_checkpoints(run)[0].path / "learner.pt", weights_only=True)
    assert torch.equal(loaded["value"], torch.ones(3))
    saver.close()


def test_the_main_writer_commits_only_when_every_rank_is_durable(run: Run) -> None:
    main, other = Saver(run, 1, 0, 2, keep=None), Saver(run, 1, 1, 2, keep=None)
    main.save(4, content(4), {})
    wait_for_file(run, 4)
    assert main.poll() == [] and list_checkpoints(run) == []
    other.save(4, {"rank-1.pt": {"value": torch.ones(3)}}, None)
    assert main.wait() == ["checkpoint 00000004-e1"]
    assert set(list_checkpoints(run)[0].manifest["files"]) == {"learner.pt", "rank-1.pt"}
    main.save(5, content(5), {})
    main.abandon()
    assert "another rank could not write its files" in main.wait()[0]
    main.close()
    other.close()


def test_a_writer_that_dies_is_reported_and_replaced(run: Run) -> None:
    saver = Saver(run, 1, 0, 2, keep=None)  # the second rank never comes: the writer waits
    saver.save(1, content(1), {})
    wait_for_file(run, 1)
    assert saver._process is not None
    os.kill(saver._process.pid, signal.SIGKILL)
    (line,) = saver.wait()
    assert line == "warning: iteration 1 could not be saved (its writer died with code -9); training goes on"
    assert saver.failures == 1
    alone = Saver(run, 1, 0, 1, keep=None)
    alone.save(2, content(2), {})
    assert alone.wait() == ["checkpoint 00000002-e1"]
    alone.save(2, content(2), {})  # once more, as for a writer that died after the commit and before its answer
    assert alone.wait() == ["checkpoint 00000002-e1"] and alone.failures == 0
    alone.close()


def test_a_sigterm_to_every_process_of_a_node_leaves_the_writer_at_work(run: Run) -> None:
    """Slurm's way to end a job, or to tell it that it will: the last save is still to be written."""
    saver = Saver(run, 1, 0, 1, keep=None)
    saver.save(1, content(1), {})
    assert saver._process is not None
    os.kill(saver._process.pid, signal.SIGTERM)
    assert saver.wait() == ["checkpoint 00000001-e1"]
    os.kill(saver._process.pid, signal.SIGTERM)
    saver.save(2, content(2), {})
    assert saver.wait() == ["checkpoint 00000002-e1"]
    saver.close()


def test_a_stale_attempt_is_stopped_by_its_own_save(run: Run) -> None:
    saver = Saver(run, 1, 0, 1, keep=None)
    raise_epoch(run, 2)
    saver.save(3, content(3), {})
    with pytest.raises(StaleEpoch, match="now belongs to epoch 2"):
        saver.wait()
    assert list_checkpoints(run) == []


def test_a_file_is_durable_before_its_writer_tells_the_others(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    memory = os.memfd_create("snapshot")
    os.pwrite(memory, b"state", 0)
    order = {"run": str(run.path), "iteration": 1, "epoch": 1, "rank": 1, "ranks": 2, "memory": memory, "facts": None}
    seen = durable_operations(monkeypatch)
    answer = save({**order, "files": [("rank-1.pt", 0, 5)]}, Orders())
    os.close(memory)
    making = run.checkpoints / ".00000001-e1.tmp"
    assert answer["written"] == "00000001-e1" and (making / "rank-1.pt").read_bytes() == b"state"
    reported = seen.index(("rename", str(making / ".rank-1.json")))
    assert ("fsync", str(making / "rank-1.pt")) in seen[:reported]


def test_auto_saves_as_often_as_one_percent_allows() -> None:
    cadence = Cadence("auto")
    quiet = {"stall": 0.0, "iteration_seconds": 0.1}
    assert [i for i in range(1, 11) if cadence.due(i, quiet)] == [5, 10]
    slow = {"stall": 0.02, "iteration_seconds": 0.1}  # a stall of a fifth of an iteration: every 20 iterations
    due = [i for i in range(11, 61) if cadence.due(i, slow)]
    assert due == [30, 50] and cadence.every == 20
    brief = {"stall": 0.0001, "iteration_seconds": 0.1}
    due = [i for i in range(61, 101) if cadence.due(i, brief)]
    assert due == [61, 66, 71, 76, 81, 86, 91, 96] and cadence.every == 5, "after one of 10: half as many each time"
    fixed = Cadence(25)
    assert [i for i in range(1, 101) if fixed.due(i, slow)] == [25, 50, 75, 100]


def test_the_beacon_never_waits_and_survives_a_supervisor_that_is_gone() -> None:
    read, write = os.pipe2(os.O_NONBLOCK)
    beacon = Beacon({"MUSTER_PROGRESS_FD": str(write)})
    for iteration in range(20_000):
        beacon.send(iteration=iteration)
    os.close(read)
    beacon.send(iteration=1)
    beacon.send(iteration=2)
    Beacon({}).send(iteration=3)
    os.close(write)


def test_a_commit_waits_for_the_metrics_before_it_for_a_while(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    saver = Saver(run, 1, 0, 1, keep=None)
    saver.save(1, content(1), {}, after_records=True)
    wait_for_file(run, 1)
    assert saver.poll() == [] and list_checkpoints(run) == []
    saver.note_records(1)
    assert saver.wait() == ["checkpoint 00000001-e1"]
    monkeypatch.setattr(saving, "RECORDS_SECONDS", 0.2)
    saver.save(2, content(2), {}, after_records=True)
    reported = saver.wait()
    assert (
        reported[0] == "checkpoint 00000002-e1"
        and "was committed before the metrics up to it were written" in reported[1]
    )
    saver.close()


def test_a_save_does_not_wait_for_a_volume_that_hangs(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(saving, "PATIENCE", 0.3)
    saver = Saver(run, 1, 0, 2, keep=None)  # the second rank never comes: as if its volume hung
    for iteration in (1, 2, 3):
        saver.save(iteration, content(iteration), {}, wait=False)
    assert saver.is_busy and saver.failures == 1 and saver.stall > 0.1
    why = "earlier saves are still being written"
    assert saver.poll() == [f"warning: iteration 3 could not be saved ({why}); training goes on"]
    monkeypatch.setattr(
        select,
        "select",
        lambda *supplied: pytest.fail("the oldest was waited for already") if supplied[3] else ([], [], []),
    )
    saver.save(4, content(4), {}, wait=False)
    monkeypatch.undo()
    saver.abandon()
    saver.close()
