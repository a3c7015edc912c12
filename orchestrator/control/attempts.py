"""Attempts: gathers the facts on which :mod:`orchestrator.domain.attempt` decides, and carries out its instructions.

Everything that must survive a crash is in the database before it is done: an attempt is recorded before its gang is launched,
its ending before the gang is stopped. A controller that starts on the database of a dead one continues from there.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator.control.bus import Bus
from orchestrator.control.clock import Clock
from orchestrator.control.compute_environments import engine_options
from orchestrator.control.endings import node_end
from orchestrator.control.monitoring import Monitoring
from orchestrator.control.peers import Peers
from orchestrator.control.snapshot import DEFAULT_DECAY, new_nodes
from orchestrator.control.usage import add_usage, charge, placements_of, resource_seconds
from orchestrator.domain.attempt import (
    AwaitCause,
    AwaitChildren,
    Close,
    Decide,
    Due,
    Event,
    Explain,
    Gone,
    Instruction,
    Keep,
    Launch,
    LaunchDelayed,
    Launched,
    LaunchRefused,
    MarkRunning,
    Observe,
    Observed,
    Preempted,
    Save,
    Silence,
    State,
    Stop,
    StopDelayed,
    Terms,
    WindUp,
    step,
)
from orchestrator.domain.gang import GangSpec
from orchestrator.domain.job import AWS_EXITED, Ending, NodeEnd, Status, Verdict, lost_host
from orchestrator.engines.api import EngineError, EngineFault, Gang, GangStatus, NodePhase, NodeStatus, NotYet, Plan
from orchestrator.engines.registry import EngineSet
from orchestrator.engines.toolkit.backoff import Backoff
from orchestrator.persistence.models import Attempt, Job, JobQueue, Node, SchedulingPolicy, now
from orchestrator.persistence.ownership import first_description, record_owner
from orchestrator.scheduling.decide import Start
from shared_store.checkpoints import list_checkpoints
from shared_store.epoch import Claim, StaleEpoch, close_claim, read_epoch, take_epoch
from shared_store.files import DamagedFile
from shared_store.layout import Run, Store, StoreError

log = logging.getLogger("muster.controller")

GRACE = 30.0
"""Seconds from SIGTERM to SIGKILL, as on AWS Batch."""
_STOP_AGAIN, _STOP_RARELY = 2.0, 30.0
"""Seconds until another try to stop a gang that could not be stopped: at first, and at most."""


class StoreUnavailable(Exception):
    """The store can't be used now; the message says why. The action is tried again."""


@dataclass
class _Memory:
    """Facts about an attempt that its row does not hold, until it is closed."""

    cause_since: int | None = None
    done_since: int | None = None
    """As in :class:`orchestrator.domain.attempt.State`."""
    stop: Future[GangStatus] | None = None
    """The stop that is under way."""


class Attempts:
    """Drives attempts; ``changed`` is called (from any thread) when one of them should be looked at."""

    def __init__(
        self,
        engine: EngineSet,
        store: Store,
        bus: Bus,
        peers: Peers,
        clock: Clock,
        monitoring: Monitoring,
        changed: Callable[[], None],
    ) -> None:
        self.engine, self.store, self.bus = engine, store, bus
        self.peers, self.clock, self.monitoring, self.changed = peers, clock, monitoring, changed
        self._memories: dict[tuple[str, int], _Memory] = {}
        self._denied = Backoff(log, _STOP_AGAIN, _STOP_RARELY)
        """Why the engine could not stop an attempt's gang when it was last asked."""

    def begin(self, session: Session, job: Job, start: Start) -> None:
        """Record a new attempt, then launch it: after a crash in between, the next pass finds no handle and launches it.

        Raises StoreUnavailable where the run can't be prepared now; nothing is recorded then.
        """
        run = self.store.run(job.run)
        try:
            # The database and the store each remember; whichever is ahead (a restored database, a moved store) counts.
            known = [attempt.epoch for attempt in session.scalars(select(Attempt).join(Job).where(Job.run == job.run))]
            current = read_epoch(run)
            if current not in known and (writer := self.peers.writer(run)):
                raise StoreError(f"it is being written by {writer}; stop that job first")
            if job.first_epoch is not None and run.description() is None:
                raise StoreError("it was deleted from the store while the job ran")
            self._describe(session, run, job)
            epoch = take_epoch(run, max([current, *known]), Claim(self.peers.id, job.id, len(job.attempts) + 1))
        except (OSError, StaleEpoch) as error:  # a volume that is away may come back; another controller was faster
            said = f"store {self.store.path}: can't prepare run {job.run} now ({error}); trying again"
            raise StoreUnavailable(said) from error
        except (StoreError, ValueError) as error:
            job.move(Status.FAILED, f"store {self.store.path}: can't prepare run {job.run}: {error}")
            return
        if job.first_epoch is None:
            job.first_epoch = epoch
        number, nodes = len(job.attempts) + 1, new_nodes(start.placements)
        attempt = Attempt(
            job_id=job.id,
            number=number,
            epoch=epoch,
            compute_environment=start.compute_environment,
            nodes=nodes,
            created_at=now(),
        )
        attempt.held_since = self.clock.now()
        job.attempts.append(attempt)
        waited = attempt.held_since - (job.queued_since or attempt.held_since)
        self.monitoring.begun(session, job, attempt, waited / 1000)
        job.move(Status.STARTING, f"starting {self._state(job, attempt).terms.size}")
        session.commit()
        self._happened(session, job, attempt, Due())

    def advance(self, session: Session, job: Job, attempt: Attempt) -> None:
        """One look at an open attempt. Raises StoreUnavailable."""
        self._happened(session, job, attempt, Due())

    def preempt(self, session: Session, job: Job, attempt: Attempt, reason: str) -> None:
        """Have an open attempt end in favour of another job."""
        self._happened(session, job, attempt, Preempted(reason))

    def _happened(self, session: Session, job: Job, attempt: Attempt, event: Event) -> None:
        """Carry out the instructions that follow from an event, and from the events that these cause."""
        for instruction in step(self._state(job, attempt), event):
            if (then := self._carry_out(session, job, attempt, instruction)) is not None:
                self._happened(session, job, attempt, then)

    def _state(self, job: Job, attempt: Attempt) -> State:
        memory, gang = self._memory(attempt), job.gang
        terms = Terms(
            number=attempt.number,
            hosts=[node.host for node in attempt.nodes],
            whole=len(gang.nodes),
            main=gang.main,
            options=gang.options,
            grace=GRACE,
            timeout=job.timeout,
            allowed=job.attempts_allowed,
            spent=sum(1 for each in job.attempts if each.spent and each is not attempt),
            conditions=job.evaluate_on_exit,
        )
        decided = Ending(attempt.ending) if attempt.ending is not None else None
        return State(
            terms,
            launched=attempt.handle is not None,
            started=job.status != Status.STARTING,
            running_since=attempt.running_since,
            verdict=Verdict(decided, attempt.status_reason or "", attempt.exit_code) if decided else None,
            stop_reason=job.stop_reason,
            cause_since=memory.cause_since,
            done_since=memory.done_since,
            closed=attempt.stopped_at is not None,
        )

    def _memory(self, attempt: Attempt) -> _Memory:
        return self._memories.setdefault((attempt.job_id, attempt.number), _Memory())

    def _carry_out(self, session: Session, job: Job, attempt: Attempt, instruction: Instruction) -> Event | None:
        match instruction:
            case Launch(again):
                return self._launch(session, job, attempt, again)
            case Keep(handle):
                attempt.handle = handle
            case Observe():
                return self._observe(job, attempt)
            case Explain(reason):
                job.status_reason = reason
            case MarkRunning(reason, moment):
                self._mark_running(session, job, attempt, reason, moment)
            case AwaitCause(since):
                self._memory(attempt).cause_since = since
            case AwaitChildren(since):
                self._memory(attempt).done_since = since
            case Decide(verdict):
                attempt.ending, attempt.status_reason = verdict.ending, verdict.reason
                attempt.exit_code = verdict.exit_code
            case Save():
                session.commit()
            case Stop(grace):
                return self._stop(job, attempt, grace)
            case WindUp():
                return self._gone(job, [])
            case Close():
                self._close(session, job, attempt, instruction)
        return None

    def _describe(self, session: Session, run: Run, job: Job) -> None:
        record = record_owner(session, run, job)
        run.create(first_description(run, job, record.owner, record.queue))

    def _launch(self, session: Session, job: Job, attempt: Attempt, again: bool) -> Event:
        def plan() -> Plan[Any]:
            gang = self.gang(session, job, attempt, job.gang)
            return self.engine.plan(self.engine.with_secrets(gang))

        self.bus.expect(job.id, attempt.number, len(attempt.nodes))
        try:
            return Launched(self.engine.launch(_name(attempt), [node.host for node in attempt.nodes], plan, again))
        except NotYet as wait:
            return LaunchDelayed(str(wait), wait.unknown)
        except EngineError as error:
            return LaunchRefused(str(error))

    def gang(self, session: Session, job: Job, attempt: Attempt, spec: GangSpec) -> Gang:
        """The gang that the engine starts for an attempt."""
        nodes, options = spec.nodes[: len(attempt.nodes)], spec.options
        return Gang(
            job=job.id,
            attempt=attempt.number,
            epoch=attempt.epoch,
            job_epoch=job.first_epoch or attempt.epoch,
            run=job.run,
            store=str(self.store.path),
            queue=job.queue,
            compute_environment=attempt.environment,
            main=spec.main,
            commands=[node.command for node in nodes],
            environments=[node.environment for node in nodes],
            placements=placements_of(attempt),
            grace=GRACE,
            directory=options.directory or None,
            stall_timeout=options.stall_timeout,
            log_limit=options.log_limit,
            ranks=[node.ranks for node in nodes],
            is_native=options.is_native,
            is_gang=job.kind == "multinode",
            isolated=not options.is_native,
            containers=[node.container for node in nodes],
            array=None if job.array_index is None else (job.array_index, job.array_size or 0),
            bus=self.bus.endpoint,
            bus_token=self.bus.token(job.id, attempt.number),
            title=job.name,
            timeout=job.timeout,
            priority=job.priority,
            options=engine_options(session, attempt.environment, job.queue),
        )

    def _observe(self, job: Job, attempt: Attempt) -> Observed | None:
        assert attempt.handle is not None
        status = self.engine.observe(attempt.handle)
        if status is None:
            return None  # the engine's first look is under way
        ends = self._ends(job, attempt, status)
        head = status[job.gang.main]
        return Observed(
            moment=self.clock.now(),
            ends=ends,
            silences=[self._silence(attempt, *each) for each in zip(attempt.nodes, status, strict=True)],
            waits=head.words if head.phase not in (NodePhase.RUNNING, NodePhase.ENDED) else "",
            words=head.words if head.running else "",
            stale=next((node.stale for node in status if node.stale), ""),
        )

    def _silence(self, attempt: Attempt, node: Node, status: NodeStatus) -> Silence | None:
        assert attempt.handle is not None
        is_seen = status.phase is not NodePhase.UNREACHABLE and not status.stale
        asked = self.engine.asked(attempt.handle) if is_seen else None
        return self.bus.presence.silence((attempt.job_id, attempt.number, node.index), asked)

    def _ends(self, job: Job, attempt: Attempt, status: GangStatus) -> list[NodeEnd | None]:
        """The end of each node; noted in the attempt's record with the other facts about its nodes."""
        run = self.store.run(job.run)
        ends: list[NodeEnd | None] = []
        for record, node in zip(attempt.nodes, status, strict=True):
            end = None
            if not node.running:
                with self._reading():
                    end, stopped = node_end(run, record, node, job.gang.options.is_native, now())
                record.exit_code, record.reason, record.error = end.exit_code, end.reason, end.error
                if record.stopped_at is None:
                    record.stopped_at = stopped
                    if attempt.ending is None:  # by itself: no one ended the gang
                        record.status_reason = lost_host(record.host) if end.lost else AWS_EXITED
                self.bus.presence.ended((job.id, attempt.number, record.index))
            elif self.bus.presence.met((job.id, attempt.number, record.index)):
                record.met = True
            ends.append(end)
            if node.gpus:
                record.devices = tuple(node.gpus)
            record.host = node.host or record.host
            record.address = node.address or record.address or ""  # of a node that can't be seen it stays known
        return ends

    @staticmethod
    def _mark_running(session: Session, job: Job, attempt: Attempt, reason: str, moment: int) -> None:
        job.started_at = attempt.started_at = now()
        attempt.running_since = moment
        if (array := session.get(Job, job.parent) if job.parent else None) and array.started_at is None:
            array.started_at = job.started_at
        job.move(Status.RUNNING, reason)

    def _stop(self, job: Job, attempt: Attempt, grace: float) -> Gone | StopDelayed | None:
        """Stop the gang in the background. Where the engine can't stop it, it is asked again at growing intervals."""
        key, memory = (job.id, attempt.number), self._memory(attempt)
        if memory.stop is None and not self._denied.waits(key):
            assert attempt.handle is not None
            memory.stop = self._stop_in_thread(attempt.handle, grace)
        if memory.stop is not None and memory.stop.done():
            stop, memory.stop = memory.stop, None
            error = stop.exception()
            if error is None:
                return self._gone(job, self._ends(job, attempt, stop.result()))
            why = " ".join(str(error).split()).removesuffix("; trying again")
            said = f"attempt {attempt.number} can't be stopped: {why}; trying again"
            expected = isinstance(error, EngineError) and not isinstance(error, EngineFault)
            self._denied.failed(key, f"job {job.id}: {said}", None if expected else error)
        said_last = self._denied.said(key)
        return StopDelayed(said_last.removeprefix(f"job {job.id}: ")) if said_last else None

    def _stop_in_thread(self, handle: str, grace: float) -> Future[GangStatus]:
        """Stop the gang in a daemon thread, since a controller that leaves must not wait for a grace time. The result: its last status."""
        done: Future[GangStatus] = Future()

        def stop() -> None:
            try:
                done.set_result(self.engine.stop(handle, grace))
            except BaseException as error:
                done.set_exception(error)
            self.changed()

        threading.Thread(target=stop, name="stop", daemon=True).start()
        return done

    @contextmanager
    def _reading(self) -> Iterator[None]:
        """A context for reads of the store. Raises StoreUnavailable."""
        try:
            yield
        except OSError as error:
            raise StoreUnavailable(f"the store {self.store.path} can't be read now ({error}); trying again") from error

    def _gone(self, job: Job, ends: Sequence[NodeEnd | None]) -> Gone:
        with self._reading():
            checkpoints = list_checkpoints(self.store.run(job.run))
        progress = f"; last checkpoint: iteration {checkpoints[-1].iteration}" if checkpoints else ""
        return Gone(self.clock.now(), ends, progress)

    def _close(self, session: Session, job: Job, attempt: Attempt, close: Close) -> None:
        ran = close.moment - (attempt.running_since or close.moment)
        attempt.started_at = attempt.started_at or now()
        attempt.stopped_at = max(now(), attempt.started_at + ran)  # also where the clock was put back meanwhile
        attempt.spent = close.spent
        with self._reading():
            charge(attempt, self.store.run(job.run), close.moment)
        self.monitoring.ended(session, job, attempt)
        self._charge_share(session, job, attempt, close.moment)
        job.move(close.status, close.reason)
        if job.stopped_at is not None:
            job.stopped_at = max(job.stopped_at, attempt.stopped_at)
        key = (job.id, attempt.number)
        self._memories.pop(key, None)
        self._denied.worked(key)
        self.bus.forget(*key)
        with suppress(
            OSError, DamagedFile
        ):  # while this controller lives, another one may then say that the run is written
            close_claim(self.store.run(job.run), attempt.epoch)
        self.engine.forget(attempt.nodes[0].host, _name(attempt), attempt.handle)

    @staticmethod
    def _charge_share(session: Session, job: Job, attempt: Attempt, moment: int) -> None:
        queue = session.get(JobQueue, job.queue)
        policy = session.get(SchedulingPolicy, queue.policy) if queue and queue.policy else None
        if policy is not None:
            decay = policy.fairshare.get("shareDecaySeconds") or DEFAULT_DECAY
            add_usage(session, job.queue, job.share or "", resource_seconds(attempt, moment), decay, moment)


def _name(attempt: Attempt) -> str:
    """Its gang's, as in :attr:`orchestrator.engines.api.Gang.name`."""
    return f"{attempt.job_id}/{attempt.number}/{attempt.epoch}"
