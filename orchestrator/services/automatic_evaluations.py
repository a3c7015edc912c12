"""Automatic evaluations: jobs that the controller submits beside a training whose spec has a section ``evaluation``.

The progress through a training's checkpoints is a row of the database (:class:`orchestrator.persistence.own_models.AutomaticEvaluation`), which changes in
the transaction that adds the job: a controller that is killed at any moment neither loses nor doubles an evaluation. A training never
waits for one, and the reconcile loop neither: this has threads for itself.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator import machine
from orchestrator.control.controller import Controller
from orchestrator.control.run_store import ObservedRun, facts_of
from orchestrator.domain.errors import ClientError, SpecError, Unavailable
from orchestrator.domain.job import Status
from orchestrator.engines.toolkit.backoff import Backoff
from orchestrator.persistence.batch_models import Job
from orchestrator.persistence.own_models import AutomaticEvaluation
from orchestrator.persistence.ownership import is_of_earlier_run
from orchestrator.services.context import Context, Known
from orchestrator.services.permissions import CONTROLLER, Actor
from orchestrator.services.spec_submission import commit_submission, inherited, submit
from orchestrator.spec.evaluations import (
    AUTOMATIC_TAG,
    Counted,
    automatic_evaluation,
    due,
    evaluation_settings,
    first_count,
    place_of,
)
from orchestrator.spec.sections import Evaluation
from shared_store.contract.plugins import PluginError
from shared_store.volume.checkpoints import Checkpoint, DamagedCheckpoint, list_checkpoints
from shared_store.volume.evaluations import keep_for_evaluation, pending_checkpoints, release_from_evaluation
from shared_store.volume.layout import Run

LOOK = 2.0
"""Seconds between two polls of the checkpoints of running trainings: a listing of a directory each."""
_THREADS = 4
"""Number of polls at the same time; each may hang on the directory of its run."""
_PATIENCE = 20.0
"""Seconds for which a poll is waited for: then the next one begins."""

log = logging.getLogger("muster.evaluations")


@dataclass(frozen=True)
class _Training:
    """The part that does not change while a job trains."""

    job: str
    run: Run
    owner: str
    first_epoch: int
    spec: Mapping[str, Any]
    queue: str
    directory: str
    evaluation: Evaluation


class AutomaticEvaluations:
    """The thread that sees new checkpoints and submits their evaluations."""

    def __init__(
        self, controller: Controller, actor_named: Callable[[str], Actor | None], interval: float = LOOK
    ) -> None:
        """
        Args:
            actor_named: The actor of that name with the rights that it has now; None where its key is gone.
            interval: Seconds between two polls.
        """
        self._controller, self._actor_named, self._interval = controller, actor_named, interval
        self._known: dict[str, _Training | None] = {}
        """By job, of those that run; None of one without a section ``evaluation``."""
        self._backoff = Backoff(log)
        self._pool = machine.pool("looks at checkpoints", _THREADS)
        self._under_way: dict[str, Future[None]] = {}
        """The last poll of each subject."""
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._loop, name="evaluations", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Stop polling; submitted evaluations continue."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join(timeout=10)
        self._pool.close()

    def _loop(self) -> None:
        self._on_store("unclaimed checkpoints", self._let_go)
        while not self._ending.wait(self._interval):
            if self._controller.trouble is None and self._controller.access.problem() is None:
                self.poll()

    def poll(self) -> None:
        """One poll of the evaluations that are open and at all trainings that run; one that can't be handled does not stop the others."""
        self._backoff.tidy()
        self._isolated("open evaluations", self._close_ended)
        active = self._controller.work_queue.active()
        self._known = {job: self._known[job] for job in active if job in self._known}
        for job in active:
            self._on_store(f"job {job}", partial(self._check, job))

    def _on_store(self, subject: str, body: Callable[[], None]) -> None:
        """Carry out ``body``, which may hang; while it does, the subject is passed over, so that nothing is done twice."""

        def wait() -> None:
            self._under_way = {each: call for each, call in self._under_way.items() if not call.done()}
            if subject not in self._under_way:
                call = self._under_way[subject] = self._pool.submit(body)
                try:
                    machine.result(call, _PATIENCE)
                except TimeoutError:
                    raise OSError(f"the store has not answered for {_PATIENCE:.0f} s") from None

        self._isolated(subject, wait)

    def _isolated(self, subject: str, body: Callable[[], None]) -> None:
        if self._backoff.waits(subject):
            return
        try:
            body()
            self._backoff.worked(subject)
        except Unavailable:
            pass  # which the controller reports
        except (OSError, ValueError, DamagedCheckpoint, PluginError) as error:
            self._backoff.failed(subject, f"automatic evaluations, {subject}: {' '.join(str(error).split())}")
        except Exception as error:
            self._backoff.failed(subject, f"automatic evaluations, {subject}: {type(error).__name__}", error)

    # -- what was submitted ---------------------------------------------------------------------------------------------

    def _let_go(self) -> None:
        """Give up the claims of a controller that was killed before it submitted their evaluations."""
        with self._controller.database.session() as session:
            rows = session.scalars(select(AutomaticEvaluation).where(AutomaticEvaluation.open.is_(False))).all()
            names = [row.run for row in rows]
        for name in names:
            run = self._controller.access.store.run(name)
            for checkpoint in pending_checkpoints(run):
                release_from_evaluation(run, checkpoint)

    def _close_ended(self) -> None:
        """Give up the claim on checkpoints whose evaluation has ended, well or not."""
        with self._controller.database.session() as session:
            rows = session.scalars(select(AutomaticEvaluation).where(AutomaticEvaluation.open)).all()
            ended = [(row.run, row.checkpoint or "") for row in rows if not _is_open(session, row)]
        for name, checkpoint in ended:
            self._on_store(f"run {name}", partial(self._close, name, checkpoint))

    def _close(self, name: str, checkpoint: str) -> None:
        release_from_evaluation(self._controller.access.store.run(name), checkpoint)
        with self._controller.writes.session() as session:
            row = session.get_one(AutomaticEvaluation, name)
            row.open = False
            job = session.get(Job, row.job)
        if job is not None and job.status == Status.FAILED:
            log.warning("run %s: the evaluation of checkpoint %s failed: %s", name, checkpoint, job.status_reason)

    # -- what is due ----------------------------------------------------------------------------------------------------

    def _check(self, job_id: str) -> None:
        training = self._training(job_id)
        if training is None:
            return
        run, iterations = training.run, int(training.spec["train"]["iterations"])
        checkpoints = [each for each in list_checkpoints(run) if each.is_scheduled]
        with self._controller.database.session() as session:
            job, row = session.get(Job, job_id), session.get(AutomaticEvaluation, run.name)
            if job is None or job.is_terminal or job.stop_reason is not None:
                return
            busy = row is not None and row.open
            before = _counted(row, training, checkpoints)
        counted, chosen = due(checkpoints, before, training.evaluation.every, iterations, busy)
        if chosen is not None and self._claimed(run, chosen):
            self._submit(training, counted, chosen)
        elif chosen is None and (row is None or row.training != job_id or counted != before):
            self._note(training, counted)

    def _training(self, job_id: str) -> _Training | None:
        if job_id not in self._known:
            with self._controller.database.session() as session:
                job = session.get(Job, job_id)
                if job is None or job.first_epoch is None:
                    return None
                self._known[job_id] = self._read(job)
        return self._known[job_id]

    def _read(self, job: Job) -> _Training | None:
        gang = job.gang
        try:
            evaluation = evaluation_settings(gang.spec)
        except SpecError as error:  # it was checked when it was submitted
            raise ValueError(str(error)) from None
        if evaluation is None or job.first_epoch is None:
            return None
        owner, directory = job.owner or CONTROLLER.name, gang.options.directory
        run = self._controller.access.store.run(job.run)
        return _Training(job.id, run, owner, job.first_epoch, gang.spec or {}, job.queue, directory, evaluation)

    @staticmethod
    def _claimed(run: Run, chosen: Checkpoint) -> bool:
        """Keep the checkpoint from retention; False if that was faster. Raises DamagedCheckpoint, OSError."""
        if run.description() is None:  # deleted
            return False
        keep_for_evaluation(run, chosen.name)
        return chosen.path.is_dir() and bool(chosen.manifest)

    def _note(self, training: _Training, counted: Counted, problem: str | None = None) -> None:
        found = facts_of(training.run)
        with self._controller.writes.session() as session:
            row = _row(session, training, counted, found)
            row.problem = problem or row.problem  # it stands until an evaluation is submitted

    def _submit(self, training: _Training, counted: Counted, chosen: Checkpoint) -> None:
        """Submit the evaluation, as the training's owner, in one transaction with the progress through the training's checkpoints."""
        controller, run = self._controller, training.run
        try:
            actor = self._actor_named(training.owner)
            if actor is None:
                raise ClientError(f"{training.owner}, which submitted the training, has no access any more")
            place = place_of(
                training.queue, evaluation_settings(inherited(actor, training.spec)) or training.evaluation
            )
            spec = automatic_evaluation(run.name, training.spec, place, training.evaluation, chosen.iteration)
            tags, found = {AUTOMATIC_TAG: f"{run.name}@{chosen.iteration}"}, facts_of(run)

            def call(known: Known) -> Job:
                with controller.writes.session() as session:
                    context = Context(session, controller, actor, known=known)
                    job = submit(context, spec, training.directory, f"evaluation of run {run.name}", tags=tags)
                    row = _row(session, training, counted, found)
                    row.checkpoint, row.job, row.open, row.problem = chosen.name, job.id, True, None
                    return job

            job = commit_submission(controller, call)
        except ClientError as error:
            # a queue that takes no jobs, say: the next checkpoint that is due is tried
            release_from_evaluation(run, chosen.name)
            self._note(training, counted, f"checkpoint {chosen.name} was not evaluated: {error}")
            self._backoff.failed(
                ("evaluations of", run.name), f"run {run.name}: checkpoints are not evaluated: {error}"
            )
            return
        self._backoff.worked(("evaluations of", run.name))
        passed = f"; {counted.passed} that were due have been passed over so far" if counted.passed else ""
        log.info("job %s evaluates %s@%d%s", job.id[:8], run.name, chosen.iteration, passed)


def _is_open(session: Session, row: AutomaticEvaluation) -> bool:
    job = session.get(Job, row.job)
    return job is not None and not job.is_terminal


def _counted(row: AutomaticEvaluation | None, training: _Training, checkpoints: list[Checkpoint]) -> Counted:
    if row is None or row.training != training.job:
        return first_count(checkpoints, training.first_epoch)
    return Counted(row.seen, row.waiting, row.passed)


def _row(session: Session, training: _Training, counted: Counted, found: ObservedRun) -> AutomaticEvaluation:
    row = session.get(AutomaticEvaluation, training.run.name)
    if row is None:
        row = AutomaticEvaluation(run=training.run.name)
        session.add(row)
    elif (before := session.get(Job, row.training)) is not None and is_of_earlier_run(before, found):
        row.checkpoint, row.job, row.open, row.problem = None, None, False, None
    row.training, row.seen, row.waiting, row.passed = training.job, counted.seen, counted.waiting, counted.passed
    return row
