"""The completion of a training: its last checkpoint is saved, however long the store takes."""

from __future__ import annotations

from time import sleep
from typing import TYPE_CHECKING

from shared_store.contract.phases import Phase
from worker.settings.errors import TrainingError

if TYPE_CHECKING:
    from worker.learning.loop import Loop


LONGEST_PAUSE = 30
"""Seconds between two tries to save the last checkpoint, at most."""


def complete(loop: Loop) -> str:
    """Save the last checkpoint until the store takes it; returns its name. All ranks call it.

    Raises TrainingError where the gang is asked to exit before the store takes the checkpoint.
    """
    loop.beacon.tell(
        done=True, phase=Phase.SAVING
    )  # training is over: a slow volume must not look like a stalled iteration
    state, gang, pause = loop.state, loop.gang, 1
    if state.ordered_at != state.progress.iteration:
        _order(loop)
    while True:
        loop.tell_saved(state.finish())
        name = gang.tell(state.saved_at) or ""
        if name.startswith(f"{state.progress.iteration:08d}-"):
            return name
        loop.say(f"training is done, and its last checkpoint is not saved yet; trying again in {pause} s")
        for _ in range(pause):  # of a second: the gang has little time to exit
            if gang.greatest(int(loop.stop.requested)):
                raise TrainingError(
                    "training is done, but its last checkpoint could not be saved; free space in the store and start again"
                )
            sleep(1.0)
        _order(loop)
        pause = min(2 * pause, LONGEST_PAUSE)


def _order(loop: Loop) -> None:
    loop.state.save(loop.reporter if loop.gang.is_main else None)
