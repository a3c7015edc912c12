"""The guard: what it refuses, with kind, file and line, before any job starts."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest

from docs.tools.reward_table import table
from racer.rewards import guard
from racer.rewards.__main__ import main
from racer.rewards.guard import check, check_source
from racer.rewards.parameters import BY_NAME, PARAMETERS, parameters_of, row_of
from racer.rewards.problems import KINDS
from racer.rewards.samples import oval_track, samples
from racer.rewards.translation import translate
from racer.tracks.geometry import place_at
from tests.conftest import REPOSITORY
from tests.support.racer.racing import round_the_guard

HEAD = "def reward_function(params):\n    "


def output(source: str) -> str:
    """The problem in one line; empty: there is none."""
    problem = check_source(source, "r.py")
    assert problem is None or (problem.kind in KINDS and "\n" not in str(problem))
    return str(problem or "")


def imports(line: int, module: str) -> str:
    may = "a reward function may import math, random, numpy, scipy, shapely"
    return f":{line}: IMPORT_ERROR: {module} can't be imported; {may}"


def forbidden(line: int, what: str) -> str:
    return f":{line}: FORBIDDEN: {what} can't be used in a reward function"


MISTYPED = ": TEST_FAILURE: there is no def reward_function(params); did you mean reward?"
LONG = ": SYNTAX_ERROR: 140,045 characters; a reward function has at most 140,000"
MANY = ": SYNTAX_ERROR: 120,015 words, signs and lines; a reward function has at most 60,000"
BESIDE = ":1: IMPORT_ERROR: a reward function is one file: it can't import from beside it"
ARGUMENTS = ":1: TEST_FAILURE: reward_function takes one argument: def reward_function(params)"


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("def reward_function(params:\n    return 1\n", ":1: SYNTAX_ERROR: '(' was never closed"),
        (f"{HEAD}return 1\x00", ": SYNTAX_ERROR: source code string cannot contain null bytes"),
        ("x = " + "(" * 5000 + ")" * 5000, ":1: SYNTAX_ERROR: too many nested parentheses"),
        (f"{HEAD}return {'1+' * 25_000}1", ": SYNTAX_ERROR: it is nested too deeply"),
        (f"{HEAD}return 1.0\nx = 1{'<1' * 60_000}", MANY),
        (f"{HEAD}return 1.0\n#{'x' * 140_000}", LONG),
        (f"import os\n{HEAD}return 1", imports(1, "os")),
        (f"{HEAD}from subprocess import run\n    return 1", imports(2, "subprocess")),
        (f"from . import other\n{HEAD}return 1", BESIDE),
        (f"import numpy.lib.format\n{HEAD}return 1", forbidden(1, "numpy.lib.format")),
        (f"from numpy import load\n{HEAD}return 1", forbidden(1, "numpy.load")),
        (f"import numpy as np\n{HEAD}return np.load('a')", forbidden(3, "the attribute load")),
        (f"import random\n{HEAD}return random._os.getpid()", forbidden(3, "the attribute _os")),
        (f"{HEAD}return eval('1')", forbidden(2, "eval")),
        (f"{HEAD}f = open\n    return 1", forbidden(2, "open")),
        (f"{HEAD}return __import__('os')", forbidden(2, "__import__")),
        (f"{HEAD}return ().__class__.__bases__", forbidden(2, "the attribute __bases__")),
        ("def reward(params):\n    return 1.0", MISTYPED),
        ("def reward_function(params, other):\n    return 1.0", ARGUMENTS),
        (f"{HEAD}return 1.0\ndef reward_function(params, x, y=1):\n    return 1", ARGUMENTS.replace(":1:", ":3:")),
        (f"{HEAD}break\n    return 1", ":2: SYNTAX_ERROR: 'break' outside loop"),
        ("def reward_function(params, x, y=1):\n    return 1", ARGUMENTS),
        (f"{HEAD}return float(len(dir(params)))", forbidden(2, "dir")),
        (f"{HEAD}return max([1], key=vars)", forbidden(2, "vars")),
        (f"def other():\n    dir = 1\n    return dir\n{HEAD}return len(dir())", forbidden(5, "dir")),
        (
            f"class A:\n    input = 1\n    x = input\n    def y(self): return input\n{HEAD}return [input for _ in 'a']",
            forbidden(4, "input"),
        ),
        (f"from numpy import *\n{HEAD}return load('a')", forbidden(3, "load")),
        ("from math import *\nx = 1", ": TEST_FAILURE: there is no def reward_function(params); the file defines none"),
    ],
)
def test_a_text_that_cannot_be_used_is_refused_without_running_it(
    source: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guard, "try_out", lambda *_, **__: pytest.fail("it was run"))
    assert output(source) == f"r.py{message}"


NONE = "it returned None; return a number on every way through the function"
TRUTH = "it returned False, a truth value; return a number such as float(False)"
LARGE = "it returned -100000.5; a reward is from -100,000 to 100,000, as on AWS"


@pytest.mark.parametrize(
    ("line", "sample", "message", "body"),
    [
        (2, "start", "ZeroDivisionError: division by zero", "return 1 / 0"),
        (2, "start", "KeyError: 'sped'", "return params['sped']"),
        (1, "off-track", NONE, "if params['is_offtrack']:\n        return None\n    return 1"),
        (1, "start", TRUTH, "return params['is_crashed'] or 0.5 > 1"),
        (1, "finish", "it returned inf; return a finite number", "return params['progress'] == 100 and 1e999 or 1"),
        (1, "start", "it returned a str; return a number", "return '1'"),
        (1, "start", "it returned a number beyond the range of a float", "return 10 ** 400"),
        (1, "start", "it returned a complex; return a number", "return 1j"),
        (2, "start", r"ValueError: a b\x1b[31m", r"raise ValueError('a\nb\x1b[31m')"),
        (1, "start", "it returned a generator; return a number", "yield 1"),
        (1, "start", LARGE, "return -100000.5"),
        (
            1,
            "finish",
            LARGE.replace("-100000.5", "1e+30"),
            "return 1e28 * params['progress'] if params['progress'] == 100 else 1",
        ),
        (2, "start", "it used more than 2 GiB of memory", "return len('x' * 10**10)"),
        (2, "start", "it calls itself too often (RecursionError)", "return reward_function(params)"),
    ],
)
def test_a_function_that_fails_on_a_sample_is_refused_with_the_sample_and_the_line(
    line: int, sample: str, message: str, body: str
) -> None:
    assert output(f"{HEAD}{body}") == f"r.py:{line}: TEST_FAILURE: the sample '{sample}': {message}"


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("np.array(True)", "it returned True, a truth value; return a number such as float(True)"),
        ("np.bool_(False)", TRUTH),
        ("np.str_('1')", "it returned a str_; return a number"),
        ("np.array('1')", "it returned an array of <U1; return a number"),
        ("np.complex128(1)", "it returned a complex128; return a number"),
        ("np.ones(1)", "it returned an array of shape (1,); return one number"),
    ],
)
def test_a_value_of_numpy_that_is_not_a_number_is_not_a_reward(value: str, message: str) -> None:
    assert output(f"import numpy as np\n{HEAD}return {value}") == f"r.py:2: TEST_FAILURE: the sample 'start': {message}"
    assert output(f"import numpy as np\n{HEAD}return np.array(1.5) + np.int64(2) * np.uint8(1)") == ""


def test_an_exception_that_cannot_be_shown_is_named_with_its_line() -> None:
    source = f"class Odd(Exception):\n    def __str__(self):\n        return [][0]\n{HEAD}raise Odd()\n"
    why = "Odd: its message can't be shown, since its __str__ raises IndexError"
    assert output(source) == f"r.py:5: TEST_FAILURE: the sample 'start': {why}"


def test_of_two_definitions_the_last_counts_and_underscores_of_own_objects_are_taken() -> None:
    twice = f"{HEAD}return None\n{HEAD}return 2.0"
    assert output(twice) == ""
    own = f"class Car:\n    def __init__(self):\n        self._last = 1.0\ncar = Car()\n{HEAD}return car._last"
    assert output(own) == ""
    private = (
        '__version__ = "1"\nclass Car:\n    __slots__ = ("__best", "io")\n    def __init__(self):\n        self.__best = 1.0\n'
        "        self.io = self.__best\n    __call__ = lambda self: self.io\n    __repr__ = __call__\ncar = Car()\n"
        f"{HEAD}__near = car.__call__()\n    return __near + len(type(car).__name__ + __version__)"
    )
    assert output(private) == ""
    hidden = f"import random\nbox = [random]\n{HEAD}r = box[0]\n    return r._inst.random()"
    assert output(hidden) == "r.py:5: FORBIDDEN: the sample 'start': random._inst can't be used in a reward function"


@pytest.mark.parametrize("config", ["[1]", "{", "3", "null"])
def test_a_configuration_of_the_check_that_is_not_a_mapping_is_refused_in_one_line(
    config: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["rewards", str(tmp_path / "r.py"), "--config", config])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == f'--config: expected a JSON object such as {{"track": "chicane"}}, found {config!r}'


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (
            f"{HEAD}for i in range(10**6):\n        print(i)",
            "3: {}: the sample 'start' printed more than 64 KiB of text",
        ),
        (f"A = [][0]\n{HEAD}return 1", "1: {}: the module: IndexError: list index out of range"),
        ("reward_function = 1.0", ": {}: the module: TypeError: reward_function is a float, which can't be called"),
        (
            "A = 0\nif A:\n    reward_function = A",
            ": {}: the module: NameError: the file defines no reward_function when it runs",
        ),
    ],
)
def test_a_flood_of_text_and_an_error_of_the_module_are_refused_with_their_line(source: str, message: str) -> None:
    assert output(source) == f"r.py:{message.format('TEST_FAILURE')}".replace("::", ":")


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (
            f"import numpy as np\n{HEAD}return len(np.ma.core.inspect.linecache.getlines('a'))",
            "3: the sample 'start': inspect",
        ),
        (
            f"import numpy as np\nbox = [np]\n{HEAD}box[0].savetxt('a', [])\n    return 1",
            "4: the sample 'start': numpy.savetxt",
        ),
        (f"import scipy\nx = scipy\n{HEAD}return 1\nx.datasets", "5: the module: scipy.datasets"),
        (
            f"import numpy as np\n{HEAD}return np.random.get_bit_generator()",
            "3: the sample 'start': numpy.random.get_bit_generator",
        ),
    ],
)
def test_a_module_outside_the_packages_and_a_function_for_files_are_refused_by_whatever_name(
    source: str, message: str
) -> None:
    line, _, rest = message.partition(": ")
    assert output(source) == f"r.py:{line}: FORBIDDEN: {rest} can't be used in a reward function"


def test_what_the_packages_need_inside_themselves_works() -> None:
    source = (
        "import numpy as np, scipy\nfrom scipy import interpolate, spatial\ndef reward_function(params):\n"
        "    near = spatial.cKDTree(params['waypoints']).query([params['x'], params['y']])[0]\n"
        "    line = interpolate.interp1d([0.0, 1.0], [1.0, 3.0])(0.5) + scipy.spatial.distance.euclidean([0.0], [2.0])\n"
        "    return float(np.emath.sqrt(4.0) + np.fft.fft([1.0]).real[0] + near + line + np.random.default_rng(1).random())\n"
    )
    assert output(source) == ""


CATCHING = "while True:\n        try:\n            while True: pass\n        except: pass"


@pytest.mark.parametrize("body", ["while True:\n        pass", CATCHING])
def test_a_function_that_loops_for_ever_is_refused_with_its_line(body: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "SECONDS", 0.5)
    problem = check_source(f"{HEAD}{body}", "r.py")
    assert problem is not None and problem.kind == "TIMEOUT" and problem.line in (2, 3, 4)
    assert problem.message == "the sample 'start' did not end within 0.5 s"


@pytest.mark.parametrize(
    "source",
    [
        f"{HEAD}return 1",
        f"import numpy as np\n{HEAD}return np.float32(params['speed'])",
        f"import math, random\n{HEAD}print('load', 'save', '__import__')\n    return random.random() + math.pi",
        "class A:\n    def __init__(self):\n        self.load = 1.0\nA1 = A()\ndef reward_function(params):\n    return A1.load\n",
        f"{HEAD}waypoints = list(params['waypoints'])\n    waypoints.append((0, 0))\n    return float(len(waypoints))",
        f"{HEAD}params['waypoints'].append((0, 0))\n    params['speed'] = 1\n    return 1",
        f"{HEAD}dir = params['heading']\n    return float(abs(dir))",
        "help = 2.0\ndef vars(input, eval=1):\n    return input\ndef reward_function(params):\n    return vars(help, eval=2)",
        "def reward_function(params, x=1, *rest, y=2, **more):\n    return x + y",
        "reward_function = lambda params: params['speed']",
        "from math import *\nreward_function = lambda params: hypot(3, 4) + pi",
        "from numpy import *\ndef reward_function(params):\n    return float(sqrt(params['speed']))",
        "class Reward:\n    def of(self, params):\n        return 1.0\nreward_function = Reward().of",
    ],
)
def test_a_valid_function_is_accepted_whatever_its_words(source: str) -> None:
    assert output(source) == ""


def test_a_tried_function_writes_no_file_and_sees_no_secret(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUSTER_TOKEN", "secret")
    kept = tmp_path / "kept.npy"
    monkeypatch.setattr(guard, "read", lambda *_: None)  # as one who gets round it would
    source = f"import os\n{HEAD}assert 'MUSTER_TOKEN' not in os.environ\n    open({str(kept)!r}, 'w').write('x' * 9999)\n    return 1"
    denied = f"PermissionError: [Errno 1] Operation not permitted: {str(kept)!r}"
    assert output(round_the_guard(source)) == f"r.py:4: TEST_FAILURE: the sample 'start': {denied}"
    assert not kept.exists()


def test_a_file_that_is_not_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.py"
    assert str(check(path)) == f"{path}: TEST_FAILURE: the file can't be read: No such file or directory"
    path.write_bytes(b"\xff\xfe\x00")
    assert str(check(path)).startswith(f"{path}: SYNTAX_ERROR: the file is not text: ")


def test_the_command_reports_errors_or_the_mode_of_execution(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    good, slow, bad = tmp_path / "good.py", tmp_path / "slow.py", tmp_path / "bad.py"
    good.write_text(f"{HEAD}print(1)\n    return params['speed']\n")
    slow.write_text(f"{HEAD}seen = []\n    seen.append({{}})\n    return 1.0\n")
    bad.write_text(f"{HEAD}return None\n")
    long = tmp_path / "long.py"
    long.write_text(f"{HEAD}return params['speed']\n{'#' * 21_000}\n")
    monkeypatch.setattr(sys, "argv", ["rewards", str(good), str(slow), str(bad), str(long)])
    assert main() == 1
    text, errors = capsys.readouterr()
    assert text.splitlines() == [
        f"{good}: valid, compiled to the device",
        "  line 2: print() is left out",
        f"{slow}: valid, not compiled",
        f"{long}: valid, compiled to the device",
        f"  {long.stat().st_size:,} bytes: a job keeps it in the store, not in its definition",
    ]
    [note] = [line for line in errors.splitlines() if line.startswith(f"{slow}: line")]
    slower = "hundreds of times slower than compiled ones for thousands of cars"
    assert note == f"{slow}: line 3: a list that grows: such functions run in Python workers, {slower}"
    assert errors.strip().endswith(NONE)
    monkeypatch.setattr(sys, "argv", ["rewards", str(tmp_path / "missing.py")])
    assert main() == 2 and "missing.py: there is no such file" in capsys.readouterr().err


def test_the_samples_are_what_a_car_on_the_oval_sees() -> None:
    found = samples()
    straight = found["straight"]
    # 1.5 m along the lower straight, from its middle at (0, -1.757); 0.21 m to the left of it; turned by 8 degrees to the right
    assert (round(straight["x"], 2), round(straight["y"], 2), round(straight["heading"], 2)) == (1.5, -1.55, -8.0)
    assert straight["is_left_of_center"] and straight["all_wheels_on_track"] and not straight["objects_location"]
    assert found["off-track"]["is_offtrack"] and not found["off-track"]["all_wheels_on_track"]
    direction = math.degrees(place_at(oval_track(), [3.3])[1][0])
    assert abs(found["reversed"]["heading"] - (direction - 175.0)) < 0.01 and found["reversed"]["is_reversed"]
    # the boxes are at 7, 11 and 15.5 m; the car at 6.4 m
    assert found["objects"]["closest_objects"] == [2, 0]
    for params in found.values():
        assert list(params) == [each.name for each in PARAMETERS]
        for name, value in params.items():
            least, most = BY_NAME[name].limits
            for each in value if isinstance(value, list) and not BY_NAME[name].points else [value]:
                if not isinstance(each, list):
                    assert least is None or least <= each
                    assert most is None or each <= most


def test_a_row_of_the_arrays_holds_all_that_a_dictionary_does() -> None:
    for params in samples().values():
        numbers, objects = row_of(params)
        assert parameters_of(numbers, objects, params["waypoints"]) == params


def test_the_page_has_the_table_of_the_contract_and_an_example_that_is_valid_and_compiles() -> None:
    page = (REPOSITORY / "docs" / "racer" / "rewards.md").read_text()
    source = page.split("```python\n")[1].split("```")[0]
    assert table() in page and output(source) == "" and translate(source).notes == ()


def test_the_characters_of_a_large_file_are_counted_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "large.py"
    path.write_text("# é" + "x" * 5_000_000, encoding="utf-8")
    assert str(check(path)) == f"{path}: SYNTAX_ERROR: 5,000,003 characters; a reward function has at most 140,000"
