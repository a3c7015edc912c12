"""Tracks in the store, which never change."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from racer.store import tracks
from racer.store.tracks import TrackError
from shared_store.volume.layout import Store


def test_a_track_is_never_changed(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    tracks.add(store, "hills", b"rows", {})
    for _ in range(2):
        with pytest.raises(TrackError, match="hills exists already, and tracks are immutable; choose another name"):
            tracks.add(store, "hills", b"others", {})
        monkeypatch.setattr(tracks, "names", lambda store: [])  # it looked before the other one was done
    monkeypatch.undo()
    assert tracks.find(store, "hills").read() == b"rows"
    assert [path.name for path in tracks.folder_in(store).iterdir()] == ["hills"], "nothing half made is left"


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden", "random:7", "x" * 129])
def test_a_name_that_can_be_no_directory_is_refused(store: Store, name: str) -> None:
    with pytest.raises(TrackError, match="use letters, digits"):
        tracks.add(store, name, b"rows", {})
    assert not tracks.folder_in(store).exists()


def test_a_track_that_was_altered_is_not_read(store: Store) -> None:
    path = tracks.add(store, "hills", b"rows", {}).path
    (path / "track.npy").chmod(0o644)
    (path / "track.npy").write_bytes(b"ROWS")
    output = r"track hills is damaged: .* track.npy was altered .*; delete .*hills and make or import it again"
    with pytest.raises(TrackError, match=output):
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
    shutil.rmtree(tracks.folder_in(store))
    os.symlink(tmp_path, tracks.folder_in(store))
    with pytest.raises(TrackError, match="links inside a run are not followed"):
        tracks.add(store, "valleys", b"rows", {})
