"""Deleting directories of the store: each is renamed into ``trash/`` first, and removed there.

Whatever dies in between, a directory is either whole in its place or in the trash, which :func:`empty` sweeps.
"""

from __future__ import annotations

import errno
import os
import shutil
import stat
import uuid
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from shared_store.volume.files import refuse_links, sync_directory
from shared_store.volume.layout import Store

_FIXED = (errno.EACCES, errno.EPERM, errno.EBUSY, errno.EXDEV)
"""Errors that say something of one directory: it may not be written, or another volume is mounted there."""


def discard(store: Store, paths: Iterable[Path]) -> tuple[list[Path], dict[Path, OSError]]:
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
            existing = trash / f"{uuid.uuid4().hex}.{path.name[:100]}"
            try:
                os.rename(path, existing)
            except FileNotFoundError:
                continue
            except OSError as error:
                if error.errno not in _FIXED:
                    raise
                kept[path] = error
            else:
                thrown.append(existing)
                changed.add(path.parent)
    finally:
        for each in changed:
            with suppress(FileNotFoundError):  # thrown away, too
                sync_directory(each)
    return thrown, kept


def remove(thrown: Path) -> bool:
    """Remove what was thrown away, and return whether nothing is left; :func:`empty` tries again."""
    with suppress(OSError, RecursionError):
        if thrown.is_symlink() or not thrown.is_dir():
            thrown.unlink()
        shutil.rmtree(thrown, ignore_errors=True)
        if thrown.exists():  # a job may have left directories that may not be written
            _open_up(thrown)
            shutil.rmtree(thrown, ignore_errors=True)
    return not os.path.lexists(thrown)


def _open_up(directory: str | Path, within: int | None = None) -> None:
    """Allow this user everything in a directory and those below, as far as that can be changed; no link is followed."""
    with suppress(OSError):
        descriptor = os.open(directory, os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=within)
        try:
            os.chmod(f"/proc/self/fd/{descriptor}", stat.S_IRWXU)
            for each in os.listdir(f"/proc/self/fd/{descriptor}"):
                _open_up(each, descriptor)
        finally:
            os.close(descriptor)


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
