"""The package ``muster-kernels``: compiled kernels of Muster's tasks, checked and unpacked into Warp's cache.

Its files are native code. A file is used only if root or this user owns it, other users can't write it, and its digest is that of the
manifest. :mod:`worker.kernels.making` makes the package.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import stat
import tarfile
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

NAME = "muster-kernels"
FOLDER = "muster_kernels"
MANIFEST = "manifest.json"
VERSIONS = ("muster", "warp-lang", "newton", "mujoco-warp")
"""Distributions whose versions the kernels belong to."""


class Unfit(Exception):
    """The package can't be used; the message says why."""


@dataclass(frozen=True)
class Gpu:
    """What a package has to fit."""

    arch: int
    """90 is compute capability 9.0."""
    driver: tuple[int, int]
    """The newest version of CUDA that the driver knows."""


def installed() -> Path | None:
    """The folder of the installed package; None without one."""
    try:
        found = metadata.distribution(NAME).locate_file(FOLDER)
    except metadata.PackageNotFoundError:
        return None
    return Path(str(found))


def versions() -> dict[str, str]:
    """The installed versions of :data:`VERSIONS`; empty where a distribution is not installed."""
    found = {}
    for name in VERSIONS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = ""
    return found


def target_for(manifest: Mapping[str, Any], gpu: Gpu) -> str:
    """The archive of a package for a GPU: ``sm90``, or ``ptx90``, which its driver compiles, for a newer one. Raises Unfit."""
    archives, toolkit = manifest["archives"], tuple(manifest["toolkit"])
    target = f"sm{gpu.arch}"
    if target not in archives:
        older = [name for name in archives if name.startswith("ptx") and int(name[3:]) < gpu.arch]
        if not older:
            raise Unfit(f"it has {', '.join(sorted(archives))}, and this GPU is sm{gpu.arch}")
        target = max(older)
    needs = (toolkit[0], 0) if target.startswith("sm") else toolkit
    if gpu.driver < needs:
        driver, words = ".".join(map(str, gpu.driver)), ".".join(map(str, needs))
        raise Unfit(f"it needs a driver for CUDA {words}, and this one is for CUDA {driver}")
    return target


def unpack(folder: Path, gpu: Gpu, cache: Path) -> str:
    """Bring the kernels of a package into Warp's cache, unless they have been.

    Processes and nodes may do this at once: each file appears whole, under the name that it has for all of them.

    Args:
        folder: The package's folder.
        gpu: The device.
        cache: Warp's cache for this version.

    Returns:
        The target whose kernels are there now: ``sm90`` or ``ptx90``.

    Raises:
        Unfit: The package is for something else, or was tampered with.
        OSError: The cache can't be written.
    """
    try:
        manifest = json.loads(_trusted(folder, MANIFEST))
    except ValueError:
        raise Unfit(f"{folder / MANIFEST} can't be read") from None
    if (now := versions()) != manifest["versions"]:
        differ = [
            f"{name} {manifest['versions'].get(name)} (here {now[name]})"
            for name in VERSIONS
            if now[name] != manifest["versions"].get(name)
        ]
        raise Unfit(f"it was made for {', '.join(differ)}")
    target = target_for(manifest, gpu)
    entry = manifest["archives"][target]
    mark = cache / f"wp_muster_package_{entry['sha256'][:16]}"
    if mark.exists():
        return target
    data = _trusted(folder, entry["file"])
    if hashlib.sha256(data).hexdigest() != entry["sha256"]:
        raise Unfit(f"{folder / entry['file']} was changed: its digest is not that of {MANIFEST}")
    unpacked = Path(tempfile.mkdtemp(prefix="wp_muster_unpacked_", dir=cache))
    try:
        found = _read(data)
        for name in sorted(found, key=lambda each: each.startswith("wp_muster_")):  # marks last
            directory = unpacked / name
            directory.mkdir()
            for file, content in found[name].items():
                (directory / file).write_bytes(content)
            try:
                directory.rename(cache / name)
            except OSError:  # it is there, perhaps for other GPUs
                _move(directory, cache / name)
        mark.mkdir(exist_ok=True)
    finally:
        shutil.rmtree(unpacked, ignore_errors=True)
    return target


def _read(data: bytes) -> dict[str, dict[str, bytes]]:
    """The directories in an archive, with their files. Extraction by ``tarfile`` takes three times as many calls of the system.

    Raises:
        Unfit: It has other things in it.
    """
    found: dict[str, dict[str, bytes]] = {}
    with tarfile.open(fileobj=io.BytesIO(data)) as archive:
        for member in archive:
            parts = member.name.split("/")
            if not parts[0].startswith("wp_") or ".." in parts or len(parts) > 2:
                raise Unfit(f"its archive has an entry {member.name!r}")
            files = found.setdefault(parts[0], {})
            if content := archive.extractfile(member):
                files[parts[-1]] = content.read()
    return found


def _move(source: Path, target: Path) -> None:
    target.mkdir(exist_ok=True)
    # a module counts as compiled once it has its description, which is the last
    for file in sorted(source.iterdir(), key=lambda each: each.suffix == ".meta"):
        if not (target / file.name).exists():
            os.replace(file, target / file.name)


def _trusted(folder: Path, name: str) -> bytes:
    """The bytes of a file that other users can't write. Raises Unfit if they can."""
    path = folder / name
    try:
        with path.open("rb") as file:
            for place, found in ((folder, folder.stat()), (path, os.fstat(file.fileno()))):
                if found.st_uid not in (0, os.getuid()):
                    raise Unfit(f"{place} belongs to user {found.st_uid}, who could put any code there")
                if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
                    raise Unfit(f"{place} can be written by others (mode {stat.S_IMODE(found.st_mode):o}); chmod go-w")
            return file.read()
    except OSError as error:
        raise Unfit(f"{path}: {error.strerror}") from None
