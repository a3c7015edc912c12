"""What must hold in every history: of each launch, of each stop, and of all that a user sees."""

from __future__ import annotations

from typing import TYPE_CHECKING

from orchestrator.control.presence import LOST_AFTER
from orchestrator.domain.job import TERMINAL, Status
from orchestrator.engines.api import Gang
from tests.support.simulation.cluster import SimulatedGang
from tests.support.simulation.engine import ABSENT, HANGS
from tests.support.simulation.jobs import SimulatedJob
from tests.support.simulation.machine import Violation
from tests.support.simulation.store import NO_VOLUME

if TYPE_CHECKING:
    from tests.support.simulation.run import Simulation

_REPORTED = 80.0
"""Seconds within which a controller notices whether its engine and its volume answer: the longest pause between two tries, and some more."""
_SEEN = 30.0
"""Seconds within which a gang whose engine answers is seen to run, whatever the bus and the store do."""
_SLACK = 5.0
"""Seconds by which an end may be early: as long as clocks and leases are rounded."""


class Invariants:
    """Checks, by what is true in the cluster and what the database says. Each raises :class:`tests.support.simulation.machine.Violation`."""

    def __init__(self, world: Simulation) -> None:
        self._world = world
        self._state: tuple[int, float] | None = None
        """The controller's process, and when its engine, its database or its volume began or ceased to fail."""
        self._since = 0.0
        """Since when that is so, as far as was looked [s]."""
        self._is_checked = False
        """What reasons say of the engine was checked since then."""
        self._requests: set[tuple[int, str]] = set()
        """Processes of the controller, and the gangs whose launch each has asked for."""
        self._launched: list[SimulatedGang] = []
        """Gangs that have not been seen to run yet."""

    def check_request(self, gang: Gang) -> None:
        """The launch of nothing that is to end is asked for, except once by a process that can't know whether an earlier one had it launched."""
        ending, _ = self._attempt(gang.job, gang.attempt)
        request = self._world.machine.process, gang.name
        if ending is not None and request in self._requests:
            raise Violation(f"{gang.name} is to be launched, although it is {ending}")
        self._requests.add(request)

    def check_launch(self, gang: Gang) -> None:
        """Never two writers, nothing without its run, and no third attempt after the same fault twice."""
        if gang.run not in self._world.volume.runs:
            raise Violation(f"{gang.name} is launched, and the store does not have its run")
        for other in self._world.cluster.gangs.values():
            if other.run == gang.run and any(self._world.cluster.can_write(node) for node in other.running):
                raise Violation(f"{gang.name} is launched while {other.name} runs")
        before, last = self._faults(gang.job, gang.attempt)
        if last and before and last[1] is not None and last[1] == before[1]:
            raise Violation(f"{gang.name} is launched after {last[1]} ended attempts {before[0]} and {last[0]}")

    def launched(self, gang: SimulatedGang) -> None:
        """A gang that is to be seen soon."""
        if not (self._world.engine_absent or self._world.database_down):
            self._launched.append(gang)

    def check_cause(self, gang: SimulatedGang) -> None:
        """No gang is ended without a cause."""
        job, moment = self._world.job(gang.job), self._world.machine.time
        if job.stop_requested or not all(node.alive for node in gang.nodes):
            return
        if job.timeout is not None and moment - gang.launched > job.timeout - _SLACK:
            return
        silences = [moment - node.silent_since for node in gang.nodes if node.silent_since is not None]
        silences += [node.was_silent for node in gang.nodes]  # the engine may have been away since it was decided
        if self._world.bus_down and self._world.received <= 1:
            silences.append(
                moment - self._world.bus_down_since
            )  # nobody knows which is cut off: the node or the router
        if any(seconds > LOST_AFTER - _SLACK for seconds in silences):
            return
        ending, reason = self._attempt(gang.job, gang.attempt)
        by = self._world.job(reason.split()[3]) if ending == "preempted" and reason else None
        known = {row[0] for row in self._world.memory.execute("SELECT id FROM jobs")}  # some are not acknowledged yet
        if by is None or job.urgent or not by.urgent or by.id not in known:
            raise Violation(f"{gang.name} is ended without a cause: {ending}, {reason}")

    def poll(self) -> None:
        """What a user sees now: nothing acknowledged is lost, and each state has a reason."""
        found = self._world.memory.execute("SELECT id, status, status_reason FROM jobs").fetchall()
        rows = {job_id: (status, reason) for job_id, status, reason in found}
        for job in self._world.jobs:
            if not job.acknowledged:
                continue
            if job.id not in rows:
                raise Violation(f"{job.name} was acknowledged, and is lost")
            status, reason = rows[job.id]
            if job.final and status != job.final:
                raise Violation(f"{job.name} was {job.final}, and is {status} ({reason})")
            if not reason and status != Status.SUBMITTED:
                raise Violation(f"{job.name} is {status} and does not say why")
            if status in TERMINAL and not job.final:
                job.final = status
                self._check_end(job, status, reason)

    def _check_end(self, job: SimulatedJob, status: str, reason: str) -> None:
        """Every end is the true end, and a job that failed has spent its attempts."""
        succeeded = any(code == 0 for _, code, _ in job.main_ends)
        in_time = any(code == 0 and not (requested and job.timeout) for _, code, requested in job.main_ends)
        if status == Status.SUCCEEDED and job.name not in self._world.volume.runs:
            raise Violation(f"{job.name} is SUCCEEDED, and the store does not have its run")
        if status == Status.SUCCEEDED and not succeeded:
            raise Violation(f"{job.name} is SUCCEEDED, and its main node did not end with 0: {job.main_ends}")
        if status != Status.FAILED or job.stop_requested:
            return
        if in_time:
            raise Violation(f"{job.name} is FAILED ({reason}), and its main node ended with 0: {job.main_ends}")
        if job.timeout is not None:
            return
        query = "SELECT count(*) FROM attempts WHERE job_id = ? AND spent"
        spent = self._world.memory.execute(query, (job.id,)).fetchone()[0]
        ended_alike = [each and each[1] is not None and each[0] in job.faults for each in self._faults(job.id, 1 << 30)]
        if spent < job.attempts and not all(ended_alike):
            raise Violation(f"{job.name} is FAILED ({reason}) after {spent} of {job.attempts} attempts")

    def _faults(self, job: str, before: int) -> list[tuple[int, str | None] | None]:
        """Number and fault of the last two attempts that a job has spent before one, the later last; None where there was none."""
        query = (
            "SELECT number, fault FROM attempts WHERE job_id = ? AND number < ? AND spent ORDER BY number DESC LIMIT 2"
        )
        found = [tuple(row) for row in self._world.memory.execute(query, (job, before)).fetchall()]
        return [*[None] * (2 - len(found)), *reversed(found)]

    def check_reachable(self, process: int) -> None:
        """Once all has been as it is for a while: a RUNNING gang says whether its engine is away and whether a node is unreachable; a new gang
        is seen; jobs say why they wait."""
        world = self._world
        state = process, world.changed
        if state != self._state:
            self._state, self._since, self._is_checked, self._launched = state, world.machine.time, False, []
        self._check_seen()
        if self._is_checked or world.database_down or world.machine.time - self._since < _REPORTED:
            return  # without the database no reason can be written
        began, self._is_checked = self._since, True
        self._check_waiting()
        self._check_stops(began)
        rows = world.memory.execute(
            "SELECT jobs.name, jobs.status_reason, attempts.running_since, nodes.node_index FROM jobs"
            " JOIN attempts ON attempts.job_id = jobs.id"
            " LEFT JOIN nodes ON nodes.job_id = jobs.id AND nodes.attempt = attempts.number AND nodes.met"
            " WHERE jobs.status = 'RUNNING' AND jobs.stop_reason IS NULL AND attempts.ending IS NULL"
        ).fetchall()
        for name, reason, running, met in rows:
            job = world.job(name)
            seen = [
                gang for gang in world.cluster.gangs.values() if gang.run == name and gang.launched < began - _REPORTED
            ]
            if running is None or not seen or job.stop_requested:
                continue
            if world.engine_absent and not any(gang.running for gang in seen):
                continue  # the engine is not needed any more
            if (ABSENT in reason or HANGS in reason) != world.engine_absent:
                raise Violation(
                    f"{name} is RUNNING ({reason}), and its engine {'is away' * world.engine_absent or 'answers'}"
                )
            known = [node for gang in seen for node in gang.nodes if node.index == met and node.alive]
            missing = [node for node in known if not (world.hears(node) or world.met(node))]
            if missing and not world.engine_absent and "unreachable" not in reason:
                raise Violation(f"{name} is RUNNING ({reason}), and its controller has not met {missing[0]}")

    def _check_stops(self, began: float) -> None:
        """A stop that was asked for before ``began`` is decided, whatever the store does, unless the engine is away."""
        world = self._world
        if world.engine_absent:
            return
        query = (
            "SELECT jobs.name FROM jobs JOIN attempts ON attempts.job_id = jobs.id"
            " WHERE jobs.status = 'RUNNING' AND jobs.stop_reason IS NOT NULL AND attempts.ending IS NULL"
        )
        for (name,) in world.memory.execute(query).fetchall():
            if (requested := world.job(name).stopped_at) is not None and requested < began:
                raise Violation(f"{name} was asked to stop at {requested:.0f} s, and its end is not decided")

    def _check_waiting(self) -> None:
        """A job that waits says why, and that the volume is away if that is so, and only then."""
        world = self._world
        missing = world.volume.stalled or world.volume.full or world.volume.absent
        for name, reason in world.reasons():
            if not reason or (NO_VOLUME in reason) != missing:
                raise Violation(f"{name} waits ({reason}), and its volume {'is away' if missing else 'answers'}")

    def _check_seen(self) -> None:
        """A gang that runs is RUNNING soon after its launch."""
        while self._launched and self._world.machine.time - self._launched[0].launched > _SEEN:
            gang = self._launched.pop(0)
            query = "SELECT status, status_reason FROM jobs WHERE id = ?"
            status, reason = self._world.memory.execute(query, (gang.job,)).fetchone()
            if all(node.alive for node in gang.nodes) and status == Status.STARTING:
                raise Violation(f"{gang.name} runs, and its job is {status} ({reason})")

    def _attempt(self, job_id: str, number: int) -> tuple[str | None, str | None]:
        query = "SELECT ending, status_reason FROM attempts WHERE job_id = ? AND number = ?"
        ending, reason = self._world.memory.execute(query, (job_id, number)).fetchone()
        return ending, reason
