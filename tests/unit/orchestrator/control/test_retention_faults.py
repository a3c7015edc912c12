"""Retention where something in the store can't be read, moved or removed, and where the store is away."""

from __future__ import annotations

import logging
import os

import pytest

from orchestrator.control.retention import RunNeeded
from tests.support.orchestrator.retention import World
from tests.support.permissions import permissions_count


def test_a_store_that_is_away_is_not_taken_for_an_empty_one(world: World) -> None:
    world.ended("old")

    def absent() -> None:
        raise OSError("the volume is not there")

    world.access.check = absent
    with pytest.raises(OSError):
        world.retention().take_all()
    assert world.jobs() == ["old"] and world.runs() == ["old"]
    os.rename(world.store.path, world.store.path.with_name("gone"))  # it vanishes between two looks
    checks = [0]

    def vanishing() -> None:
        checks[0] += 1
        if checks[0] > 3:
            raise OSError("the volume is not there")

    world.access.check = vanishing
    with pytest.raises(OSError):
        world.retention().take_all()
    assert world.jobs() == ["old"]


def test_a_run_that_can_t_be_read_or_moved_is_kept_and_stops_no_other(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("closed", "fixed", "free", "stuck"):
        world.ended(name)
    closed, fixed = world.store.run("closed").path / "logs", world.store.run("fixed").path
    closed.chmod(0)
    fixed.chmod(0o555)
    with permissions_count():
        assert "it can't be read ([Errno 13] Permission denied" in world.reasons()["closed"]
        totals = world.retention().take_all()
        assert (totals.jobs, totals.runs, totals.kept) == (2, 2, 2)
        assert world.runs() == world.jobs() == ["closed", "fixed"]
        warning = f"1 old directory can't be moved into the store's trash, such as {fixed} (Permission denied)"
        assert [each.getMessage() for each in caplog.records] == [warning]
        with pytest.raises(
            RunNeeded, match=r"run fixed is kept: it can't be moved into the store's trash \(Permission denied"
        ):
            world.retention().delete("fixed")
        assert world.runs() == ["closed", "fixed"]
        for path in (closed, fixed):
            path.chmod(0o755)
        assert world.retention().take_all().jobs == 2 and world.trashed() == []


def test_a_log_that_can_t_be_moved_keeps_its_job_alone(world: World) -> None:
    for name in ("a", "b"):
        world.ended(name, run="r")
    run = world.store.run("r")
    (run.path / "results.csv").write_text("1")
    held = run.path / "outcomes" / "a"
    held.chmod(0o555)
    with permissions_count():
        [step], _ = world.step(take=True)
        assert step["jobs"] == ["b"] and step["kept"] == [
            f"it can't be moved into the store's trash (Permission denied: {held})"
        ]
        held.chmod(0o755)
    assert world.jobs() == ["a"] and world.retention().take_all().jobs == 1 and world.jobs() == []


def test_what_stays_in_the_trash_is_named_once_a_pass(
    world: World, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    world.ended("old")
    monkeypatch.setattr("shutil.rmtree", lambda path, ignore_errors=False: None)
    deleted = world.retention().delete("old")
    [left] = world.trashed()
    assert deleted["left"].endswith(left) and deleted["bytes"] > 0
    with caplog.at_level(logging.WARNING):
        world.retention()._pass()
    assert "1 thing in the store's trash can't be removed, such as" in caplog.text and left in caplog.text
    monkeypatch.undo()
    world.retention()._pass()
    assert world.trashed() == []
