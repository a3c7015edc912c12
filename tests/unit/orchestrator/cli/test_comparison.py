"""`muster compare`: groups of runs, their numbers and curves; and how the weights of two policies differ."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from orchestrator.cli.comparison.curves import draw
from orchestrator.cli.comparison.weights import difference
from shared_store.volume.comparison import POINTS, ComparedRun, grouped


def run(name: str, seed: int, rewards: list[float], *, evaluated: float | None = None, **train: Any) -> ComparedRun:
    spec = {"name": name, "train": {"task": "Ant", "seed": seed, **train}}
    records = [
        {"iteration": i, "env_steps": 10 * i, "reward": reward, "episode_length": 5.0}
        for i, reward in enumerate(rewards, 1)
    ]
    evaluation = None if evaluated is None else {"mean_return": evaluated, "success": {"share": 0.5}}
    return ComparedRun(name, spec, records, evaluation)


def test_runs_that_differ_in_name_and_seed_alone_are_one_group() -> None:
    alike = [run("ant-a", 1, [1.0]), run("ant-b", 2, [3.0])]
    groups = grouped([*alike, run("slow", 1, [2.0], worlds=3), ComparedRun("bare", {}, [], None)])
    assert [group.label for group in groups] == ["ant-* (2)", "slow", "bare"]
    assert groups[0].describe()["seeds"] == [1, 2]
    assert groups[0].describe()["reward"] == {"mean": 2.0, "std": pytest.approx(2**0.5)}
    bare = grouped([ComparedRun("a", {}, [], None), ComparedRun("b", {}, [], None)])
    assert bare[1].label == "b", "nothing says that they are alike"


def test_a_curve_is_the_mean_where_runs_have_records_and_in_proportion_between_them() -> None:
    (group,) = grouped([run("a", 1, [0.0, 10.0, 20.0]), run("b", 2, [4.0, 6.0])])
    curve = group.curve()
    assert len(curve) == POINTS and curve[0] == (10.0, 2.0, pytest.approx(8**0.5), 2)
    assert curve[-1] == (30.0, 20.0, 0.0, 1), "the other run has ended"
    steps, mean, spread, count = min(curve, key=lambda point: abs(point[0] - 15.0))
    first, second = (steps - 10.0) / 10.0 * 10.0, 4.0 + (steps - 10.0) / 10.0 * 2.0
    assert (mean, spread, count) == (
        *(pytest.approx((first + second) / 2), pytest.approx(abs(first - second) / 2**0.5)),
        2,
    )


def test_a_single_run_keeps_its_own_points_and_one_without_episodes_has_no_curve() -> None:
    one, none = grouped([run("a", 1, [1.0, 5.0, 2.0]), run("b", 1, [], worlds=9)])
    assert one.curve() == [(10.0, 1.0, 0.0, 1), (20.0, 5.0, 0.0, 1), (30.0, 2.0, 0.0, 1)] and none.curve() == []


def test_the_curves_are_drawn_without_a_display(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    groups = grouped([run("a", 1, [1.0, 2.0]), run("b", 2, [2.0, 4.0])])
    draw(groups, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ValueError, match="no episode of these runs has finished yet"):
        draw(grouped([run("c", 1, [])]), tmp_path / "none.png")
    assert [path.name for path in tmp_path.iterdir()] == ["curves.png"]


def policy(path: Path, matrix: list[list[float]], note: str = "") -> Path:
    """An ONNX file of one product with ``matrix`` and a bias of two numbers."""
    weights = np.array(matrix, np.float32)
    arrays = [numpy_helper.from_array(weights, "w"), numpy_helper.from_array(np.array([0.5, 0.5], np.float32), "b")]
    supplied = helper.make_tensor_value_info("obs", TensorProto.FLOAT, ["n", len(matrix)])
    made = helper.make_tensor_value_info("actions", TensorProto.FLOAT, ["n", 2])
    graph = helper.make_graph(
        [helper.make_node("Gemm", ["obs", "w", "b"], ["actions"])], "policy", [supplied], [made], arrays
    )
    onnx.save(helper.make_model(graph, doc_string=note), path)
    return path


def test_the_greatest_difference_of_parameters_is_shown_and_notes_are_none(tmp_path: Path) -> None:
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
