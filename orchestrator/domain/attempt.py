"""An attempt as a state machine: from a state and an event to instructions. No I/O, no clock, no database.

:func:`step` and the three tables below it hold every rule. :mod:`orchestrator.control.attempts` gathers facts into events, carries the
instructions out and keeps the state; :func:`after` says what it is then.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

from orchestrator.domain import attempt_instructions as do
from orchestrator.domain.attempt_events import (
    Delayed,
    Due,
    Event,
    Gone,
    Launched,
    Observed,
    Preempted,
    Prepared,
    Silence,
    StartRefused,
)
from orchestrator.domain.excerpts import LONGEST_REASON, excerpt
from orchestrator.domain.job import (
    AWS_NOT_STARTED,
    Ending,
    NodeEnd,
    Status,
    Verdict,
    container_reason,
    judge,
    judge_as_aws,
    lost_host,
    retries,
)
from orchestrator.domain.native_options import NativeOptions
from shared_store.contract.error_text import counted

UNHEARD = 10.0
"""Seconds of a node's silence from which its job says so."""
CAUSE_PATIENCE = 90_000
"""For so long [ms] a gang that has lost nodes that were stopped waits for the end of the node that is the cause."""
FINISHING = 10_000
"""Children of a native job get so long [ms] to end by themselves after the main node is done. On AWS the main node's end cuts them off; a
rank that prints its last line or closes a file deserves better."""
SHORTEST_REQUEUE = 10_000
"""An attempt that leaves with 75 sooner than this [ms] counts as spent, so that a program that always does can't spin."""
_FAILED_GRACE = 5.0
"""Seconds from SIGTERM to SIGKILL for a gang whose collectives are broken: there is nothing left to save."""
_MARGIN = 5.0
"""Seconds that an engine waits beyond the grace time: supervisors count it too, and record what did not leave in time."""
NOT_STARTED = "can't start the gang: "
"""Before the reason for which an engine refuses a gang for good."""
_DONE = "done before it was {}"
_REPEATED = "{} ended the attempt before, too: not tried again after {} of {} attempts; correct it before you resume or submit again"


class AttemptPhase(StrEnum):
    """How far an attempt is."""

    PREPARING = "preparing"
    """Recorded; it has no epoch in its run yet."""
    LAUNCHING = "launching"
    """It has an epoch; no handle of its gang is known."""
    STARTING = "starting"
    """Launched; its main node has not been seen to run."""
    RUNNING = "running"
    ENDING = "ending"
    """Its end is decided; something of the gang may still run."""
    CLOSED = "closed"


@dataclass(frozen=True)
class Terms:
    """What an attempt consists of, and what its job allows."""

    number: int
    hosts: Sequence[str]
    """Of the nodes, by index."""
    whole: int
    """How many nodes the gang has where there is room for all."""
    main: int
    """Index of the main node."""
    options: NativeOptions
    grace: float
    """Seconds from SIGTERM to SIGKILL."""
    timeout: int | None = None
    """Of the attempt [s]."""
    allowed: int = 1
    """How many attempts the job may spend."""
    spent: int = 0
    """How many of them the attempts before this one have spent."""
    conditions: Sequence[Mapping[str, str]] = ()
    """``evaluateOnExit`` of the job."""
    cancelled: int = 0
    """How many attempts before this one were cancelled by others than Muster."""
    last_fault: str | None = None
    """:attr:`Verdict.fault` of the last attempt that the job has spent before this one."""

    @property
    def size(self) -> str:
        """How many nodes the attempt has, and of how many, where there was no room for all."""
        if (nodes := len(self.hosts)) < self.whole:
            return f"{nodes} of {self.whole} nodes: there is no room for more"
        return counted(nodes, "node")


@dataclass(frozen=True)
class AttemptState:
    """An attempt as it is known. Times are steady time [ms]."""

    terms: Terms
    prepared: bool = False
    """Whether it has an epoch in its run."""
    launched: bool = False
    """Whether the handle of its gang is known."""
    started: bool = False
    """Whether its main node was seen to run, or to have run."""
    running_since: int | None = None
    verdict: Verdict | None = None
    """From the moment that the end was decided."""
    stop_reason: str | None = None
    """Set once the job was asked to end."""
    cause_since: int | None = None
    """Since when only nodes have ended that were stopped."""
    done_since: int | None = None
    """Since when the main node is done and children still run."""
    closed: bool = False

    @property
    def phase(self) -> AttemptPhase:
        if self.closed:
            return AttemptPhase.CLOSED
        if not self.prepared:
            return AttemptPhase.PREPARING
        if not self.launched:
            return AttemptPhase.LAUNCHING
        if self.verdict is not None:
            return AttemptPhase.ENDING
        return AttemptPhase.RUNNING if self.started else AttemptPhase.STARTING


def step(state: AttemptState, event: Event) -> do.Instructions:
    """What is to be done, in this order. An event that means nothing in a state is passed over."""
    match state.phase, event:
        case AttemptPhase.CLOSED, _:
            return ()
        case AttemptPhase.PREPARING, Due() if state.verdict is not None:
            return (do.WindUp(),)
        case AttemptPhase.PREPARING, Due() if state.stop_reason is not None:
            return do.Decide(Verdict(Ending.STOPPED, state.stop_reason)), do.WindUp()
        case AttemptPhase.PREPARING, Due():
            return (do.Prepare(),)
        case AttemptPhase.PREPARING, Prepared(epoch):
            return do.TakeEpoch(epoch), do.Save(), do.Launch()
        case AttemptPhase.PREPARING, Delayed(reason, idle=True):
            return (do.Withdraw(reason),)
        case AttemptPhase.PREPARING, StartRefused(reason):
            return do.Decide(Verdict(Ending.FATAL, reason, start_error=reason)), do.WindUp()
        case AttemptPhase.LAUNCHING, Due():
            return (do.Launch(again=state.verdict is None and state.stop_reason is None),)
        case AttemptPhase.LAUNCHING, Launched(handle):
            return do.Keep(handle), do.Save(), do.Observe()
        case AttemptPhase.LAUNCHING, Delayed(idle=True) | StartRefused() if state.verdict is not None:
            return (do.WindUp(),)
        case AttemptPhase.LAUNCHING, Delayed(idle=True) if state.stop_reason is not None:
            return do.Decide(Verdict(Ending.STOPPED, state.stop_reason)), do.WindUp()
        case AttemptPhase.LAUNCHING, StartRefused():
            return do.Decide(_refused(state.terms, event)), do.WindUp()
        case _, Preempted(reason) if state.verdict is None:
            return (do.Decide(Verdict(Ending.PREEMPTED, reason)),)
        case AttemptPhase.STARTING | AttemptPhase.RUNNING | AttemptPhase.ENDING, Due():
            return (do.Observe(),)
        case AttemptPhase.STARTING | AttemptPhase.RUNNING | AttemptPhase.ENDING, Observed():
            return _observed(state, event)
        case _, Delayed(reason) if reason:
            return (do.Explain(reason),)
        case _, Gone() if state.verdict is not None:
            return (_close(state, state.verdict, event),)
    return ()


def _refused(terms: Terms, event: StartRefused) -> Verdict:
    ending = Ending.FATAL if event.is_final else Ending.FAILED
    reason = f"{NOT_STARTED}{event.reason}" if event.is_final else event.reason
    return Verdict(ending, reason if terms.options.is_native else AWS_NOT_STARTED, start_error=event.reason)


def _observed(state: AttemptState, seen: Observed) -> do.Instructions:
    """The tables for an observation, one after the other, each from the state that the one before leaves."""
    was_decided, done = state.verdict is not None, do.Instructions()
    for table in (_explain, _judge):
        for instruction in table(state, seen):
            state, done = after(state, instruction), (*done, instruction)
    return *done, *_end(state, seen, is_explained=was_decided and not done)


def _explain(state: AttemptState, seen: Observed) -> do.Instructions:
    """The reason that the job's user sees."""
    unheard = _unheard(state.terms, seen)
    if seen.unread is not None:
        reason = "; ".join(each for each in (seen.waits, unheard, seen.stale, seen.unread) if each)
        return (do.Explain(reason),) if reason != unheard and state.verdict is None else ()
    runs = seen.words or f"attempt {state.terms.number} runs on {state.terms.size}"
    runs = "; ".join(each for each in (runs, unheard, seen.stale) if each)
    if seen.waits:
        return (do.Explain(seen.waits),) if state.verdict is None else ()
    if not state.started:
        return (do.MarkRunning(runs, seen.moment),)
    return (do.Explain(runs),) if state.verdict is None else ()


def _judge(state: AttemptState, seen: Observed) -> do.Instructions:
    """Whether the attempt is to end, and how: by the nodes' ends once they are known, on request, for its silence, or for its time."""
    if state.verdict is not None:
        return ()
    waits: do.Instructions = ()
    terms, verdict = state.terms, None
    if seen.unread is None and terms.options.is_native:
        verdict = judge(terms.options.on_child_failure, terms.main, seen.ends)
    elif seen.unread is None:
        verdict = judge_as_aws(terms.main, seen.ends, terms.hosts[terms.main])
    if verdict is not None and not verdict.certain:
        since = seen.moment if state.cause_since is None else state.cause_since
        if seen.moment - since <= CAUSE_PATIENCE:
            verdict, waits = None, (do.Await("cause_since", since),)
    if verdict is None and state.stop_reason is not None:
        verdict = Verdict(Ending.STOPPED, state.stop_reason)
    verdict = verdict or _by_silence(terms, seen)
    ran = seen.moment - (state.running_since or seen.moment)
    if verdict is None and terms.timeout and ran > terms.timeout * 1000:
        verdict = Verdict(Ending.TIMEOUT, "Job attempt duration exceeded timeout")
    return waits if verdict is None else (*waits, do.Decide(verdict))


def _end(state: AttemptState, seen: Observed, *, is_explained: bool) -> do.Instructions:
    """Once the end is decided: the gang is stopped, unless its children may end by themselves.

    ``is_explained``: an earlier observation has explained why the job ends; the stop may have something to add, which stays.
    """
    if (verdict := state.verdict) is None:
        return ()
    waits = f"{verdict.reason}; {f'waits for {seen.stale}' if seen.stale else 'its nodes are ending'}"
    if verdict.ending == Ending.SUCCEEDED and state.terms.options.is_native and None in seen.ends:
        since = seen.moment if state.done_since is None else state.done_since
        if seen.moment - since < FINISHING:
            return do.Explain(waits), do.Save(), do.Await("done_since", since)
    grace = _FAILED_GRACE if verdict.ending in (Ending.FAILED, Ending.FATAL) else state.terms.grace + _MARGIN
    recorded = (do.Save(),) if is_explained else (do.Explain(waits), do.Save())
    return *recorded, do.Stop(grace, waits)


def _by_silence(terms: Terms, seen: Observed) -> Verdict | None:
    """That a node is lost; on AWS a child's death changes nothing."""
    for index, silence in _silent(seen):
        if silence.is_lost and (index == terms.main or terms.options.is_native):
            reason = f"node {index} has been silent for {silence.seconds:.0f} s: it hangs, or its network is down"
            return Verdict(Ending.LOST, reason if terms.options.is_native else lost_host(terms.hosts[index]))
    return None


def _silent(seen: Observed) -> Iterator[tuple[int, Silence]]:
    """The nodes that are silent, although nothing is known of their end."""
    for index, (end, silence) in enumerate(zip(seen.ends, seen.silences, strict=True)):
        if end is None and silence is not None:
            yield index, silence


def _unheard(terms: Terms, seen: Observed) -> str:
    """A note about the first node that is unreachable; empty where there is none."""
    for index, silence in _silent(seen):
        if silence.seconds > UNHEARD:
            name = "the main node" if index == terms.main else f"node {index}"
            return f"{name} has been unreachable since {silence.since}" + (
                f" ({silence.cause})" if silence.cause else ""
            )
    return ""


def _close(state: AttemptState, verdict: Verdict, gone: Gone) -> do.Close:
    """What becomes of the job: over, or RUNNABLE again."""
    terms, ending, progress = state.terms, verdict.ending, gone.progress
    native, number = terms.options.is_native, terms.number
    ran = gone.moment - (state.running_since or gone.moment)
    is_free = ending == Ending.PREEMPTED or (ending == Ending.REQUEUE and ran >= SHORTEST_REQUEUE)
    spent = terms.spent + (not is_free)
    is_left = spent < terms.allowed
    head = gone.ends[terms.main] if terms.main < len(gone.ends) else None

    def to(status: Status, reason: str) -> do.Close:
        return do.Close(gone.moment, not is_free, status, reason)

    match ending:
        case Ending.STOPPED if _was_done(ending, native, head):
            return to(Status.SUCCEEDED, _DONE.format("stopped"))
        case Ending.STOPPED | Ending.FAILED | Ending.LOST | Ending.PREEMPTED | Ending.REQUEUE if (
            state.stop_reason is not None
        ):
            return to(Status.FAILED, f"{state.stop_reason}{progress}" if native else state.stop_reason)
        case Ending.SUCCEEDED:
            return to(Status.SUCCEEDED, verdict.reason)
        case Ending.PREEMPTED | Ending.LOST | Ending.FAILED | Ending.TIMEOUT if _was_done(ending, native, head):
            return to(Status.SUCCEEDED, _DONE.format("preempted" if ending == Ending.PREEMPTED else "stopped"))
        case Ending.PREEMPTED:
            return to(Status.RUNNABLE, f"attempt {number} was {verdict.reason}{progress}")
        case Ending.REQUEUE if gone.cancelled:
            return _cancelled(terms, gone, spent=not is_free, may_go_on=is_free or is_left)
        case Ending.REQUEUE if is_free or is_left:
            return to(Status.RUNNABLE, f"attempt {number} left on request{progress}; starting again")
        case Ending.FAILED | Ending.LOST if is_left and _retries(terms, verdict, head):
            if native and verdict.fault is not None and verdict.fault == terms.last_fault:
                words = f" ({_REPEATED.format(verdict.fault, spent, terms.allowed)})"
                return to(Status.FAILED, excerpt(verdict.reason, LONGEST_REASON - len(words)) + words)
            return to(Status.RUNNABLE, f"attempt {number} failed ({verdict.reason}){progress}; trying again")
        case Ending.FAILED | Ending.LOST if native:
            times = "not tried again" if is_left else f"attempt {spent} of {terms.allowed}"
            return to(Status.FAILED, f"{verdict.reason} ({times})")
    return to(Status.FAILED, verdict.reason)


def _cancelled(terms: Terms, gone: Gone, *, spent: bool, may_go_on: bool) -> do.Close:
    """Whoever cancels a gang in its engine's queue again and again does not want it there."""
    times, most = terms.cancelled + 1, gone.cancellations
    how = f"attempt {terms.number} was {gone.cancelled}{gone.progress}"
    if may_go_on and times <= most:
        return do.Close(
            gone.moment, spent, Status.RUNNABLE, f"{how}; starting again ({times} of {most} times)", gone.cancelled
        )
    reason = f"{how}; not started again after {counted(times, 'cancellation')}: ask who did it before you resume it"
    return do.Close(gone.moment, spent, Status.FAILED, reason, gone.cancelled)


def _was_done(ending: Ending, native: bool, head: NodeEnd | None) -> bool:
    """Whether the main node had finished its work, which decides, also where its end was seen after another node's was.

    A native one leaves work with 75. Others may leave it with 0, too, once they are asked to end. Where a user has asked for the end, only
    a node counts that was surely not asked.
    """
    if head is None or head.exit_code != 0:
        return False
    if ending == Ending.STOPPED:
        return head.requested is False
    return not head.requested or ending == Ending.PREEMPTED or (native and ending != Ending.TIMEOUT)


def _retries(terms: Terms, verdict: Verdict, head: NodeEnd | None) -> bool:
    """The reason of a gang that was never launched is its container's, as of AWS's CannotStartContainerError."""
    reason = head.reason if head else verdict.start_error or verdict.reason
    if not terms.options.is_native:
        reason = container_reason(reason, verdict.reason) or ""
    return retries(terms.conditions, verdict.exit_code, reason, verdict.reason)


def after(state: AttemptState, instruction: do.Instruction) -> AttemptState:
    """The state once an instruction was carried out."""
    match instruction:
        case do.TakeEpoch():
            return replace(state, prepared=True)
        case do.Keep():
            return replace(state, launched=True)
        case do.MarkRunning(_, moment):
            return replace(state, started=True, running_since=moment)
        case do.Await("cause_since", moment):
            return replace(state, cause_since=moment)
        case do.Await(_, moment):
            return replace(state, done_since=moment)
        case do.Decide(verdict):
            return replace(state, verdict=verdict)
        case do.Close():
            return replace(state, closed=True)
    return state
