"""The weights that a clone holds: copied whole and proven, published by one rename, taken back where it comes to nothing."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from shared_store.volume.checkpoints import Checkpoint, DamagedCheckpoint, list_checkpoints, retain
from shared_store.volume.files import DamagedFile
from shared_store.volume.initial_weights import NewRun, RunExists, TeacherCopy, parent_checkpoint
from shared_store.volume.layout import Run, Store
from tests.support.orchestrator.trained import add_checkpoint, add_run


@pytest.fixture
def store(tmp_path: Path) -> Store:
    store = Store(tmp_path / "store").open()
    add_run(store, "source")
    add_checkpoint(store, "source", 3, b"weights" * 1000, score=2.0, score_error=0.5, env_steps=96, task="x" * 200_000)
    return store


def new(store: Store, source: Checkpoint | None = None) -> NewRun:
    return NewRun(store, "me", "source", source or list_checkpoints(store.run("source"))[-1])


def heir(store: Store) -> Run:
    """A clone of the source that is published."""
    making = new(store)
    making.copy()
    return making.publish("heir", {"run": "heir"})


def names(store: Store) -> list[str]:
    return sorted(os.listdir(store.path / "runs"))


def test_the_new_run_has_only_the_weights_and_its_lineage_and_keeps_what_retention_deletes(store: Store) -> None:
    making = new(store)
    making.copy()
    assert len(names(store)) == 2 and not store.run("heir").path.exists(), "nobody sees half of it"
    assert [run.name for run in store.runs()] == ["source"]
    run = making.publish("heir", {"run": "heir", "spec": None, "created": 5})
    making.close()
    assert names(store) == ["heir", "source"]
    parent = parent_checkpoint(run)
    assert parent is not None and sorted(os.listdir(parent.path)) == ["learner.pt", "manifest.json"]
    assert (parent.path / "learner.pt").read_bytes() == b"weights" * 1000 and parent.iteration == 3
    description = run.description()
    assert description is not None
    lineage: dict[str, Any] = {"run": "source", "checkpoint": "00000003-e1", "iteration": 3}
    assert description["parent"] == {**lineage, "score": 2.0, "score_error": 0.5, "env_steps": 96}
    assert parent_checkpoint(store.run("source")) is None
    for iteration in (4, 5, 6):
        add_checkpoint(store, "source", iteration, score=9.0)
    assert "00000003-e1" in retain(store.run("source"), 2)
    parent = parent_checkpoint(run)
    assert parent is not None and parent.path.is_dir()


HARMS: dict[str, Callable[[Path], Any]] = {
    "is missing": Path.unlink,
    "has 1 bytes": lambda path: path.write_bytes(b"w"),
    "not a regular file": lambda path: (path.rename(path.with_name("elsewhere")), path.symlink_to("elsewhere")),
    "was altered": lambda path: path.write_bytes(b"WEIGHTS" * 1000),
}


@pytest.mark.parametrize("message", HARMS)
def test_damage_is_found_before_the_copy_and_before_the_use(store: Store, message: str) -> None:
    source, run = list_checkpoints(store.run("source"))[-1], heir(store)
    HARMS[message](run.parent / source.name / "learner.pt")
    with pytest.raises(DamagedCheckpoint, match=message):
        parent_checkpoint(run)
    making = new(store)
    HARMS[message](source.path / "learner.pt")
    with pytest.raises(DamagedCheckpoint, match=f"00000003-e1: .*learner.pt .*{message}|learner.pt was altered"):
        making.copy()
    making.discard()
    assert names(store) == ["heir", "source"]


def test_a_name_that_is_taken_is_never_written_over_and_a_published_run_can_be_taken_back(store: Store) -> None:
    making = new(store)
    making.copy()
    with pytest.raises(RunExists):
        making.publish("source", {"run": "source"})
    making.discard()
    assert names(store) == ["source"] and list_checkpoints(store.run("source"))
    making = new(store)
    making.copy()
    making.publish("heir", {"run": "heir"})
    making.discard()
    assert names(store) == ["source"]


def test_a_lineage_that_leads_elsewhere_is_refused(store: Store) -> None:
    run = heir(store)
    text = (run.path / "run.json").read_text()
    (run.path / "run.json").write_text(text.replace("00000003-e1", "../../source/checkpoints/00000003-e1"))
    with pytest.raises(DamagedCheckpoint, match=r"run\.json names no checkpoint as its parent"):
        parent_checkpoint(run)
    (run.path / "run.json").write_text(text)
    shutil.rmtree(run.parent)
    run.parent.symlink_to(store.run("source").checkpoints)
    with pytest.raises(DamagedFile, match="a link"):
        parent_checkpoint(run)


# -- the teacher ------------------------------------------------------------------------------------------------------


def copy_of_teacher(store: Store) -> TeacherCopy:
    copy = TeacherCopy(store, "me", "source", list_checkpoints(store.run("source"))[-1])
    copy.copy("teacher")
    return copy


def test_a_run_holds_its_teacher_before_it_exists_and_after_the_teacher_s_run_is_gone(store: Store) -> None:
    pupil = store.run("pupil")
    copy = copy_of_teacher(store)
    assert len(names(store)) == 2 and not pupil.path.exists()
    copy.publish(pupil.path)
    copy.close()
    assert names(store) == ["pupil", "source"] and pupil.is_missing() and pupil not in store.runs()
    shutil.rmtree(store.run("source").path)
    (held,) = list_checkpoints(pupil.teacher("source"))
    held.verify()
    assert held.iteration == 3 and (held.path / "learner.pt").read_bytes() == b"weights" * 1000
    assert sorted(os.listdir(held.path)) == ["learner.pt", "manifest.json"]
    pupil.create({"run": "pupil"})
    assert pupil.description() == {"run": "pupil"}


def test_a_copy_of_a_teacher_is_in_the_run_or_leaves_nothing(store: Store) -> None:
    copy = copy_of_teacher(store)
    copy.discard()
    published = copy_of_teacher(store)
    published.publish(store.run("pupil").path)
    published.publish(store.run("pupil").path)
    published.discard()
    assert names(store) == ["source"]
    (store.run("pupil").path / "logs").mkdir(parents=True)
    another = copy_of_teacher(store)
    another.publish(store.run("pupil").path)
    another.discard()
    assert os.listdir(store.run("pupil").path) == ["logs"]


def test_a_link_among_the_teachers_is_refused(store: Store) -> None:
    pupil = store.run("pupil")
    pupil.path.mkdir()
    (pupil.path / "teachers").symlink_to(store.run("source").path)
    with pytest.raises(DamagedFile, match="a link"):
        pupil.check_links()
