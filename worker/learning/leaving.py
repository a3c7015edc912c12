"""Leaving in the middle of an iteration: a stopped job has a few seconds, and an iteration may take minutes.

A request to exit is seen once in an iteration, in its middle: at worst, the rank exits almost two iterations later. Where that could be too
late, every iteration is saved (the signal ``long`` of :mod:`worker.learning.exchange`). A rank whose iteration has still not ended
shortly before it would be killed exits without it: only that iteration is lost, and a resumed run repeats it, with the same bits.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

from shared_store.contract.error_text import counted
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.node_outcomes import EX_TEMPFAIL

if TYPE_CHECKING:
    from worker.learning.job import StopRequest
    from worker.learning.loop import Loop

_GRACE = 30.0
"""Seconds between SIGTERM and SIGKILL, where the environment does not say."""
_MARGIN = 5.0
"""Seconds before the kill at which a rank leaves."""
_FLUSH = 2.0
"""Longest wait for the last lines to be printed [s]."""


def patience_of(env: Mapping[str, str]) -> float:
    """Seconds after a request to exit at which a rank leaves in the middle of an iteration."""
    grace = float(env.get("MUSTER_GRACE_SECONDS") or _GRACE)
    return grace - min(_MARGIN, grace / 5)


def train(loop: Loop, stop: StopRequest) -> int:
    """Train to the end or until ``stop``, whose wait for the end of an iteration is limited; returns the exit code."""
    patience = patience_of(os.environ)
    stop.when_late(patience, partial(leave, loop, patience))
    try:
        return loop.train()
    except RuntimeError:  # of a collective with a rank that has just left
        if stop.is_older(patience / 2):
            leave(loop, patience)
        raise


def leave(loop: Loop, seconds: float) -> None:
    """Exit this process with 75, in the middle of what it is doing, unless it is already exiting; any thread may call it.

    A save of the last whole iteration that is in progress is waited for.

    Args:
        loop: The training.
        seconds: Since the request to exit.
    """
    state, run = loop.state, loop.job.run
    done = state.progress.iteration

    def is_pending() -> bool:
        return state.ordered_at == done and not any(each.iteration == done for each in list_checkpoints(run))

    while not loop.exits and is_pending():  # until the supervisor kills
        time.sleep(0.05)
    if loop.exits:
        return
    kept = next((each for each in reversed(list_checkpoints(run)) if each.iteration <= done), None)
    saved = kept.iteration if kept else 0
    doing = "the evaluation" if done == loop.training.iterations else f"iteration {done + 1}"
    there = f"checkpoint {kept.name} stands" if kept else "there is no checkpoint yet"
    lost = f", {counted(done - saved, 'iteration')} after it lost" if done > saved else ""
    printed = threading.Event()
    loop.say(f"asked to stop: {doing} did not end within {seconds:g} s and was left; {there}{lost}")
    loop.reporter.do(printed.set)
    printed.wait(_FLUSH)
    sys.stdout.flush()
    os._exit(EX_TEMPFAIL)
