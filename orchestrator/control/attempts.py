"""Attempts: launching a job's gang, watching it, judging its end, closing the attempt.

Everything that must survive a crash is in the database before it is done: an attempt is recorded before its gang is launched,
its ending before the gang is stopped. A controller that starts on the database of a dead one goes on from there.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator.control.bus import Bus
from orchestrator.control.clock import Clock
from orchestrator.control.compute_environments import engine_options
from orchestrator.control.endings import seen_end
from orchestrator.control.monitoring import Monitoring
from orchestrator.control.peers import Peers
from orchestrator.control.snapshot import DEFAULT_DECAY, new_nodes
from orchestrator.control.usage import add_usage, charge, placements_of, resource_seconds
from orchestrator.domain.gang import GangSpec
from orchestrator.domain.hosts import engine_of
from orchestrator.domain.job import AWS_EXITED, Ending, NodeEnd, Status, Verdict, judge, judge_as_aws
from orchestrator.domain.retry import retries
from orchestrator.engines.api import Cause, EngineError, EngineFault, Gang, GangStatus, NodePhase, NotYet, Plan
from orchestrator.engines.registry import EngineSet
from orchestrator.engines.toolkit.backoff import Backoff
from orchestrator.persistence.models import Attempt, Job, JobQueue, SchedulingPolicy, now
from orchestrator.persistence.ownership import first_description, record_owner
from orchestrator.scheduling.decide import Start
from shared_store.checkpoints import list_checkpoints
from shared_store.epoch import Claim, StaleEpoch, close_claim, read_epoch, take_epoch
from shared_store.files import DamagedFile
from shared_store.layout import Run, Store, StoreError
from shared_store.outcomes import read_outcome
from shared_store.wording import counted

log = logging.getLogger("muster.controller")

GRACE = 30.0
"""Seconds from SIGTERM to SIGKILL, as on AWS Batch."""
_FAILED_GRACE = 5.0
"""The same for a gang whose collectives are broken: there is nothing left to save."""
LOST = 20.0
"""Seconds without a node's token on the bus, while the engine says that it runs, after which the gang is started again."""
_MARGIN = 5.0
"""Seconds that an engine waits beyond the grace time: supervisors count it too, and record what did not leave in time."""
_CAUSE_PATIENCE = 90.0
"""Seconds for which a gang that has lost nodes which were told to end waits for the end of the node that is the cause."""
_FINISHING = 10.0
"""Seconds that children of a native job get to end by themselves after the main node is done."""
_SHORTEST_REQUEUE = 10_000
"""An attempt that leaves with 75 sooner than this [ms] counts as spent, so that a program that always does can't spin."""
_STOP_AGAIN, _STOP_RARELY = 2.0, 30.0
"""Seconds after which a gang that could not be stopped is asked again: at first, and at most."""


class StoreUnavailable(Exception):
    """The store can't be used now; the message says why. What was to be done is tried again."""


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
        self._stops: dict[tuple[str, int], Future[GangStatus]] = {}
        self._finished: dict[tuple[str, int], float] = {}
        self._denied = Backoff(log, _STOP_AGAIN, _STOP_RARELY)
        """Why the engine could not stop an attempt's gang when it was last asked."""
        self._uncertain: dict[tuple[str, int], float] = {}
        """Since when all nodes that are known to have failed were told to end."""

    def begin(self, session: Session, job: Job, start: Start) -> None:
        """Record a new attempt, then launch it: a crash in between is mended by the next pass, which finds no handle.

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
        job.move(Status.STARTING, f"starting {_size(job, len(nodes))}")
        session.commit()
        self._launch(session, job, attempt)

    def _describe(self, session: Session, run: Run, job: Job) -> None:
        record = record_owner(session, run, job)
        run.create(first_description(run, job, record.owner, record.queue))

    def _launch(self, session: Session, job: Job, attempt: Attempt) -> None:
        def plan() -> Plan[Any]:
            gang = self.gang(session, job, attempt, job.gang)
            return self.engine.plan(self.engine.with_secrets(gang))

        self.bus.expect(job.id, attempt.number, len(attempt.nodes))
        try:
            attempt.handle = self.engine.launch(_name(attempt), [node.host for node in attempt.nodes], plan)
        except NotYet as wait:
            if job.stop_reason is not None and not wait.unknown:  # nothing of it was started: there is nothing to stop
                self._close(session, job, attempt, Verdict(Ending.STOPPED, job.stop_reason), [])
            elif str(wait):
                job.status_reason = str(wait)
        except EngineError as error:
            self._close(session, job, attempt, Verdict(Ending.FATAL, f"can't start the gang: {error}"), [])
        session.commit()

    def gang(self, session: Session, job: Job, attempt: Attempt, spec: GangSpec) -> Gang:
        """What the engine is given to start an attempt."""
        nodes, options = spec.nodes[: len(attempt.nodes)], spec.options
        compute_environment = attempt.compute_environment or "local"
        return Gang(
            job=job.id,
            attempt=attempt.number,
            epoch=attempt.epoch,
            job_epoch=job.first_epoch or attempt.epoch,
            run=job.run,
            store=str(self.store.path),
            queue=job.queue,
            compute_environment=compute_environment,
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
            options=engine_options(session, compute_environment, job.queue),
        )

    def advance(self, session: Session, job: Job, attempt: Attempt) -> None:
        """One look at an open attempt: what the engine and the store say of it, and what follows."""
        if attempt.handle is None:
            self._launch(session, job, attempt)
            return
        status = self.engine.observe(attempt.handle)
        if status is None:
            return  # the engine's first look is under way
        ends = self._ends(job, attempt, status)
        main = job.gang.main
        head = status[main]
        runs = (head.running and head.words) or f"attempt {attempt.number} runs on {_size(job, len(status))}"
        if head.phase not in (NodePhase.RUNNING, NodePhase.ENDED):
            job.status_reason = head.words
        elif job.status == Status.STARTING and (head.running or ends[main]):
            job.started_at = attempt.started_at = now()
            attempt.running_since = self.clock.now()
            if (array := session.get(Job, job.parent) if job.parent else None) and array.started_at is None:
                array.started_at = job.started_at
            job.move(Status.RUNNING, runs)
        elif attempt.ending is None and job.status_reason != runs:
            job.status_reason = runs  # it can be seen again
        if attempt.ending is None and (verdict := self._verdict(job, attempt, ends, main)):
            attempt.ending, attempt.status_reason, attempt.exit_code = verdict.ending, verdict.reason, verdict.exit_code
            session.commit()
        if attempt.ending is not None and (trouble := next((n.stale for n in status if n.stale), "")):
            job.status_reason = f"{attempt.status_reason}; waits for {trouble}"
        if attempt.ending is None or self._finishing(job, attempt, status):
            return
        if (last := self._stopped(job, attempt)) is not None:
            ends = self._ends(job, attempt, last)
            verdict = Verdict(Ending(attempt.ending), attempt.status_reason or "", attempt.exit_code)
            self._close(session, job, attempt, verdict, ends)

    def _finishing(self, job: Job, attempt: Attempt, status: GangStatus) -> bool:
        """Whether the children of a native job whose main node is done are still given time to end by themselves.

        On AWS the main node's end cuts them off; a rank that prints its last line or closes a file deserves better.
        """
        if attempt.ending != Ending.SUCCEEDED or not job.gang.options.is_native:
            return False
        since = self._finished.setdefault((job.id, attempt.number), time.monotonic())
        return any(node.running for node in status) and time.monotonic() - since < _FINISHING

    def _stop(self, handle: str, grace: float) -> Future[GangStatus]:
        """Stop a gang in a thread of its own: a daemon, since a controller that leaves must not wait for a grace time."""
        done: Future[GangStatus] = Future()

        def stop() -> None:
            try:
                done.set_result(self.engine.stop(handle, grace))
            except BaseException as error:
                done.set_exception(error)
            self.changed()

        threading.Thread(target=stop, name="stop", daemon=True).start()
        return done

    def _verdict(self, job: Job, attempt: Attempt, ends: list[NodeEnd | None], main: int) -> Verdict | None:
        options = job.gang.options
        if options.is_native:
            verdict = judge(options.on_child_failure, main, ends)
        else:
            verdict = judge_as_aws(main, ends, attempt.nodes[main].host)
        if verdict and (verdict.certain or self._cause_is_overdue(job, attempt)):
            return verdict
        if job.stop_reason is not None:
            return Verdict(Ending.STOPPED, job.stop_reason)
        for index, end in enumerate(ends):
            if index != main and not options.is_native:
                continue  # on AWS a child's death changes nothing
            if engine_of(attempt.nodes[index].host) not in self.engine.names:
                continue  # the bus does not listen where its nodes look for it
            silence = self.bus.silence(job.id, attempt.number, index, attempt.nodes[index].met)
            if end is None and silence is not None and silence > LOST:
                reason = f"node {index} gives no sign of life for {silence:.0f} s: frozen, or cut off"
                return Verdict(Ending.FAILED, reason)
        if job.timeout and attempt.running_since and self.clock.now() - attempt.running_since > job.timeout * 1000:
            return Verdict(Ending.TIMEOUT, "Job attempt duration exceeded timeout")
        return None

    def _cause_is_overdue(self, job: Job, attempt: Attempt) -> bool:
        """Whether it has been waited long enough for the end of the node that made the others end."""
        since = self._uncertain.setdefault((job.id, attempt.number), time.monotonic())
        return time.monotonic() - since > _CAUSE_PATIENCE

    def _ends(self, job: Job, attempt: Attempt, status: GangStatus) -> list[NodeEnd | None]:
        """How each node ended: by the outcome in the store, else by what the engine saw; noted in the attempt's record."""
        run = self.store.run(job.run)
        ends: list[NodeEnd | None] = []
        for record, node in zip(attempt.nodes, status, strict=True):
            end, stopped = None, now()
            if not node.running:
                with self._reading():
                    outcome = read_outcome(run, job.id, attempt.number, record.index)
                if outcome:
                    stopped = min(stopped, int(outcome.ended * 1000))
                    message = outcome.error.message if outcome.error else None
                    # a supervisor sees that its rank was killed; only the engine knows for what
                    starved = outcome.signal == "SIGKILL" and node.cause is Cause.OUT_OF_MEMORY
                    end = NodeEnd(
                        outcome.exit_code,
                        node.words if starved else outcome.reason,
                        outcome.error.time if outcome.error else outcome.ended,
                        message,
                        asked=outcome.asked,
                    )
                else:
                    end = seen_end(node, _is_native(job), now() / 1000)
            ends.append(end)
            if end:
                record.exit_code, record.reason, record.error = end.exit_code, end.reason, end.error
                if record.stopped_at is None:
                    record.stopped_at = stopped
                    if attempt.ending is None:  # by itself: no one ended the gang
                        gone = f"Host EC2 (instance {record.host}) terminated."
                        record.status_reason = gone if end.lost else AWS_EXITED
            if self.bus.met(job.id, attempt.number, record.index):
                record.met = True
            if node.gpus:
                record.devices = tuple(node.gpus)
            record.host = node.host or record.host
            record.address = node.address or record.address or ""  # of a node that can't be seen it stays known
        return ends

    def _stopped(self, job: Job, attempt: Attempt) -> GangStatus | None:
        """Stop the gang in the background; how its nodes ended, once no process of it is left.

        Where the engine can't stop it the job says why, and the engine is asked again, later and later.
        """
        key = (job.id, attempt.number)
        if key not in self._stops and not self._denied.waits(key):
            grace = _FAILED_GRACE if attempt.ending in (Ending.FAILED, Ending.FATAL) else GRACE + _MARGIN
            assert attempt.handle is not None
            self._stops[key] = self._stop(attempt.handle, grace)
        if key in self._stops and self._stops[key].done():
            stop = self._stops.pop(key)
            error = stop.exception()
            if error is None:
                return stop.result()
            said = f"attempt {attempt.number} can't be stopped: {' '.join(str(error).split())}; trying again"
            expected = isinstance(error, EngineError) and not isinstance(error, EngineFault)
            self._denied.failed(key, f"job {job.id}: {said}", None if expected else error)
        if said_last := self._denied.said(key):
            job.status_reason = said_last.removeprefix(f"job {job.id}: ")
        return None

    @contextmanager
    def _reading(self) -> Iterator[None]:
        """Around reads of the store. Raises StoreUnavailable."""
        try:
            yield
        except OSError as error:
            raise StoreUnavailable(f"the store {self.store.path} can't be read now ({error}); trying again") from error

    def _close(
        self, session: Session, job: Job, attempt: Attempt, verdict: Verdict, ends: Sequence[NodeEnd | None]
    ) -> None:
        """The gang is gone: close its attempt and decide what becomes of the job. Raises StoreUnavailable."""
        with self._reading():
            self._close_attempt(session, job, attempt, verdict, ends)
        key = (job.id, attempt.number)
        self._finished.pop(key, None)
        self._uncertain.pop(key, None)
        self._denied.worked(key)
        self.bus.forget(*key)
        with suppress(
            OSError, DamagedFile
        ):  # while this controller lives, another one may then say that the run is written
            close_claim(self.store.run(job.run), attempt.epoch)
        self.engine.forget(attempt.nodes[0].host, _name(attempt), attempt.handle)

    def _close_attempt(
        self, session: Session, job: Job, attempt: Attempt, verdict: Verdict, ends: Sequence[NodeEnd | None]
    ) -> None:
        moment, ending = self.clock.now(), verdict.ending
        attempt.ending, attempt.status_reason, attempt.exit_code = ending, verdict.reason, verdict.exit_code
        ran = moment - (attempt.running_since or moment)
        attempt.started_at = attempt.started_at or now()
        attempt.stopped_at = max(now(), attempt.started_at + ran)  # also where the clock was put back meanwhile
        left = ending == Ending.REQUEUE and ran >= _SHORTEST_REQUEUE
        attempt.spent = not (left or ending == Ending.PREEMPTED)
        charge(attempt, self.store.run(job.run), moment)
        self.monitoring.ended(session, job, attempt)
        self._charge_share(session, job, attempt, moment)
        spent = sum(1 for each in job.attempts if each.spent)
        tries_left = spent < job.attempts_allowed
        number, progress = attempt.number, self._progress(job)
        if job.stop_reason is not None and ending not in (Ending.SUCCEEDED, Ending.FATAL, Ending.TIMEOUT):
            job.move(Status.FAILED, f"{job.stop_reason}{progress}" if _is_native(job) else job.stop_reason)
        elif ending == Ending.SUCCEEDED or (ending == Ending.PREEMPTED and self._is_done(job, ends)):
            job.move(Status.SUCCEEDED, verdict.reason if ending == Ending.SUCCEEDED else "done before it was preempted")
        elif ending == Ending.PREEMPTED:
            job.move(Status.RUNNABLE, f"attempt {number} was {verdict.reason}{progress}")
        elif ending == Ending.REQUEUE and (not attempt.spent or tries_left):
            job.move(Status.RUNNABLE, f"attempt {number} left on request{progress}; starting again")
        elif ending == Ending.FAILED and tries_left and self._retries(job, verdict, ends):
            job.move(Status.RUNNABLE, f"attempt {number} failed ({verdict.reason}){progress}; trying again")
        else:
            of = f" (attempt {spent} of {job.attempts_allowed})" if ending == Ending.FAILED and _is_native(job) else ""
            job.move(Status.FAILED, f"{verdict.reason}{of}")
        if job.stopped_at is not None:
            job.stopped_at = max(job.stopped_at, attempt.stopped_at)

    @staticmethod
    def _is_done(job: Job, ends: Sequence[NodeEnd | None]) -> bool:
        """Whether the main node had done its work when it was stopped; to leave with work to do is exit 75, or a signal's."""
        main = job.gang.main
        head = ends[main] if main < len(ends) else None
        return head is not None and head.exit_code == 0

    @staticmethod
    def _retries(job: Job, verdict: Verdict, ends: Sequence[NodeEnd | None]) -> bool:
        main = job.gang.main
        head = ends[main] if main < len(ends) else None
        return retries(job.evaluate_on_exit, verdict.exit_code, head.reason if head else "", verdict.reason)

    @staticmethod
    def _charge_share(session: Session, job: Job, attempt: Attempt, moment: int) -> None:
        queue = session.get(JobQueue, job.queue)
        policy = session.get(SchedulingPolicy, queue.policy) if queue and queue.policy else None
        if policy is not None:
            decay = policy.fairshare.get("shareDecaySeconds") or DEFAULT_DECAY
            add_usage(session, job.queue, job.share or "", resource_seconds(attempt, moment), decay, moment)

    def _progress(self, job: Job) -> str:
        checkpoints = list_checkpoints(self.store.run(job.run))
        return f"; last checkpoint: iteration {checkpoints[-1].iteration}" if checkpoints else ""


def _name(attempt: Attempt) -> str:
    """Its gang's, as in :attr:`orchestrator.engines.api.Gang.name`."""
    return f"{attempt.job_id}/{attempt.number}/{attempt.epoch}"


def _is_native(job: Job) -> bool:
    return job.gang.options.is_native


def _size(job: Job, nodes: int) -> str:
    """How many nodes an attempt has, and of how many, where there was no room for all."""
    most = len(job.gang.nodes)
    if nodes < most:
        return f"{nodes} of {most} nodes: there is no room for more"
    return counted(nodes, "node")
