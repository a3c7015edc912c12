"""Faults that the control plane once had, put back: each is found within 200 seeds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any
from unittest import mock

from orchestrator.control import attempts, node_ends
from orchestrator.control.observer import Observer
from orchestrator.control.presence import Presence
from orchestrator.control.run_store import Errands, RunStore
from orchestrator.domain import attempt as rules
from orchestrator.domain.attempt_events import Delayed, Due, Event, Launched, Observed, Silence
from orchestrator.domain.attempt_instructions import Explain, Instructions, Launch
from orchestrator.domain.job import NodeEnd
from orchestrator.engines.api import Cause, NodeStatus
from shared_store.contract.bus import Node
from tests.support.simulation.database import SimulatedDatabase

Mutant = AbstractContextManager[Any]


def silence_alone_counts() -> Mutant:
    """B1: a node counts as dead when it is silent for 20 s, whatever its engine says, and however many others are."""

    def silence(self: Presence, node: Node, requested: float | None, runs: bool = True) -> Silence | None:
        received = self._nodes.get(node)
        if received is None or received.gone is None:
            return None
        seconds = self._monotonic() - received.gone
        return Silence(seconds, received.since, seconds > 20.0)

    return mock.patch.object(Presence, "silence", silence)


def those_whom_another_router_met_are_silent() -> Mutant:
    """B2: after a start or a move, nodes that do not come count as silent since the start."""
    expect = Presence.expect

    def expected(self: Presence, job: str, attempt: int, nodes: int, met: Iterable[int] = ()) -> None:
        expect(self, job, attempt, nodes)
        for index in range(nodes):
            self.left((job, attempt, index))

    return mock.patch.object(Presence, "expect", expected)


def nodes_that_do_not_reconnect_are_not_reported() -> Mutant:
    """After a start or a move, the controller does not report nodes that do not reconnect."""
    expect = Presence.expect

    def expected(self: Presence, job: str, attempt: int, nodes: int, met: Iterable[int] = ()) -> None:
        expect(self, job, attempt, nodes)

    return mock.patch.object(Presence, "expect", expected)


def the_loop_shares_its_connections() -> Mutant:
    """B3: requests that wait hold the connections that the loop needs."""
    return mock.patch.object(SimulatedDatabase, "reserve_connections", lambda self: None)


def the_loop_reads_the_store() -> Mutant:
    """B4: the loop waits for the volume."""

    def result(self: Errands, key: object, name: str, body: Callable[[], Any], again: bool = True) -> Any:
        return body()

    return mock.patch.object(Errands, "result", result)


def what_is_to_end_is_launched() -> Mutant:
    """B9: a gang that is preempted before its launch is launched all the same."""
    step = rules.step

    def stepped(state: rules.AttemptState, event: Event) -> Instructions:
        if state.phase is rules.AttemptPhase.LAUNCHING and state.verdict is not None:
            if isinstance(event, Due):
                return (Launch(),)
            if isinstance(event, Delayed):
                return (Explain(event.reason),) if event.reason else ()
        return step(state, event)

    return mock.patch.object(attempts, "step", stepped)


def a_launched_gang_waits_for_its_look() -> Mutant:
    """A gang is launched, and nobody looks at it until the next look at an attempt for which nothing is due."""
    step = rules.step

    def stepped(state: rules.AttemptState, event: Event) -> Instructions:
        done = step(state, event)
        return done[:-1] if isinstance(event, Launched) and done else done

    return mock.patch.object(attempts, "step", stepped)


def a_stop_waits_for_outcomes() -> Mutant:
    """Nothing is decided while it is not known how a node has ended."""
    observe = Observer.observe

    def observed(self: Observer, job: Any, attempt: Any) -> Observed | None:
        seen = observe(self, job, attempt)
        return None if seen is not None and seen.unread is not None else seen

    return mock.patch.object(Observer, "observe", observed)


def any_volume_is_the_store() -> Mutant:
    """T1: what is missing on another volume counts as missing."""
    init = RunStore.__init__

    def made(self: RunStore, store: Any, peers: Any, check: Any = None) -> None:
        init(self, store, peers)

    return mock.patch.object(RunStore, "__init__", made)


def without_an_outcome_is_killed() -> Mutant:
    """T2: a node that ended with 0 and could not write its outcome counts as killed."""
    seen_end = node_ends.seen_end

    def seen(node: NodeStatus, is_native: bool, moment: float) -> NodeEnd:
        end = seen_end(node, is_native, moment)
        return replace(end, exit_code=end.exit_code or 137) if node.cause is Cause.EXIT else end

    return mock.patch.object(node_ends, "seen_end", seen)


def a_fault_is_forgotten() -> Mutant:
    """The same fault is tried as often as the job has attempts."""
    step = rules.step

    def stepped(state: rules.AttemptState, event: Event) -> Instructions:
        return step(replace(state, terms=replace(state.terms, last_fault=None)), event)

    return mock.patch.object(attempts, "step", stepped)


MUTANTS: Mapping[str, Callable[[], Mutant]] = {
    "B1": silence_alone_counts,
    "B2": those_whom_another_router_met_are_silent,
    "B3": the_loop_shares_its_connections,
    "B4": the_loop_reads_the_store,
    "B9": what_is_to_end_is_launched,
    "fault": a_fault_is_forgotten,
    "look": a_launched_gang_waits_for_its_look,
    "missing": nodes_that_do_not_reconnect_are_not_reported,
    "stop": a_stop_waits_for_outcomes,
    "T1": any_volume_is_the_store,
    "T2": without_an_outcome_is_killed,
}
