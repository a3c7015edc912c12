"""Leaving a training: after its last checkpoint, however long the store takes, or in the middle of an iteration.

A stopped job has a few seconds, and an iteration may take minutes. A request to exit is seen once in an iteration, in its middle: at worst,
the rank exits almost two iterations later. Where that could be too late, every iteration is saved (the signal ``long`` of
:mod:`worker.learning.exchange`). A rank whose iteration has still not ended shortly before it would be killed exits without it: only that
iteration is lost, and a resumed run repeats it, with the same bits.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Mapping
from functools import partial
from time import sleep
from typing import TYPE_CHECKING

from shared_store.contract.error_text import counted
from shared_store.contract.phases import Phase
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.node_outcomes import EX_TEMPFAIL
from worker.settings.errors import TrainingError

if TYPE_CHECKING:
    from worker.learning.job import StopRequest
    from worker.learning.loop import Loop

LONGEST_PAUSE = 30
"""Seconds between two tries to save the last checkpoint, at most."""
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


def complete(loop: Loop) -> str:
    """Save the last checkpoint until the store takes it; returns its name. All ranks call it.

    Raises TrainingError where an exit is requested before the store takes the checkpoint.
    """
    loop.beacon.send(done=True, phase=Phase.SAVING)  # a slow volume must not look like a stalled iteration
    state, gang, pause = loop.state, loop.gang, 1
    is_ordered = state.ordered_at == state.progress.iteration
    while True:
        if not is_ordered:
            state.save(loop.reporter if gang.is_main else None)
        is_ordered = False
        loop.report_saves(state.finish())
        name = gang.broadcast_text(state.saved_at) or ""
        if name.startswith(f"{state.progress.iteration:08d}-"):
            return name
        loop.say(f"training is done, and its last checkpoint is not saved yet; trying again in {pause} s")
        for _ in range(pause):  # of a second: the gang has little time to exit
            if gang.greatest(int(loop.stop.requested)):
                raise TrainingError(
                    "training is done, but its last checkpoint could not be saved; free space in the store and start again"
                )
            sleep(1.0)
        pause = min(2 * pause, LONGEST_PAUSE)


def leave(loop: Loop, seconds: float) -> None:
    """Exit this process with 75, in the middle of what it is doing, unless it is already exiting; any thread may call it.

    A save of the last whole iteration that is in progress is waited for.

    Args:
        loop: The training.
        seconds: Since the request to exit.
    """
    state, run = loop.state, loop.job.run
    done = state.progress.iteration
    while not loop.exits and state.ordered_at == done and all(each.iteration != done for each in list_checkpoints(run)):
        sleep(0.05)  # until the supervisor kills
    if loop.exits:
        return
    kept = next((each for each in reversed(list_checkpoints(run)) if each.iteration <= done), None)
    saved = kept.iteration if kept else 0
    doing = "the evaluation" if done == loop.training.iterations else f"iteration {done + 1}"
    last = f"checkpoint {kept.name} stands" if kept else "there is no checkpoint yet"
    lost = f", {counted(done - saved, 'iteration')} after it lost" if done > saved else ""
    printed = threading.Event()
    loop.say(f"stop requested: {doing} did not end within {seconds:g} s and was left; {last}{lost}")
    loop.reporter.do(printed.set)
    printed.wait(_FLUSH)
    sys.stdout.flush()
    os._exit(EX_TEMPFAIL)
