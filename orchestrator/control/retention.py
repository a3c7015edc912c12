"""Retention: takes old jobs, their logs and their runs, in small steps, where nothing needs them (:mod:`orchestrator.domain.retention`).

A run goes in three steps, none of which holds a lock while it waits for the store: under the lock of all writes it is taken, so that no
request uses it any more; it is looked at again, and moved into the store's trash; then the rows of its jobs are deleted. Whatever dies in
between leaves the run, or rows of jobs whose run is gone: the next pass deletes these.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import wait
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

from sqlalchemy import delete, or_, select
from sqlalchemy.orm import Session

from orchestrator import machine
from orchestrator.control.retention_facts import CONTROLLER, PassTotals, Requester, RetentionPlan, Step, StoredRuns
from orchestrator.control.store_access import StoreAccess
from orchestrator.domain import retention
from orchestrator.domain.errors import RequestError, Unavailable
from orchestrator.domain.job import TERMINAL
from orchestrator.domain.retention import A_DAY, JobFacts, References, RetentionRules, RunFacts, decide, still_needed
from orchestrator.persistence import retention_rows as rows
from orchestrator.persistence.batch_models import Job, JobQueue, RunRecord, now
from orchestrator.persistence.keyset import Cursor, behind
from orchestrator.persistence.own_models import RetentionStart, RunUse, ShareUsage
from orchestrator.persistence.session import Database
from shared_store.contract.error_text import counted
from shared_store.volume import contents, trash
from shared_store.volume.files import DamagedFile
from shared_store.volume.layout import NAME

log = logging.getLogger("muster.retention")

A_STEP, A_TRANSACTION = 100, 50
"""Jobs of a step, and of a transaction that deletes their rows: for that the loop and submissions wait."""
_INTERVAL, _FIRST = 600.0, 60.0
"""Seconds between two passes, and until the first one."""
_REST = 2.0
"""After a step, a pass rests for so many times the processor time that it took."""
_REMOVERS = 8
"""Threads that remove what was thrown away."""
_FRESH = 600.0
"""Seconds for which what was found in the store counts: what needs a run that is old enough to go seldom comes."""
_PATIENCE = 10.0
"""Seconds for which the end of a controller waits for a step."""
_UNUSED = 90 * A_DAY
"""Milliseconds after which the use of a share is forgotten."""
_LOGGED = 24 * 3600.0
"""Seconds between two reports of what would go."""


class RunNeeded(RequestError):
    """A run is not deleted; one line that says why."""

    status = 409


class Retention:
    """Of the jobs of one database and their runs. Any thread may call; all but :meth:`when_due` may wait for the store."""

    def __init__(
        self,
        database: Database,
        access: StoreAccess,
        writing: threading.Lock,
        steady: Callable[[], int],
        default: float | None = None,
    ) -> None:
        """
        Args:
            database: Of the jobs.
            access: To the store of their runs.
            writing: Held while something is submitted.
            steady: Steady time [ms]; of two clocks, the one that is behind decides.
            default: Seconds for which jobs of queues without a rule are kept; None: as :class:`RetentionRules` says. Infinity: without end,
                and nothing goes by itself.
        """
        self._database, self._store, self._users = database, access.store, access.users
        self._beginning, self._writing, self._steady = access.beginning, writing, steady
        self.stored = StoredRuns(access.store, access.peers, access.check)
        self._is_on = default != inf
        self._default = int(default * 1000) if default is not None and self._is_on else None
        self._removing = machine.pool("emptying the trash", _REMOVERS)
        self._next, self._next_report = machine.monotonic() + _FIRST, machine.monotonic()
        self._is_under_way = False
        self._is_closing, self._passing = threading.Event(), threading.Lock()
        self._fixed = dict[Path, OSError]()
        """What the last pass could not move into the trash, and why."""

    # -- passes ---------------------------------------------------------------------------------------------------------

    def start(self, later: Callable[[Callable[[], object]], None]) -> None:
        """Have ``later`` remove what a killed controller has left in the trash."""
        later(self._empty_trash)

    def close(self) -> None:
        """End a pass after its present step, for which this waits some seconds: then the database is another controller's."""
        self._is_closing.set()
        if self._passing.acquire(timeout=_PATIENCE):
            self._passing.release()
        self._removing.close()

    def when_due(self, later: Callable[[Callable[[], object]], None]) -> None:
        """Have ``later`` carry out a pass once in a while; returns at once."""
        if not self._is_under_way and machine.monotonic() > self._next:
            self._is_under_way = True
            later(self._pass)

    def _pass(self) -> None:
        try:
            with self._passing:
                self._take_or_report()
        except (DamagedFile, OSError, Unavailable) as error:
            log.warning("old jobs and runs can't be taken now (%s); trying again later", " ".join(str(error).split()))
        except Exception:
            log.exception("old jobs and runs can't be taken now; trying again later")
        finally:
            self._next = machine.monotonic() + _INTERVAL
            self._is_under_way = False

    def _take_or_report(self) -> None:
        if self._is_closing.is_set():
            return
        self._empty_trash()
        with self._writing, self._database.session() as session:
            # of the longest half-life, a week, less than 0.02 % is left
            session.execute(delete(ShareUsage).where(ShareUsage.as_of < self._steady() - _UNUSED))
        if not self._is_on:
            return
        if self.rules().is_trial(self._moment()):
            self._report()
        else:
            self.take_all()

    def take_all(self) -> PassTotals:
        """Take everything that may go, step by step. Raises Unavailable, OSError."""
        self._fixed.clear()
        totals = self._all(lambda rules, place: self.step(place, rules, take=True))
        if self._fixed:
            count, first = counted(len(self._fixed), "old directory"), next(iter(self._fixed.values()))
            log.warning(
                "%s can't be moved into the store's trash, such as %s (%s)", count, first.filename, first.strerror
            )
        if totals.jobs or totals.runs:
            log.info(
                "retention took %s; %d runs are kept that are old enough, see `muster gc --dry-run`",
                totals,
                totals.kept,
            )
        return totals

    def _report(self) -> None:
        """In the first days after an upgrade: log what would go, if the rules counted already."""
        if machine.monotonic() < self._next_report:
            return
        self._next_report = machine.monotonic() + _LOGGED
        totals = self._all(lambda rules, place: self.step(place, replace(rules, since=0), take=False))
        log.warning(
            "retention has taken nothing yet: in the first %d days after the upgrade it only counts, and %s are old enough. "
            "`muster gc --dry-run` lists them, `muster runs archive RUN` keeps a run, `muster serve --retention off` keeps everything",
            retention.TRIAL_DAYS,
            totals,
        )

    def _all(self, step: Callable[[RetentionRules, Cursor], Step]) -> PassTotals:
        """Step by step with the rules of each moment, and a rest after each."""
        totals, place = PassTotals(), Cursor()
        while not self._is_closing.is_set():
            began = machine.processor_time()
            plans, following = step(self.rules(), place)
            totals.add(plans)
            if following is None:
                break
            place = following
            self._is_closing.wait(_REST * (machine.processor_time() - began))
        return totals

    def _empty_trash(self) -> None:
        try:
            self.stored.check()
            if left := trash.empty(self._store):
                leftovers = counted(len(left), "thing")
                log.warning("%s in the store's trash can't be removed, such as %s; remove by hand", leftovers, left[0])
        except (OSError, Unavailable) as error:
            log.warning("the store's trash can't be emptied now (%s)", error)

    # -- one step -------------------------------------------------------------------------------------------------------

    def rules(self) -> RetentionRules:
        """The rules as they are now."""
        with self._database.session() as session:
            start = session.get(RetentionStart, 1)
            tags = {queue.name: queue.tags.get(retention.TAG) for queue in session.scalars(select(JobQueue))}
        queues = {name: _age_of(tag) for name, tag in tags.items() if tag is not None}
        others = [name for name, tag in tags.items() if tag is None]
        return RetentionRules(queues, others, self._default, start.since if start else 0, batch=self._is_on)

    def step(
        self,
        after: Cursor,
        rules: RetentionRules,
        *,
        take: bool,
        by: Requester = CONTROLLER,
        most: int = A_STEP,
    ) -> Step:
        """Look at the next jobs that are old enough, and take what may go.

        Args:
            after: Where the step before ended.
            rules: As :meth:`rules` answers, or changed.
            take: Take it; else only plan.
            by: Who requests it.
            most: Number of jobs.

        Returns:
            What went, or would go, and what is kept; where the next step begins, None after the last one.

        Raises:
            Unavailable, OSError: The store or the database can't be used.
        """
        moment = self._moment()
        with self._database.session() as session:
            query = select(Job.id, Job.run, Job.stopped_at).where(rows.due(rules, moment))
            query = query.where(behind((Job.stopped_at, Job.id), (after.at, after.id), (False, True)))
            if by.queues is not None:
                query = query.where(Job.owner == by.name, Job.queue.in_(by.queues))
            # of equal times an array behind its children
            found = session.execute(query.order_by(Job.stopped_at, Job.id.desc()).limit(most)).all()
        plans = self._plans({row.run for row in found if NAME.fullmatch(row.run)}, rules, moment, by)
        going = [plan.run for plan in plans if plan.decision.jobs]
        described = {plan.run: plan.described() for plan in plans if not take or plan.decision.reasons}
        if take and going:
            taken = self._take(going)
            try:
                again = self._plans(taken, rules, moment, by)
                described |= {plan.run: plan.described() for plan in again}
                gone, stay = self._carry_out(again)
                for run, why in stay.items():
                    described[run] |= {"whole": False, "kept": [why]}
                for each in (described[run] for run in taken):
                    each["jobs"] = [job for job in each["jobs"] if job in gone]
                    if not each["jobs"]:
                        each |= {"whole": False, "bytes": 0, "files": 0}
            finally:
                for run in taken:
                    self._users.let_go(run)
        shown = [each for each in described.values() if each["jobs"] or each["kept"]]
        return shown, Cursor(found[-1].stopped_at, found[-1].id) if len(found) == most else None

    def _take(self, runs: Sequence[str]) -> list[str]:
        """Those of the runs that nobody uses; from now on nobody does."""
        with self._writing:
            return [run for run in runs if run not in self._beginning and self._users.take(run)]

    def _plans(self, runs: Collection[str], rules: RetentionRules, moment: int, by: Requester) -> list[RetentionPlan]:
        """What may go of these runs and their jobs. Raises Unavailable, OSError."""
        if not runs:
            return []
        stored = self.stored.references(_FRESH)
        facts = self.stored.facts(runs)
        with self._database.session() as session:  # after the store: what was submitted meanwhile counts
            jobs = self._jobs(session, runs, rules, moment, by)
            needed = References.of(rows.references(session, runs)) | stored
        needed = needed if by.queues is None else needed.unnamed()
        return [self._plan(run, facts[run], jobs[run], needed) for run in sorted(runs)]

    def _jobs(
        self, session: Session, runs: Collection[str], rules: RetentionRules, moment: int, by: Requester
    ) -> dict[str, list[JobFacts]]:
        """The jobs of the runs; those of others, and all of a run that is another's, never go."""
        jobs = rows.jobs_of_runs(session, runs, rules, moment)
        if by.queues is None:
            return jobs
        owners = session.execute(select(Job.id, Job.owner, Job.queue).where(Job.run.in_(runs)))
        own = {job for job, owner, queue in owners if by.owns(owner, queue)}
        records = session.scalars(select(RunRecord).where(RunRecord.name.in_(runs)))
        others = {record.name for record in records if not by.owns(record.owner, record.queue)}
        return {
            run: [each if each.id in own and run not in others else replace(each, is_due=False) for each in of_run]
            for run, of_run in jobs.items()
        }

    def _plan(self, name: str, facts: RunFacts | None, jobs: Sequence[JobFacts], needed: References) -> RetentionPlan:
        decision, run = decide(facts, jobs, needed), self._store.run(name)
        if decision.run:
            return RetentionPlan(name, decision, facts, (run.path,))
        return RetentionPlan(
            name, decision, facts, tuple(path for job in decision.jobs for path in contents.job_directories(run, job))
        )

    def _carry_out(self, plans: Sequence[RetentionPlan]) -> tuple[Collection[str], Mapping[str, str]]:
        """Move into the trash what goes, delete the rows, and empty the trash.

        Returns the jobs that went, and why something of a run stays, by run. Raises Unavailable, OSError.
        """
        unchanged, stay, gone = list[RetentionPlan](), dict[str, str](), set[str]()
        self.stored.check()
        thrown, fixed = trash.discard(self._store, self._directories(plans, unchanged, stay))
        self.stored.check()
        self._fixed |= fixed
        going = list[str]()
        for plan in unchanged:
            held = [path for path in plan.directories if path in fixed]
            if held:
                stay[plan.run] = _unmoved(fixed[held[0]])
            if not (held and plan.decision.run):
                going += set(plan.decision.jobs) - {path.name for path in held}
        if self._is_closing.is_set():
            return gone, stay  # the next controller deletes the rows
        going.sort(key=lambda job: ":" not in job)  # an array behind its children
        runs = [plan.run for plan in unchanged if plan.run not in stay and (plan.decision.run or plan.facts is None)]
        for start in range(0, len(going), A_TRANSACTION):
            with self._writing, self._database.session() as session:
                gone |= rows.forget_jobs(session, going[start : start + A_TRANSACTION])
                if start + A_TRANSACTION >= len(going):
                    rows.forget_owners(session, runs)
        self._remove(thrown)
        return gone, stay

    def _directories(
        self, plans: Sequence[RetentionPlan], unchanged: list[RetentionPlan], stay: dict[str, str]
    ) -> Iterator[Path]:
        """The directories that go. Each run is read again right before: since it was looked at, another controller may have begun an
        attempt of it, which no lock of this one keeps out.
        """
        for plan in plans:
            if not plan.decision.jobs:
                continue
            if self.stored.is_unchanged(plan.run, plan.facts):
                unchanged.append(plan)
                yield from plan.directories
            else:
                stay[plan.run] = "it has just changed"

    def _remove(self, thrown: Sequence[Path]) -> None:
        """Remove what was thrown away, several at once: each waits for the file system's journal."""
        wait([self._removing.submit(partial(trash.remove, path)) for path in thrown])

    # -- one run, as a person requests --------------------------------------------------------------------------------------

    def _needs(self, name: str, by: Requester) -> tuple[RunFacts | None, list[str]]:
        """A run as the store has it, and why it may not be deleted, in words for who asks. Raises Unavailable, OSError."""
        stored, facts = self.stored.references(0.0), self.stored.facts([name])[name]
        rules, moment = self.rules(), self._moment()
        with self._database.session() as session:
            jobs = rows.jobs_of_runs(session, [name], rules, moment)[name]
            needed = References.of(rows.references(session, [name])) | stored
        needed = needed if by.queues is None else needed.unnamed()
        return facts, [] if facts is None else still_needed(facts, jobs, needed)

    def open_job(self, name: str) -> str | None:
        """A job that has not ended, of the run or one that uses it."""
        with self._database.session() as session:
            using = select(RunUse.job_id).where(RunUse.run == name)
            query = select(Job.id).where(or_(Job.run == name, Job.id.in_(using)), Job.status.not_in(TERMINAL))
            return session.scalars(query.limit(1)).first()

    def delete(self, name: str, by: Requester = CONTROLLER) -> dict[str, Any]:
        """Delete a run with all that it holds, for who asks; its jobs stay in the history.

        Returns:
            Its size, in ``bytes`` and ``files``; ``left``: where in the trash the rest is that can't be removed, else None.

        Raises:
            RunNeeded: Something needs it, a request uses it, or it can't be moved.
            Unavailable, OSError: The store or the database can't be used.
        """
        with self.alone(name):
            facts, reasons = self._needs(name, by)
            if reasons:
                raise RunNeeded(f"run {name} is kept: {'; '.join(reasons)}")
            path = self._store.run(name).path
            size, files = (0, 0) if facts is None else trash.size_of(path)
            if not self.stored.is_unchanged(name, facts):
                raise RunNeeded(f"run {name} has just changed, and nothing of it is deleted; try again in a moment")
            thrown, fixed = trash.discard(self._store, [path])
            if path in fixed:
                raise RunNeeded(f"run {name} is kept: {_unmoved(fixed[path])}")
            with self._writing, self._database.session() as session:
                if (record := session.get(RunRecord, name)) is not None:
                    session.delete(record)
        self._remove(thrown)
        left = next((str(each) for each in thrown if each.exists()), None)
        return {"run": name, "bytes": size, "files": files, "left": left}

    @contextmanager
    def alone(self, name: str) -> Iterator[None]:
        """A block in which no other request uses the run and no job starts that writes it. Raises RunNeeded if a request uses it."""
        if not self._take([name]):
            raise RunNeeded(f"run {name} is used by another request now; try again in a moment")
        try:
            yield
        finally:
            self._users.let_go(name)

    def _moment(self) -> int:
        return min(now(), self._steady())


def _unmoved(error: OSError) -> str:
    return f"it can't be moved into the store's trash ({error.strerror}: {error.filename})"


def _age_of(tag: str) -> int | None:
    try:
        return retention.rule_of(tag)
    except ValueError:  # an older Muster took any text
        return None
