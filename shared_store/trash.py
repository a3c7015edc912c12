"""Deleting directories of the store: each is renamed into ``trash/`` first, and removed there.

Whatever dies in between, a directory is either whole in its place or in the trash, which :func:`empty` sweeps.
"""

from __future__ import annotations

import os
import shutil
import stat
import uuid
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from shared_store.files import refuse_links, sync_directory
from shared_store.layout import Store


def throw_away(store: Store, paths: Iterable[Path]) -> tuple[list[Path], dict[Path, OSError]]:
    """Move directories of the store into the trash, durably.

    Args:
        store: The shared volume.
        paths: Of the directories. Each is moved before the next one is asked for, so that an iterator may look at it right before.

    Returns:
        Where those are now that were there, and why others could not be moved.

    Raises:
        DamagedFile: A directory on the way is a link, which leads out of the store.
        OSError: The trash can't be used, or the volume is gone.

    After an error, some of the directories may be in the trash.
    """
    trash = store.path / "trash"
    refuse_links(trash, 1)
    trash.mkdir(exist_ok=True)
    thrown, kept, changed = list[Path](), dict[Path, OSError](), {trash}
    try:
        for path in paths:
            refuse_links(path, len(path.relative_to(store.path).parts))
            there = trash / f"{uuid.uuid4().hex}.{path.name[:100]}"
            try:
                os.rename(path, there)
            except FileNotFoundError:
                continue
            except OSError as error:  # a directory that may not be written can't be moved
                kept[path] = error
            else:
                thrown.append(there)
                changed.add(path.parent)
    finally:
        for each in changed:
            with suppress(FileNotFoundError):  # thrown away, too
                sync_directory(each)
    return thrown, kept


def remove(thrown: Path) -> bool:
    """Remove what was thrown away, and return whether nothing is left; :func:`empty` tries again."""
    with suppress(OSError):
        if thrown.is_symlink() or not thrown.is_dir():
            thrown.unlink()
        shutil.rmtree(thrown, ignore_errors=True)
        if thrown.exists():  # a job may have left directories that may not be written
            thrown.chmod(stat.S_IRWXU)
            for folder, names, _ in os.walk(thrown):
                for path in (os.path.join(folder, name) for name in names):
                    if not os.path.islink(path):
                        os.chmod(path, stat.S_IRWXU)
            shutil.rmtree(thrown)
    return not os.path.lexists(thrown)


def empty(store: Store) -> list[Path]:
    """Remove everything in the trash, such as what a killed controller has left; returns what could not be removed. Raises OSError."""
    trash = store.path / "trash"
    if trash.is_symlink() or not trash.is_dir():
        return []
    return [path for path in map(Path, sorted(entry.path for entry in os.scandir(trash))) if not remove(path)]


def size_of(path: Path) -> tuple[int, int]:
    """Bytes and number of the files below a directory, links counted as themselves; what can't be read counts nothing."""
    total = count = 0
    for folder, _, names in os.walk(path):
        for name in names:
            with suppress(OSError):
                total += os.lstat(os.path.join(folder, name)).st_size
                count += 1
    return total, count
