"""Deleting directories of the store: each is renamed into ``trash/`` first, and removed there.

Whatever dies in between, a directory is either whole in its place or in the trash, which :func:`empty` sweeps.
"""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from shared_store.files import refuse_links, sync_directory
from shared_store.layout import Store


def throw_away(store: Store, paths: Iterable[Path]) -> list[Path]:
    """Move directories of the store into the trash, durably; returns where those are now that were there.

    Args:
        store: The shared volume.
        paths: Of the directories. Each is moved before the next one is asked for, so that an iterator may look at it right before.

    Raises:
        DamagedFile: A directory on the way is a link, which leads out of the store.
        OSError: The volume can't be written, or is gone.

    After an error, some of the directories may be in the trash.
    """
    trash = store.path / "trash"
    refuse_links(trash, 1)
    trash.mkdir(exist_ok=True)
    thrown, changed = [], {trash}
    try:
        for path in paths:
            refuse_links(path, len(path.relative_to(store.path).parts))
            there = trash / f"{uuid.uuid4().hex}.{path.name[:100]}"
            with suppress(FileNotFoundError):
                os.rename(path, there)
                thrown.append(there)
                changed.add(path.parent)
    finally:
        for each in changed:
            with suppress(FileNotFoundError):  # thrown away, too
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
