"""One seed: 50 jobs, 20 faults, the real control plane, and what must hold of them."""

from __future__ import annotations

import logging
import math
import sqlite3
from collections.abc import Sequence
from functools import partial
from random import Random
from typing import Any

from orchestrator import machine as seam
from orchestrator.control.controller import Controller
from orchestrator.engines.registry import EngineSet
from orchestrator.persistence.batch_models import Job
from orchestrator.persistence.queries import ask_to_end
from orchestrator.persistence.session import DatabaseError
from tests.support.simulation.bus import SimulatedBus
from tests.support.simulation.cluster import Cluster, SimulatedNode
from tests.support.simulation.database import SimulatedDatabase, new_memory
from tests.support.simulation.engine import SimulatedEngine
from tests.support.simulation.faults import draw_fault
from tests.support.simulation.invariants import Invariants
from tests.support.simulation.jobs import SUBMITTING, SimulatedJob, draw_job
from tests.support.simulation.machine import Crash, LoopWaits, SimulatedMachine, Violation
from tests.support.simulation.store import SimulatedDisk, SimulatedRunStore, Volume

JOBS = range(50)
FAULTS = range(20)
_PATIENCE = 4 * 3600.0
"""Seconds after which every job must have ended."""
_TICK = 10.0
"""Seconds between two passes of the loop while nothing changes."""
_SOON = 0.02
"""Seconds from a change to a pass."""
_AGAIN = 5.0
"""Seconds after which a user submits again what was not acknowledged."""


class Simulation:
    """The world of one seed, and the controller in it."""

    def __init__(self, seed: int, jobs: Sequence[int] = JOBS, faults: Sequence[int] = FAULTS) -> None:
        """``jobs``, ``faults``: numbers of those that take part."""
        self.rng = Random(seed)
        self.machine = SimulatedMachine(self.rng)
        self.machine.latency = self._latency
        self.memory = new_memory()
        self.memory.hook = self._on_statement
        self.volume = Volume()
        self.cluster = Cluster(self)
        self.invariants = Invariants(self)
        self.engine_down = self.engine_hangs = self.bus_down = self.database_down = False
        self.changed = 0.0
        """When the engine, the database or the volume began or ceased to fail the last time [s]."""
        self.bus_down_since = 0.0
        """Since when the bus is down, or was the last time [s]."""
        self.crowded = False
        """Requests hold every connection to the database that they can get."""
        self.in_loop = False
        """The controller's loop is at work."""
        self.router = 1
        """The address at which the controller's bus is."""
        self.writes_left: int | None = None
        """How many more writes the controller's process survives; None: all."""
        self.story: list[str] = []
        self.jobs = [draw_job(seed, index) for index in jobs]
        self._named = {job.name: job for job in self.jobs}
        self._faults = [draw_fault(seed, index) for index in faults]
        self._controller: Controller | None = None
        self._bus: SimulatedBus | None = None
        self._next_tick = 0.0
        self._committed = False

    def run(self) -> None:
        """Raises Violation."""
        with seam.replaced_by(self.machine):
            try:
                self._start()
                for job in self.jobs:
                    self.machine.after(job.submitted_at, partial(self._submit, job))
                    if job.stopped_at is not None:
                        self.machine.after(job.stopped_at, partial(self._ask_to_stop, job))
                for moment, fault, rng in self._faults:
                    self.machine.after(moment, partial(fault, self, rng))
                self._go_on()
            finally:
                if self._controller is not None:
                    self._controller.engines.close()

    @property
    def engine_absent(self) -> bool:
        """Whether the engine refuses calls, or does not return from them."""
        return self.engine_down or self.engine_hangs

    def job(self, name: str) -> SimulatedJob:
        """The job of this name or id."""
        return self._named[name.rpartition("-")[2]]

    def note(self, what: str) -> None:
        self.story.append(f"{self.machine.time:.1f} {what}")

    def _go_on(self) -> None:
        end = self.machine.time + SUBMITTING + _PATIENCE
        while self.machine.time < end:
            self.machine.step()
            controller, soon = self._controller, self.machine.time + _SOON
            if controller is not None and controller.work_queue.alarm.is_set() and self._next_tick > soon:
                self._tick_at(soon)
            if all(job.final for job in self.jobs):
                return
        query = "SELECT name, status, status_reason FROM jobs WHERE status NOT IN ('SUCCEEDED', 'FAILED')"
        raise Violation(f"these jobs do not end: {self.memory.execute(query).fetchall()}")

    # -- the controller's process -------------------------------------------------------------------------------------

    def _start(self) -> None:
        self.machine.process += 1
        self.crowded = False
        try:
            runs = SimulatedRunStore(self)
            self._bus = SimulatedBus(self)
            self._controller = Controller(
                SimulatedDatabase(self.memory, self),
                EngineSet([SimulatedEngine(self)]),
                runs.store,
                self._bus,  # type: ignore[arg-type]
                None,  # type: ignore[arg-type]
                disk=SimulatedDisk(self),  # type: ignore[arg-type]
                runs=runs,
            )
            self._controller.texts._next_sweep = math.inf  # its store has no texts
        except (DatabaseError, Crash):
            self._controller = self._bus = None
            self.machine.after(2.0, self._start)
            return
        for node in self.cluster.running:
            self.notice(node, self.rng.uniform(0.5, 8.0))
        self._tick_at(self.machine.time)

    def _tick_at(self, moment: float) -> None:
        """Make the next pass of the loop then."""
        self._next_tick, process = moment, self.machine.process
        self.machine.after(max(0.0, moment - self.machine.time), lambda: self._tick(process, moment))

    def _tick(self, process: int, due: float) -> None:
        controller = self._controller
        if process != self.machine.process or due != self._next_tick or controller is None or self._bus is None:
            return
        self._bus.listen()
        controller.work_queue.alarm.clear()
        self.in_loop = True
        try:
            controller._isolation.part("reconciling", controller.tick)
        except Crash:
            self.die()
            return
        except LoopWaits:
            raise Violation("the loop waits for a call") from None
        finally:
            self.in_loop = False
        self._tick_at(self.machine.time + _TICK)
        if self._committed:
            self._committed = False
            self.invariants.poll()
        self.invariants.check_reachable(process)

    def die(self) -> None:
        """Kill the process; another one is started soon."""
        if self._controller is None:
            return
        self.note("the controller is killed")
        self.writes_left = self._controller = self._bus = None
        self.machine.process += 1
        self.machine.after(self.rng.uniform(1.0, 30.0), self._start)

    def write(self, where: str) -> None:
        """A write of the controller: its process may be killed here. Raises Crash."""
        if self.writes_left is not None:
            self.writes_left -= 1
            if self.writes_left <= 0:
                self.writes_left = None
                self.note(f"killed {where}")
                self.machine.after(0.0, self.die)
                raise Crash(where)

    def _on_statement(self, statement: str) -> None:
        self._committed |= statement == "COMMITTED"
        if statement[:6] not in ("SELECT", "PRAGMA"):
            self.write(f"at {statement[:30]}")
        if self.database_down:
            raise sqlite3.OperationalError("disk I/O error")

    def _latency(self, pool: str) -> float:
        return self.rng.choice((0.002, 0.01, 0.05, 0.3, 1.5)) if not pool.startswith("stop") else 0.01

    def reasons(self) -> list[tuple[str, str]]:
        """The jobs that wait for room, and the reason that the user of each sees."""
        assert self._controller is not None
        query = "SELECT id, name, status, status_reason FROM jobs WHERE status = 'RUNNABLE'"
        rows = [Job(id=row[0], name=row[1], status=row[2], status_reason=row[3]) for row in self.memory.execute(query)]
        return [(job.name, self._controller.admission.reason(job).aws) for job in rows]

    # -- the bus ------------------------------------------------------------------------------------------------------

    @property
    def received(self) -> int:
        """How many nodes the controller's router has met, and does not know to have ended."""
        return len(self._bus.presence._nodes) if self._bus is not None else 0

    def hears(self, node: SimulatedNode) -> bool:
        """Whether the controller's router hears the node."""
        return node.acts and not self.bus_down and node.gang.router == self.router

    def met(self, node: SimulatedNode) -> bool:
        """Whether the controller of now has met the node."""
        return self._bus is not None and self._bus.presence.met(node.key)

    def notice(self, node: SimulatedNode, after: float) -> None:
        """After so many seconds the bus has noticed how a node is."""
        self.machine.after(after, lambda: self._bus.notice(node) if self._bus is not None else None)

    # -- people -------------------------------------------------------------------------------------------------------

    def _submit(self, job: SimulatedJob) -> None:
        """Submit until that is acknowledged."""

        def body(session: Any) -> dict[str, Any]:
            if session.get(Job, job.id) is None:  # else it came in, and the answer was lost
                session.add(job.row())
            return {}

        if self._controller is not None and self._controller.trouble is None:
            try:
                self._controller.writes.gather(body)
                job.acknowledged = True
            except DatabaseError:
                pass
            except Crash:
                self.die()
        if not job.acknowledged:
            self.machine.after(_AGAIN, lambda: self._submit(job))

    def _ask_to_stop(self, job: SimulatedJob) -> None:
        if not job.acknowledged or self._controller is None:
            return
        job.stop_requested = True  # also where the answer is lost: then it may count or not
        try:
            with self._controller.database.session() as session:
                ask_to_end(session, Job.id == job.id, "stopped by its user")
        except DatabaseError:
            pass
        except Crash:
            self.die()


def simulate(seed: int, jobs: Sequence[int] = JOBS, faults: Sequence[int] = FAULTS) -> Simulation:
    """One seed. Raises Violation, with the story of the faults."""
    disabled = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    simulation = Simulation(seed, jobs, faults)
    try:
        simulation.run()
    except Violation as violation:
        raise Violation("\n".join([f"seed {seed}: {violation}", *simulation.story])) from None
    finally:
        logging.disable(disabled)
    return simulation
