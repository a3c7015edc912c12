"""The reconcile loop: database × scheduler × engine.

Everything that must survive a crash is in the database before it is done: an attempt is recorded before its gang is launched,
its ending before the gang is stopped. A controller that starts on the database of a dead one goes on from there.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator.bus import Bus
from orchestrator.database import Attempt, Database, Job, now
from orchestrator.definition import GangNeeds, gang_needs
from orchestrator.engines.base import Engine, EngineError, Gang, GangStatus, Placement
from orchestrator.jobs import Ending, NodeEnd, Status, Verdict, judge
from orchestrator.scheduler import Start, Waiting, decide
from shared_store import __version__
from shared_store.checkpoints import list_checkpoints
from shared_store.epoch import StaleEpoch, raise_epoch, read_epoch
from shared_store.layout import Run, Store, StoreError
from shared_store.outcomes import read_outcome

GRACE = 30.0
"""Seconds from SIGTERM to SIGKILL, as on AWS Batch."""
_FAILED_GRACE = 5.0
"""The same for a gang whose collectives are broken: there is nothing left to save."""
LOST = 20.0
"""Seconds without a node's token on the bus, while the engine says that it runs, after which the gang is started again."""
_FINISHING = 10.0
"""Seconds that children of a native job get to end by themselves after the main node is done."""
_SHORTEST_REQUEUE = 10_000
"""An attempt that leaves with 75 sooner than this [ms] counts as spent, so that a program that always does can't spin."""

log = logging.getLogger("muster.controller")


class Controller:
    """Drives every job of a database to its end on one engine."""

    def __init__(self, database: Database, engine: Engine, store: Store, bus: Bus, interval: float = 0.2) -> None:
        """``interval``: seconds between two looks at the engine."""
        self.database, self.engine, self.store, self.bus, self.interval = database, engine, store, bus, interval
        bus.changed = self.wake
        self._wake = threading.Event()
        self._ending = threading.Event()
        self._stops: dict[tuple[str, int], Future[None]] = {}
        self.writing = threading.Lock()
        """Held by whoever registers or submits: what is checked must still hold when it is written."""
        self._troubles: dict[str, str] = {}
        self._finished: dict[tuple[str, int], float] = {}
        self._stoppers = ThreadPoolExecutor(max_workers=16, thread_name_prefix="stop")
        self._thread = threading.Thread(target=self._loop, name="controller", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def wake(self) -> None:
        """Something changed: look now instead of at the next interval."""
        self._wake.set()

    def close(self) -> None:
        """Leave the loop; running gangs go on, and the next controller on this database finds them."""
        self._ending.set()
        self._wake.set()
        self._thread.join()
        self._stoppers.shutdown(wait=False, cancel_futures=True)

    def _loop(self) -> None:
        while not self._ending.is_set():
            try:
                self.tick()
            except Exception:
                log.exception("reconciling failed; trying again")
            self._wake.wait(self.interval)
            self._wake.clear()

    def tick(self) -> None:
        """One pass over every job that is not over; a job that can't be handled now does not hold up the others."""
        with self.database.session() as session:
            ids = [job.id for job in _unfinished(session)]
        for job_id in ids:
            try:
                with self.database.session() as session:
                    self._reconcile(session, session.get_one(Job, job_id))
                self._troubles.pop(job_id, None)
            except OSError as error:
                if self._troubles.get(job_id) != str(error):  # said once, not at every look
                    log.error("job %s: the store can't be read (%s); trying again", job_id, error)
                self._troubles[job_id] = str(error)
            except Exception:
                log.exception("job %s: reconciling failed; trying again", job_id)
        with self.database.session() as session:
            self._admit(session, _unfinished(session))

    def _reconcile(self, session: Session, job: Job) -> None:
        if job.status == Status.SUBMITTED:
            job.move(Status.RUNNABLE, "waiting for the scheduler")
        if attempt := job.open_attempt:
            self._advance(session, job, attempt)
        elif job.stop_reason is not None:
            self._finish(job, Status.FAILED, job.stop_reason)

    # -- admission ----------------------------------------------------------------------------------------------------

    def _admit(self, session: Session, jobs: Sequence[Job]) -> None:
        waiting = [
            Waiting(job.id, job.name, gang_needs(job.node_properties)) for job in jobs if job.status == Status.RUNNABLE
        ]
        if not waiting:
            return
        running = [(job.name, _placements(attempt)) for job in jobs if (attempt := job.open_attempt)]
        by_id = {job.id: job for job in jobs}
        for decision in decide(waiting, self.engine.capacity(), running):
            job = by_id[decision.job]
            if isinstance(decision, Start):
                self._begin(session, job, decision.placements)
            else:
                job.status_reason = decision.reason

    def _begin(self, session: Session, job: Job, placements: tuple[Placement, ...]) -> None:
        """Record a new attempt, then launch it: a crash in between is mended by the next pass, which finds no handle."""
        run = self.store.run(job.run)
        try:
            # The database and the store each remember; whichever is ahead (a restored database, a moved store) counts.
            known = [attempt.epoch for attempt in session.scalars(select(Attempt).join(Job).where(Job.run == job.run))]
            epoch = max([read_epoch(run), *known]) + 1
            if job.first_epoch is not None and run.description() is None:
                raise StoreError("it was deleted from the store while the job ran")
            self._describe(run, job)
            raise_epoch(run, epoch)
        except OSError as error:  # a volume that is full or away may come back
            job.status_reason = f"store {self.store.path}: can't prepare run {job.run} now ({error}); trying again"
            return
        except (StoreError, StaleEpoch, ValueError) as error:
            self._finish(job, Status.FAILED, f"store {self.store.path}: can't prepare run {job.run}: {error}")
            return
        if job.first_epoch is None:
            job.first_epoch = epoch
        nodes = [
            {"index": i, "host": p.host, "gpus": list(p.gpus), "cpus": p.cpus, "memory": p.memory}
            for i, p in enumerate(placements)
        ]
        attempt = Attempt(job_id=job.id, number=len(job.attempts) + 1, epoch=epoch, nodes=nodes, created_at=now())
        job.attempts.append(attempt)
        job.move(Status.STARTING, f"starting {_size(job, len(nodes))}")
        session.commit()
        self._launch(session, job, attempt)

    def _describe(self, run: Run, job: Job) -> None:
        needs = gang_needs(job.node_properties)
        run.create(
            {
                "run": run.name,
                "job": job.id,
                "created": now(),
                "version": __version__,
                "spec": needs.spec,
                "name": job.name,
            }
        )

    def _launch(self, session: Session, job: Job, attempt: Attempt) -> None:
        needs = gang_needs(job.node_properties)
        try:
            attempt.handle = self.engine.launch(self.engine.plan(self._gang(job, attempt, needs)))
        except (EngineError, OSError, ValueError) as error:  # ValueError: a zero byte in a variable or an argument
            self._close(job, attempt, Verdict(Ending.FATAL, f"can't start the gang: {error}"), [])
        session.commit()

    def _gang(self, job: Job, attempt: Attempt, needs: GangNeeds) -> Gang:
        nodes = needs.nodes[: len(attempt.nodes)]
        return Gang(
            job=job.id,
            attempt=attempt.number,
            epoch=attempt.epoch,
            job_epoch=job.first_epoch or attempt.epoch,
            run=job.run,
            store=str(self.store.path),
            queue=job.queue,
            main=needs.main,
            commands=[node.command for node in nodes],
            environments=[node.environment for node in nodes],
            placements=_placements(attempt),
            grace=GRACE,
            directory=needs.setting("MUSTER_DIRECTORY") or None,
            stall_timeout=float(stall) if (stall := needs.setting("MUSTER_STALL_TIMEOUT")) else None,
            bus=self.bus.endpoint,
            bus_token=self.bus.token,
        )

    # -- running attempts ---------------------------------------------------------------------------------------------

    def _advance(self, session: Session, job: Job, attempt: Attempt) -> None:
        if attempt.handle is None:
            self._launch(session, job, attempt)
            return
        status = self.engine.observe(attempt.handle)
        ends = self._ends(job, attempt, status)
        main = gang_needs(job.node_properties).main
        if job.status == Status.STARTING and (status[main].running or ends[main]):
            job.started_at = attempt.started_at = now()
            job.move(Status.RUNNING, f"attempt {attempt.number} runs on {_size(job, len(status))}")
        if attempt.ending is None and (verdict := self._verdict(job, attempt, ends, main)):
            attempt.ending, attempt.status_reason, attempt.exit_code = verdict.ending, verdict.reason, verdict.exit_code
            session.commit()
        if attempt.ending is not None and not self._finishing(job, attempt, status) and self._stopped(job, attempt):
            ends = self._ends(job, attempt, self.engine.observe(attempt.handle))
            self._close(
                job, attempt, Verdict(Ending(attempt.ending), attempt.status_reason or "", attempt.exit_code), ends
            )

    def _finishing(self, job: Job, attempt: Attempt, status: GangStatus) -> bool:
        """Whether the children of a native job whose main node is done are still given time to end by themselves.

        On AWS the main node's end cuts them off; a rank that prints its last line or closes a file deserves better.
        """
        if attempt.ending != Ending.SUCCEEDED or gang_needs(job.node_properties).on_child_failure == "ignore":
            return False
        since = self._finished.setdefault((job.id, attempt.number), time.monotonic())
        return any(node.running for node in status) and time.monotonic() - since < _FINISHING

    def _verdict(self, job: Job, attempt: Attempt, ends: list[NodeEnd | None], main: int) -> Verdict | None:
        verdict = judge(gang_needs(job.node_properties).on_child_failure, main, ends)
        if verdict:
            return verdict
        if job.stop_reason is not None:
            return Verdict(Ending.STOPPED, job.stop_reason)
        for index, end in enumerate(ends):
            silence = self.bus.silence(job.id, attempt.number, index, bool(attempt.nodes[index].get("met")))
            if end is None and silence is not None and silence > LOST:
                reason = f"node {index} gives no sign of life for {silence:.0f} s: frozen, or cut off"
                return Verdict(Ending.FAILED, reason)
        if job.timeout and attempt.started_at and now() - attempt.started_at > job.timeout * 1000:
            return Verdict(Ending.TIMEOUT, "Job attempt duration exceeded timeout")
        return None

    def _ends(self, job: Job, attempt: Attempt, status: GangStatus) -> list[NodeEnd | None]:
        """How each node ended: by the outcome in the store, else by what the engine saw; noted in the attempt's record."""
        run = self.store.run(job.run)
        ends: list[NodeEnd | None] = []
        records = []
        for record, node in zip(attempt.nodes, status, strict=True):
            end = None
            if not node.running:
                outcome = read_outcome(run, job.id, attempt.number, record["index"])
                if outcome:
                    message = outcome.error.message if outcome.error else None
                    end = NodeEnd(
                        outcome.exit_code,
                        outcome.reason,
                        outcome.error.time if outcome.error else outcome.ended,
                        message,
                    )
                else:
                    code = 137 if node.exit_code in (None, 0) else node.exit_code
                    end = NodeEnd(code or 137, node.detail or "the supervisor died without an outcome", now() / 1000)
            ends.append(end)
            seen: dict[str, Any] = {"exitCode": end.exit_code, "reason": end.reason, "error": end.error} if end else {}
            if self.bus.met(job.id, attempt.number, record["index"]):
                seen["met"] = True  # the next controller must miss it, too, if it does not come back
            records.append({**record, "address": node.address, **seen})
        if records != attempt.nodes:
            attempt.nodes = records
        return ends

    def _stopped(self, job: Job, attempt: Attempt) -> bool:
        """Stop the gang in the background; True once no process of it is left."""
        key = (job.id, attempt.number)
        if key not in self._stops:
            grace = _FAILED_GRACE if attempt.ending in (Ending.FAILED, Ending.FATAL) else GRACE
            assert attempt.handle is not None
            self._stops[key] = self._stoppers.submit(self.engine.stop, attempt.handle, grace)
            self._stops[key].add_done_callback(lambda _: self.wake())
        if not self._stops[key].done():
            return False
        self._finished.pop(key, None)
        self.bus.forget(*key)
        self._stops.pop(key).result()
        return True

    # -- ends ---------------------------------------------------------------------------------------------------------

    def _close(self, job: Job, attempt: Attempt, verdict: Verdict, ends: list[NodeEnd | None]) -> None:
        """The gang is gone: close its attempt and decide what becomes of the job."""
        ended = now()
        requeued = verdict.ending == Ending.REQUEUE
        attempt.ending, attempt.status_reason, attempt.exit_code = verdict.ending, verdict.reason, verdict.exit_code
        attempt.started_at, attempt.stopped_at = attempt.started_at or ended, ended
        attempt.spent = not (requeued and ended - attempt.started_at >= _SHORTEST_REQUEUE)
        spent = sum(1 for each in job.attempts if each.spent)
        if job.stop_reason is not None and verdict.ending in (Ending.REQUEUE, Ending.STOPPED, Ending.FAILED):
            self._finish(job, Status.FAILED, f"{job.stop_reason}{self._progress(job)}")
        elif verdict.ending == Ending.SUCCEEDED:
            self._finish(job, Status.SUCCEEDED, verdict.reason)
        elif requeued and (not attempt.spent or spent < job.attempts_allowed):
            job.move(Status.RUNNABLE, f"attempt {attempt.number} left on request{self._progress(job)}; starting again")
        elif verdict.ending == Ending.FAILED and spent < job.attempts_allowed:
            job.move(
                Status.RUNNABLE,
                f"attempt {attempt.number} failed ({verdict.reason}){self._progress(job)}; trying again",
            )
        else:
            of = f" (attempt {spent} of {job.attempts_allowed})" if verdict.ending == Ending.FAILED else ""
            self._finish(job, Status.FAILED, f"{verdict.reason}{of}")

    def _progress(self, job: Job) -> str:
        checkpoints = list_checkpoints(self.store.run(job.run))
        return f"; last checkpoint: iteration {checkpoints[-1].iteration}" if checkpoints else ""

    @staticmethod
    def _finish(job: Job, status: Status, reason: str) -> None:
        job.move(status, reason)
        job.stopped_at = now()


def _unfinished(session: Session) -> Sequence[Job]:
    """Jobs that are not over, oldest first."""
    over = [Status.SUCCEEDED, Status.FAILED]
    return session.scalars(select(Job).where(Job.status.not_in(over)).order_by(Job.created_at, Job.id)).all()


def _size(job: Job, nodes: int) -> str:
    """How many nodes an attempt has, and of how many, where there was no room for all."""
    most = int(job.node_properties["numNodes"])
    if nodes < most:
        return f"{nodes} of {most} nodes: there is no room for more"
    return f"{nodes} node{'s' if nodes != 1 else ''}"


def _placements(attempt: Attempt) -> list[Placement]:
    return [Placement(node["host"], tuple(node["gpus"]), node["cpus"], node["memory"]) for node in attempt.nodes]
