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
from shared_store.volume import files
from shared_store.volume.files import (
    EVERY_LEVEL,
    DamagedFile,
    copy_file,
    difference_of,
    json_bytes,
    make_directory,
    manifest_entry,
    sync_directory,
    sync_file,
    write_json,
)
from shared_store.volume.files import MANIFEST as MANIFEST
from shared_store.volume.files import hidden_folder as hidden_folder
from shared_store.volume.files import publish as publish

FORMAT = 1
"""Version of the manifest; a newer one is refused."""
CONTRACT, REPORT, POLICY = "contract.json", "report.json", "policy.onnx"
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
    entries = {path: manifest_entry(bundle / path) for path in _files(bundle)}
    for path in entries:
        sync_file(bundle / path)
    manifest = json.loads(json.dumps({**facts, "format": FORMAT, "files": entries}))
    write_json(bundle / MANIFEST, {**manifest, "digest": _manifest_digest(manifest)})
    _sync_folders(bundle)


def read_manifest(bundle: Path) -> dict[str, Any]:
    """The manifest of a bundle. Raises DamagedBundle."""

    def damaged(why: str) -> DamagedBundle:
        hint = "; is it a directory that `muster export` made?" if why == f"{MANIFEST} is missing" else ""
        return DamagedBundle(f"bundle {bundle}: {why}{hint}")

    manifest = files.read_manifest(bundle, _PATH, FORMAT, damaged, damaged)
    if not manifest["files"]:
        raise damaged(f"{MANIFEST} lists no files")
    if manifest.get("digest") != _manifest_digest(manifest):
        raise damaged(f"the content of {MANIFEST} was altered (SHA-256 differs)")
    return manifest


def verify(bundle: Path) -> dict[str, Any]:
    """Verify that no file of a bundle was altered, removed or added since it was sealed; returns its manifest. Raises DamagedBundle."""
    manifest = read_manifest(bundle)
    listed: dict[str, Any] = manifest["files"]
    try:
        is_same = (bundle / MANIFEST).read_bytes() == json_bytes(
            manifest
        )  # parsing hides some differences, such as spaces
        added = sorted(set(_files(bundle)) - {MANIFEST, *listed})
    except DamagedFile as error:
        raise DamagedBundle(f"bundle {bundle}: {error}") from None
    except OSError as error:
        raise DamagedBundle(f"bundle {bundle}: {error.filename} can't be read ({error.strerror})") from error
    problems = [
        "" if is_same else f"the content of {MANIFEST} was altered",
        *(f"{path} was added; {MANIFEST} does not list it" for path in added),
        *(difference_of(bundle, path, entry) for path, entry in sorted(listed.items())),
    ]
    if problem := next(filter(None, problems), ""):
        raise DamagedBundle(f"bundle {bundle}: {problem}")
    return manifest


def reason(error: Exception, bundle: Path) -> str:
    """The words of an error without the bundle's directory, for a message that names what the bundle is."""
    return str(error).removeprefix(f"bundle {bundle}: ")


def read_document(folder: Path, name: str, called: str) -> dict[str, Any]:
    """A JSON document of a bundle or a model, which errors call ``called``. Raises DamagedBundle."""
    return files.read_present(folder, name, lambda words: DamagedBundle(f"{called}: {words}"))


def read_contract(bundle: Path) -> Contract:
    """The policy contract of a bundle. Raises DamagedBundle."""
    try:
        return read(read_document(bundle, CONTRACT, f"bundle {bundle}"))
    except DocumentError as error:
        raise DamagedBundle(f"bundle {bundle}: {error}") from None


def copy(bundle: Path, target: Path, overwrite: bool = False) -> None:
    """Copy a bundle to ``target``, and verify it: whole, or not at all.

    Args:
        bundle: The bundle.
        target: A directory, which must not exist unless ``overwrite``.
        overwrite: Replace ``target`` once the copy is complete.

    Raises:
        DamagedBundle: The bundle was altered since it was sealed.
        FileExistsError: ``target`` exists.
        OSError: The volume is full or gone.
    """
    target = Path(os.path.realpath(target))
    if os.path.lexists(target) and not overwrite:
        raise FileExistsError(errno.EEXIST, "exists already", str(target))
    place = target.parent / f".{target.name}.{uuid.uuid4().hex[:8]}.tmp"
    with hidden_folder(place, levels=EVERY_LEVEL) as hidden:
        copy_files(bundle, hidden)
        if not os.path.lexists(target):
            publish(hidden, target)
            return
        former = hidden.with_suffix(".former")
        target.rename(former)
        try:
            publish(hidden, target)
        except OSError:
            former.rename(target)
            raise
    shutil.rmtree(former)


def copy_files(bundle: Path, hidden: Path) -> None:
    """Copy a bundle durably into the directory ``hidden``, and verify the copy. Raises as :func:`copy`."""
    for path in (*verify(bundle)["files"], MANIFEST):
        make_directory((hidden / path).parent, len(Path(path).parts))
        copy_file(bundle / path, hidden / path)
    _sync_folders(hidden)
    verify(hidden)


def _sync_folders(bundle: Path) -> None:
    for folder, _, _ in os.walk(bundle, topdown=False):
        sync_directory(Path(folder))


def _manifest_digest(manifest: Mapping[str, Any]) -> str:
    return hashlib.sha256(json_bytes({name: each for name, each in manifest.items() if name != "digest"})).hexdigest()


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
