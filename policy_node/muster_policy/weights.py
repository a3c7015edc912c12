"""Finds weights of an ONNX model that lie in other files (``external_data``), in the bytes of its protobuf.

Older versions of onnxruntime read them from anywhere on the machine, so they are refused before it sees the model.
"""

from __future__ import annotations

from collections.abc import Iterator

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
        ValueError: The bytes are no protobuf.
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
