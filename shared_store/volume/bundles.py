"""Policy bundles: directories that appear atomically, with a manifest that has the digest of every file.

``manifest.json`` lists all other files, by their path in the bundle, with size and SHA-256; a bundle has no further files. Its own
``digest`` is the SHA-256 of its other content.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from shared_store.contract.documents import DocumentError
from shared_store.contract.policy import Contract, read
from shared_store.volume.files import DamagedFile, open_regular, read_json, sync_directory, sync_file, write_json

FORMAT = 1
"""Version of the manifest; a newer one is refused."""
MANIFEST, CONTRACT, REPORT, POLICY = "manifest.json", "contract.json", "report.json", "policy.onnx"
_PART = r"[A-Za-z0-9_][A-Za-z0-9._+-]{0,199}"
_PATH = re.compile(rf"{_PART}(?:/{_PART}){{0,7}}")
"""Valid paths of a bundle's files: none leads out of it."""


class DamagedBundle(Exception):
    """A bundle can't be used; the message names it, the file and the error."""


def seal(bundle: Path, facts: Mapping[str, Any]) -> None:
    """Write the manifest of the files in ``bundle``, and make the bundle durable. Raises OSError.

    Args:
        bundle: The directory, still without readers.
        facts: Further entries of the manifest; JSON values.
    """
    files = {}
    for path in _files(bundle):
        sync_file(bundle / path)
        files[path] = {"size": (bundle / path).stat().st_size, "sha256": _digest(bundle / path)}
    manifest = json.loads(json.dumps({**facts, "format": FORMAT, "files": files}))
    write_json(bundle / MANIFEST, {**manifest, "digest": _manifest_digest(manifest)})
    for folder, _, _ in os.walk(bundle, topdown=False):
        sync_directory(Path(folder))


def read_manifest(bundle: Path) -> dict[str, Any]:
    """The manifest of a bundle. Raises DamagedBundle."""
    try:
        manifest = read_json(bundle / MANIFEST)
    except (OSError, ValueError) as error:
        raise DamagedBundle(f"bundle {bundle}: {MANIFEST} can't be read ({error})") from error
    if manifest is None:
        raise DamagedBundle(f"bundle {bundle}: {MANIFEST} is missing; is it a directory that `muster export` made?")
    if not isinstance(manifest.get("format"), int):
        raise DamagedBundle(f"bundle {bundle}: {MANIFEST} has no format")
    if manifest["format"] > FORMAT:
        raise DamagedBundle(
            f"bundle {bundle}: has format {manifest['format']}, this Muster reads up to {FORMAT}; upgrade Muster"
        )
    files = manifest.get("files")
    if not isinstance(files, dict) or not files:
        raise DamagedBundle(f"bundle {bundle}: {MANIFEST} lists no files")
    for path, entry in files.items():
        if not _PATH.fullmatch(path) or path == MANIFEST:
            raise DamagedBundle(f"bundle {bundle}: {MANIFEST} names {path[:60]!r}, which is no file of it")
        if not isinstance(entry, dict) or not (
            isinstance(entry.get("size"), int) and isinstance(entry.get("sha256"), str)
        ):
            raise DamagedBundle(f"bundle {bundle}: {MANIFEST} has no size and digest of {path}")
    if manifest.get("digest") != _manifest_digest(manifest):
        raise DamagedBundle(f"bundle {bundle}: the content of {MANIFEST} was altered (SHA-256 differs)")
    return manifest


def verify(bundle: Path) -> dict[str, Any]:
    """Verify that no file of a bundle was altered, removed or added since it was sealed; returns its manifest. Raises DamagedBundle."""
    manifest = read_manifest(bundle)
    listed: dict[str, Any] = manifest["files"]
    try:
        if (bundle / MANIFEST).read_bytes() != _written(manifest):  # differences that parsing hides, such as spaces
            raise DamagedBundle(f"bundle {bundle}: the content of {MANIFEST} was altered")
        there = set(_files(bundle)) - {MANIFEST}
        for path in sorted(listed.keys() - there):
            raise DamagedBundle(f"bundle {bundle}: {path} is missing")
        for path in sorted(there - listed.keys()):
            raise DamagedBundle(f"bundle {bundle}: {path} was added; {MANIFEST} does not list it")
        for path, entry in sorted(listed.items()):
            size = (bundle / path).stat().st_size
            if size != entry["size"]:
                raise DamagedBundle(f"bundle {bundle}: {path} has {size} bytes, {entry['size']} were written")
            if _digest(bundle / path) != entry["sha256"]:
                raise DamagedBundle(f"bundle {bundle}: the content of {path} was altered (SHA-256 differs)")
    except DamagedFile as error:
        raise DamagedBundle(f"bundle {bundle}: {error}") from None
    except OSError as error:
        raise DamagedBundle(f"bundle {bundle}: {error.filename} can't be read ({error.strerror})") from error
    return manifest


def reason(error: Exception, bundle: Path) -> str:
    """The words of an error without the bundle's directory, for a message that names what the bundle is."""
    return str(error).removeprefix(f"bundle {bundle}: ")


def read_contract(bundle: Path) -> Contract:
    """The policy contract of a bundle. Raises DamagedBundle."""
    try:
        document = read_json(bundle / CONTRACT)
        if document is None:
            raise DamagedBundle(f"bundle {bundle}: {CONTRACT} is missing")
        return read(document)
    except (OSError, DamagedFile) as error:
        raise DamagedBundle(f"bundle {bundle}: {CONTRACT} can't be read ({error})") from error
    except DocumentError as error:
        raise DamagedBundle(f"bundle {bundle}: {error}") from None


def copy(bundle: Path, target: Path) -> None:
    """Copy a bundle atomically to ``target``, which must not exist, and verify it.

    Raises:
        DamagedBundle: The bundle was altered since it was sealed.
        FileExistsError: ``target`` exists.
        OSError: The volume is full or gone.
    """
    if os.path.lexists(target):
        raise FileExistsError(errno.EEXIST, "exists already", str(target))
    target.parent.mkdir(parents=True, exist_ok=True)
    hidden = target.parent / f".{target.name}.{uuid.uuid4().hex[:8]}.tmp"
    try:
        copy_files(bundle, hidden)
        publish(hidden, target)
    finally:
        shutil.rmtree(hidden, ignore_errors=True)


def copy_files(bundle: Path, hidden: Path) -> None:
    """Copy a bundle durably into the new directory ``hidden``, and verify the copy. Raises as :func:`copy`."""
    manifest = verify(bundle)
    hidden.mkdir()
    for path in (*manifest["files"], MANIFEST):
        (hidden / path).parent.mkdir(parents=True, exist_ok=True)
        with open_regular(bundle / path) as there, open(hidden / path, "wb") as here:
            shutil.copyfileobj(there, here, 1 << 20)
            here.flush()
            os.fsync(here.fileno())
    for folder, _, _ in os.walk(hidden, topdown=False):
        sync_directory(Path(folder))
    verify(hidden)


def publish(hidden: Path, target: Path) -> None:
    """Rename a finished directory to ``target``, which must not exist or be empty. Raises FileExistsError, OSError."""
    try:
        os.rename(hidden, target)
    except OSError as error:
        if error.errno in (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR):
            raise FileExistsError(errno.EEXIST, "exists already", str(target)) from None
        raise
    sync_directory(target.parent)


def _manifest_digest(manifest: Mapping[str, Any]) -> str:
    return hashlib.sha256(_written({name: each for name, each in manifest.items() if name != "digest"})).hexdigest()


def _written(manifest: Mapping[str, Any]) -> bytes:
    """As :func:`shared_store.volume.files.write_json` writes it."""
    return (json.dumps(manifest, indent=1, sort_keys=True) + "\n").encode()


def _files(bundle: Path) -> list[str]:
    """Paths of all files in a bundle, relative to it. Raises DamagedFile for links and other irregular files."""
    found = []
    for folder, folders, names in os.walk(bundle):
        for name in (*folders, *names):
            path = Path(folder) / name
            if path.is_symlink() or not (path.is_dir() or path.is_file()):
                raise DamagedFile(f"{path.relative_to(bundle)} is not a regular file")
        found += [str((Path(folder) / name).relative_to(bundle)) for name in names]
    return sorted(found)


def _digest(path: Path) -> str:
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
