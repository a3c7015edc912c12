"""Reward functions in Python workers: the same rewards, and one line for each way in which a function misbehaves."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.refusals import refusal
from tests.support.waiting import wait_for
from worker.racer.rewards import parameters
from worker.racer.rewards.problems import Failure, RewardFailed
from worker.racer.rewards.samples import oval, samples
from worker.racer.rewards.workers import Workers

WORLDS = 9


def pool(body: str, worlds: int = WORLDS, processes: int = 2, **options: Any) -> Workers:
    """Workers of a function whose statements are ``body``; car k drives at k m/s."""
    source = "def reward_function(params):\n" + "".join(f"    {line}\n" for line in body.split("\n"))
    workers = Workers(source, "reward.py", [oval()], worlds, processes, **options)
    row, objects = parameters.row_of(samples()["objects"])
    workers.numbers[:] = row
    workers.objects[:, : len(objects)] = objects
    workers.numbers[:, parameters.NUMBER_COLUMNS["speed"]] = range(worlds)
    return workers


def test_the_dictionary_has_every_documented_key_with_its_type() -> None:
    checks = [
        f"type(params[{each.name!r}]) is {each.kind}" if each.shape == "one" else f"type(params[{each.name!r}]) is list"
        for each in parameters.PARAMETERS
    ]
    elements = "type(params['waypoints'][0]) is tuple and type(params['objects_left_of_center'][0]) is bool"
    with pool(f"return float({' and '.join([*checks, elements])})") as workers:
        assert workers.rewards().tolist() == [1.0] * WORLDS


def test_a_function_that_changes_its_parameters_changes_nothing_for_others() -> None:
    with pool("params['waypoints'].clear()\nparams['speed'] = -1\nreturn float(len(params))") as workers:
        first = workers.rewards().tolist()
        assert workers.rewards().tolist() == first == [float(len(parameters.PARAMETERS))] * WORLDS
    with pool("n = len(params['waypoints'])\nparams['waypoints'].clear()\nreturn n") as workers:
        assert workers.rewards().tolist() == workers.rewards().tolist() == [float(len(oval()))] * WORLDS


NONE = "reward.py: it returned None; return a number on every way through the function"


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("return 1 / (params['speed'] - 3)", "reward.py:2: ZeroDivisionError: float division by zero"),
        ("return None if params['speed'] == 3 else 1", NONE),
        ("return float('nan') if params['speed'] == 3 else 1", "reward.py: it returned nan; return a finite number"),
        ("return 'much' if params['speed'] == 3 else 1", "reward.py: it returned a str; return a number"),
        ("if params['speed'] == 3: [0] * 10**9\nreturn 1", "reward.py:2: it used more than 2 GiB of memory"),
        ("if params['speed'] == 3: raise SystemExit\nreturn 1", "reward.py:2: it ended the program (SystemExit)"),
    ],
)
def test_a_call_that_gives_no_number_is_nan_and_counted_and_the_others_go_on(body: str, message: str) -> None:
    with pool(body) as workers:
        for steps in (1, 2):
            assert np.isnan(workers.rewards()).tolist() == [car == 3 for car in range(WORLDS)]
            assert workers.failures == {message: Failure(steps, car=3)}


LATE, FLOOD = "the function did not return within 0.3 s", "the function printed more than 64 KiB of text in one call"
CATCHING = "while params['speed'] == 7:\n    try:\n        while True: pass\n    except BaseException: pass\nreturn 1"
PRINTING = "for i in range(1_000_000 if params['speed'] == 7 else 3):\n    print(i)\nreturn 1"


@pytest.mark.parametrize(
    ("body", "line", "message"),
    [("while params['speed'] == 7: pass\nreturn 1", 2, LATE), (CATCHING, 4, LATE), (PRINTING, 3, FLOOD)],
)
def test_a_call_that_does_not_end_or_floods_ends_the_pool_with_its_line_and_car(
    body: str, line: int, message: str
) -> None:
    workers = pool(body, seconds=0.3)
    processes = list(workers._processes)
    assert refusal(workers.rewards, error=RewardFailed) == f"reward.py:{line}: car 7: {message}"
    assert all(process.returncode is not None for process in processes)
    with pytest.raises(RewardFailed, match="have ended"):
        workers.rewards()


def test_a_process_that_dies_is_reported_with_its_cars() -> None:
    workers = pool("return 1.0")
    workers._processes[1].kill()
    with pytest.raises(RewardFailed, match=r"reward.py: cars 5 to 8: the process of the function ended \(signal 9\)"):
        workers.rewards()


def test_a_file_that_cannot_be_loaded_is_reported_at_the_start() -> None:
    with pytest.raises(RewardFailed, match=r"^reward.py:1: ZeroDivisionError: division by zero$"):
        Workers("A = 1 / 0\ndef reward_function(params):\n    return 1.0\n", "reward.py", [oval()], 2, 1)


def test_a_worker_keeps_no_file_and_starts_no_process(tmp_path: Path) -> None:
    with pool(f"open({str(tmp_path / 'kept')!r}, 'w').write('text' * 5000)\nreturn 1.0", 1, 1) as workers:
        assert math.isnan(workers.rewards()[0])
        assert list(workers.failures) == ["reward.py:2: OSError: [Errno 27] File too large"]
    assert not (tmp_path / "kept").exists() or (tmp_path / "kept").stat().st_size == 0


def test_workers_end_with_the_process_that_started_them() -> None:
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        workers = pool("return 1.0", 2, 1)
        os.write(writer, f"{workers._processes[0].pid}\n".encode())
        time.sleep(600)
    os.close(writer)
    with os.fdopen(reader) as said:
        worker = int(said.readline())
    os.kill(child, 9)
    os.waitpid(child, 0)
    wait_for(lambda: not Path(f"/proc/{worker}").exists() or _ended(worker), 30, "the worker's end")


def _ended(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().split(") ")[1].startswith("Z")
    except OSError:
        return True
