"""Deleting directories of the store: each is renamed into ``trash/`` first, and removed there.

Whatever dies in between, a directory is either whole in its place or in the trash, which :func:`empty` sweeps.
"""

from __future__ import annotations

import os
import shutil
import uuid
from contextlib import suppress
from pathlib import Path

from shared_store.files import refuse_links, sync_directory
from shared_store.layout import Store


def throw_away(store: Store, path: Path) -> Path | None:
    """Move a directory of the store into the trash, durably; returns where it is now, None where it was not there.

    Raises:
        DamagedFile: A directory on the way is a link, which leads out of the store.
        OSError: The volume can't be written, or is gone.
    """
    inside = path.relative_to(store.path)
    refuse_links(path, len(inside.parts))
    trash = store.path / "trash"
    refuse_links(trash, 1)
    trash.mkdir(exist_ok=True)
    thrown = trash / f"{uuid.uuid4().hex}.{path.name[:100]}"
    try:
        os.rename(path, thrown)
    except FileNotFoundError:
        return None
    for each in (path.parent, trash):
        sync_directory(each)
    return thrown


def remove(thrown: Path) -> None:
    """Remove what was thrown away; what can't be removed now, :func:`empty` tries again."""
    shutil.rmtree(thrown, ignore_errors=True)


def empty(store: Store) -> int:
    """Remove everything in the trash, such as what a killed controller has left; returns how much there was."""
    trash = store.path / "trash"
    count = 0
    if trash.is_symlink():
        return 0
    with suppress(FileNotFoundError, NotADirectoryError):
        for entry in os.scandir(trash):
            count += 1
            if entry.is_dir(follow_symlinks=False):
                remove(Path(entry.path))
            else:
                Path(entry.path).unlink(missing_ok=True)
    return count


def size_of(path: Path) -> tuple[int, int]:
    """Bytes and number of the files below a directory, links counted as themselves; what can't be read counts nothing."""
    total = count = 0
    for folder, _, names in os.walk(path):
        for name in names:
            with suppress(OSError):
                total += os.lstat(os.path.join(folder, name)).st_size
                count += 1
    return total, count
