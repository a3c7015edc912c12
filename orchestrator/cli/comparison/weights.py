"""Differences between the weights of two exported policies, from their ONNX parameters. Imports no torch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from shared_store.contract.error_text import counted

LARGEST = 512 << 20
"""Greatest size of a policy file that is read [bytes]."""


def difference(before: Path, after: Path) -> str | None:
    """Differences between the parameters of two ONNX files, as ``differ: …``.

    Returns:
        Empty if all parameters are equal; None if they can't be compared here: the files are not on this machine or too large, or the
        package ``onnx`` is missing.
    """
    try:
        import numpy

        was, now = _parameters(before), _parameters(after)
    except (ImportError, OSError, ValueError):
        return None
    counts = [sum(array.size for array in each.values()) for each in (was, now)]
    if [(name, array.shape) for name, array in was.items()] != [(name, array.shape) for name, array in now.items()]:
        return f"differ: {counted(counts[0], 'parameter')} became {counts[1]}, of other names or shapes"
    largest = max((float(numpy.abs(now[name] - array).max()) for name, array in was.items() if array.size), default=0.0)
    return "" if largest == 0.0 else f"differ: {counted(counts[0], 'parameter')}, by {largest:.3g} at most"


def _parameters(path: Path) -> dict[str, Any]:
    """Arrays by name, float64. Raises ImportError, OSError, and ValueError for anything but an ONNX file that contains its parameters."""
    import onnx

    if path.stat().st_size > LARGEST:
        raise ValueError(f"{path} is larger than {LARGEST} bytes")
    try:
        model = onnx.load_model_from_string(path.read_bytes())
    except Exception as error:  # protobuf's own, from any of its implementations
        raise ValueError(str(error)) from None
    tensors = sorted(model.graph.initializer, key=lambda tensor: str(tensor.name))
    if any(tensor.data_location == onnx.TensorProto.EXTERNAL for tensor in tensors):
        raise ValueError(f"{path} has parameters in other files")
    return {str(tensor.name): onnx.numpy_helper.to_array(tensor).astype("float64") for tensor in tensors}
