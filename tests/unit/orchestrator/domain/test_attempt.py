"""The rules of an attempt, one by one: from a state and an event to instructions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

from orchestrator.domain import attempt_instructions as do
from orchestrator.domain.attempt import CAUSE_PATIENCE, FINISHING, SHORTEST_REQUEUE, UNHEARD, AttemptState, Terms, step
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
from orchestrator.domain.excerpts import LONGEST_REASON
from orchestrator.domain.job import AWS_EXITED, Ending, NodeEnd, Status, Verdict
from orchestrator.domain.native_options import NativeOptions

T = 1_000_000
"""The moment of every event here (steady time [ms])."""
NATIVE = NativeOptions(is_native=True, on_child_failure="restart")
TERMS = Terms(number=2, hosts=("h/0", "h/1"), whole=2, main=0, options=NATIVE, grace=30.0, allowed=3, spent=1)

PREPARING = AttemptState(TERMS)
LAUNCHING = replace(PREPARING, prepared=True)
STARTING = replace(LAUNCHING, launched=True)
RUNNING = replace(STARTING, started=True, running_since=T - 50_000)


def ending(
    ending: Ending, reason: str = "why", exit_code: int | None = None, of: AttemptState = RUNNING
) -> AttemptState:
    return replace(of, verdict=Verdict(ending, reason, exit_code))


def with_terms(state: AttemptState, **terms: Any) -> AttemptState:
    return replace(state, terms=replace(state.terms, **terms))


def stopping(state: AttemptState) -> AttemptState:
    return replace(state, stop_reason="enough")


def on_aws(state: AttemptState) -> AttemptState:
    return with_terms(state, options=NativeOptions())


def seen(*ends: NodeEnd | None, silences: Sequence[Silence | None] = (None, None), **facts: Any) -> Observed:
    """A look at two nodes that run, where nothing else is reported."""
    return Observed(T, ends or (None, None), silences, **facts)


def end(code: int, **facts: Any) -> NodeEnd:
    return NodeEnd(code, f"exit {code}", 1.0, **facts)


RUNS = "attempt 2 runs on 2 nodes"
SAYS_SO = do.Explain(RUNS)
DONE = Verdict(Ending.SUCCEEDED, AWS_EXITED, 0)
STOPPED = Verdict(Ending.STOPPED, "enough")
FAILED = Verdict(Ending.FAILED, "main node: exit 1", 1)
MAIN_LAST = (end(0), end(0))
LEFT_LAST = (end(0, requested=True), end(0))
KILLED = end(143, requested=True)
UNSURE = Verdict(Ending.FAILED, "main node: exit 143", 143, certain=False)
QUIET = Silence(121.0, "12:00:00 UTC", False, "none is heard")
GONE_QUIET = replace(QUIET, is_lost=True, cause="")
FROZEN = Verdict(Ending.LOST, "node 1 has been silent for 121 s: it hangs, or its network is down")
UNHEARD_SO = do.Explain("attempt 2 runs on 2 nodes; node 1 has been unreachable since 12:00:00 UTC (none is heard)")
QUIET_SO = do.Explain("attempt 2 runs on 2 nodes; node 1 has been unreachable since 12:00:00 UTC")
LATE = Verdict(Ending.TIMEOUT, "Job attempt duration exceeded timeout")
REFUSED = Verdict(Ending.FATAL, "can't start the gang: no such image", start_error="no such image")
DRIVER = "CannotStartContainerError: a driver"
AWS_FAILED = Verdict(Ending.FAILED, AWS_EXITED, 1)
GONE = Verdict(Ending.FAILED, "Host EC2 (instance h/0) terminated.")
ROOMLESS = "attempt 2 runs on 2 of 4 nodes: there is no room for more"


def ends(verdict: Verdict, grace: float = 35.0, first: do.Instruction = SAYS_SO) -> list[do.Instruction]:
    """A look at a gang brings its end about."""
    return [first, *decided(verdict, grace)]


def decided(verdict: Verdict, grace: float = 35.0) -> list[do.Instruction]:
    return [do.Decide(verdict), ending_so(verdict.reason), *stops(grace, verdict.reason)]


def stops(grace: float = 35.0, why: str = "why") -> list[do.Instruction]:
    """The end is saved before the gang is stopped; what the stop adds to the reason stays until something else is known."""
    return [do.Save(), do.Stop(grace, f"{why}; its nodes are ending")]


def ending_so(reason: str = "why") -> do.Instruction:
    return do.Explain(f"{reason}; its nodes are ending")


TIMED = with_terms(RUNNING, timeout=50)

RULES: dict[str, tuple[AttemptState, Event, Sequence[do.Instruction]]] = {
    # -- preparing
    "a new attempt takes its run": (PREPARING, Due(), [do.Prepare()]),
    "its epoch is saved before anything is launched": (
        PREPARING,
        Prepared(7),
        [do.TakeEpoch(7), do.Save(), do.Launch()],
    ),
    "a run that can't be used is final": (
        PREPARING,
        StartRefused("it is damaged"),
        [do.Decide(Verdict(Ending.FATAL, "it is damaged", start_error="it is damaged")), do.WindUp()],
    ),
    "while its run can't be read, others may have its room": (
        PREPARING,
        Delayed("away", idle=True),
        [do.Withdraw("away")],
    ),
    "but not while a call on the store is under way": (PREPARING, Delayed("silent"), [do.Explain("silent")]),
    "one that is not needed takes nothing": (stopping(PREPARING), Due(), [do.Decide(STOPPED), do.WindUp()]),
    "nor one that was preempted": (ending(Ending.PREEMPTED, of=PREPARING), Due(), [do.WindUp()]),
    "the scheduler may take its place": (
        PREPARING,
        Preempted("for b"),
        [do.Decide(Verdict(Ending.PREEMPTED, "for b"))],
    ),
    # -- launching
    "what is recorded is launched": (LAUNCHING, Due(), [do.Launch()]),
    "what is to end is not launched anew": (ending(Ending.PREEMPTED, of=LAUNCHING), Due(), [do.Launch(again=False)]),
    "nor on request": (stopping(LAUNCHING), Due(), [do.Launch(again=False)]),
    "what was preempted before it could start is over": (
        ending(Ending.PREEMPTED, of=LAUNCHING),
        Delayed("pulling the image", idle=True),
        [do.WindUp()],
    ),
    "a handle is saved at once": (LAUNCHING, Launched("handle"), [do.Keep("handle"), do.Save(), do.Observe()]),
    "a launch that waits says why": (LAUNCHING, Delayed("no room", idle=True), [do.Explain("no room")]),
    "or nothing yet": (LAUNCHING, Delayed(""), []),
    "one that is not needed is given up": (
        stopping(LAUNCHING),
        Delayed("full", idle=True),
        [do.Decide(STOPPED), do.WindUp()],
    ),
    "unless something may run": (stopping(LAUNCHING), Delayed("silent"), [do.Explain("silent")]),
    "a refusal of what is to end anyway changes nothing": (
        ending(Ending.PREEMPTED, of=LAUNCHING),
        StartRefused("gone", is_final=False),
        [do.WindUp()],
    ),
    "a refusal is final": (LAUNCHING, StartRefused("no such image"), [do.Decide(REFUSED), do.WindUp()]),
    "a start that failed is an attempt that failed": (
        LAUNCHING,
        StartRefused(DRIVER, is_final=False),
        [do.Decide(Verdict(Ending.FAILED, DRIVER, start_error=DRIVER)), do.WindUp()],
    ),
    "on AWS it has AWS's reason": (
        on_aws(LAUNCHING),
        StartRefused(DRIVER, is_final=False),
        [do.Decide(Verdict(Ending.FAILED, "Task failed to start", start_error=DRIVER)), do.WindUp()],
    ),
    "so has a refusal on AWS": (
        on_aws(LAUNCHING),
        StartRefused("no such image"),
        [do.Decide(Verdict(Ending.FATAL, "Task failed to start", start_error="no such image")), do.WindUp()],
    ),
    "before its launch nothing can be seen of it": (LAUNCHING, seen(), []),
    # -- what is reported
    "what is launched is looked at": (STARTING, Due(), [do.Observe()]),
    "also while it runs": (RUNNING, Due(), [do.Observe()]),
    "and while it ends": (ending(Ending.FAILED), Due(), [do.Observe()]),
    "a main node that waits says why": (STARTING, seen(waits="queued"), [do.Explain("queued")]),
    "also one that can't be seen any more": (RUNNING, seen(waits="silent"), [do.Explain("silent")]),
    "the main node's first sign makes the job run": (STARTING, seen(), [do.MarkRunning(RUNS, T)]),
    "in the engine's words where it has some": (STARTING, seen(words="on n1"), [do.MarkRunning("on n1", T)]),
    "so does an end that came before any sign": (STARTING, seen(*MAIN_LAST), ends(DONE, first=do.MarkRunning(RUNS, T))),
    "a gang with too little room is called so": (with_terms(RUNNING, whole=4), seen(), [do.Explain(ROOMLESS)]),
    "one node is singular": (
        with_terms(RUNNING, hosts=("h/0",), whole=1),
        seen(None, silences=(None,)),
        [do.Explain("attempt 2 runs on 1 node")],
    ),
    # -- what ends it
    "the main node's end decides": (RUNNING, seen(*MAIN_LAST), ends(DONE)),
    "a failure has little to save": (RUNNING, seen(end(1), None), ends(FAILED, 5.0)),
    "so has a child's that is final": (
        with_terms(RUNNING, options=replace(NATIVE, on_child_failure="fail")),
        seen(None, end(1)),
        ends(Verdict(Ending.FATAL, "node 1: exit 1", 1), 5.0),
    ),
    "what was asked to end waits for the cause": (RUNNING, seen(KILLED, None), [SAYS_SO, do.Await("cause_since", T)]),
    "since the first time": (
        replace(RUNNING, cause_since=T - CAUSE_PATIENCE),
        seen(KILLED, None),
        [SAYS_SO, do.Await("cause_since", T - CAUSE_PATIENCE)],
    ),
    "but not for ever": (replace(RUNNING, cause_since=T - CAUSE_PATIENCE - 1), seen(KILLED, None), ends(UNSURE, 5.0)),
    "nor when the job is to stop": (
        stopping(RUNNING),
        seen(KILLED, None),
        [SAYS_SO, do.Await("cause_since", T), *decided(STOPPED)],
    ),
    "a request ends it": (stopping(RUNNING), seen(), ends(STOPPED)),
    "also before it runs": (stopping(STARTING), seen(waits="queued"), ends(STOPPED, first=do.Explain("queued"))),
    "an end counts more than a request": (stopping(RUNNING), seen(*MAIN_LAST), ends(DONE)),
    "a node that is lost ends it, with its whole grace": (
        RUNNING,
        seen(silences=(None, GONE_QUIET)),
        ends(FROZEN, 35.0, first=QUIET_SO),
    ),
    "one that is unreachable does not, and is called so": (RUNNING, seen(silences=(None, QUIET)), [UNHEARD_SO]),
    "after a moment": (RUNNING, seen(silences=(None, replace(QUIET, seconds=UNHEARD))), [SAYS_SO]),
    "the silence of a node that has ended is none": (
        RUNNING,
        seen(None, end(0), silences=(None, GONE_QUIET)),
        [SAYS_SO],
    ),
    "that of a child on AWS ends nothing": (on_aws(RUNNING), seen(silences=(None, GONE_QUIET)), [QUIET_SO]),
    "that of the main node loses its host": (
        on_aws(RUNNING),
        seen(silences=(GONE_QUIET, None)),
        ends(replace(GONE, ending=Ending.LOST), 35.0, first=do.Explain(f"{RUNS}; the main node{QUIET_SO.reason[33:]}")),
    ),
    "while it is not known how nodes ended, the store is named": (
        RUNNING,
        seen(unread="the store is away", stale="Slurm is away"),
        [do.Explain("Slurm is away; the store is away")],
    ),
    "or nothing yet, and nothing follows from ends": (RUNNING, seen(end(1), None, unread=""), []),
    "a request does not wait for the store": (stopping(RUNNING), seen(unread=""), decided(STOPPED)),
    "nor does the clock": (
        replace(TIMED, running_since=T - 50_001),
        seen(unread=""),
        decided(LATE),
    ),
    "nor a lost node": (
        RUNNING,
        seen(silences=(None, GONE_QUIET), unread=""),
        decided(FROZEN),
    ),
    "nor an end that is decided": (
        ending(Ending.PREEMPTED),
        seen(unread="the store is away"),
        stops(),
    ),
    "an engine that does not answer is named": (
        RUNNING,
        seen(stale="Slurm is away"),
        [do.Explain(f"{RUNS}; Slurm is away")],
    ),
    "time ends it": (replace(TIMED, running_since=T - 50_001), seen(), ends(LATE)),
    "to the second": (TIMED, seen(), [SAYS_SO]),
    "on AWS a child's end is nothing": (on_aws(RUNNING), seen(None, end(1)), [SAYS_SO]),
    "and the main node's everything": (on_aws(RUNNING), seen(end(1), None), ends(AWS_FAILED, 5.0)),
    "where it vanished its host is named": (on_aws(RUNNING), seen(end(137, lost=True), None), ends(GONE, 5.0)),
    "the scheduler ends it": (RUNNING, Preempted("for b"), [do.Decide(Verdict(Ending.PREEMPTED, "for b"))]),
    "also before its launch": (LAUNCHING, Preempted("for b"), [do.Decide(Verdict(Ending.PREEMPTED, "for b"))]),
    "not twice": (ending(Ending.FAILED), Preempted("for b"), []),
    # -- how it is ended
    "an end that is decided stays": (stopping(ending(Ending.FAILED)), seen(*MAIN_LAST), stops(5.0)),
    "a preempted gang may save": (ending(Ending.PREEMPTED), seen(), stops()),
    "one that never ran is stopped, too, and its queue says no more why it waits": (
        ending(Ending.PREEMPTED, of=STARTING),
        seen(waits="queued"),
        stops(),
    ),
    "one that is seen to run only now says why it ends nevertheless": (
        ending(Ending.PREEMPTED, of=STARTING),
        seen(),
        [do.MarkRunning(RUNS, T), ending_so(), *stops()],
    ),
    "children of a main node that is done may end": (
        RUNNING,
        seen(end(0), None),
        [SAYS_SO, do.Decide(DONE), ending_so(DONE.reason), do.Save(), do.Await("done_since", T)],
    ),
    "for a while": (
        replace(ending(Ending.SUCCEEDED), done_since=T - FINISHING + 1),
        seen(end(0), None),
        [ending_so(), do.Save(), do.Await("done_since", T - FINISHING + 1)],
    ),
    "and no longer": (
        replace(ending(Ending.SUCCEEDED), done_since=T - FINISHING),
        seen(end(0), None),
        stops(),
    ),
    "on AWS not at all": (on_aws(ending(Ending.SUCCEEDED)), seen(end(0), None), stops()),
    "an old picture is named": (
        ending(Ending.FAILED),
        seen(stale="Slurm to answer"),
        [do.Save(), do.Stop(5.0, "why; waits for Slurm to answer")],
    ),
    "a stop that fails is reported": (ending(Ending.FAILED), Delayed("not allowed"), [do.Explain("not allowed")]),
    "so is a store that can't be read": (RUNNING, Delayed("the store is away"), [do.Explain("the store is away")]),
    "one that is closed stays so": (replace(ending(Ending.FAILED), closed=True), Gone(T, MAIN_LAST, ""), []),
    "a gang does not go before its end is decided": (RUNNING, Gone(T, MAIN_LAST, ""), []),
}


@pytest.mark.parametrize("rule", RULES)
def test_a_rule_says_what_follows_from_an_event_in_a_state(rule: str) -> None:
    state, event, expected = RULES[rule]
    assert list(step(state, event)) == expected


SAVED = "; last checkpoint: iteration 50"
STOPPED_SO = f"enough{SAVED}"
PREEMPTED_SO = f"attempt 2 was why{SAVED}"
LEFT_SO = f"attempt 2 left on request{SAVED}; starting again"
FAILED_SO = f"attempt 2 failed (why){SAVED}; trying again"
LEFT = SHORTEST_REQUEUE
SPENT, FREE = True, False
REQUEUE, STOP = Ending.REQUEUE, Ending.STOPPED
CODE_4 = {"action": "EXIT", "onExitCode": "4"}


def ran(state: AttemptState, milliseconds: int) -> AttemptState:
    return replace(state, running_since=T - milliseconds)


def final(code: int, condition: dict[str, str]) -> AttemptState:
    return with_terms(ending(Ending.FAILED, exit_code=code), conditions=[condition])


REASON_3 = {"action": "EXIT", "onReason": "exit 3"}
UNCERTAIN = (replace(end(0), requested=None), None)
NEVER_STARTED = ending(Ending.FAILED, of=LAUNCHING)
REFUSED_ON_AWS = replace(LAUNCHING, verdict=Verdict(Ending.FAILED, "Task failed to start", start_error="why"))
WHY = {"action": "EXIT", "onReason": "wh*"}
BOTH_LEFT, MAIN_FAILED = (end(75), end(75)), (end(1), None)
FAILED_LAST = with_terms(ending(Ending.FAILED), spent=2)
"""In the third of three attempts."""
AT_ONCE = ran(ending(REQUEUE), LEFT - 1)
S = Status
DONE_SO, LAST_SO = "done before it was preempted", "why (not tried again)"
STOPPED_LATE = "done before it was stopped"

FAULT, OTHER = "ValueError in reward.py, line 3", "ValueError in reward.py, line 4"


def faulty(before: str | None, now: str | None = FAULT, **terms: Any) -> AttemptState:
    """The second attempt ends by a fault, and the last spent one ended by ``before``."""
    state = with_terms(ending(Ending.FAILED, exit_code=1), last_fault=before, **terms)
    return replace(state, verdict=replace(FAILED, reason="why", fault=now))


REPEATED_SO = f"why ({FAULT} ended the attempt before, too: not tried again after 2 of 3 attempts; correct it before you resume or submit again)"

# state, the nodes' ends → whether the attempt is spent, the job's state, and its reason
CLOSES: dict[str, tuple[AttemptState, Sequence[NodeEnd | None], bool, Status, str]] = {
    "done": (ending(Ending.SUCCEEDED), MAIN_LAST, SPENT, S.SUCCEEDED, "why"),
    "done before the stop": (stopping(ending(Ending.SUCCEEDED)), MAIN_LAST, SPENT, S.SUCCEEDED, "why"),
    "done before its user stopped it": (stopping(ending(STOP)), MAIN_LAST, SPENT, S.SUCCEEDED, STOPPED_LATE),
    "stopped with 0": (stopping(ending(STOP)), LEFT_LAST, SPENT, S.FAILED, STOPPED_SO),
    "stopped with 0, perhaps": (stopping(ending(STOP)), UNCERTAIN, SPENT, S.FAILED, STOPPED_SO),
    "stopped": (stopping(ending(STOP)), (), SPENT, S.FAILED, STOPPED_SO),
    "stopped, on AWS": (on_aws(stopping(ending(STOP))), (), SPENT, S.FAILED, "enough"),
    "failed when it was asked to stop": (stopping(ending(Ending.FAILED)), (), SPENT, S.FAILED, STOPPED_SO),
    "left when it was asked to stop": (stopping(ending(REQUEUE)), (), FREE, S.FAILED, STOPPED_SO),
    "preempted when it was asked to stop": (stopping(ending(Ending.PREEMPTED)), MAIN_LAST, FREE, S.FAILED, STOPPED_SO),
    "refused when it was asked to stop": (stopping(ending(Ending.FATAL)), (), SPENT, S.FAILED, "why"),
    "over time when it was asked to stop": (stopping(ending(Ending.TIMEOUT)), (), SPENT, S.FAILED, "why"),
    "preempted": (ending(Ending.PREEMPTED), BOTH_LEFT, FREE, S.RUNNABLE, PREEMPTED_SO),
    "preempted before its launch": (ending(Ending.PREEMPTED, of=LAUNCHING), (), FREE, S.RUNNABLE, PREEMPTED_SO),
    "done before it was stopped": (ending(Ending.LOST), MAIN_LAST, SPENT, S.SUCCEEDED, STOPPED_LATE),
    "done when it was stopped": (ending(Ending.LOST), LEFT_LAST, SPENT, S.SUCCEEDED, STOPPED_LATE),
    "done when a child had failed": (ending(Ending.FAILED), (end(0), end(1)), SPENT, S.SUCCEEDED, STOPPED_LATE),
    "done before it was stopped, on AWS": (on_aws(ending(Ending.LOST)), MAIN_LAST, SPENT, S.SUCCEEDED, STOPPED_LATE),
    "stopped with 0, on AWS": (on_aws(with_terms(ending(Ending.LOST), spent=2)), LEFT_LAST, SPENT, S.FAILED, "why"),
    "done before its time was over": (ending(Ending.TIMEOUT), MAIN_LAST, SPENT, S.SUCCEEDED, STOPPED_LATE),
    "stopped with 0 when its time was over": (ending(Ending.TIMEOUT), LEFT_LAST, SPENT, S.FAILED, "why"),
    "done before it was preempted": (ending(Ending.PREEMPTED), MAIN_LAST, FREE, S.SUCCEEDED, DONE_SO),
    "left on request": (with_terms(ran(ending(REQUEUE), LEFT), spent=3), BOTH_LEFT, FREE, S.RUNNABLE, LEFT_SO),
    "left at once": (AT_ONCE, BOTH_LEFT, SPENT, S.RUNNABLE, LEFT_SO),
    "left at once, the last time": (with_terms(AT_ONCE, spent=2), BOTH_LEFT, SPENT, S.FAILED, "why"),
    "lost": (ending(Ending.LOST), MAIN_FAILED, SPENT, S.RUNNABLE, FAILED_SO),
    "lost the last time": (with_terms(ending(Ending.LOST), spent=2), (), SPENT, S.FAILED, "why (attempt 3 of 3)"),
    "failed": (ending(Ending.FAILED), MAIN_FAILED, SPENT, S.RUNNABLE, FAILED_SO),
    "failed the last time": (FAILED_LAST, MAIN_FAILED, SPENT, S.FAILED, "why (attempt 3 of 3)"),
    "failed the last time, on AWS": (on_aws(FAILED_LAST), MAIN_FAILED, SPENT, S.FAILED, "why"),
    "failed as no retry mends": (final(4, CODE_4), (end(4), None), SPENT, S.FAILED, LAST_SO),
    "failed for the reason that no retry mends": (final(3, REASON_3), (end(3), None), SPENT, S.FAILED, LAST_SO),
    "failed by a fault": (faulty(None), MAIN_FAILED, SPENT, S.RUNNABLE, FAILED_SO),
    "failed by the same fault twice": (faulty(FAULT), MAIN_FAILED, SPENT, S.FAILED, REPEATED_SO),
    "failed by two faults": (faulty(OTHER), MAIN_FAILED, SPENT, S.RUNNABLE, FAILED_SO),
    "failed for no fault after a fault": (faulty(FAULT, None), MAIN_FAILED, SPENT, S.RUNNABLE, FAILED_SO),
    "failed twice for no fault": (faulty(None, None), MAIN_FAILED, SPENT, S.RUNNABLE, FAILED_SO),
    "failed by the same fault twice, on AWS": (on_aws(faulty(FAULT)), MAIN_FAILED, SPENT, S.RUNNABLE, FAILED_SO),
    "failed by the same fault when it was asked to stop": (
        stopping(faulty(FAULT)),
        MAIN_FAILED,
        SPENT,
        S.FAILED,
        STOPPED_SO,
    ),
    "failed by the same fault the last time": (
        faulty(FAULT, spent=2),
        MAIN_FAILED,
        SPENT,
        S.FAILED,
        "why (attempt 3 of 3)",
    ),
    "not started": (NEVER_STARTED, (), SPENT, S.RUNNABLE, FAILED_SO),
    "not started for a reason that no retry mends": (
        with_terms(NEVER_STARTED, conditions=[WHY]),
        (),
        SPENT,
        S.FAILED,
        LAST_SO,
    ),
    "not started, on AWS": (
        on_aws(with_terms(REFUSED_ON_AWS, conditions=[{"action": "EXIT", "onReason": "wh*"}])),
        (),
        SPENT,
        S.RUNNABLE,
        f"attempt 2 failed (Task failed to start){SAVED}; trying again",
    ),
    "not started, on AWS, for a reason that no retry mends": (
        on_aws(
            with_terms(REFUSED_ON_AWS, conditions=[{"action": "EXIT", "onReason": "CannotStartContainerError: why"}])
        ),
        (),
        SPENT,
        S.FAILED,
        "Task failed to start",
    ),
    "fatal": (ending(Ending.FATAL), (), SPENT, S.FAILED, "why"),
    "over time": (ending(Ending.TIMEOUT), (), SPENT, S.FAILED, "why"),
}


@pytest.mark.parametrize("case", CLOSES)
def test_how_an_attempt_ended_says_what_becomes_of_its_job(case: str) -> None:
    state, ends, spent, status, reason = CLOSES[case]
    assert step(state, Gone(T, ends, SAVED)) == (do.Close(T, spent, status, reason),)


def test_a_long_reason_leaves_room_for_the_fault_that_came_again() -> None:
    state = faulty(FAULT)
    long = replace(state, verdict=replace(FAILED, reason="y" * 5000, fault=FAULT))
    (close,) = step(long, Gone(T, MAIN_FAILED, SAVED))
    assert isinstance(close, do.Close) and close.reason.endswith(REPEATED_SO.removeprefix("why"))
    assert len(close.reason) == LONGEST_REASON and close.reason.startswith("yyyy")
