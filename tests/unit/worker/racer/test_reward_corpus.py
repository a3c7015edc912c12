"""Reward functions of the kinds that people write: compiled for the device, they give what Python gives."""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.support.refusals import refusal
from worker.racer.rewards import parameters
from worker.racer.rewards.compiled import kernels, race_arrays, told_errors, warp_function
from worker.racer.rewards.problems import Failure
from worker.racer.rewards.samples import Line, oval, random_sample, samples
from worker.racer.rewards.translation import Outside, translate

CORPUS = {path.stem: path.read_text() for path in sorted((Path(__file__).parent / "corpus").glob("*.py"))}
OUTSIDE = {
    "global_state": "line 7: the global variable last_progress, which keeps its value: such functions run in Python workers",
    "numpy_arrays": "line 7: numpy.array(): such functions run in Python workers",
    "stateful_class": "line 18: an object of the class Reward: such functions run in Python workers",
}
DRAWN = 250


def tried() -> list[dict[str, Any]]:
    """Sample inputs and drawn ones, as the arrays hold them."""
    chance, line = random.Random(16), Line(oval())
    drawn = [*samples().values(), *(random_sample(line, chance) for _ in range(DRAWN))]
    rounded = np.float32(line.points).tolist()
    found = []
    for params in drawn:
        numbers, objects = parameters.row_of(params)
        rows = np.float32(objects).tolist()
        found.append(parameters.parameters_of(np.float32(numbers).tolist(), rows, [tuple(p) for p in rounded]))
    return found


def filled(drawn: list[dict[str, Any]]) -> Any:
    """The same in arrays."""
    race = race_arrays(len(drawn), [drawn[0]["waypoints"]], "cpu")
    numbers, objects = race.numbers.numpy(), race.objects.numpy()
    for world, params in enumerate(drawn):
        row, rows = parameters.row_of(params)
        numbers[world] = row
        objects[world, : len(rows)] = rows if rows else 0.0
    return race


@pytest.fixture(scope="module")
def rewarded() -> tuple[list[dict[str, Any]], dict[str, tuple[np.ndarray, dict[str, Failure]]]]:
    """The inputs, and the rewards and errors of every function that compiles; all in one module of Warp."""
    drawn = tried()
    names = [name for name in CORPUS if name not in OUTSIDE]
    found = kernels([warp_function(translate(CORPUS[name]).snippet) for name in names], "corpus")
    results = {}
    for name, kernel in zip(names, found, strict=True):
        race = filled(drawn)
        rewards = wp.empty(len(drawn), dtype=wp.float32, device="cpu")
        wp.launch(kernel, dim=len(drawn), inputs=[race, rewards], device="cpu")
        results[name] = (rewards.numpy(), told_errors(race.errors.numpy()))
    return drawn, results


def interpreted(source: str) -> Any:
    scope: dict[str, Any] = {}
    exec(compile(source, "<reward>", "exec"), scope)
    return scope["reward_function"]


@pytest.mark.parametrize("name", [name for name in CORPUS if name not in OUTSIDE])
def test_a_compiled_reward_function_equals_python_s(name: str, rewarded: Any) -> None:
    drawn, results = rewarded
    rewards, errors = results[name]
    function, expected, raised = interpreted(CORPUS[name]), [], 0
    for params in drawn:
        try:
            expected.append(float(function(params)))
        except (ArithmeticError, ValueError, IndexError):
            expected.append(math.nan)
            raised += 1
    assert rewards == pytest.approx(np.float32(expected), rel=2e-6, abs=1e-6, nan_ok=True)
    assert sum(failure.count for failure in errors.values()) == raised
    assert len({round(value, 9) for value in expected}) > 1, "all rewards are the same: the test shows nothing"


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_function_outside_the_subset_is_refused_with_its_line_and_the_reason(name: str) -> None:
    assert refusal(translate, CORPUS[name], error=Outside) == OUTSIDE[name]


def test_nine_of_ten_functions_compile() -> None:
    assert len(CORPUS) >= 30 and len(OUTSIDE) / len(CORPUS) <= 0.1


def test_the_corpus_compiles_for_a_gpu(tmp_path: Path) -> None:
    functions = [warp_function(translate(CORPUS[name]).snippet) for name in CORPUS if name not in OUTSIDE]
    kernels(functions, "corpus_for_a_gpu")
    wp.compile_aot_module(wp.get_module("muster.corpus_for_a_gpu"), arch=90, module_dir=tmp_path)
    assert list(tmp_path.glob("*.sm90.*"))
