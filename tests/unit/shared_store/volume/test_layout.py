"""Where things lie on the shared volume, what may be used as one, and its tracks, which never change."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest

from racer.store import tracks
from racer.store.tracks import TrackError
from shared_store.volume.layout import FORMAT, Store, StoreError


def test_a_new_store_is_made_where_there_was_nothing_and_opened_again_unchanged(tmp_path: Path) -> None:
    store = Store(tmp_path / "a" / "store").open()
    described = json.loads((store.path / "store.json").read_text())
    assert described == {"format": FORMAT, "id": store.identity()} and len(described["id"]) == 32
    assert os.listdir(store.path / "runs") == []
    store.run("ant").create({"seed": 1})
    assert [run.name for run in Store(store.path).open().runs()] == ["ant"]
    assert json.loads((store.path / "store.json").read_text()) == described


NOT_A_STORE = {
    f'{{"format": {FORMAT + 1}}}': f"has format {FORMAT + 1}, this Muster reads up to {FORMAT}; upgrade Muster",
    **dict.fromkeys(("", "{", "[]"), "store.json is damaged"),
}


@pytest.mark.parametrize("content", NOT_A_STORE)
def test_a_store_of_a_newer_format_or_a_damaged_one_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "store.json").write_text(content)
    with pytest.raises(StoreError) as caught:
        Store(tmp_path).open()
    assert str(caught.value).startswith(f"store {tmp_path}: {NOT_A_STORE[content]}")


def test_a_path_becomes_absolute_or_is_named_with_the_reason_why_it_can_be_no_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    path = tmp_path / "file" / "store"
    with pytest.raises(StoreError) as caught:
        Store(path).open()
    assert (
        str(caught.value)
        == f"store {path}: not writable (Not a directory); see whether its volume is mounted, or choose another with --store"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/somebody")
    assert Store("store").path == tmp_path / "store"
    assert Store("~/store").path == Path("/home/somebody/store")


@pytest.mark.parametrize("name", ["", ".", "..", ".hidden", "-x", "a/b", "../a", "a b", "ä", "a\n", "x" * 129])
def test_a_run_has_the_name_of_a_directory_and_can_not_leave_the_store_by_it(tmp_path: Path, name: str) -> None:
    for good in ("ant", "a", "0", "Ant_v2.1-b", "x" * 128):
        assert Store(tmp_path).run(good).path == tmp_path / "runs" / good
    with pytest.raises(StoreError, match="use letters, digits"):
        Store(tmp_path).run(name)


def test_everything_of_a_run_lies_where_the_design_says(tmp_path: Path) -> None:
    run = Store(tmp_path).run("ant")
    base = tmp_path / "runs" / "ant"
    assert run.checkpoints == base / "checkpoints"
    assert run.metrics == base / "metrics"
    assert run.evaluations == base / "evaluations"
    assert run.exports == base / "exports"
    assert run.log("job", 2, 1) == base / "logs" / "job" / "2" / "node-1.log"
    assert run.outcome("job", 2, 1) == base / "outcomes" / "job" / "2" / "node-1.json"
    assert list(tmp_path.iterdir()) == [], "asking for a path creates nothing"


def test_runs_keep_their_descriptions_and_are_listed_by_name_only_if_they_were_created(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert store.runs() == [] and store.run("a").description() is None
    for name in ("b", "a"):
        for seed in (1, 2):
            store.run(name).create({"seed": seed})
        assert store.run(name).description() == {"seed": 1}
    (tmp_path / "runs" / "empty").mkdir()
    (tmp_path / "runs" / ".probe-1").write_text("")
    assert [run.name for run in store.runs()] == ["a", "b"]


def test_a_track_is_kept_with_its_measures(store: Store) -> None:
    assert tracks.names(store) == []
    kept = tracks.add(store, "hills", b"rows", {"length": 40.0, "origin": {"seed": 7}})
    assert (kept.name, kept.path, tracks.names(store)) == ("hills", store.path / "tracks" / "hills", ["hills"])
    found = tracks.find(store, "hills")
    facts = found.facts()
    assert (facts["name"], facts["length"], facts["origin"]) == ("hills", 40.0, {"seed": 7}) and facts["created"] > 0
    assert found.read() == b"rows"
    assert all(file.stat().st_mode & 0o222 == 0 for file in kept.path.iterdir()), "nothing of it may be written"


def test_a_track_is_never_changed(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    tracks.add(store, "hills", b"rows", {})
    for _ in range(2):
        with pytest.raises(TrackError, match="hills exists already, and tracks are immutable; choose another name"):
            tracks.add(store, "hills", b"others", {})
        monkeypatch.setattr(tracks, "names", lambda store: [])  # it looked before the other one was done
    monkeypatch.undo()
    assert tracks.find(store, "hills").read() == b"rows"
    assert [path.name for path in store.tracks.iterdir()] == ["hills"], "nothing half made is left"


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden", "random:7", "x" * 129])
def test_a_name_that_can_be_no_directory_is_refused(store: Store, name: str) -> None:
    with pytest.raises(TrackError, match="use letters, digits"):
        tracks.add(store, name, b"rows", {})
    assert not store.tracks.exists()


def test_an_unknown_track_is_reported_with_the_nearest_name(store: Store) -> None:
    with pytest.raises(TrackError, match="track hils does not exist; none is kept yet"):
        tracks.find(store, "hils")
    tracks.add(store, "hills", b"rows", {})
    with pytest.raises(TrackError, match=r"track hils does not exist; did you mean hills\?"):
        tracks.find(store, "hils")


def test_a_track_that_was_altered_is_not_read(store: Store) -> None:
    path = tracks.add(store, "hills", b"rows", {}).path
    (path / "track.npy").chmod(0o644)
    (path / "track.npy").write_bytes(b"ROWS")
    said = r"track hills is damaged: .* track.npy was altered .*; delete .*hills and make or import it again"
    with pytest.raises(TrackError, match=said):
        tracks.find(store, "hills").read()
    (path / "manifest.json").unlink()
    with pytest.raises(TrackError, match=r"track hills is damaged: .* manifest.json is missing"):
        tracks.find(store, "hills").facts()


def test_links_out_of_the_store_are_not_followed(store: Store, tmp_path: Path) -> None:
    path = tracks.add(store, "hills", b"rows", {}).path
    shutil.move(path, tmp_path / "elsewhere")
    os.symlink(tmp_path / "elsewhere", path)
    for read in (tracks.StoredTrack(path).read, tracks.StoredTrack(path).facts):
        with pytest.raises(TrackError, match="links inside a run are not followed"):
            read()
    shutil.rmtree(store.tracks)
    os.symlink(tmp_path, store.tracks)
    with pytest.raises(TrackError, match="links inside a run are not followed"):
        tracks.add(store, "valleys", b"rows", {})
