"""Which exceptions another attempt of a job would meet again, and how two of them are known to be the same."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest

from shared_store.contract.faults import Fault, fault_from, fault_in

FRAME = 'Traceback (most recent call last):\n  File "/job/train.py", line 7, in main\n    step()\n'


def raised(tmp_path: Path, text: str) -> Fault | None:
    """The fault of a program, by what Python prints of it."""
    (tmp_path / "train.py").write_text(text)
    ended = subprocess.run([sys.executable, "train.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == 1, ended.stderr
    return fault_in(ended.stderr, tmp_path.resolve())


def test_a_fault_is_the_place_where_the_exception_was_raised(tmp_path: Path) -> None:
    text = "def reward(x):\n    return 1 / x\n\nfor x in (2, 1, 0):\n    reward(x)\n"
    fault = raised(tmp_path, text)
    assert fault == Fault("ZeroDivisionError", "train.py", 2)
    assert str(fault) == "ZeroDivisionError in train.py, line 2"
    assert raised(tmp_path, text.replace("1 / x", "1 / x  # again")) == fault, "its message and text do not count"
    assert raised(tmp_path, "\n" + text) != fault


def test_one_line_that_raises_for_unlike_causes_makes_unlike_faults() -> None:
    text = f"{FRAME}worker.settings.errors.TrainingError: 3 resets\n"
    falls, spins = (fault_in(text, Path("/job"), cause) for cause in ("its reward term fall", "its physics"))
    assert falls is not None and falls != spins and falls == fault_from(asdict(falls))
    assert str(falls) == "worker.settings.errors.TrainingError in train.py, line 7 (its reward term fall)"


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("class Odd(Exception): ...\nraise Odd('a\\nb: c')", ("Odd", 2)),
        ("import json\njson.loads('')", ("json.decoder.JSONDecodeError", None)),
        ("try:\n    {}[1]\nexcept KeyError as error:\n    raise ValueError('x') from error", ("ValueError", 4)),
        ("try:\n    {}[1]\nexcept KeyError:\n    [][0]", ("IndexError", 4)),
        ("compile('if True', 'other.py', 'exec')", ("SyntaxError", None)),
        ("import sys\nprint('before', file=sys.stderr)\nassert not 1", ("AssertionError", 3)),
        ("import atexit\natexit.register(print, 'Bye: all', file=__import__('sys').stderr)\n[][1]", ("IndexError", 3)),
    ],
)
def test_of_any_exception_of_the_program_itself(tmp_path: Path, text: str, fault: tuple[str, int | None]) -> None:
    found = raised(tmp_path, text)
    assert found is not None and found.type == fault[0]
    assert fault[1] is None or (found.file, found.line) == ("train.py", fault[1])


@pytest.mark.parametrize(
    "text",
    [
        "open('missing')",
        "import socket\nsocket.create_connection(('127.0.0.1', 1))",
        "import urllib.request\nurllib.request.urlopen('http://127.0.0.1:1')",
        "import subprocess\nsubprocess.run(['false'], check=True)",
        "raise MemoryError",
        "raise TimeoutError('late')",
        "raise RuntimeError('CUDA error: an illegal memory access was encountered')",
        "raise RuntimeError('CUDA out of memory. Tried to allocate 2.00 GiB')",
        "raise RuntimeError('Connection closed by peer [127.0.0.1]:4711')",
        "try:\n    open('missing')\nexcept OSError as error:\n    raise ValueError('no data') from error",
        "try:\n    open('missing')\nexcept OSError:\n    raise ValueError('no data')",
        "import os\nos.write(2, b'no traceback\\n')\nraise SystemExit(1)",
    ],
)
def test_what_comes_from_outside_the_program_is_not_a_fault(tmp_path: Path, text: str) -> None:
    assert raised(tmp_path, text) is None


@pytest.mark.parametrize(
    "name",
    [
        "torch.OutOfMemoryError",
        "torch.AcceleratorError",
        "torch.distributed.DistBackendError",
        "torch.distributed.DistStoreError",
        "requests.exceptions.ConnectionError",
        "botocore.exceptions.EndpointConnectionError",
        "urllib3.exceptions.MaxRetryError",
        "concurrent.futures.process.BrokenProcessPool",
        "worker.settings.errors.GangError",
        "shared_store.volume.epoch.StaleEpoch",
        "shared_store.volume.layout.StoreError",
        "shared_store.volume.checkpoints.DamagedCheckpoint",
        "PermissionError",
    ],
)
def test_types_of_memory_networks_peers_and_volumes_are_none(name: str) -> None:
    assert fault_in(f"{FRAME}{name}: why\n", Path("/job")) is None
    assert fault_in(f"{FRAME}worker.settings.errors.TrainingError: why\n", Path("/job")) is not None


def test_an_exception_that_a_collective_raised_is_none_whatever_it_says() -> None:
    inside = FRAME + '  File "/lib/torch/distributed/distributed_c10d.py", line 3000, in all_reduce\n    work.wait()\n'
    assert fault_in(f"{inside}RuntimeError: what is this\n", Path("/job")) is None
    assert fault_in(f"{FRAME}RuntimeError: what is this\n", Path("/job")) == Fault("RuntimeError", "train.py", 7)


def test_values_of_other_types_are_refused_and_long_ones_cut() -> None:
    assert fault_from(None) is None and fault_from(asdict(Fault("A", "a", 1))) == Fault("A", "a", 1)
    for wrong in (
        {"type": 1},
        {"file": None},
        {"line": True},
        {"line": 2**40},
        {"line": -1},
        {"other": 1},
        {"cause": 1},
    ):
        with pytest.raises(ValueError):
            fault_from({"type": "A", "file": "a", "line": 1, **wrong})
    with pytest.raises(ValueError):
        fault_from(["A", "a", 1])
    long = fault_from({"type": "x" * 9999 + "Error", "file": "y" * 9999 + ".py", "line": 1, "cause": "z" * 9999})
    assert long is not None and len(str(long)) < 950 and long.type.endswith("Error") and long.file.endswith(".py")
