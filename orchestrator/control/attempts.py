"""Attempts: gathers the facts on which :mod:`orchestrator.domain.attempt` decides, and carries out its instructions.

Everything that must survive a crash is in the database before it is done: an attempt is recorded before its gang is launched,
its ending before the gang is stopped. A controller that starts on the database of a dead one continues from there.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import inf
from typing import Any

from sqlalchemy.orm import Session

from orchestrator import machine
from orchestrator.control.attempt_rows import GRACE, NO_EPOCH, SharedRows, note_of, state_of
from orchestrator.control.bus import Bus
from orchestrator.control.clock import Clock
from orchestrator.control.kept_texts import KeptTexts, references_of
from orchestrator.control.monitoring import Monitoring
from orchestrator.control.observer import CHECK_INTERVAL, Observer
from orchestrator.control.run_store import Errands, Key, ObservedRun, RunContent, RunRefused, RunStore, StoreUnavailable
from orchestrator.control.snapshot import DEFAULT_DECAY, new_nodes
from orchestrator.control.stops import Stops
from orchestrator.control.usage import add_usage, charge, placements_of, resource_seconds
from orchestrator.domain import attempt_instructions as do
from orchestrator.domain.attempt import FINISHING, AttemptPhase, AttemptState, after, step
from orchestrator.domain.attempt_events import Delayed, Due, Event, Gone, Launched, Preempted, Prepared, StartRefused
from orchestrator.domain.gang import GangSpec
from orchestrator.domain.job import Ending, Status
from orchestrator.engines.api import CannotStart, Cause, EngineError, Gang, GangNode, GangStatus, NotYet, Plan
from orchestrator.engines.registry import EngineSet
from orchestrator.persistence.batch_models import Attempt, Job, now
from orchestrator.persistence.log_groups import record_logs
from orchestrator.persistence.ownership import first_description, record_owner
from orchestrator.scheduling.decisions import Start
from shared_store.volume.epoch import Claim

log = logging.getLogger("muster.controller")

_READERS = 16
"""Threads for the store. An open attempt has one call there at most, and of a run's closed attempts only the last one has any."""
_CANCELLATIONS = 3
"""How often a job is started again, by default, after others have cancelled it in its engine's own queue."""
_LEAST, _LATER = 0.02, 60.0
"""Seconds until an attempt is advanced again: at least, and where nothing is due."""


Steps = Generator[Callable[[], None], None, None]
"""What is done to an attempt, up to each commit: at a ``yield`` what has changed is to be committed, and then the value to be called. So
many attempts share a commit, and everything is recorded before it is done."""


@dataclass(slots=True)
class _Open:
    """What is known of an open attempt beside its rows."""

    key: Key
    state: AttemptState
    is_current: bool = True
    """Whether the state is that of the rows: they were not read anew since."""
    run: ObservedRun | None = None
    """The run, as it was found before the attempt takes it."""
    taking: Callable[[], int] | None = None
    """Takes the run; returns the epoch."""
    progress: RunContent | None = None
    """What the run holds once the gang is stopped."""
    uncommitted: list[Callable[[], None]] = field(default_factory=list)
    """What the metrics are to note after the next commit."""

    def committed(self) -> None:
        """Follows each commit."""
        for note in self.uncommitted:
            note()
        self.uncommitted = []


class Attempts:
    """Drives attempts. On the controller's thread alone, which never waits here for an engine or the store."""

    def __init__(
        self,
        engine: EngineSet,
        runs: RunStore,
        bus: Bus,
        clock: Clock,
        monitoring: Monitoring,
        changed: Callable[[str], None],
        withdrawn: Callable[[str, str], None],
        texts: KeptTexts,
    ) -> None:
        """``changed``: called, from any thread, with a job whose attempt should be advanced; ``withdrawn``: with one that can't start
        now, and why. ``texts``: of which each run gets those that its job names.
        """
        self.engine, self.runs, self.bus = engine, runs, bus
        self.clock, self.monitoring, self.changed, self.withdrawn = clock, monitoring, changed, withdrawn
        self.texts = texts
        self._open: dict[str, _Open] = {}
        """By job."""
        self._errands = Errands(machine.pool("store", _READERS), str(runs.store.path), changed)
        self._observer = Observer(engine, runs, self._errands, bus, clock)
        self._stops = Stops(engine, changed, log)

    def close(self) -> None:
        """Leave the calls that are under way to themselves."""
        self._errands.close()
        self._stops.close()

    def begin(self, session: Session, job: Job, start: Start) -> Steps:
        """Record a new attempt, and go on with it: after a crash in between, the next controller goes on from there."""
        number, nodes = len(job.attempts) + 1, new_nodes(start.placements)
        attempt = Attempt(
            job_id=job.id,
            number=number,
            epoch=NO_EPOCH,
            compute_environment=start.compute_environment,
            nodes=nodes,
            created_at=now(),
        )
        attempt.held_since = self.clock.now()
        record_logs(session, job, nodes)
        opened = self._open[job.id] = _Open((job.id, number), state_of(job, attempt))
        job.attempts.append(attempt)
        job.move(Status.STARTING, f"starting {opened.state.terms.size}")
        yield opened.committed
        yield from self._happened(session, job, attempt, opened, Due())

    def advance(self, session: Session, job: Job, attempt: Attempt) -> Steps:
        """Observe an open attempt and go on with it."""
        return self._happened(session, job, attempt, self._opened(job, attempt), Due())

    def pause(self, job: Job, attempt: Attempt) -> float:
        """Seconds until :meth:`advance`, where no engine, errand, node or request calls for it earlier."""
        if not _is_open(job, attempt):
            return _LATER
        opened = self._opened(job, attempt)
        key, state = opened.key, opened.state
        if state.phase is AttemptPhase.LAUNCHING:
            pause = self.engine.launch_pause(_name(attempt), attempt.nodes[0].host)
        elif self._stops.has_started(key):
            pause = self._stops.pause(key)
        elif state.done_since is not None:
            pause = (state.done_since + FINISHING - self.clock.now()) / 1000
        elif state.verdict is not None:
            pause = self._stops.pause(key)
        elif state.cause_since is not None or self._observer.has_hidden(key):
            pause = CHECK_INTERVAL
        elif job.timeout is not None and attempt.running_since is not None:
            pause = attempt.running_since / 1000 + job.timeout - self.clock.now() / 1000
        else:
            pause = _LATER
        return min(max(min(pause, self._errands.pause(key) or inf), 0.0) + _LEAST, _LATER)

    def preempt(self, session: Session, job: Job, attempt: Attempt, reason: str) -> Steps:
        """Have an open attempt end in favour of another job."""
        return self._happened(session, job, attempt, self._opened(job, attempt), Preempted(reason))

    def _happened(self, session: Session, job: Job, attempt: Attempt, opened: _Open, event: Event) -> Steps:
        """Carry out the instructions that follow from an event, and from the events that these cause."""
        for instruction in step(opened.state, event):
            match instruction:
                case do.Save():
                    yield opened.committed
                case do.Withdraw(reason):
                    yield self._withdraw(job, attempt, opened, reason)
                case do.Close():
                    yield self._close(session, job, attempt, opened, instruction)
                case _:
                    then = self._carry_out(session, job, attempt, opened, instruction)
                    opened.state = after(opened.state, instruction)
                    if then is not None:
                        yield from self._happened(session, job, attempt, opened, then)

    def load_shared_rows(self, session: Session, jobs: Sequence[Job]) -> None:
        """These jobs are worked on next: what their attempts share is read once."""
        self._rows = SharedRows(session, jobs)

    def forget_states(self, jobs: Iterable[str]) -> None:
        """The rows of these jobs were read anew."""
        for job_id in jobs:
            if (opened := self._open.get(job_id)) is not None:
                opened.is_current, opened.taking, opened.uncommitted = False, None, []

    def _opened(self, job: Job, attempt: Attempt) -> _Open:
        opened = self._open.get(job.id)
        if opened is None or opened.state.terms.number != attempt.number:
            opened = self._open[job.id] = _Open((job.id, attempt.number), state_of(job, attempt))
        elif not opened.is_current:
            known = opened.state
            opened.state = replace(state_of(job, attempt), cause_since=known.cause_since, done_since=known.done_since)
            opened.is_current = True
        return opened

    def _carry_out(
        self, session: Session, job: Job, attempt: Attempt, opened: _Open, instruction: do.Instruction
    ) -> Event | None:
        match instruction:
            case do.Prepare():
                return self._prepare(session, job, attempt, opened)
            case do.TakeEpoch(epoch):
                attempt.epoch = epoch
                waited = attempt.held_since - (job.queued_since or attempt.held_since) if attempt.held_since else 0
                opened.uncommitted.append(self.monitoring.started(job, attempt, waited / 1000))
                job.first_epoch = job.first_epoch or epoch
            case do.Launch(again):
                return self._launch(job, attempt, again)
            case do.Keep(handle):
                attempt.handle = handle
            case do.Observe():
                return self._observer.observe(job, attempt)
            case do.Explain(reason):
                if job.status_reason != reason:
                    job.status_reason = reason
            case do.MarkRunning(reason, moment):
                job.started_at = attempt.started_at = now()
                attempt.running_since = moment
                if (array := session.get(Job, job.parent) if job.parent else None) and array.started_at is None:
                    array.started_at = job.started_at
                job.move(Status.RUNNING, reason)
            case do.Decide(verdict):
                attempt.ending, attempt.status_reason = verdict.ending, verdict.reason
                attempt.exit_code, attempt.fault = verdict.exit_code, verdict.fault
                if verdict.start_error is not None:
                    attempt.nodes[job.gang.main].reason = verdict.start_error
            case do.Stop():
                return self._stop(job, attempt, opened, instruction)
            case do.WindUp():
                return Gone(self.clock.now(), [], "")
        return None

    def _prepare(
        self, session: Session, job: Job, attempt: Attempt, opened: _Open
    ) -> Prepared | Delayed | StartRefused | None:
        """Read the run, record its owner, then take it."""
        key = opened.key
        try:
            if opened.run is None:
                self._errands.await_earlier(job.run)
                opened.run = self._errands.result(key, "examine", partial(self.runs.examine, job.run), again=False)
            if opened.run is None:
                return self._errands.delayed(key)
            if opened.taking is None:
                opened.taking = self._take(session, job, attempt, opened.run)
            epoch = self._errands.result(key, "claim", opened.taking, again=False)
        except StoreUnavailable as error:
            return Delayed(str(error), idle=True)
        except (RunRefused, ValueError) as error:
            return StartRefused(str(error))
        return Prepared(epoch) if epoch is not None else self._errands.delayed(key)

    def _take(self, session: Session, job: Job, attempt: Attempt, run: ObservedRun) -> Callable[[], int]:
        """The call that takes the run, whose owner is recorded here. Raises RunRefused."""
        # The database and the store each remember; whichever is ahead (a restored database, a moved store) counts.
        known = self._rows.epochs(job.run)
        if run.epoch not in known and run.writer:
            raise RunRefused(f"run {job.run} is being written by {run.writer}; stop that job first")
        if job.first_epoch is not None and run.description() is None:
            raise RunRefused(f"run {job.run} was deleted from the store while the job ran")
        record = record_owner(session, run, job, self._rows.runs.get(job.run))
        self._rows.runs[job.run] = record
        description = first_description(run, job, record.owner, record.queue)
        claim = Claim(self.runs.peers.id, job.id, attempt.number)
        texts = [(each, self.texts.source(session, each)) for each in references_of(job.gang)]
        return partial(self.runs.claim, job.run, description, max([run.epoch, *known]), claim, texts)

    def _launch(self, job: Job, attempt: Attempt, again: bool) -> Event:
        def plan() -> Plan[Any]:
            gang = self.gang(job, attempt, job.gang, self._rows.options(attempt.environment, job.queue))
            return self.engine.plan(self.engine.with_secrets(gang))

        self.bus.expect(job.id, attempt.number, len(attempt.nodes))
        try:
            return Launched(self.engine.launch(_name(attempt), [node.host for node in attempt.nodes], plan, again))
        except NotYet as wait:
            return Delayed(str(wait), idle=not wait.unknown)
        except EngineError as error:
            return StartRefused(str(error), is_final=not isinstance(error, CannotStart))

    def gang(self, job: Job, attempt: Attempt, spec: GangSpec, options: Mapping[str, str]) -> Gang:
        """The gang that the engine starts for an attempt; ``options``: those of its compute environment and queue."""
        own, note = spec.options, note_of(job, attempt)
        placed = zip(spec.nodes, placements_of(attempt), strict=False)  # an elastic gang may have fewer nodes
        return Gang(
            job=job.id,
            attempt=attempt.number,
            epoch=attempt.epoch,
            job_epoch=job.first_epoch or attempt.epoch,
            run=job.run,
            store=str(self.runs.store.path),
            queue=job.queue,
            compute_environment=attempt.environment,
            main=spec.main,
            nodes=[
                GangNode(node.command, node.environment, placement, node.ranks, node.container, note)
                for node, placement in placed
            ],
            grace=GRACE,
            directory=own.directory or None,
            stall_timeout=own.stall_timeout,
            log_limit=own.log_limit,
            is_native=own.is_native,
            is_gang=job.kind == "multinode",
            isolated=not own.is_native,
            array=None if job.array_index is None else (job.array_index, job.array_size or 0),
            bus=self.bus.endpoint,
            bus_token=self.bus.token(job.id, attempt.number),
            title=job.name,
            timeout=job.timeout,
            priority=job.priority,
            options=options,
        )

    def _stop(self, job: Job, attempt: Attempt, opened: _Open, stop: do.Stop) -> Gone | Delayed | None:
        """Stop the gang in the background. Where the engine can't stop it, it is asked again at growing intervals."""
        key = opened.key
        assert attempt.handle is not None
        if (stopped := self._stops.ask(key, attempt.handle, stop.grace)) is not None:
            return self._wind_up(job, attempt, opened, stopped)
        return Delayed(self._stops.reason(key) or stop.waits)

    def _wind_up(self, job: Job, attempt: Attempt, opened: _Open, status: GangStatus) -> Gone | Delayed | None:
        """Read what the gang has left, once nothing of it runs any more; None until it is known."""
        key = opened.key
        if not self._observer.know_outcomes(job, attempt, status, [None] * len(status)):
            return self._errands.delayed(key)
        opened.progress = opened.progress or self._observer.progress(key)
        if opened.progress is None:
            reading = partial(self.runs.progress, job.run, attempt.epoch)
            opened.progress = self._errands.result(key, "progress", reading)
        if opened.progress is None:
            return self._errands.delayed(key)
        iteration = opened.progress.iteration
        progress = "" if iteration is None else f"; last checkpoint: iteration {iteration}"
        gone = Gone(self.clock.now(), self._observer.ends(job, attempt, status), progress)
        cancelled = next((node.words for node in status if node.cause is Cause.CANCELLED), "")
        if not cancelled:
            return gone
        most = self._rows.options(attempt.environment, job.queue).get("cancellations", _CANCELLATIONS)
        return replace(gone, cancelled=cancelled, cancellations=int(most))

    def _withdraw(self, job: Job, attempt: Attempt, opened: _Open, reason: str) -> Callable[[], None]:
        """Give the room back; returns what follows the commit."""

        def withdrawn() -> None:
            self._forget(job, attempt, opened)
            self.withdrawn(job.id, reason)

        job.attempts.remove(attempt)
        job.move(Status.RUNNABLE, reason)
        return withdrawn

    def _forget(self, job: Job, attempt: Attempt, opened: _Open) -> None:
        key, release = opened.key, partial(self.runs.release, job.run)
        self._open.pop(job.id, None)
        self._stops.forget(key)
        self._errands.forget(key, job.run, release, attempt.epoch if attempt.epoch != NO_EPOCH else None)
        self._observer.forget(key)

    def _leave(self, job: Job, attempt: Attempt, opened: _Open) -> None:
        """The attempt is closed."""
        self._forget(job, attempt, opened)
        self.bus.forget(*opened.key)
        self.engine.forget(attempt.nodes[0].host, _name(attempt), attempt.handle)

    def leave_closed(self, session: Session, open_ones: Collection[Key]) -> None:
        """Only these attempts are open: others were closed by a commit of which this controller did not hear that it was made."""
        for opened in [each for each in self._open.values() if each.key not in open_ones]:
            if (attempt := session.get(Attempt, opened.key)) is not None and attempt.nodes:
                self._leave(attempt.job, attempt, opened)
            else:
                self._open.pop(opened.key[0])

    def _close(
        self, session: Session, job: Job, attempt: Attempt, opened: _Open, close: do.Close
    ) -> Callable[[], None]:
        """Record the end; returns what follows the commit."""

        def closed() -> None:
            opened.committed()
            self._leave(job, attempt, opened)

        ran = close.moment - (attempt.running_since or close.moment)
        attempt.started_at = attempt.started_at or now()
        attempt.stopped_at = max(now(), attempt.started_at + ran)  # also where the clock was put back meanwhile
        attempt.spent = close.spent
        if close.cancelled:
            attempt.ending, attempt.status_reason = Ending.CANCELLED, close.cancelled
            log.warning("job %s: %s", job.id, close.reason)
        charge(attempt, opened.progress.saved if opened.progress else None, close.moment)
        opened.uncommitted.append(self.monitoring.ended(job, attempt))
        if (policy := self._rows.policy(job.queue)) is not None:
            decay, seconds = policy.fairshare.get("shareDecaySeconds"), resource_seconds(attempt, close.moment)
            add_usage(session, job.queue, job.share or "", seconds, decay or DEFAULT_DECAY, close.moment)
        job.move(close.status, close.reason)
        if job.stopped_at is not None:
            job.stopped_at = max(job.stopped_at, attempt.stopped_at)
        return closed


def _is_open(job: Job, attempt: Attempt) -> bool:
    """Whether it was neither closed nor withdrawn."""
    return attempt.stopped_at is None and attempt in job.attempts


def _name(attempt: Attempt) -> str:
    """Its gang's, as in :attr:`orchestrator.engines.api.Gang.name`."""
    return f"{attempt.job_id}/{attempt.number}/{attempt.epoch}"
