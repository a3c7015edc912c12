"""Time that no step of the wall clock moves, for time-outs, shares, limits and the order of jobs.

A wall clock steps: a person sets it, NTP corrects it, a machine that was suspended wakes up hours later. The kernel's monotonic clock
does not, and it is the same for every process until the machine boots again. Steady time is Unix time as the wall clock had it when a
database was first used, and from there on what the monotonic clock counts: time for which the machine is suspended is not part of it.
Times for people and clients (``createdAt``, logs) stay wall-clock times.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from sqlalchemy import update
from sqlalchemy.orm import Session

from orchestrator import machine
from orchestrator.persistence.own_models import ClockState

log = logging.getLogger("muster.controller")

_STEP = 1000
"""A difference between both clocks that changes by more than this [ms] is a step; smaller ones come from reading them in turn."""


class Clock:
    """Steady time of one database, continued by each controller that uses it. For the controller's thread to change."""

    def __init__(
        self,
        wall: Callable[[], float] = machine.wall,
        monotonic: Callable[[], float] = machine.monotonic,
        boot: Callable[[], str] = machine.boot,
    ) -> None:
        """The machine's clocks [s], and the identity of its boot."""
        self._wall, self._monotonic, self._boot = wall, monotonic, boot
        self._offset = 0
        """Steady time less monotonic time [ms]; the same until the next boot."""
        self.drift = 0
        """Wall-clock time less steady time [ms]: added to a steady time where it is shown."""

    def now(self) -> int:
        """Steady time [ms]."""
        return round(self._monotonic() * 1000) + self._offset

    def restore(self, session: Session) -> None:
        """Continue the steady time of the controller before.

        After another boot (or on another machine) only the wall clock tells how much time has passed, and is believed.
        """
        state, boot = session.get(ClockState, 1), self._boot()
        if state is not None and state.boot == boot:
            self._offset, self.drift = state.offset, state.drift
            return
        self.drift = state.drift if state is not None else 0
        self._offset = round((self._wall() - self._monotonic()) * 1000) - self.drift
        self._save(session)

    @property
    def stepped(self) -> bool:
        """Whether the wall clock was moved, or the machine suspended, since the last look."""
        return abs(self._difference() - self.drift) > _STEP

    def note_step(self, session: Session) -> None:
        """Remember the step."""
        before, self.drift = self.drift, self._difference()
        log.warning(
            "the wall clock moved by %+.0f s against the monotonic one (it was set, or the machine was suspended); time-outs, "
            "limits and shares continue without that time",
            (self.drift - before) / 1000,
        )
        self._save(session)

    def rewrite(self, session: Session) -> None:
        """Write the present values again, as a test that the database can be written to."""
        session.execute(update(ClockState).values(boot=self._boot()))

    def _difference(self) -> int:
        return round(self._wall() * 1000) - self.now()

    def _save(self, session: Session) -> None:
        session.merge(ClockState(id=1, boot=self._boot(), offset=self._offset, drift=self.drift))
