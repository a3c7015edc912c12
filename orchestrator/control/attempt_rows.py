"""An attempt's rows as the state machine's state, and the rows that attempts share."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any

from sqlalchemy import Select, select
from sqlalchemy.orm import Session

from orchestrator.control.compute_environments import options_of
from orchestrator.domain.attempt import AttemptState, Terms
from orchestrator.domain.job import Ending, Status, Verdict
from orchestrator.persistence.batch_models import (
    Attempt,
    ComputeEnvironment,
    Job,
    JobQueue,
    RunRecord,
    SchedulingPolicy,
)

GRACE = 30.0
"""Seconds from SIGTERM to SIGKILL, as on AWS Batch."""
NO_EPOCH = 0
"""Of an attempt that has none yet."""


def state_of(job: Job, attempt: Attempt) -> AttemptState:
    """The state of an attempt, by its rows: all but what only a controller's memory has."""
    gang = job.gang
    counted = [each for each in job.attempts if each.spent and each is not attempt]
    terms = Terms(
        number=attempt.number,
        hosts=[node.host for node in attempt.nodes],
        whole=len(gang.nodes),
        main=gang.main,
        options=gang.options,
        grace=GRACE,
        timeout=job.timeout,
        allowed=job.attempts_allowed,
        spent=len(counted),
        conditions=job.evaluate_on_exit,
        cancelled=sum(each.ending == Ending.CANCELLED for each in job.attempts if each is not attempt),
        last_fault=counted[-1].fault if counted else None,
    )
    verdict = None
    if attempt.ending is not None:
        ending, reason = Ending(attempt.ending), attempt.status_reason or ""
        main = attempt.node(gang.main)
        error = main.reason if main is not None and attempt.handle is None else None
        verdict = Verdict(ending, reason, attempt.exit_code, fault=attempt.fault, start_error=error)
    return AttemptState(
        terms,
        prepared=attempt.epoch != NO_EPOCH,
        launched=attempt.handle is not None,
        started=job.status == Status.RUNNING,
        running_since=attempt.running_since,
        verdict=verdict,
        stop_reason=job.stop_reason,
        closed=attempt.stopped_at is not None,
    )


def note_of(job: Job, attempt: Attempt) -> str:
    """For the beginning of the nodes' logs: that others have cancelled the attempt before this one."""
    before = next((each for each in job.attempts if each.number == attempt.number - 1), None)
    if before is None or before.ending != Ending.CANCELLED:
        return ""
    return f"muster: attempt {before.number} was {before.status_reason}"


class SharedRows:
    """Rows that the attempts of some jobs read: each kind is read once for all of the jobs, and only if one of them needs it."""

    def __init__(self, session: Session, jobs: Sequence[Job]) -> None:
        self._session, self._jobs = session, jobs

    def _by_name(self, rows: Select[Any]) -> dict[str, Any]:
        """Rows as they are now: the session may have some of before, which requests have changed since."""
        found: Iterable[Any] = self._session.scalars(rows, execution_options={"populate_existing": True})
        return {each.name: each for each in found}

    @cached_property
    def queues(self) -> dict[str, JobQueue]:
        """By name."""
        return self._by_name(select(JobQueue).where(JobQueue.name.in_({job.queue for job in self._jobs})))

    @cached_property
    def _environments(self) -> dict[str, ComputeEnvironment]:
        return self._by_name(select(ComputeEnvironment))

    @cached_property
    def _policies(self) -> dict[str, SchedulingPolicy]:
        return self._by_name(select(SchedulingPolicy))

    def policy(self, queue: str) -> SchedulingPolicy | None:
        """The scheduling policy of a queue; None where it has none."""
        found = self.queues.get(queue)
        return self._policies.get(found.policy) if found is not None and found.policy else None

    def options(self, environment: str, queue: str) -> dict[str, str]:
        """As :func:`orchestrator.control.compute_environments.options_of`."""
        return options_of(self._environments.get(environment), self.queues.get(queue))

    @cached_property
    def runs(self) -> dict[str, RunRecord]:
        """The owners of the jobs' runs, by name; a record that is added belongs here, too."""
        query = select(RunRecord).where(RunRecord.name.in_({job.run for job in self._jobs}))
        return {each.name: each for each in self._session.scalars(query)}

    @cached_property
    def _epochs(self) -> dict[str, list[int]]:
        found: dict[str, list[int]] = defaultdict(list)
        query = select(Job.run, Attempt.epoch).join(Attempt).where(Job.run.in_({job.run for job in self._jobs}))
        for run, epoch in self._session.execute(query):
            found[run].append(epoch)
        return found

    def epochs(self, run: str) -> Sequence[int]:
        """Those of all recorded attempts on a run."""
        return self._epochs[run]
