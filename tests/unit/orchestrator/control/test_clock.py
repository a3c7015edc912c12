"""Steps of the wall clock, and suspended machines: nothing ends, and nothing lasts less than nothing."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy.orm import Session

from orchestrator.control.clock import Clock
from orchestrator.control.usage import usage_at
from orchestrator.persistence.own_models import ShareUsage
from orchestrator.persistence.session import Database

HOUR = 3600


@dataclass
class Machine:
    """The clocks of a machine [s]."""

    wall: float = 1_800_000_000.0
    monotonic: float = 500.0
    boot: str = "first"

    def passes(self, seconds: float) -> None:
        self.wall += seconds
        self.monotonic += seconds

    def clock(self) -> Clock:
        return Clock(lambda: self.wall, lambda: self.monotonic, lambda: self.boot)


def started(machine: Machine, database: Database) -> Clock:
    clock = machine.clock()
    with database.session() as session:
        clock.restore(session)
    return clock


def noted(clock: Clock, database: Database) -> None:
    assert clock.stepped
    with database.session() as session:
        clock.note_step(session)
    assert not clock.stepped


def test_steady_time_begins_as_the_wall_clock_and_passes_over_its_steps_and_the_machine_s_sleep(
    database: Database,
) -> None:
    machine = Machine()
    clock = started(machine, database)
    start = clock.now()
    assert start == machine.wall * 1000 and clock.drift == 0 and not clock.stepped
    machine.passes(10)
    assert clock.now() == start + 10_000 and not clock.stepped
    for step in (2 * HOUR, -24 * HOUR, HOUR):  # set ahead, set back, and an hour of sleep
        machine.wall += step
        noted(clock, database)
        assert clock.now() == start + 10_000
    assert clock.drift == -21 * HOUR * 1000
    machine.passes(5)
    again = started(machine, database)
    assert (again.now(), again.drift) == (start + 15_000, clock.drift), "the next controller goes on from there"
    machine.wall += HOUR
    machine.passes(1)
    noted(started(machine, database), database)  # while no controller ran


def test_after_another_boot_the_wall_clock_says_how_much_time_has_passed(database: Database) -> None:
    machine = Machine()
    clock = started(machine, database)
    start = clock.now()
    machine.wall += 2 * HOUR
    noted(clock, database)
    machine.passes(10)
    machine.wall, machine.monotonic, machine.boot = machine.wall + 60, 3.0, "second"
    after = started(machine, database)
    assert (after.now(), after.drift) == (start + 70_000, clock.drift) and not after.stepped


def test_a_clock_that_is_behind_does_not_multiply_the_use_of_a_share(session: Session) -> None:
    session.add(ShareUsage(queue="default", share="red", seconds=100.0, as_of=10**12))
    session.flush()
    assert usage_at(session, 10**12 - 86_400_000, {"default": 60}, []) == {("default", "red"): 100.0}
