"""A policy bundle: read whole, and refused if a byte of it was altered."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from muster_policy.contract import Contract, read
from muster_policy.errors import Refused

FORMAT = 1
"""The newest version of the manifest that the node reads."""
MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Bundle:
    """The node's files of a bundle, in memory: nothing is read again after the verification.

    Attributes:
        path: Of the directory.
        manifest: ``manifest.json``.
        contract: ``contract.json``.
        model: ``policy.onnx``.
        parity: ``parity.npz``.
    """

    path: Path
    manifest: dict[str, Any]
    contract: Contract
    model: bytes
    parity: bytes

    @property
    def origin(self) -> str:
        """Its run and checkpoint."""
        return f"{self.manifest.get('run', 'unknown run')}, checkpoint {self.manifest.get('checkpoint', 'unknown')}"


def open_bundle(path: Path) -> Bundle:
    """Read and verify a bundle: every file is listed and unaltered, none is missing and none was added.

    Args:
        path: Its directory.

    Raises:
        Refused: It is not a bundle, or a file differs.
    """
    if not path.is_dir():
        raise Refused(f"{path}: it is not a directory; name a bundle that `muster export` made")
    manifest = _manifest(path)
    content: dict[str, bytes] = {}
    for name, entry in sorted(manifest["files"].items()):
        data = _read(path, name)
        if len(data) != entry["size"]:
            raise Refused(
                f"{path}: {name} has {len(data)} bytes, {entry['size']} were written; copy the bundle once more"
            )
        if hashlib.sha256(data).hexdigest() != entry["sha256"]:
            raise Refused(f"{path}: {name} was altered (SHA-256 differs); copy the bundle once more")
        if name in ("contract.json", "policy.onnx", "parity.npz"):
            content[name] = data
    names = {str((Path(folder) / name).relative_to(path)) for folder, _, names in os.walk(path) for name in names}
    for name in sorted(names - set(manifest["files"]) - {MANIFEST}):
        raise Refused(f"{path}: {name} was added, {MANIFEST} does not list it; remove it")
    for name in ("contract.json", "policy.onnx", "parity.npz"):
        if name not in content:
            raise Refused(f"{path}: {MANIFEST} lists no {name}; export the policy again")
    try:
        if lie_elsewhere(content["policy.onnx"]):
            raise Refused(f"{path}: policy.onnx has weights in another file (external_data); export the policy again")
    except ValueError:
        raise Refused(f"{path}: policy.onnx is not an ONNX file; export the policy again") from None
    contract = read(content["contract.json"], f"{path}: contract.json")
    return Bundle(path, manifest, contract, content["policy.onnx"], content["parity.npz"])


def _manifest(path: Path) -> dict[str, Any]:
    data = _read(path, MANIFEST)
    try:
        manifest: dict[str, Any] = json.loads(data)
        if manifest["format"] > FORMAT:
            raise Refused(
                f"{path}: {MANIFEST} has format {manifest['format']}, this node reads up to {FORMAT}; upgrade muster-policy"
            )
        bare = {name: value for name, value in manifest.items() if name != "digest"}
        sound = data == _written(manifest) and manifest["digest"] == hashlib.sha256(_written(bare)).hexdigest()
        for name, entry in manifest["files"].items():
            parts = Path(name).parts
            sound &= isinstance(entry["size"], int) and isinstance(entry["sha256"], str)
            sound &= bool(parts) and not Path(name).is_absolute() and ".." not in parts
    except (ValueError, KeyError, TypeError, AttributeError):
        raise Refused(f"{path}: {MANIFEST} is not a bundle's manifest; export the policy again") from None
    if not sound:
        raise Refused(f"{path}: {MANIFEST} was altered (SHA-256 differs); copy the bundle once more")
    return manifest


def _written(manifest: dict[str, Any]) -> bytes:
    return (json.dumps(manifest, indent=1, sort_keys=True) + "\n").encode()


def _read(path: Path, name: str) -> bytes:
    file = path / name
    if file.is_symlink() or (file.exists() and not file.is_file()):
        raise Refused(f"{path}: {name} is not a regular file; copy the bundle once more")
    try:
        return file.read_bytes()
    except FileNotFoundError:
        hint = "name a bundle that `muster export` made" if name == MANIFEST else "copy the bundle once more"
        raise Refused(f"{path}: {name} is missing; {hint}") from None
    except OSError as error:
        raise Refused(f"{path}: {name} can't be read ({error.strerror})") from None


PARTS = {
    "ModelProto": {7: "GraphProto", 20: "TrainingInfoProto", 25: "FunctionProto"},
    "GraphProto": {1: "NodeProto", 5: "TensorProto", 15: "SparseTensorProto"},
    "SparseTensorProto": {1: "TensorProto", 2: "TensorProto"},
    "NodeProto": {5: "AttributeProto"},
    "AttributeProto": {
        **{5: "TensorProto", 10: "TensorProto", 6: "GraphProto", 11: "GraphProto"},
        **{22: "SparseTensorProto", 23: "SparseTensorProto"},
    },
    "FunctionProto": {7: "NodeProto", 11: "AttributeProto"},
    "TrainingInfoProto": {1: "GraphProto", 2: "GraphProto"},
}
"""Messages in which a tensor may be, by type and number of their field (onnx.proto)."""
EXTERNAL = (13, 14)
"""Fields of a TensorProto, external_data and data_location, which a tensor within the model lacks or has as 0."""


def lie_elsewhere(model: bytes) -> bool:
    """Whether a tensor of an ONNX model lies in another file.

    Raises:
        ValueError: The bytes aren't a protobuf.
    """
    pending = [("ModelProto", memoryview(model))]
    while pending:
        kind, message = pending.pop()
        for number, value in _fields(message):
            if kind == "TensorProto":
                if number in EXTERNAL and value:
                    return True
            elif isinstance(value, memoryview) and (part := PARTS[kind].get(number)):
                pending.append((part, value))
    return False


def _fields(message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Number and value of each field: a number, or the bytes of a text, a list or a message."""
    place = 0
    while place < len(message):
        key, place = _number(message, place)
        wire = key & 7
        if wire == 0:
            value, place = _number(message, place)
            yield key >> 3, value
            continue
        if wire == 2:
            size, place = _number(message, place)
        else:
            size = {1: 8, 5: 4}.get(wire, len(message) + 1)
        if place + size > len(message):
            raise ValueError("no protobuf")
        yield key >> 3, message[place : place + size]
        place += size


def _number(message: memoryview, place: int) -> tuple[int, int]:
    """A number of variable length, and where it ends."""
    value = 0
    for shift in range(0, 70, 7):
        if place >= len(message):
            break
        byte = message[place]
        place += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, place
    raise ValueError("no protobuf")
