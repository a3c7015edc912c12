"""The observer of gangs: it learns of them from their engines, the bus, and the outcomes that their nodes leave in the store."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

from orchestrator import machine
from orchestrator.control.bus import Bus
from orchestrator.control.clock import Clock
from orchestrator.control.node_ends import node_end
from orchestrator.control.run_store import Errands, Key, RunContent, RunStore
from orchestrator.domain.attempt_events import Observed, Silence
from orchestrator.domain.job import NodeEnd, aws_ending
from orchestrator.engines.api import GangStatus, NodePhase
from orchestrator.engines.registry import EngineSet
from orchestrator.persistence.batch_models import Attempt, Job, Node, now
from shared_store.volume.node_outcomes import Outcome

CHECK_INTERVAL = 5.0
"""Seconds between two observations of a gang of which a node can't be seen or heard, or whose cause is not known yet."""


@dataclass
class _Seen:
    """What is known of the outcomes of a gang."""

    outcomes: dict[int, Outcome | None] = field(default_factory=dict)
    """Of nodes that have ended, by index; None for one that has left none."""
    checked: float | None = None
    """When they were read last (monotonic [s])."""
    progress: RunContent | None = None
    """What the run holds, read after the last of them was found."""
    has_hidden: bool = False
    """Whether a node could not be seen or heard at the last observation."""


class Observer:
    """Observes gangs. On the controller's thread alone, which never waits here for an engine or the store."""

    def __init__(self, engine: EngineSet, runs: RunStore, errands: Errands, bus: Bus, clock: Clock) -> None:
        self._engine, self._runs, self._errands, self._bus, self._clock = engine, runs, errands, bus, clock
        self._seen = defaultdict[Key, _Seen](_Seen)

    def forget(self, key: Key) -> None:
        """The attempt is closed."""
        self._seen.pop(key, None)

    def observe(self, job: Job, attempt: Attempt) -> Observed | None:
        """An observation of a gang that was launched; None before its engine's first poll."""
        assert attempt.handle is not None
        key = job.id, attempt.number
        status = self._engine.observe(attempt.handle)
        if status is None:
            return None  # the engine's first poll is under way
        silences = self._silences(key, attempt.handle, status)
        known = self.know_outcomes(job, attempt, status, silences)
        ends = self.ends(job, attempt, status)
        head, unseen = status[job.gang.main], (node.words for node in status if node.phase is NodePhase.UNREACHABLE)
        return Observed(
            moment=self._clock.now(),
            ends=ends,
            silences=silences,
            unread=None if known else self._errands.trouble(key),
            waits=head.words
            if head.phase not in (NodePhase.RUNNING, NodePhase.ENDED) and ends[job.gang.main] is None
            else ("" if known else next(unseen, "")),
            words=head.words if head.running else "",
            stale=next((node.stale for node in status if node.stale), ""),
        )

    def has_hidden(self, key: Key) -> bool:
        """Whether a node of the attempt could not be seen or heard at the last observation, and has left no outcome."""
        return key in self._seen and self._seen[key].has_hidden

    def _silences(self, key: Key, handle: str, status: GangStatus) -> Sequence[Silence | None]:
        """The silence of each node, by what the engine and the store say of it; None for one that has ended."""
        seen = self._seen[key]
        age = self._engine.status_age(handle)
        age = None if age is None or seen.checked is None else max(age, machine.monotonic() - seen.checked)

        if self._bus.endpoint is None:
            return [None] * len(status)
        return [
            self._bus.presence.silence((*key, index), age, node.phase is not NodePhase.UNREACHABLE and not node.stale)
            if node.running
            else None
            for index, node in enumerate(status)
        ]

    def know_outcomes(self, job: Job, attempt: Attempt, status: GangStatus, silences: Sequence[Silence | None]) -> bool:
        """Read the outcomes of nodes that have ended, and now and then of those that can't be seen or heard.

        Args:
            job: The job.
            attempt: Its open attempt.
            status: Of each node.
            silences: Of each node, at the same observation.

        Returns:
            Whether those of the nodes that have ended are known.
        """
        key = job.id, attempt.number
        memory, moment = self._seen[key], machine.monotonic()
        ended = [index for index, node in enumerate(status) if not node.running and index not in memory.outcomes]
        hidden = [
            index
            for index, (node, silence) in enumerate(zip(status, silences, strict=True))
            if node.running
            and memory.outcomes.get(index) is None
            and (node.phase is NodePhase.UNREACHABLE or node.stale or silence)
        ]
        memory.has_hidden = bool(hidden)
        if not ended and (not hidden or (memory.checked is not None and moment - memory.checked < CHECK_INTERVAL)):
            return True
        missing = {index for index in range(len(status)) if memory.outcomes.get(index) is None}
        reading = partial(self._read, job.run, attempt.epoch, key, [*ended, *hidden], frozenset(missing))
        found = self._errands.result(key, "outcomes", lambda: (moment, ended, *reading()))
        if found is None:
            return not ended
        # of the call that has returned: a node that has ended since may have left its outcome after it was looked for
        memory.checked, finished, outcomes, memory.progress = found
        memory.outcomes |= {**dict.fromkeys(finished), **outcomes}
        return all(index in memory.outcomes for index in ended) or self.know_outcomes(job, attempt, status, silences)

    def _read(
        self, run: str, epoch: int, key: Key, nodes: Sequence[int], missing: frozenset[int]
    ) -> tuple[Mapping[int, Outcome], RunContent | None]:
        """The outcomes of these nodes; where none is ``missing`` any more, so that nothing writes into the run, what that holds, too."""
        found = self._runs.outcomes(run, *key, nodes)
        return found, self._runs.progress(run, epoch) if missing <= found.keys() else None

    def progress(self, key: Key) -> RunContent | None:
        """What the run held after all nodes of an attempt had left their outcomes; None where that was not read."""
        return self._seen[key].progress if key in self._seen else None

    def ends(self, job: Job, attempt: Attempt, status: GangStatus) -> list[NodeEnd | None]:
        """The end of each node, None while it is not known; noted in the attempt's record with the other facts about its nodes."""
        key = job.id, attempt.number
        outcomes, ends = self._seen[key].outcomes, list[NodeEnd | None]()
        for index, (record, node) in enumerate(zip(attempt.nodes, status, strict=True)):
            end, outcome = None, outcomes.get(index)
            if outcome is not None or (not node.running and index in outcomes):
                end, stopped = node_end(outcome, node, job.gang.options.is_native, now())
                _note(record, exit_code=end.exit_code, reason=end.reason, error=end.error)
                if record.stopped_at is None:
                    record.stopped_at = stopped
                    if attempt.ending is None:  # by itself: no one ended the gang
                        record.status_reason = aws_ending(end, record.host)
                self._bus.presence.ended((*key, index))
            elif self._bus.presence.met((*key, index)):
                _note(record, met=True)
            ends.append(end)
            _note(record, devices=tuple(node.gpus) or record.devices, host=node.host or record.host)
            _note(record, address=node.address or record.address or "")  # of a node that can't be seen it stays known
        return ends


def _note(record: Node, **facts: object) -> None:
    """Note what is new: an observation of nothing new changes no row."""
    for name, value in facts.items():
        if getattr(record, name) != value:
            setattr(record, name, value)
