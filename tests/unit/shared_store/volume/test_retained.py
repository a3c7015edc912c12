"""What a run holds and what needs it; directories are thrown away whole, whatever dies in between."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from shared_store.volume import contents, models, trash
from shared_store.volume.bundles import seal
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.files import DamagedFile, write_json
from shared_store.volume.initial_weights import NewRun, TeacherCopy
from shared_store.volume.layout import Run, Store
from shared_store.volume.references import references
from tests.support.orchestrator.trained import add_checkpoint, add_run
from tests.support.permissions import permissions_count


def logged(store: Store, name: str, job: str = "j1") -> Run:
    """A run that a command has left."""
    add_run(store, name, None)
    run = store.run(name)
    run.logs(job, 1).mkdir(parents=True)
    run.log(job, 1, 0).write_bytes(b"line\n" * 100)
    write_json(run.outcome(job, 1, 0), {}, levels=3)
    return run


def write(path: Path, text: str = "x") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


@pytest.mark.parametrize(
    ("make", "results"),
    [
        (lambda run: None, ()),
        (lambda run: run.checkpoints.mkdir(), ()),
        (lambda run: (run.path / "metrics" / "deep").mkdir(parents=True), ()),
        (lambda run: write(run.texts / "abc"), ()),
        (lambda run: write(run.path / "EPOCH.12"), ()),
        (lambda run: write(run.path / "results.csv"), ("results.csv",)),
        (lambda run: write(run.path / "out" / "deep" / "a"), ("out",)),
        (lambda run: write(run.path / ".hidden"), (".hidden",)),
        (lambda run: write(run.path / "logs" / "mine.txt"), ("logs/mine.txt",)),
        (lambda run: write(run.checkpoints / "00000001-e1" / "manifest.json"), ("checkpoints",)),
        (lambda run: os.symlink("/", run.path / "link"), ("link",)),
    ],
)
def test_everything_but_muster_s_records_and_logs_is_a_result(
    store: Store, make: Callable[[Run], object], results: tuple[str, ...]
) -> None:
    run = logged(store, "r")
    make(run)
    found = contents.contents(run)
    assert found.results == results and found.logged == {"j1"}
    assert found.epoch == (12 if (run.path / "EPOCH.12").exists() else 0)


def test_a_run_that_is_a_link_or_is_missing_is_not_looked_into(store: Store) -> None:
    with pytest.raises(FileNotFoundError):
        contents.contents(store.run("none"))
    logged(store, "r")
    os.symlink(store.run("r").path, store.run("linked").path)
    with pytest.raises(DamagedFile):
        contents.contents(store.run("linked"))
    os.rename(store.run("r").path / "logs", store.path / "elsewhere")
    os.symlink(store.path / "elsewhere", store.run("r").path / "logs")
    with pytest.raises(DamagedFile, match="links inside a run are not followed"):
        contents.contents(store.run("r"))


def test_an_archived_run_says_by_whom_and_damage_counts_as_archived(store: Store) -> None:
    run = logged(store, "r")
    assert contents.archived(run) is None and not contents.is_archived(run)
    contents.archive(run, "key a")
    assert (contents.archived(run) or {})["by"] == "key a" and contents.is_archived(run)
    assert contents.contents(run).results == ()
    (run.path / contents.ARCHIVED).write_text("{")
    assert contents.archived(run) == {}
    contents.unarchive(run)
    assert contents.archived(run) is None
    with pytest.raises(OSError):
        contents.archive(store.run("none"), "key a")
    assert not store.run("none").path.exists()


def test_a_directory_is_moved_whole_and_what_a_killed_controller_left_is_swept(store: Store) -> None:
    run = logged(store, "r")
    assert trash.size_of(run.path)[1] == 3
    other = logged(store, "other")
    [thrown, _], _ = trash.discard(store, [run.path, store.run("none").path, other.path])
    assert not run.path.exists() and not other.path.exists() and (thrown / "run.json").is_file()
    assert trash.discard(store, [run.path]) == ([], {})
    logged(store, "r2")
    assert trash.empty(store) == [] and os.listdir(store.path / "trash") == []
    assert store.run("r2").path.is_dir() and trash.empty(store) == []
    trash.discard(store, [store.run("r2").path])
    (store.path / "trash" / "stray").write_text("x")
    os.symlink(store.path / "runs", store.path / "trash" / "out")
    assert trash.empty(store) == [] and (store.path / "runs").is_dir(), "links in the trash lead nowhere"
    assert os.listdir(store.path / "trash") == []


def test_directories_that_may_not_be_written_are_kept_where_they_are_and_removed_in_the_trash(store: Store) -> None:
    fixed, open_ = logged(store, "fixed"), logged(store, "open")
    deep = open_.path / "out" / "deep"
    write(deep / "file")
    os.symlink(fixed.path, deep / "link")
    deep.chmod(0)
    deep.parent.chmod(0o555)
    fixed.path.chmod(0o555)
    with permissions_count():
        thrown, kept = trash.discard(store, [fixed.path, open_.path])
        assert list(kept) == [fixed.path] and fixed.path.is_dir() and len(thrown) == 1
        assert trash.remove(thrown[0]) and trash.empty(store) == []
        assert os.stat(fixed.path).st_mode & 0o777 == 0o555, "a link is removed, not followed"


def test_nothing_outside_of_the_store_is_thrown_away(store: Store, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    write(outside / "logs" / "j1" / "a")
    run = logged(store, "r")
    os.rename(run.path / "logs", run.path / "kept")
    os.symlink(outside / "logs", run.path / "logs")
    with pytest.raises(DamagedFile):
        trash.discard(store, [run.path / "logs" / "j1"])
    with pytest.raises(ValueError):
        trash.discard(store, [outside])
    (store.path / "trash").rmdir()
    os.symlink(outside, store.path / "trash")
    with pytest.raises(DamagedFile):
        trash.discard(store, [run.path])
    assert trash.empty(store) == [] and (outside / "logs" / "j1" / "a").is_file()


def needed(store: Store) -> set[tuple[str, str, str]]:
    found, unreadable = references(store)
    assert unreadable == []
    return {(each.kind, each.name, each.by) for each in found}


def test_clones_pupils_models_and_entries_need_their_runs(store: Store) -> None:
    assert needed(store) == set()
    add_run(store, "source")
    weights = add_checkpoint(store, "source", 3)
    with NewRun(store, "me", "source", weights) as clone:
        clone.copy()
        heir = clone.publish("heir", {"run": "heir"})
    assert needed(store) == {("run", "source", "run heir is a clone of it")}
    add_run(store, "pupil")
    with TeacherCopy(store, "me", "heir", weights) as copy:
        copy.copy("teacher")
        copy.publish(store.run("pupil").path)
    assert ("run", "heir", "it is the teacher of run pupil") in needed(store)
    checkpoint = add_checkpoint(store, "heir", 5)
    bundle = heir.exports / checkpoint.name
    write(bundle / "policy.onnx")
    seal(bundle, {})
    models.register(store, "ant", heir, list_checkpoints(heir)[-1], {})
    assert {("run", "heir", "model ant@1 is of it"), ("run", "source", "model ant@1 began with its weights")} <= needed(
        store
    )


def test_one_thing_that_can_t_be_read_hides_no_other(store: Store) -> None:
    for name in ("source", "child", "pupil", "hidden"):
        add_run(store, name)
    for name in ("child", "hidden"):
        store.run(name).parent.mkdir()
        write_json(store.run(name).path / "run.json", {"run": name, "parent": {"run": "source"}})
    write(store.run("pupil").path / "teachers" / "source" / "weights")
    for name in ("ant", "bee"):
        write_json(store.models / name / "1" / "model.json", {"run": "source"}, levels=3)
    closed = (
        store.models / "ant",
        store.run("hidden").path,
        store.run("pupil").path / "teachers",
    )
    for path in closed:
        path.chmod(0)
    with permissions_count():
        found, unreadable = references(store)
        (store.path / "models").chmod(0)
        assert any(each.why.startswith("models can't be read") for each in references(store)[1])
    for path in (*closed, store.models):
        path.chmod(0o755)
    assert {each.by for each in found} == {"run child is a clone of it", "model bee@1 is of it"}
    for part in ("model ant", "run hidden", "run pupil"):
        assert any(each.why.startswith(f"{part} can't be read ([Errno 13]") for each in unreadable), (part, unreadable)


def noted(store: Store, folders: object) -> None:
    write_json(store.path / "plugins.json", {"absent": folders})


def test_folders_of_a_plug_in_that_is_not_installed_may_need_any_run_and_any_job(store: Store) -> None:
    noted(store, ["cards", "decks"])
    assert references(store) == ([], []), "there are none"
    (store.path / "cards").mkdir()
    words = f"what its folder {store.path / 'cards'} needs can't be known; install the package that brings it, or move the folder out"
    [unreadable] = references(store)[1]
    assert unreadable.whole and unreadable.why == f"plug-in 'absent' is not installed, so {words} of the store"
    write(store.path / "decks" / "1.json")
    [unreadable] = references(store)[1]
    assert f"its folders {store.path / 'cards'} and {store.path / 'decks'} need" in unreadable.why


@pytest.mark.parametrize("folders", [3, [3], "cards", {"cards": 1}, None, ["../x"], ["/"], [""]])
def test_a_note_of_folders_that_is_not_one_may_need_any_run_and_any_job(store: Store, folders: object) -> None:
    noted(store, folders)
    [unreadable] = references(store)[1]
    assert unreadable.whole and "plugins.json: 'absent': expected a list of names of folders" in unreadable.why
