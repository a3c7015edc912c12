"""One seed: 50 jobs, 20 faults, and what must hold of them."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from random import Random
from typing import Any

from orchestrator import machine as seam
from orchestrator.control.presence import LOST_AFTER
from orchestrator.control.reconciler import Reconciler
from orchestrator.domain.job import TERMINAL, Status
from orchestrator.engines.api import Gang
from orchestrator.engines.registry import EngineSet
from orchestrator.persistence.models import Job
from orchestrator.persistence.queries import ask_to_end
from orchestrator.persistence.session import DatabaseError
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.model import validate
from shared_store.outcomes import EX_TEMPFAIL, Outcome
from tests.support.simulation.bus import SimulatedBus
from tests.support.simulation.cluster import SimulatedEngine, SimulatedGang, SimulatedNode
from tests.support.simulation.database import SimulatedDatabase, new_memory
from tests.support.simulation.machine import Crash, LoopWaits, SimulatedMachine
from tests.support.simulation.store import SimulatedDisk, SimulatedRunStore, Volume

JOBS = 50
FAULTS = 20
SUBMITTING = 1200.0
"""Seconds during which jobs are submitted and faults happen."""
PATIENCE = 4 * 3600.0
"""Seconds after which every job must have ended."""
TICK = 10.0
"""Seconds between two passes of the loop while nothing changes."""
_LEASE = 4.0
"""Seconds until the bus notices that a node is silent."""


class Violation(AssertionError):
    """Something does not hold that always must."""


@dataclass
class SimulatedJob:
    """A job as its user knows it."""

    name: str
    nodes: int
    work: float
    """Seconds that its main node needs in all."""
    code: int
    """Exit code once the work is done."""
    breaks: list[float]
    """Seconds of an attempt after which it fails by itself, by attempt."""
    attempts: int
    timeout: int | None
    urgent: bool
    """It is in a queue that preempts."""
    pulling: float
    """Seconds for which its image is pulled before it can be launched."""
    id: str = ""
    """Once its submission was acknowledged."""
    stop_asked: bool = False
    done: float = 0.0
    """Seconds of work that its checkpoints hold."""
    main_ends: list[tuple[int, int]] = field(default_factory=list)
    """Attempt and exit code of each main node that ended by itself."""
    final: str = ""
    """The state that was shown once, and must stay."""


@cache
def _definition(nodes: int) -> dict[str, Any]:
    document = {
        "name": "job",
        "nodes": nodes,
        "resources": {"cpus": 1, "memory": "16MiB"},
        "command": ["true"],
        "preemptible": True,
    }
    properties: dict[str, Any] = compile_definition(validate(document, "job"), "/")["nodeProperties"]
    return properties


class Simulation:
    """The world of one seed, and the controller in it."""

    def __init__(self, seed: int, jobs: int = JOBS, faults: int = FAULTS) -> None:
        self.seed, self.rng = seed, Random(seed)
        self.machine = SimulatedMachine(self.rng)
        self.machine.latency = self._latency
        self.memory = new_memory()
        self.memory.hook = self._on_statement  # type: ignore[method-assign]
        self.volume = Volume()
        self.gangs: dict[str, SimulatedGang] = {}
        self.engine_down = self.bus_down = self.database_down = False
        self.router = 1
        """The address at which the controller's bus is."""
        self.reconciler: Reconciler | None = None
        self.bus: SimulatedBus | None = None
        self.story: list[str] = []
        self._crash_in: int | None = None
        """How many more writes the process survives."""
        self._next_tick = 0.0
        self._committed = False
        self._pulled: dict[str, int] = {}
        """The process that asked for each gang first."""
        self._asked: dict[str, float] = {}
        self._jobs = [self._draw_job(index) for index in range(jobs)]
        self._faults = faults

    # -- the run ------------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Raises Violation."""
        logging.disable(logging.CRITICAL)
        with seam.replaced_by(self.machine):
            try:
                self._start()
                for job in self._jobs:
                    self.machine.after(self.rng.uniform(0, SUBMITTING), lambda job=job: self._submit(job))
                    if self.rng.random() < 0.1:
                        self.machine.after(self.rng.uniform(0, 2 * SUBMITTING), lambda job=job: self._ask_to_stop(job))
                for _ in range(self._faults):
                    self.machine.after(self.rng.uniform(0, SUBMITTING), self._draw_fault())
                self._go_on()
            finally:
                logging.disable(logging.NOTSET)
                if self.reconciler is not None:
                    self.reconciler.engine.close()

    def _go_on(self) -> None:
        end = self.machine.time + SUBMITTING + PATIENCE
        while self.machine.time < end:
            self._step()
            if self.machine.time > 1000.0 + SUBMITTING and all(job.final for job in self._jobs):
                return
        stuck = [(job.name, self._row(job)) for job in self._jobs if not job.final]
        raise Violation(f"these jobs do not end: {[(n, r and (r.status, r.status_reason)) for n, r in stuck]}")

    def _step(self) -> None:
        self.machine.step()
        if (
            self.reconciler is not None
            and self.reconciler._wake.is_set()
            and self._next_tick > self.machine.time + 0.02
        ):
            self._next_tick = self.machine.time + 0.02
            self._schedule_tick()

    def _schedule_tick(self) -> None:
        process, due = self.machine.process, self._next_tick
        self.machine.after(max(0.0, due - self.machine.time), lambda: self._tick(process, due))

    def _tick(self, process: int, due: float) -> None:
        if process != self.machine.process or due != self._next_tick or self.reconciler is None:
            return
        self.reconciler._wake.clear()
        try:
            self.reconciler._isolated("reconciling", self.reconciler.tick)
        except Crash:
            self._die()
            return
        except LoopWaits:
            raise Violation("the loop waits for a call") from None
        self._next_tick = self.machine.time + TICK
        self._schedule_tick()
        self._look()

    # -- the controller's process -------------------------------------------------------------------------------------

    def _start(self) -> None:
        self.machine.process += 1
        try:
            database = SimulatedDatabase(self.memory)
            self.bus = SimulatedBus(self)
            self.reconciler = Reconciler(
                database,
                EngineSet([SimulatedEngine(self)]),
                SimulatedRunStore(self).store,
                self.bus,  # type: ignore[arg-type]
                None,  # type: ignore[arg-type]
                disk=SimulatedDisk(self),  # type: ignore[arg-type]
                runs=SimulatedRunStore(self),
            )
        except (DatabaseError, Crash):
            self.reconciler = self.bus = None
            self.machine.after(2.0, self._start)
            return
        for gang in self.gangs.values():
            for node in gang.running:
                self.machine.after(self.rng.uniform(0.5, 8.0), lambda node=node: self.connect(node))
        self._next_tick = self.machine.time
        self._schedule_tick()

    def _die(self) -> None:
        """Kill the process; another one is started soon."""
        if self.reconciler is None:
            return
        self.story.append(f"{self.machine.time:.1f} the controller is killed")
        self._crash_in = None
        self.reconciler = self.bus = None
        self.machine.process += 1
        self.machine.after(self.rng.uniform(1.0, 30.0), self._start)

    def crash(self, where: str) -> None:
        """A write of the controller: its process may be killed here."""
        if self._crash_in is not None:
            self._crash_in -= 1
            if self._crash_in <= 0:
                self._crash_in = None
                self.story.append(f"{self.machine.time:.1f} killed {where}")
                self.machine.after(0.0, self._die)
                raise Crash(where)

    def _on_statement(self, statement: str) -> None:
        self._committed |= statement == "COMMITTED"
        if statement[:6] not in ("SELECT", "PRAGMA"):
            self.crash(f"at {statement[:30]}")
        if self.database_down:
            raise sqlite3.OperationalError("disk I/O error")

    def _latency(self, pool: str) -> float:
        return self.rng.choice((0.002, 0.01, 0.05, 0.3, 1.5)) if not pool.startswith("stop") else 0.01

    # -- people -------------------------------------------------------------------------------------------------------

    def _draw_job(self, index: int) -> SimulatedJob:
        rng = self.rng
        attempts = rng.choice((1, 2, 3))
        code = 0 if rng.random() < 0.8 else rng.choice((1, 2))
        breaks = [rng.uniform(1, 200) if rng.random() < 0.2 else 1e9 for _ in range(attempts + 20)]
        timeout = rng.choice((60, 300)) if rng.random() < 0.1 else None
        pulling = rng.uniform(5, 120) if rng.random() < 0.2 else 0.0
        work, nodes, urgent = rng.uniform(5, 300), rng.choice((1, 1, 2, 3)), rng.random() < 0.15
        return SimulatedJob(f"j{index}", nodes, work, code, breaks, attempts, timeout, urgent, pulling)

    def _submit(self, job: SimulatedJob) -> None:
        if self.reconciler is None or self.reconciler.trouble is not None:
            self.machine.after(5.0, lambda: self._submit(job))
            return

        def body(session: Any) -> dict[str, Any]:
            row = Job(
                id=f"{self.seed}-{job.name}",
                name=job.name,
                queue="urgent" if job.urgent else "default",
                definition="job:1",
                kind="multinode",
                request={},
                node_properties=_definition(job.nodes),
                run=job.name,
                status=Status.SUBMITTED,
                attempts_allowed=job.attempts,
                timeout=job.timeout,
            )
            if session.get(Job, row.id) is None:  # it came in, and the answer was lost
                session.add(row)
            return {"id": row.id}

        try:
            job.id = self.reconciler.submissions.call(body)["id"]
        except DatabaseError:
            self.machine.after(5.0, lambda: self._submit(job))
        except Crash:
            self._die()
            self.machine.after(5.0, lambda: self._submit(job))

    def _ask_to_stop(self, job: SimulatedJob) -> None:
        if not job.id or self.reconciler is None:
            return
        try:
            with self.reconciler.database.session() as session:
                job.stop_asked = True  # also where the answer is lost: then it may count or not
                ask_to_end(session, Job.id == job.id, "stopped by its user")
        except DatabaseError:
            pass
        except Crash:
            self._die()

    # -- nodes --------------------------------------------------------------------------------------------------------

    def pulls(self, gang: Gang) -> bool:
        """Whether its image is still being pulled: since it was asked for."""
        self._pulled.setdefault(gang.name, self.machine.process)
        since = self._asked.setdefault(gang.name, self.machine.time)
        return gang.name not in self.gangs and self.machine.time - since < self._job(gang.job).pulling

    def launch(self, gang: Gang) -> None:
        """What the engine does once for a name."""
        if gang.name in self.gangs:
            return
        for other in self.gangs.values():
            if other.run == gang.run and any(self._can_write(node) for node in other.running):
                raise Violation(f"{gang.name} is launched while {other.name} runs")
        ending = self.memory.execute(
            "SELECT ending FROM attempts WHERE job_id = ? AND number = ?", (gang.job, gang.attempt)
        ).fetchone()[0]
        if ending is not None and self._pulled.get(gang.name) == self.machine.process:
            raise Violation(f"{gang.name} is launched, although it is {ending}")
        found = SimulatedGang(gang.name, gang.job, gang.attempt, gang.epoch, gang.run, self.router, self.machine.time)
        found.nodes = [SimulatedNode(found, index, each.host) for index, each in enumerate(gang.placements)]
        self.gangs[gang.name] = found
        for node in found.nodes:
            self.machine.after(self.rng.uniform(0.5, 3.0), lambda node=node: self.connect(node))
        job = self._job(gang.job)
        self.machine.after(job.breaks[gang.attempt - 1], lambda: self._break(found))
        self._work(found)

    def _can_write(self, node: SimulatedNode) -> bool:
        return not (node.frozen or node.isolated or node.host_lost) and self.volume_epoch(node.gang) <= node.gang.epoch

    def volume_epoch(self, gang: SimulatedGang) -> int:
        """The epoch of the gang's run."""
        run = self.volume.runs.get(gang.run)
        return run.epoch if run is not None else 0

    def _work(self, gang: SimulatedGang) -> None:
        """Work until the next save, or the end."""
        job = self._job(gang.job)
        left = job.work - job.done
        if left <= 0:
            self._finish(gang.nodes[0], job.code)
            return
        piece = min(left, 30.0)
        self.machine.after(piece, lambda: self._save(gang, piece))

    def _save(self, gang: SimulatedGang, piece: float) -> None:
        if not all(node.alive for node in gang.nodes):
            return
        if any(node.frozen or node.isolated or node.host_lost for node in gang.nodes) or self.volume.stalled:
            self.machine.after(5.0, lambda: self._save(gang, piece))  # the others wait for it
            return
        if self.volume_epoch(gang) > gang.epoch:
            for node in gang.nodes:
                self._finish(node, 1)
            return
        job = self._job(gang.job)
        if not (self.volume.full or self.volume.absent or self.volume.failing):
            job.done += piece
            run = self.volume.runs[gang.run]
            run.iteration, run.saved[gang.epoch] = int(job.done), self.machine.wall()
        else:
            job.work += 0.0
            self.machine.after(5.0, lambda: self._save(gang, piece))
            return
        self._work(gang)

    def _break(self, gang: SimulatedGang) -> None:
        """A fault of the job's own: one node fails, the others' collectives break."""
        if not all(node.alive and not node.frozen and not node.host_lost for node in gang.nodes):
            return
        first = self.rng.choice(gang.nodes)
        self._finish(first, 1)
        for node in gang.nodes:
            if node is not first:
                self.machine.after(self.rng.uniform(0.5, 5.0), lambda node=node: self._finish(node, 1))

    def _finish(self, node: SimulatedNode, code: int, tries: int = 60) -> None:
        """The node ends: it writes its outcome until that stands, or leaves without after a while."""
        if not node.alive or node.host_lost:
            return
        if node.frozen or node.isolated:
            self.machine.after(5.0, lambda: self._finish(node, code, tries))
            return
        run = self.volume.runs.get(node.gang.run)
        can_write = run is not None and not (
            self.volume.full or self.volume.absent or self.volume.failing or self.volume.stalled
        )
        if not can_write and tries and not node.asked:
            self.machine.after(1.0, lambda: self._finish(node, code, tries - 1))
            return
        gang = node.gang
        if can_write and run is not None:
            wall = self.machine.wall()
            outcome = Outcome(
                node.index, gang.epoch, code, None, f"exit {code}", None, wall - 1, wall, asked=node.asked
            )
            run.outcomes[gang.job, gang.attempt, node.index] = outcome
        node.alive, node.exit_code = False, code
        if node.index == 0 and code != EX_TEMPFAIL:
            self._job(gang.job).main_ends.append((gang.attempt, code))
        self._notice(node, 0.2)
        if node.index == 0 and code == 0:
            for other in gang.running:
                self.machine.after(self.rng.uniform(0.1, 12.0), lambda other=other: self._finish(other, 0))

    def stop(self, name: str, grace: float) -> None:
        """What an engine does: ask, wait, kill. On a pool's greenlet."""
        gang = self.gangs.get(name)
        if gang is None:
            return
        self._check_cause(gang)
        deadline = self.machine.time + grace
        for node in gang.running:
            node.asked = True
            self.machine.after(self.rng.uniform(0.1, 4.0), lambda node=node: self._leave(node))
        while gang.running and self.machine.time < deadline:
            self.machine.sleep(0.5)
        for node in gang.running:
            node.alive, node.killed = False, True
            self._notice(node, 0.2)

    def _leave(self, node: SimulatedNode) -> None:
        """Save and leave with 75."""
        if not node.alive or node.frozen or node.host_lost or node.isolated:
            return
        self._finish(node, EX_TEMPFAIL)

    # -- the bus ------------------------------------------------------------------------------------------------------

    def hears(self, node: SimulatedNode) -> bool:
        """Whether the controller's router hears the node."""
        reaches = not (self.bus_down or node.gang.router != self.router)
        return reaches and node.alive and not (node.frozen or node.isolated or node.host_lost)

    def connect(self, node: SimulatedNode) -> None:
        """The node, or the bus, notices how it is by now."""
        if self.bus is not None:
            self.bus.notice(node)

    def _notice(self, node: SimulatedNode, after: float) -> None:
        self.machine.after(after, lambda: self.connect(node))

    def _notice_all(self) -> None:
        for gang in self.gangs.values():
            for node in gang.running:
                self._notice(node, self.rng.uniform(0.5, _LEASE))

    # -- faults -------------------------------------------------------------------------------------------------------

    def _draw_fault(self) -> Callable[[], None]:
        kinds: Sequence[Callable[[], None]] = (
            *(self._crash_soon, self._crash_soon, self._partition, self._engine_outage, self._bus_outage),
            *(
                self._database_outage,
                self._freeze,
                self._isolate,
                self._lose_host,
                self._stall,
                self._fill,
                self._vanish,
            ),
            *(self._fail_volume, self._move, self._step_clock, self._kill_node),
        )
        return self.rng.choice(kinds)

    def _note(self, what: str) -> None:
        self.story.append(f"{self.machine.time:.1f} {what}")

    def _during(self, seconds: float, name: str, of: object | None = None) -> None:
        """Set a flag for a while."""
        target = self if of is None else of
        self._note(f"{name} for {seconds:.0f} s")
        setattr(target, name, True)
        self.machine.after(seconds, lambda: setattr(target, name, False))

    def _seconds(self) -> float:
        return self.rng.choice((5.0, 30.0, 90.0, 300.0, 600.0)) * self.rng.uniform(0.7, 1.0)

    def _crash_soon(self) -> None:
        self._crash_in = self.rng.choice((1, 2, 3, 5, 8, 13, 21))
        self._note(f"the controller dies at its write number {self._crash_in}")

    def _partition(self) -> None:
        """The controller alone is cut off: from its engine, and from all nodes."""
        seconds = self._seconds()
        self._during(seconds, "engine_down")
        self._bus_for(seconds)

    def _bus_for(self, seconds: float) -> None:
        self._during(seconds, "bus_down")
        self._notice_all()
        self.machine.after(seconds + 0.1, self._notice_all)

    def _bus_outage(self) -> None:
        self._bus_for(self._seconds())

    def _engine_outage(self) -> None:
        self._during(self._seconds(), "engine_down")

    def _database_outage(self) -> None:
        self._during(self.rng.uniform(1, 60), "database_down")

    def _stall(self) -> None:
        self._during(self._seconds(), "stalled", self.volume)

    def _fill(self) -> None:
        self._during(self._seconds(), "full", self.volume)

    def _vanish(self) -> None:
        self._during(self._seconds(), "absent", self.volume)

    def _fail_volume(self) -> None:
        self._during(self.rng.uniform(1, 60), "failing", self.volume)

    def _move(self) -> None:
        """The controller is stopped, and started at another address: nodes look for it at the old one."""
        self._note("the controller moves")
        self.router += 1
        self._die()

    def _step_clock(self) -> None:
        seconds = self.rng.choice((-3600.0, -5.0, 5.0, 3600.0))
        self._note(f"the wall clock steps by {seconds:.0f} s")
        self.machine.offset += seconds

    def _some_node(self) -> SimulatedNode | None:
        nodes = [node for gang in self.gangs.values() for node in gang.running]
        return self.rng.choice(nodes) if nodes else None

    def _freeze(self) -> None:
        self._silence("frozen")

    def _isolate(self) -> None:
        self._silence("isolated")

    def _silence(self, how: str) -> None:
        if (node := self._some_node()) is None:
            return
        seconds = self._seconds()
        self._note(f"{node.gang.name} node {node.index} is {how} for {seconds:.0f} s")
        setattr(node, how, True)
        node.silent_since = self.machine.time
        self._notice(node, _LEASE)

        def back() -> None:
            setattr(node, how, False)
            node.silent_since = None
            self._notice(node, self.rng.uniform(0.2, 5.0))

        self.machine.after(seconds, back)

    def _lose_host(self) -> None:
        """A host dies; the engine notices."""
        if (node := self._some_node()) is None:
            return
        self._note(f"host {node.host} dies")
        for gang in self.gangs.values():
            for each in gang.running:
                if each.host == node.host:
                    each.host_lost, each.alive = True, False
                    self._notice(each, _LEASE)

    def _kill_node(self) -> None:
        if (node := self._some_node()) is None or node.frozen:
            return
        self._note(f"{node.gang.name} node {node.index} is killed")
        node.alive, node.killed = False, True
        self._notice(node, 0.2)

    # -- what must hold -----------------------------------------------------------------------------------------------

    def _job(self, job_id: str) -> SimulatedJob:
        return self._jobs[int(job_id.rpartition("-j")[2])]

    def _row(self, job: SimulatedJob) -> Any:
        found = self.memory.execute("SELECT status, status_reason FROM jobs WHERE id = ?", (job.id,)).fetchone()
        return None if found is None else type("Row", (), {"status": found[0], "status_reason": found[1]})

    def _check_cause(self, gang: SimulatedGang) -> None:
        """No gang is ended without a cause."""
        job = self._job(gang.job)
        if job.stop_asked or not all(node.alive for node in gang.nodes):
            return
        if job.timeout is not None and self.machine.time - gang.launched > job.timeout - 5:
            return
        for node in gang.nodes:
            if node.silent_since is not None and self.machine.time - node.silent_since > LOST_AFTER - 5:
                return
        ending, reason = self.memory.execute(
            "SELECT ending, status_reason FROM attempts WHERE job_id = ? AND number = ?", (gang.job, gang.attempt)
        ).fetchone()
        if ending == "preempted" and not job.urgent:
            return
        raise Violation(f"{gang.name} is ended at {self.machine.time:.1f} without a cause: {ending}, {reason}")

    def _look(self) -> None:
        """What a user sees now."""
        if not self._committed:
            return
        self._committed = False
        rows = {row[0]: row[1:] for row in self.memory.execute("SELECT id, status, status_reason FROM jobs").fetchall()}
        for job in self._jobs:
            if not job.id:
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
        """An end is the true end."""
        succeeded = any(code == 0 for _, code in job.main_ends)
        if status == Status.SUCCEEDED and job.name not in self.volume.runs:
            raise Violation(f"{job.name} is SUCCEEDED, and the store does not have its run")
        if status == Status.SUCCEEDED and not succeeded:
            raise Violation(f"{job.name} is SUCCEEDED, and its main node did not end with 0: {job.main_ends}")
        if status == Status.FAILED and succeeded and not job.stop_asked and job.timeout is None:
            raise Violation(f"{job.name} is FAILED ({reason}), and its main node ended with 0")
        if status == Status.FAILED and not (job.stop_asked or job.timeout is not None):
            self._check_attempts(job, reason)

    def _check_attempts(self, job: SimulatedJob, reason: str) -> None:
        """A job that failed has spent its attempts, each for a cause."""
        spent = self.memory.execute("SELECT count(*) FROM attempts WHERE job_id = ? AND spent", (job.id,)).fetchone()[0]
        if spent < job.attempts:
            raise Violation(f"{job.name} is FAILED ({reason}) after {spent} of {job.attempts} attempts")


def simulate(seed: int, jobs: int = JOBS, faults: int = FAULTS) -> Simulation:
    """One seed. Raises Violation, with the story of the faults."""
    simulation = Simulation(seed, jobs, faults)
    try:
        simulation.run()
    except Violation as violation:
        raise Violation(f"seed {seed}: {violation}\n" + "\n".join(simulation.story)) from None
    return simulation
