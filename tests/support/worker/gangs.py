"""A gang of two real ranks that plays cases: functions of a test's module that are marked ``@case``.

A test of the same name judges what each rank returned from its case. All share one gang, since most of the time goes into starting ranks.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from shared_store.volume.epoch import raise_epoch
from shared_store.volume.layout import Run
from tests.support.waiting import PATIENCE
from tests.support.worker.collectives import watching
from tests.support.worker.point_task import Point
from tests.support.worker.ranks import run_ranks
from worker.learning import distributed
from worker.learning.distributed import Gang, RankPlacement
from worker.learning.randomness import seed_generators

Case = Callable[[Gang, Path], Any]
"""Gets the gang and the store; returns what JSON can hold."""
Played = dict[str, list[dict[str, Any]]]
"""By the name of a test: of each rank ``seen``, the functions and lines from which collectives were entered, and ``result`` or ``error``."""
SECONDS = 60.0
"""After how long a rank that waits for another in vain fails [s]."""


def case(function: Case) -> Case:
    """Mark a case of the module."""
    importlib.import_module(function.__module__).__dict__.setdefault("CASES", []).append(function)
    return function


def play_cases(module: str, env: dict[str, str]) -> Played:
    """Play the cases of ``tests.{module}``; its ranks have ``env``, with the store."""
    ranks = run_ranks("support.worker.gangs:play", 2, {**env, "CASES": f"tests.{module}"}, timeout=120.0 * PATIENCE)
    found: Played = {}
    for _, output, errors in ranks:
        for line in output.splitlines():
            if line.startswith('{"case"'):
                message = json.loads(line)
                found.setdefault(f"test_{message['case']}", []).append({**message, "errors": errors})
    assert [code for code, _, _ in ranks] == [0, 0], ranks
    return found


def play() -> int:
    """Body of a rank: a line of JSON for each case."""
    torch.set_num_threads(1)
    distributed.COLLECTIVE_SECONDS = SECONDS * PATIENCE
    with watching() as seen:
        gang = distributed.connect(RankPlacement.from_env(os.environ))
        for function in importlib.import_module(os.environ["CASES"]).CASES:
            seed_generators(1, gang.rank)
            reported: dict[str, Any] = {}
            try:
                reported["result"] = function(gang, Path(os.environ["MUSTER_STORE"]))
            except Exception as error:
                reported["error"] = f"{type(error).__name__}: {error}"
            print("\n" + json.dumps({"case": function.__name__, "seen": sorted(seen), **reported}), flush=True)
            seen.clear()
            gang.greatest(0)
        gang.close()
    return 0


def digest(state: Any) -> str:
    """Of all the tensors and values in a nested state."""
    if isinstance(state, torch.Tensor):
        return hashlib.sha256(state.contiguous().numpy().tobytes()).hexdigest()
    if isinstance(state, dict):
        return digest([digest([name, value]) for name, value in state.items()])
    if isinstance(state, list | tuple):
        return hashlib.sha256("".join(map(digest, state)).encode()).hexdigest()
    return hashlib.sha256(repr(state).encode()).hexdigest()


@contextlib.contextmanager
def supplied(gang: Gang, env: dict[str, str]) -> Iterator[None]:
    """``worker``'s commands have ``env``, find the point task, and are in ``gang``, which they do not close."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("worker.learning.distributed.connect", lambda *_, **__: gang)
        patch.setattr("worker.tasks.find_task", lambda _: Point)
        patch.setattr(gang, "close", lambda: None)
        for name, value in env.items():
            patch.setenv(name, value)
        yield


def started(gang: Gang, run: Run, epoch: int = 1) -> Run:
    """The run, given to this attempt as a controller does before it starts one."""
    if gang.is_main:
        raise_epoch(run, epoch)
    gang.greatest(0)
    return run
