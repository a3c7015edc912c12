"""Files that are written atomically: after any crash, a reader sees either the old content or the new one.

The rules also hold on NFS and EFS: new content goes under a hidden name in the same directory, is fsynced and closed (NFS reports a
full disk at the close), is renamed, and the directory is fsynced.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import re
import shutil
import stat
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BufferedRandom, BufferedReader
from pathlib import Path
from typing import Any

MANIFEST = "manifest.json"
"""Of an immutable directory: its ``files`` have the size and the SHA-256 of each of the others."""
LARGEST_JSON = 16 << 20
"""Bytes of a JSON file; Muster writes no larger one."""
DEEPEST_JSON = 100
"""Levels of lists and objects in a JSON file."""
LONGEST_WHOLE = 1000
"""Bits of a whole number in a JSON file."""
EVERY_LEVEL = 1 << 20
"""For a file outside the store: all directories above it are made that are missing."""
_INSIDE = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


class DamagedFile(ValueError):
    """A file of the store can't be used; the message names the file and the error in one line."""


def sync_file(path: Path, flags: int = os.O_RDONLY) -> None:
    """Make the content of ``path`` durable. Raises OSError (ENOSPC, EIO) if the volume could not keep it."""
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_directory(path: Path) -> None:
    """Make the names in directory ``path`` durable."""
    sync_file(path, os.O_RDONLY | os.O_DIRECTORY)


def make_directory(path: Path, levels: int = 1) -> None:
    """Make directory ``path`` where it is missing, and up to ``levels - 1`` of those above it.

    What is above them must exist: where a volume is gone, it would be made in the mount point, and vanish when the volume is back.
    Raises OSError, FileNotFoundError where more is missing.
    """
    try:
        path.mkdir(exist_ok=True)
    except FileNotFoundError:
        if levels <= 1:
            raise
        make_directory(path.parent, levels - 1)
        path.mkdir(exist_ok=True)


def write_atomic(path: Path, data: bytes, mode: int = 0o666, *, levels: int = 1) -> None:
    """Replace ``path`` with ``data`` atomically. Raises OSError; a failed write leaves no file behind.

    Args:
        path: The file.
        data: Its content.
        mode: Permissions, less the umask, from the first instant; 0o600 for secrets.
        levels: Directories above the file that are made where they are missing, as :func:`make_directory` does; 0: none.
    """
    if levels:
        make_directory(path.parent, levels)
    hidden = path.parent / f".{path.name}.{uuid.uuid4().hex[:8]}.tmp"
    try:
        with open(hidden, "wb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(hidden, path)
    except OSError:
        hidden.unlink(missing_ok=True)
        raise
    sync_directory(path.parent)


def write_json(path: Path, value: Mapping[str, Any], mode: int = 0o666, *, levels: int = 1) -> None:
    """:func:`write_atomic` for a JSON document."""
    write_atomic(path, json_bytes(value), mode, levels=levels)


def json_bytes(value: Mapping[str, Any]) -> bytes:
    """The content of the file that :func:`write_json` writes."""
    return (json.dumps(value, indent=1, sort_keys=True) + "\n").encode()


def read_json(path: Path, largest: int = LARGEST_JSON) -> dict[str, Any] | None:
    """The JSON object in ``path``; None if the file does not exist.

    Any job may have written the file: it must be a regular one of at most ``largest`` bytes, nested at most
    :data:`DEEPEST_JSON` levels, with text and numbers that JSON can repeat. NaN and Infinity are read as None.

    Raises:
        DamagedFile: The file breaks one of these rules.
        OSError: The volume can't be read.
    """
    try:
        with open_regular(path) as file:
            data = file.read(largest + 1)
    except (FileNotFoundError, NotADirectoryError):
        return None
    if len(data) > largest:
        raise DamagedFile(f"{path}: more than {largest} bytes")
    return json_object(data, str(path))


def json_object(data: bytes | str, name: str) -> dict[str, Any]:
    """The JSON object in ``data``, nested at most :data:`DEEPEST_JSON` levels, with text and numbers that JSON can repeat.

    NaN and Infinity are read as None. Raises DamagedFile, with ``name`` in front, for anything else.
    """
    try:
        value = json.loads(data, parse_constant=lambda _: None)
        _check_plain(value, data if isinstance(data, bytes) else data.encode())
    except RecursionError:
        raise DamagedFile(f"{name}: nested too deep") from None
    except ValueError as error:
        raise DamagedFile(f"{name}: not JSON ({error})") from None
    if not isinstance(value, dict):
        raise DamagedFile(f"{name}: not a JSON object")
    return value


def path_exists(path: Path) -> bool:
    """Whether there is anything, also a link that leads nowhere. Raises OSError where that can't be seen."""
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def refuse_links(path: Path, levels: int) -> None:
    """Raise DamagedFile if directory ``path``, or one of the ``levels - 1`` above it, is a link, which leads out of the run."""
    for each in (path, *path.parents[: levels - 1]):
        if each.is_symlink():
            raise DamagedFile(
                f"{each}: a link, and links inside a run are not followed; put the directory in its place"
            )


def open_regular(path: Path, *, write: bool = False, within: int | None = None) -> BufferedReader | BufferedRandom:
    """Open a regular file of the store: a job may have put a link in its place, which leads out of the store, or a pipe, which never ends.

    It is opened to read; with ``write``, an existing file also to write. ``within``: descriptor of the directory of a relative path. Raises DamagedFile if it is not a regular file, OSError as
    ``open`` does.
    """
    access = os.O_RDWR if write else os.O_RDONLY
    try:
        descriptor = os.open(path, access | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=within)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO, errno.EISDIR):
            raise DamagedFile(f"{path}: not a regular file") from None
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise DamagedFile(f"{path}: not a regular file")
    return open(descriptor, "rb+") if write else open(descriptor, "rb")


def open_inside(directory: Path, parts: Sequence[str]) -> BufferedReader | BufferedRandom:
    """Open a regular file below ``directory`` to read, whose ``parts`` are plain names, and follow no link, also none that comes meanwhile.

    Raises DamagedFile if it is not a regular file, NotADirectoryError where a directory is a link, OSError as ``open`` does.
    """
    found = os.open(directory, _INSIDE)
    try:
        for part in parts[:-1]:
            outer, found = found, os.open(part, _INSIDE, dir_fd=found)
            os.close(outer)
        return open_regular(Path(parts[-1]), within=found)
    finally:
        os.close(found)


def _check_plain(value: object, data: bytes) -> None:
    """Raise ValueError for a value that can be read, but not written again as JSON."""
    level = [value]
    for _ in range(DEEPEST_JSON):
        for each in level:
            is_large = isinstance(each, int) and each.bit_length() > LONGEST_WHOLE  # no float can be made of it
            if is_large or (isinstance(each, float) and not math.isfinite(each)):
                raise ValueError("a number is too large")
        level = [
            inner
            for each in level
            if isinstance(each, dict | list)
            for inner in (each.values() if isinstance(each, dict) else each)
        ]
        if not level:
            break
    else:
        raise ValueError(f"nested deeper than {DEEPEST_JSON} levels")
    if b"\\u" in data:  # JSON can name half of a character
        json.dumps(value, ensure_ascii=False).encode()


def remove_tree(path: Path) -> None:
    """Delete a directory so that no reader sees half of it: hide it by a rename first, then delete."""
    hidden = path.parent / f".{path.name.lstrip('.')}.{uuid.uuid4().hex[:8]}.trash"
    os.rename(path, hidden)
    shutil.rmtree(hidden, ignore_errors=True)


_in_progress: set[Path] = set()


@contextmanager
def hidden_folder(path: Path, leftovers: Iterable[Path] = (), *, levels: int = 1) -> Iterator[Path]:
    """A new directory ``path``, with a hidden name, for content that :func:`publish` shows at once; deleted unless that has renamed it.

    ``leftovers``: directories of the same owner; those that no other context of this process has are of killed processes, and are deleted.
    ``levels``: directories above ``path`` that are made where they are missing.
    """
    _in_progress.add(path)
    try:
        for each in leftovers:
            if each not in _in_progress and not each.parent.is_symlink():
                shutil.rmtree(each, ignore_errors=True)
        make_directory(path, levels + 1)
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        _in_progress.discard(path)


def publish(hidden: Path, target: Path) -> None:
    """:func:`rename_new`, durably."""
    rename_new(hidden, target)
    sync_directory(target.parent)


def rename_new(hidden: Path, target: Path) -> None:
    """Rename a finished directory to ``target``, which must not exist or be empty. Raises FileExistsError, OSError."""
    try:
        os.rename(hidden, target)
    except OSError as error:
        if error.errno in (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR):
            raise FileExistsError(errno.EEXIST, "exists already", str(target)) from None
        raise


def copy_file(source: Path, target: Path) -> None:
    """Copy a regular file durably. Raises as :func:`open_regular`; OSError if the volume is full or gone."""
    with open_regular(source) as existing, open(target, "wb") as here:
        shutil.copyfileobj(existing, here, 1 << 20)
        here.flush()
        os.fsync(here.fileno())


def manifest_entry(path: Path) -> dict[str, Any]:
    """Size and SHA-256 of a regular file, for a manifest. Raises as :func:`open_regular`."""
    with open_regular(path) as file:
        return {"size": os.fstat(file.fileno()).st_size, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}


def read_present(folder: Path, name: str, damaged: Callable[[str], Exception]) -> dict[str, Any]:
    """A JSON document that must be in a directory. Raises what ``damaged`` makes of the error's words."""
    try:
        document = read_json(folder / name)
    except (OSError, ValueError) as error:
        raise damaged(f"{name} can't be read ({error})") from error
    if document is None:
        raise damaged(f"{name} is missing")
    return document


def read_manifest(
    folder: Path,
    names: re.Pattern[str],
    newest: int,
    damaged: Callable[[str], Exception],
    newer: Callable[[str], Exception],
) -> dict[str, Any]:
    """The manifest of an immutable directory, whose files have these ``names``: none leads out of it.

    Raises what ``damaged`` makes of the error's words; for a format after the ``newest``, what ``newer`` does.
    """
    manifest = read_present(folder, MANIFEST, damaged)
    number, files = manifest.get("format"), manifest.get("files")
    if not isinstance(number, int):
        raise damaged(f"{MANIFEST} has no format")
    if number > newest:
        raise newer(f"has format {number}, this Muster reads up to {newest}; upgrade Muster")
    if not isinstance(files, dict):
        raise damaged(f"{MANIFEST} lists no files")
    for name, entry in files.items():
        if not names.fullmatch(name) or name == MANIFEST:
            raise damaged(f"{MANIFEST} names {name[:60]!r}, which is not a file of it")
        size, digest = (entry.get("size"), entry.get("sha256")) if isinstance(entry, dict) else (None, None)
        if type(size) is not int or not 0 <= size < 2**63 or not isinstance(digest, str):
            raise damaged(f"{MANIFEST} has no size and digest of {name}")
    return manifest


def difference_of(folder: Path, name: str, entry: Mapping[str, Any]) -> str:
    """How a file differs from its entry in the manifest, as a clause; empty if it does not."""
    try:
        with open_regular(folder / name) as file:
            if (size := os.fstat(file.fileno()).st_size) != entry["size"]:
                return f"{name} has {size} bytes, {entry['size']} were written"
            is_same = hashlib.file_digest(file, "sha256").hexdigest() == entry["sha256"]
    except DamagedFile:
        return f"{name} is not a regular file"
    except FileNotFoundError:
        return f"{name} is missing"
    except OSError as error:
        return f"{name} can't be read ({error.strerror})"
    return "" if is_same else f"the content of {name} was altered (SHA-256 differs)"
