"""How the weights of two exported policies differ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from orchestrator.cli.comparison.weights import difference


def policy(path: Path, matrix: list[list[float]], note: str = "") -> Path:
    """An ONNX file of one product with ``matrix`` and a bias of two numbers."""
    weights = np.array(matrix, np.float32)
    arrays = [numpy_helper.from_array(weights, "w"), numpy_helper.from_array(np.array([0.5, 0.5], np.float32), "b")]
    given = helper.make_tensor_value_info("obs", TensorProto.FLOAT, ["n", len(matrix)])
    made = helper.make_tensor_value_info("actions", TensorProto.FLOAT, ["n", 2])
    graph = helper.make_graph(
        [helper.make_node("Gemm", ["obs", "w", "b"], ["actions"])], "policy", [given], [made], arrays
    )
    onnx.save(helper.make_model(graph, doc_string=note), path)
    return path


def test_the_greatest_difference_of_parameters_is_told_and_notes_are_none(tmp_path: Path) -> None:
    one = policy(tmp_path / "one", [[1.0, 2.0], [3.0, 4.0]])
    other = policy(tmp_path / "other", [[1.0, 2.25], [2.5, 4.0]])
    assert difference(one, other) == "differ: 6 parameters, by 0.5 at most"
    wider = policy(tmp_path / "wider", [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    assert difference(one, wider) == "differ: 6 parameters became 8, of other names or shapes"
    one = policy(tmp_path / "one", [[1.0, 2.0]])
    other = policy(tmp_path / "other", [[1.0, 2.0]], note="exported once more")
    assert one.read_bytes() != other.read_bytes() and difference(one, other) == ""


def test_unreadable_tables_are_not_compared(tmp_path: Path) -> None:
    one = policy(tmp_path / "one", [[1.0, 2.0]])
    (tmp_path / "broken").write_bytes(b"no model at all")
    assert difference(one, tmp_path / "broken") is None and difference(tmp_path / "absent", one) is None
