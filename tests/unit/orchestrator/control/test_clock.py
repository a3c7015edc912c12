"""Steps of the wall clock, and suspended machines: nothing ends, and nothing lasts less than nothing."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from sqlalchemy.orm import Session

from orchestrator.client import Client
from orchestrator.control.clock import Clock
from orchestrator.control.usage import usage_at
from orchestrator.persistence.own_models import ShareUsage
from orchestrator.persistence.session import Database
from orchestrator.server import Server
from tests.conftest import submit_gang
from tests.support.orchestrator.jobs import FOREVER, await_status, detail
from tests.support.processes import end_all

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


def test_a_step_of_the_clock_ends_no_job_even_across_a_restart_of_the_controller(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    real, step = time.time, [0.0]
    monkeypatch.setattr(time, "time", lambda: real() + step[0])
    server = Server(tmp_path, port=0, cpus=2, retention=HOUR)
    server.start()
    try:
        with Client(server.url) as client:
            done = submit_gang(client, "print('here')")
            await_status(client, done, "SUCCEEDED")
            job = submit_gang(client, FOREVER, timeout=HOUR, attempts=2)
            await_status(client, job, "RUNNING")
            for seconds in (2 * HOUR, -24 * HOUR):
                step[0] = seconds
                # it comes after the step, is looked at after it, and is over after that
                await_status(client, submit_gang(client, "print('here')"), "SUCCEEDED")
                assert detail(client, job)["status"] == "RUNNING"
                assert detail(client, done)["status"] == "SUCCEEDED", "its history is kept for an hour"
        server.close()
        step[0] = 3 * HOUR
        server = Server(tmp_path, port=0, cpus=2, retention=HOUR)
        server.start()
        with Client(server.url) as client:
            await_status(client, submit_gang(client, "print('here')"), "SUCCEEDED")
            assert detail(client, job)["status"] == "RUNNING"
            step[0] = -24 * HOUR
            client.batch("TerminateJob", jobId=job, reason="enough")
            ended = await_status(client, job, "FAILED")
            assert ended["statusReason"] == "enough" and len(ended["attempts"]) == 1
            [attempt] = ended["attempts"]
            assert attempt["stoppedAt"] >= attempt["startedAt"] and ended["stoppedAt"] >= ended["startedAt"]
            assert 0 < attempt["cpuSeconds"] < 600
    finally:
        server.close()
        end_all(tmp_path)
    steps = [record.getMessage() for record in caplog.records if "the wall clock moved by" in record.getMessage()]
    # another controller of this process sees the same steps
    assert list(dict.fromkeys(step.split()[5] for step in steps))[:3] == ["+7200", "-93600", "+97200"], steps
