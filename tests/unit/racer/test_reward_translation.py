"""Compiled reward functions give Python's numbers and errors: case by case, and those that people write."""

from __future__ import annotations

import math
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

from racer.rewards import parameters
from racer.rewards import reward as reward_module
from racer.rewards.compiled_function import failures_of, kernels, race_arrays, warp_function
from racer.rewards.problems import Failure, RewardRefused
from racer.rewards.reward import RewardFunction
from racer.rewards.samples import oval, oval_track, random_sample, samples
from racer.rewards.translation import Outside, Translated, translate
from tests.conftest import REPOSITORY
from tests.support.refusals import refusal

VALUES = (-2.5, -2.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.5, 7.0, 1e6)
"""Of x; y is the same list backwards."""
EXPRESSIONS = (
    "x // y",
    "x % y",
    "x / y",
    "x ** 2 - y ** 3",
    "x ** y",
    "abs(x) ** 0.5",
    "int(x) // int(y)",
    "int(x) % int(y)",
    "int(x) / 3",
    "2 ** -1 + int(x) ** 2",
    "divmod(x, 3)[0] + divmod(-int(y), 4)[1]",
    "round(x) + round(y, 1) + round(x / 7, 3)",
    "math.floor(x) + math.ceil(y) + math.trunc(x * 1.5)",
    "math.sqrt(x)",
    "math.log(y)",
    "math.log(8, 2) + math.log10(100)",
    "math.acos(x)",
    "math.exp(x)",
    "math.pow(x, y)",
    "math.fmod(x, y)",
    "math.copysign(3, x) + math.atan2(x, y) + math.hypot(x, y)",
    "math.degrees(x) - math.radians(y)",
    "float(x > 0) + (y > 0) + (True and 2)",
    "min(x, y, 1) + max([x, 3])",
    "(x or 5) + (y and 6)",
    "1 if x < y < 3 else 2",
    "[x, y, 4][int(x)]",
    "(1, 2, 3)[-1] + [10, 20, 30][::-1][0]",
    "sum([x, y, True]) + sum(i * i for i in range(5) if i % 2)",
    "sum(range(10, 0, -3)) + len(range(0, 10, 4))",
    "min(abs(x - k) for k in (1, 2, 3))",
    "any(k > x for k in (1, 5)) + all(k > x for k in (1, 5))",
    "max(TABLE, key=lambda row: row[1])[0]",
    "TABLE[int(y) % 3][1] + LONG[int(x)]",
    "NAMED['b'] + NAMED[int(x)]",
    "x not in (0.5, 7) and 3 or 4",
    "not x",
    "x is None or -x",
    "~int(x) ^ 5",
    "(lambda a, b=2: a * b)(x)",
    "sum(a * b for a, b in zip((x, y), (2, 3))) + sum(i * v for i, v in enumerate([x, y], 1))",
    "int(x) ** 12",
    "sum(row[0] for row in reversed(TABLE))",
    "[a + 1 for a in (x, y)][1]",
)
HEAD = """import math
TABLE = [(1, 2.5), (2, 0.5), (3, 9.0)]
LONG = [0.5, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19]
k = e = 7
def double(v): return v * 2
NAMED = {"b": 2.0, 0: 1, 1: 4, 7: 0.25, -2: 3}
def reward_function(params):
    x = params["x"]
    y = params["y"]
"""
BODIES = {
    "a variable that only some branches set": "if x > 0:\n        z = 1.5\n    return z",
    "a function that only sometimes returns": "if x > 0:\n        return 2.0",
    "an int that becomes a float": "z = 0\n    for i in range(4):\n        z += i * 0.5 if i else 1\n    return z",
    "a loop that is left and skipped": "z = 0\n    for i in range(10):\n        if i == 3: continue\n        if i > x + 5: break\n        z += i\n    return z + i",
    "a while with a bound of its own": "z = 1.0\n    while z < abs(x) + 3:\n        z *= 1.5\n    return z",
    "a swap and a nested target": "a, (b, c) = x, (y, 2)\n    a, b, c = c, a, b\n    return a + 10 * b + 100 * c",
    "an error in a part that is not reached": "return 1.0 if y == 0 or x / y > 1 else 2",
    "an error in a function": "def half(a, b):\n        return a / b\n    return half(x, y) + half(b=2.0, a=y)",
    "an index that is too large": "return params['waypoints'][int(abs(x)) * 100][0]",
    "an index from the end": "return params['waypoints'][-int(abs(y)) - 1][1]",
    "no objects": "return min(params['objects_distance'])",
    "a result that is not finite": "return x * float('inf')",
    "a step of zero": "return sum(range(0, 10, int(y)))",
    "a text": "side = 'left' if x > 0 else 'right'\n    return 1.0 if side in ('left', 'ahead') else -1",
    "a function that gives a list": "def both(a):\n        return [a, a * 2]\n    low, high = both(x)\n    return both(low)[1] - high",
    "a function that fails before it gives a constant": "def table(a):\n        b = 1 / a\n        return NAMED\n    return table(y)['b'] + x",
    "a function that gives an empty tuple": "def nothing():\n        return ()\n    return x + len(nothing())",
    "None as a default": "def plus(a, b=None):\n        return a if b is None else a + b\n    return plus(x) + plus(x, y)",
    "a function that is given a function": "def twice(f, a):\n        return f(f(a))\n    return twice(lambda v: v + y, x) + twice(double, x)",
    "a dictionary's items": "return sum(a * b for a, b in {1: 2.5, 2: 4}.items()) + x",
    "names that look alike": "z = (x, y)\n    z_0 = 5.0\n    z_1, z__0, zé = 6.0, 7.0, 8.0\n    return z[0] + z_0 * z_1 + z__0 * zé",
    "names of the module that a comprehension and a function hide": "return sum(sum((k, 1)) for k in (x, y)) + (lambda e: [e, 2][0])(x) + k",
    "a large int": "return float(int(x) * 10**12 * int(y) * 10**6)",
}
CASES = {
    **{text: f"{HEAD}    return 0.0 + ({text})\n" for text in EXPRESSIONS},
    **{name: f"{HEAD}    {body}\n" for name, body in BODIES.items()},
}


@pytest.fixture(scope="module")
def compiled() -> dict[str, Any]:
    """A kernel for each case, all in one module of Warp."""
    functions = [warp_function(translate(source).snippet) for source in CASES.values()]
    return dict(zip(CASES, kernels(functions, "translation"), strict=True))


def arrays() -> tuple[Any, list[dict[str, Any]]]:
    """Cars at the values, without objects."""
    race = race_arrays(len(VALUES), [oval()], "cpu")
    numbers, points = race.numbers.numpy(), [tuple(point) for point in np.float32(oval()).tolist()]
    for world, (x, y) in enumerate(zip(VALUES, reversed(VALUES), strict=True)):
        numbers[world], _ = parameters.row_of({**samples()["start"], "x": x, "y": y})
    return race, [parameters.parameters_of(row.tolist(), [], points) for row in numbers]


@pytest.mark.parametrize("name", CASES)
def test_a_translated_function_gives_pythons_number_or_an_error_where_python_raises(
    name: str, compiled: dict[str, Any]
) -> None:
    race, fields = arrays()
    rewards = wp.empty(len(VALUES), dtype=wp.float32, device="cpu")
    wp.launch(compiled[name], dim=len(VALUES), inputs=[race, rewards], device="cpu")
    function = interpreted(CASES[name])
    for params, reward, (code, count) in zip(fields, rewards.numpy().tolist(), race.errors.numpy(), strict=True):
        try:
            expected = function(params)
            expected = float(expected) if isinstance(expected, int | float) else math.nan
        except (ArithmeticError, ValueError, LookupError, NameError):
            expected = math.nan
        if math.isfinite(expected) and abs(expected) <= 1e5:
            assert reward == pytest.approx(float(np.float32(expected)), rel=1e-6, abs=1e-9), params["x"]
            assert count == 0
        elif not 1e17 < abs(expected) < math.inf:  # where an int may have been too large
            assert math.isnan(reward) and count == 1 and code % 16, (params["x"], expected)


def test_an_error_names_line_and_kind_and_is_counted_for_each_call(compiled: dict[str, Any]) -> None:
    race, _ = arrays()
    rewards = wp.empty(len(VALUES), dtype=wp.float32, device="cpu")
    for _ in range(3):
        wp.launch(compiled["x / y"], dim=len(VALUES), inputs=[race, rewards], device="cpu")
    failure = Failure(3, car=VALUES[::-1].index(0.0))
    large = ("it returned -400000; a reward is from -100,000 to 100,000, as on AWS", Failure(3, car=9))
    assert list(failures_of(race).values()) == [("line 10: ZeroDivisionError: division by zero", failure), large]


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("try:\n        return 1 / x\n    except ZeroDivisionError:\n        return 0", "line 10: try and except"),
        ("seen = []\n    for i in range(3):\n        seen.append({})\n    return 1", "line 12: a list that grows"),
        ("import random\n    return random.random()", "line 11: random.random()"),
        ("z = 1\n    z = 'one'\n    return z", "line 11: z, which is an int and then a text"),
        ("z = {k: 1 for k in (1, 2)}\n    return 1", "line 10: a dictionary that is made when it runs"),
        ("return f(x)", "line 10: the name f"),
        ("def f(a):\n        return f(a - 1)\n    return f(x)", "line 11: f(), which calls itself"),
        ("with x:\n        pass\n    return 1", "line 10: with"),
        ("return x > 0", "line 7: a reward_function that returns a truth value"),
        ("return [x, y]", "line 7: a reward_function that returns a list of 2"),
        ("LONG[0] = x\n    return 1", "line 10: a list whose items are changed"),
        ("return params['sped']", "line 10: params has no key 'sped' (did you mean speed?)"),
        ("return params['waypoints'][x]", "line 10: an index that is a float"),
        ("return len(str(x))", "line 10: a text that is made when it runs"),
        ("return sorted([x, y])[0]", "line 10: the name sorted"),
        ("@abs\n    def f():\n        return 1\n    return f()", "line 11: a decorated function, or one with * or **"),
        ("return int(x) ** 1000", "line 10: an int to a power of more than 64"),
        ("return 1\nLONG.append(x)", "line 11: a statement of the module that changes something"),
        ("return 1\nTABLE[0] = (9, 9)", "line 11: a statement of the module that changes something"),
        ("r = range(3)\n    return sum(r)", "line 10: a range that is kept for later"),
        ("def f():\n        return lambda: x\n    return f()()", "line 11: a function that returns a function"),
        ("return 2 ** int(x)", "line 10: an int to the power of an int that is not known"),
        ("return 1\nfrom numpy import *", "line 11: from numpy import *"),
        ("z = {(1, [2]): 3}\n    return 1", "line 10: a dictionary whose keys are not constant"),
        ("return pow(3, 4, 5)", "line 10: pow() with 3 arguments"),
        ("return int('101', 2)", "line 10: int() with 2 arguments"),
        ("return abs() if x > 1e9 else 1", "line 10: abs() with 0 arguments"),
        ("return np.hypot(x, y, 2) if x > 1e9 else 1\nimport numpy as np", "line 10: numpy.hypot() in this form"),
        ("return len(v for v in (x, y))", "line 10: a generator in this place"),
        ("return min((v for v in (x, y)), 1)", "line 10: min() in this form"),
        ("return sum((v for v in (x, y)), default=1)", "line 10: sum() in this form"),
        ("return sum(NAMED.values(k=1))", "line 10: the method values of a constant dict"),
    ],
)
def test_code_outside_the_subset_is_refused_with_line_and_reason(body: str, reason: str) -> None:
    output = refusal(translate, f"{HEAD}    {body}\n", error=Outside)
    assert output == f"{reason}: such functions run in Python workers"


@pytest.mark.parametrize(
    "use",
    [
        "z = f(x)\n    return 1.0 if z is None else z",
        "f(x)\n    return 1",
        "return f(x) or 3.0",
        "return 0.0 + (f(x) != 5)",
    ],
)
@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("if a > 0:\n            return 1.5", "line 10: a function that returns a float or None"),
        ("if a > 0:\n            return\n        return 2", "line 13: a function that returns None or an int"),
        (
            "if a > 0:\n            return [a, 2]\n        return None",
            "line 13: a function that returns a list of 2 or None",
        ),
        (
            "for i in range(3):\n            if i > a:\n                return i",
            "line 10: a function that returns an int or None",
        ),
        ("while a > 0:\n            return a", "line 10: a function that returns a float or None"),
    ],
)
def test_a_function_that_only_sometimes_returns_a_value_runs_in_python_workers(
    body: str, reason: str, use: str
) -> None:
    found = refusal(translate, f"{HEAD}    def f(a):\n        {body}\n    {use}\n", error=Outside)
    assert found == f"{reason}: such functions run in Python workers"


@pytest.mark.parametrize(
    "body",
    [
        "if a > 0:\n            return 1.5\n        else:\n            return 2",
        "while True:\n            a += 1\n            if a > 3:\n                return a",
        "if a > 0:\n            return\n        a = 3",
    ],
)
def test_a_function_that_always_or_never_returns_a_value_compiles(body: str) -> None:
    assert translate(f"{HEAD}    def f(a):\n        {body}\n    f(x)\n    return 1.0\n").snippet


def test_a_function_that_would_be_enormous_is_outside() -> None:
    sums = (" + ".join(f"f{n}(lambda: {k})" for k in range(9)) for n in range(8))
    calls = "".join(f"def f{n}(a):\n    return {sum}\n" for n, sum in enumerate(sums, 1))
    with pytest.raises(Outside):
        translate(f"def f0(a):\n    return 1\n{calls}def reward_function(params):\n    return f8(1)\n")


def test_a_translation_that_does_not_compile_runs_in_python_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reward_module, "translate", lambda source: Translated("this is not C++;"))
    reward = filled(RewardFunction(SOURCE, TRACKS, len(samples()), file="r.py", processes=1))
    assert reward.function is None and reward.reason.startswith("r.py: the compiler refused its translation, ")
    assert np.isfinite(reward.rewards().numpy()).all()
    reward.close()


def filled(reward: RewardFunction) -> RewardFunction:
    """Cars of the samples, on the oval and on a track of twice its size."""
    numbers, objects = reward.race.numbers.numpy(), reward.race.objects.numpy()
    for world, params in enumerate(samples().values()):
        numbers[world], rows = parameters.row_of(params, track=world % 2)
        objects[world, : len(rows)] = rows if rows else 0.0
    return reward


TRACKS = [oval(), [(2.0 * x, 2.0 * y) for x, y in oval()][::2]]
SOURCE = """def reward_function(params):
    first = params["waypoints"][1]
    return len(params["waypoints"]) + first[0] + 1 / (params["speed"] - 99) + len(params["objects_speed"])
"""


def test_both_ways_of_running_a_function_give_the_same_rewards_and_failures() -> None:
    count, found = len(samples()), list[Any]()
    for compiled in (True, False):
        reward = filled(RewardFunction(SOURCE, TRACKS, count, file="r.py", compiled=compiled, processes=2))
        assert (reward.function is not None) == compiled and bool(reward.reason) != compiled
        reward.race.numbers.numpy()[4, parameters.NUMBER_COLUMNS["speed"]] = 99.0
        found.append((reward.rewards().numpy().copy(), *reward.failures().items()))
        reward.close()
    (ours, message), (theirs, named) = found
    assert ours == pytest.approx(theirs, rel=1e-6, nan_ok=True) and np.flatnonzero(np.isnan(ours)).tolist() == [4]
    assert message == ("r.py: line 3: ZeroDivisionError: division by zero", Failure(1, car=4))
    assert named == ("r.py:3: ZeroDivisionError: float division by zero", Failure(1, car=4))
    assert ours[0] == pytest.approx(len(TRACKS[0]) + TRACKS[0][1][0] + 1.0 / (0.6 - 99.0))


def test_a_function_compiles_in_a_process_that_has_used_no_warp_yet() -> None:
    code = (
        "from racer.rewards.reward import RewardFunction as F; from racer.rewards.samples import oval\n"
        f"made = F({SOURCE!r}, [oval()], 1); print('reason', made.reason, made.function is not None)"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=REPOSITORY)
    assert output.stdout.splitlines()[-1:] == ["reason  True"], output.stderr


def test_code_that_the_guard_refuses_does_not_run() -> None:
    with pytest.raises(RewardRefused, match=r"^r\.py:1: IMPORT_ERROR: os can't be imported"):
        RewardFunction(f"import os\n{SOURCE}", TRACKS, 2, file="r.py")


CORPUS = {path.stem: path.read_text() for path in sorted((Path(__file__).parent / "corpus").glob("*.py"))}
OUTSIDE = {
    "global_state": "line 7: the global variable last_progress, which keeps its value: such functions run in Python workers",
    "numpy_arrays": "line 7: numpy.array(): such functions run in Python workers",
    "stateful_class": "line 18: an object of the class Reward: such functions run in Python workers",
}
DRAWN = 250


def tried() -> list[dict[str, Any]]:
    """Sample inputs and drawn ones, as the arrays hold them."""
    chance = random.Random(16)
    drawn = [*samples().values(), *(random_sample(oval_track(), chance) for _ in range(DRAWN))]
    found = []
    for params in drawn:
        numbers, objects = parameters.row_of(params)
        rows, points = np.float32(objects).tolist(), np.float32(params["waypoints"]).tolist()
        found.append(parameters.parameters_of(np.float32(numbers).tolist(), rows, [tuple(p) for p in points]))
    return found


def arrays_of(drawn: list[dict[str, Any]]) -> Any:
    """The same in arrays."""
    forth: list[Any] = drawn[0]["waypoints"]
    race = race_arrays(len(drawn), [forth, forth[::-1]], "cpu")
    numbers, objects = race.numbers.numpy(), race.objects.numpy()
    for world, params in enumerate(drawn):
        row, rows = parameters.row_of(params, track=int(params["is_reversed"]))
        numbers[world] = row
        objects[world, : len(rows)] = rows if rows else 0.0
    return race


@pytest.fixture(scope="module")
def rewarded() -> tuple[list[dict[str, Any]], dict[str, tuple[np.ndarray, list[Failure]]]]:
    """The inputs, and the rewards and errors of every function that compiles; all in one module of Warp."""
    drawn = tried()
    names = [name for name in CORPUS if name not in OUTSIDE]
    found = kernels([warp_function(translate(CORPUS[name]).snippet) for name in names], "corpus")
    results = {}
    for name, kernel in zip(names, found, strict=True):
        race = arrays_of(drawn)
        rewards = wp.empty(len(drawn), dtype=wp.float32, device="cpu")
        wp.launch(kernel, dim=len(drawn), inputs=[race, rewards], device="cpu")
        results[name] = (rewards.numpy(), [failure for _, failure in failures_of(race).values()])
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
    assert sum(failure.count for failure in errors) == raised
    assert len({round(value, 9) for value in expected}) > 1, "all rewards are the same: the test shows nothing"


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_function_outside_the_subset_is_refused_with_its_line_and_the_reason(name: str) -> None:
    assert refusal(translate, CORPUS[name], error=Outside) == OUTSIDE[name]


FORMS = {
    "def reward_function(params, share=0.5, *, more=2):\n    return params['x'] * share + more": lambda p: (
        p["x"] * 0.5 + 2
    ),
    "reward_function = lambda params: params['x'] + 1": lambda p: p["x"] + 1,
    "from math import *\ndef pow(a): return a + 7\ndef reward_function(params):\n    return pow(hypot(3, params['x'])) + tau": lambda p: (
        math.hypot(3, p["x"]) + 7 + math.tau
    ),
}


def test_a_lambda_and_defaults_and_star_imports_of_math_compile() -> None:
    drawn = tried()[:9]
    found = kernels([warp_function(translate(source).snippet) for source in FORMS], "forms")
    for kernel, expected in zip(found, FORMS.values(), strict=True):
        race, rewards = arrays_of(drawn), wp.empty(len(drawn), dtype=wp.float32, device="cpu")
        wp.launch(kernel, dim=len(drawn), inputs=[race, rewards], device="cpu")
        assert rewards.numpy() == pytest.approx([expected(params) for params in drawn], rel=1e-6)


def test_nine_of_ten_functions_compile() -> None:
    assert len(CORPUS) >= 30 and len(OUTSIDE) / len(CORPUS) <= 0.1


def test_the_corpus_compiles_for_a_gpu(tmp_path: Path) -> None:
    functions = [warp_function(translate(CORPUS[name]).snippet) for name in CORPUS if name not in OUTSIDE]
    kernels(functions, "corpus_for_a_gpu")
    wp.compile_aot_module(wp.get_module("muster.corpus_for_a_gpu"), arch=90, module_dir=tmp_path)
    assert list(tmp_path.glob("*.sm90.*"))
