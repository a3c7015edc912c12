"""Retention and others at the same time: whoever begins to need a run, or to write it, keeps it, and what is taken nobody begins to use."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

from orchestrator.control.peers import Peers
from orchestrator.control.retention import Retention, RunNeeded
from orchestrator.control.run_users import RunInUse
from orchestrator.persistence.batch_models import Dependency
from shared_store.volume import contents, epoch, trash
from shared_store.volume.epoch import Claim
from shared_store.volume.layout import Run, Store
from tests.support.orchestrator.retention import World
from tests.support.orchestrator.rows import job


def test_a_run_that_a_request_uses_is_not_taken_and_one_that_is_taken_is_not_used(world: World) -> None:
    world.ended("old")
    with world.users.using("old"):
        assert world.retention().take_all().jobs == 0
        with pytest.raises(RunNeeded, match="used by another request"):
            world.retention().delete("old")
    version = world.users.version("old")
    with world.retention().alone("old"):
        with pytest.raises(RunInUse), world.users.using("old"):
            pass
        with pytest.raises(RunInUse):
            world.users.check("old")
        assert world.retention().take_all().jobs == 0
    assert world.users.version("old") != version, "what was read before counts no more"
    world.users.check("old")
    world.beginning["old"] = object()
    assert world.retention().take_all().jobs == 0
    del world.beginning["old"]
    assert world.retention().take_all().jobs == 1


def test_a_job_that_is_submitted_between_look_and_take_keeps_its_run(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.ended("old")
    world.ended("other")
    take = Retention._take

    def late(self: Retention, runs: Any) -> Any:
        assert sorted(runs) == ["old", "other"]
        world.add(job("resumes", run="old", status="RUNNABLE"))
        return take(self, runs)

    monkeypatch.setattr(Retention, "_take", late)
    world.retention().take_all()
    assert world.jobs() == ["old", "resumes"] and world.runs() == ["old"]


def test_a_job_that_begins_to_wait_for_one_that_is_being_taken_keeps_its_row(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.ended("old")
    throw = trash.discard

    def late(store: Store, paths: Iterable[Path]) -> list[Path]:
        world.add(job("waits", status="PENDING"), Dependency(job_id="waits", on_id="old"))
        return throw(store, paths)

    monkeypatch.setattr(trash, "discard", late)
    world.retention().take_all()
    assert world.jobs() == ["old", "waits"]


def at_the_last_moment(monkeypatch: pytest.MonkeyPatch, body: Callable[[], object]) -> None:
    """Do this after everything was looked at, and before the first directory is moved."""
    throw, calls = trash.discard, [body]

    def late(store: Store, paths: Iterable[Path]) -> list[Path]:
        if calls:
            calls.pop()()
        return throw(store, paths)

    monkeypatch.setattr(trash, "discard", late)


CLAIM = Claim("another-controller", "theirs", 1)


@pytest.mark.parametrize(
    "begin",
    [
        lambda run: epoch.take_epoch(run, epoch.read_epoch(run), CLAIM),
        lambda run: (run.path / "EPOCH.1").write_text("{}"),  # claimed, and not yet published
        lambda run: (run.path / "results.csv").write_text("1"),
        lambda run: contents.archive(run, "key of another controller"),
    ],
    ids=["an attempt", "a claim", "a result", "archived"],
)
@pytest.mark.parametrize("keeps_results", [False, True])
def test_a_run_that_another_controller_begins_to_use_at_the_last_moment_stays_with_its_rows(
    world: World, monkeypatch: pytest.MonkeyPatch, begin: Callable[[Run], object], keeps_results: bool
) -> None:
    world.ended("old")
    world.ended("other")
    run = world.store.run("old")
    if keeps_results:  # then only logs and outcomes would go
        (run.path / "kept.csv").write_text("1")
    at_the_last_moment(monkeypatch, lambda: begin(run))
    assert [each for each in world.step(take=True)[0] if each["run"] == "old"] == [
        {"run": "old", "whole": False, "jobs": [], "bytes": 0, "files": 0, "kept": ["it has just changed"]}
    ]
    assert world.jobs() == ["old"] and world.runs() == ["old"]
    assert run.log("old", 1, 0).is_file() and run.outcome("old", 1, 0).is_file()


def test_a_controller_that_comes_back_to_its_attempt_at_the_last_moment_keeps_the_run(
    world: World, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Its claim is older than the look, and its heartbeat newer."""
    world.ended("old")
    peer = Peers(world.store, tmp_path / "peer")
    epoch.take_epoch(world.store.run("old"), 0, Claim(peer.id, "theirs", 1))
    at_the_last_moment(monkeypatch, peer.start)
    try:
        assert world.retention().take_all().jobs == 0
    finally:
        peer.close()
    assert world.jobs() == ["old"] and world.runs() == ["old"]


def test_a_run_that_comes_to_be_while_the_rows_of_its_name_go_keeps_its_owner(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.ended("old", directory=False)
    before = world.rows()
    run = world.store.run("old")
    at_the_last_moment(monkeypatch, lambda: epoch.take_epoch(run, 0, CLAIM))
    world.retention().take_all()
    assert world.rows() == before and run.path.is_dir()


def test_a_run_that_changes_while_a_person_has_it_deleted_stays(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    world.ended("old")
    size, run = trash.size_of, world.store.run("old")

    def late(path: Path) -> tuple[int, int]:
        epoch.take_epoch(run, 0, CLAIM)
        return size(path)

    monkeypatch.setattr(trash, "size_of", late)
    with pytest.raises(RunNeeded, match="run old has just changed, and nothing of it is deleted; try again"):
        world.retention().delete("old")
    assert world.runs() == ["old"] and run.log("old", 1, 0).is_file()
