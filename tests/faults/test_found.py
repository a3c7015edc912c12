"""What the torture has found, each as a small test."""

from __future__ import annotations

from pathlib import Path

from orchestrator.bus import Bus
from shared_store.checkpoints import CheckpointWriter, list_checkpoints
from shared_store.epoch import raise_epoch
from shared_store.layout import Store
from tests.conftest import wait_for


def test_a_commit_removes_what_a_killed_writer_left_but_not_what_comes_next(tmp_path: Path) -> None:
    """A writer that dies does not end its attempt, so nobody may start after it who would sweep."""
    run = Store(tmp_path).open().run("ant")
    run.create({"run": "ant"})
    raise_epoch(run, 2)
    for iteration, epoch in ((10, 1), (20, 2), (40, 2), (10, 3)):
        (CheckpointWriter(run, iteration, epoch).path / "rank-1.pt").write_bytes(b"half")
    (run.checkpoints / ".LATEST.0a1b2c3d.tmp").write_bytes(b"half")
    (run.checkpoints / ".00000005-e1.0a1b2c3d.trash").mkdir()
    writer = CheckpointWriter(run, 30, 2)
    (writer.path / "learner.pt").write_bytes(b"whole")
    writer.commit({}, keep=3)
    assert [checkpoint.name for checkpoint in list_checkpoints(run)] == ["00000030-e2"]
    hidden = sorted(entry.name for entry in run.checkpoints.iterdir() if entry.name.startswith("."))
    assert hidden == [".00000010-e3.tmp", ".00000040-e2.tmp"]


def test_a_node_that_an_earlier_controller_met_is_missed_by_the_next_one(tmp_path: Path) -> None:
    """A node that is frozen while the controller is started again never comes to the new router."""
    first = Bus(tmp_path)
    first.open()
    assert first.silence("job", 1, 0, met_before=True) is None, (
        "nobody can know of a router that was never there before"
    )
    port = first.endpoint
    first.close()
    second = Bus(tmp_path)
    second.open()
    try:
        assert second.endpoint == port
        assert second.silence("job", 1, 0) is None, "one that never was on the bus may be without it"
        assert not second.met("job", 1, 0)
        wait_for(lambda: (second.silence("job", 1, 0, met_before=True) or 0) > 0.1, 5, "its silence")
    finally:
        second.close()
