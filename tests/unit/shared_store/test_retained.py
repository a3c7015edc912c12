"""What a run holds and what needs it; directories are thrown away whole, whatever dies in between."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from shared_store import contents, leagues, models, trash
from shared_store.bundles import seal
from shared_store.checkpoints import list_checkpoints
from shared_store.files import DamagedFile, write_json
from shared_store.layout import Run, Store
from shared_store.parent import NewRun, TeacherCopy
from shared_store.references import references
from tests.support.orchestrator.trained import add_checkpoint, add_run
from tests.support.shared_store.leagues import entry, league


def logged(store: Store, name: str, job: str = "j1") -> Run:
    """A run that a command has left."""
    add_run(store, name, None)
    run = store.run(name)
    run.logs(job, 1).mkdir(parents=True)
    run.log(job, 1, 0).write_bytes(b"line\n" * 100)
    write_json(run.outcome(job, 1, 0), {})
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
    [thrown, _] = trash.throw_away(store, [run.path, store.run("none").path, other.path])
    assert not run.path.exists() and not other.path.exists() and (thrown / "run.json").is_file()
    assert trash.throw_away(store, [run.path]) == []
    logged(store, "r2")
    assert trash.empty(store) == 2 and os.listdir(store.path / "trash") == []
    assert store.run("r2").path.is_dir() and trash.empty(store) == 0
    trash.throw_away(store, [store.run("r2").path])
    (store.path / "trash" / "stray").write_text("x")
    os.symlink(store.path / "runs", store.path / "trash" / "out")
    assert trash.empty(store) == 3 and (store.path / "runs").is_dir(), "links in the trash lead nowhere"


def test_nothing_outside_of_the_store_is_thrown_away(store: Store, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    write(outside / "logs" / "j1" / "a")
    run = logged(store, "r")
    os.rename(run.path / "logs", run.path / "kept")
    os.symlink(outside / "logs", run.path / "logs")
    with pytest.raises(DamagedFile):
        trash.throw_away(store, [run.path / "logs" / "j1"])
    with pytest.raises(ValueError):
        trash.throw_away(store, [outside])
    (store.path / "trash").rmdir()
    os.symlink(outside, store.path / "trash")
    with pytest.raises(DamagedFile):
        trash.throw_away(store, [run.path])
    assert trash.empty(store) == 0 and (outside / "logs" / "j1" / "a").is_file()


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
    cup = leagues.create(store, league())
    cup.enter(entry("racer", "key a"))
    cited = cup.entry(1)["evaluation"]
    by = "entry 1 of league cup cites it"
    assert {("run", cited["run"], by), ("job", cited["job"], by)} <= needed(store)


def test_what_can_t_be_read_is_named_since_it_may_need_any_run(store: Store) -> None:
    add_run(store, "source")
    (store.run("source").parent).mkdir()
    (store.run("source").path / "run.json").write_text("{")
    write(store.models / "ant" / "1" / "model.json", "{")
    (store.models / "bee" / "1").mkdir(parents=True)
    leagues.create(store, league())
    write(store.leagues / "cup" / "entries" / "1" / "entry.json", "[]")
    (store.leagues / "cup" / "entries" / "2").mkdir()
    found, unreadable = references(store)
    assert found == []
    for part in ("run source", "model ant@1", "model bee@1", "entry 1 of league cup", "entry 2 of league cup"):
        assert any(part in each for each in unreadable), (part, unreadable)
