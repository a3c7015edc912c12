"""The exposition of a controller's metrics for Prometheus: its counters, and values at the moment of a scrape.

Nothing here looks into the store or waits for an engine: a volume that hangs keeps no scrape waiting.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import Any

from prometheus_client import CollectorRegistry, Metric, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator.control.controller import Controller
from orchestrator.control.monitoring import USED, engine_named
from orchestrator.control.snapshot import open_attempts
from orchestrator.control.store_calls import THREADS
from orchestrator.control.usage import held_by
from orchestrator.domain.job import Status
from orchestrator.persistence.batch_models import JobQueue
from orchestrator.persistence.session import DatabaseError
from shared_store import __version__

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_TRAININGS = 500
"""The most trainings that have series of their own."""
_Sums = defaultdict[tuple[str, ...], float]


def exposition(controller: Controller) -> bytes:
    """All of it in Prometheus's text format."""
    return generate_latest(controller.monitoring.registry) + generate_latest(_Moment(controller))


class _Moment(CollectorRegistry):
    """The values at the moment of a scrape."""

    def __init__(self, controller: Controller) -> None:
        super().__init__()
        self._controller = controller

    def collect(self) -> Iterator[Metric]:
        controller = self._controller
        yield InfoMetricFamily("muster", "Version of the controller.", value={"version": __version__})
        age = "Seconds since the controller's loop made its last progress; /healthz fails above 5."
        yield _gauge("muster_loop_age_seconds", age, [], {(): controller.monitoring.loop_age})
        try:
            with controller.database.session() as session:
                found = [*self._jobs(session), *self._attempts(session)]
            usable = controller.trouble is None
        except DatabaseError:  # then the scrape says this, and what needs no database
            found, usable = [], False
        yield _gauge("muster_database_usable", "1 while the database can be used, else 0.", [], {(): float(usable)})
        yield from found
        yield self._volumes()
        yield from self._store()
        yield from self._hosts()

    def _jobs(self, session: Session) -> Iterator[GaugeMetricFamily]:
        counts: dict[tuple[str, ...], float] = {
            (queue, status): 0.0 for queue in session.scalars(select(JobQueue.name)) for status in Status
        }
        gangs = self._controller.database.counts.gangs()
        counts |= {kind: float(gangs[kind]) for kind in gangs.keys() & counts.keys()}  # a queue may be deleted
        yield _gauge("muster_jobs", "Jobs by state, as long as their history is kept.", ["queue", "status"], counts)
        moment, since = self._controller.clock.now(), dict[tuple[str, ...], int]()
        for each in self._controller.work_queue.waiting():
            since[each.queue,] = min(each.created_at, since.get((each.queue,), moment))
        waits = {queue: (moment - oldest) / 1000 for queue, oldest in since.items()}
        oldest = "How long the job that has waited longest for room has waited."
        yield _gauge("muster_queue_longest_wait_seconds", oldest, ["queue"], waits)

    def _attempts(self, session: Session) -> Iterator[GaugeMetricFamily]:
        held = {"gpus": _Sums(float), "cpus": _Sums(float)}
        series: dict[str, dict[tuple[str, ...], float]] = {"steps_per_second": {}, "iteration": {}}
        trainings = 0
        for job, attempt in open_attempts(session, self._controller.work_queue.active()):
            labels = (job.queue, engine_named(attempt))
            resources = held_by(attempt)
            held["gpus"][labels] += resources.gpus
            held["cpus"][labels] += resources.cpus
            try:
                main = job.gang.main
            except Exception:  # a damaged row, which is reported when the job is settled
                continue
            progress = self._controller.bus.progress(job.id, attempt.number, main) or {}
            found = {name: value for name in series if isinstance(value := progress.get(name), int | float)}
            trainings += bool(found)
            if trainings <= _TRAININGS:
                for name, value in found.items():
                    series[name][*labels, job.id, job.name, job.run] = float(value)
        for unit, amounts in held.items():
            yield _gauge(f"muster_{unit}_in_use", f"{unit[:-1].upper()}s that running attempts hold.", [*USED], amounts)
        of_job = [*USED, "job", "name", "run"]
        steps = "Environment steps a second of a running training, all worlds together."
        yield _gauge("muster_training_steps_per_second", steps, of_job, series["steps_per_second"])
        done = "Iterations that a running training has done."
        yield _gauge("muster_training_iteration", done, of_job, series["iteration"])
        others = f"Running trainings that have no series of their own: at most {_TRAININGS} have."
        yield _gauge("muster_trainings_left_out", others, [], {(): float(max(0, trainings - _TRAININGS))})

    def _volumes(self) -> GaugeMetricFamily:
        disk = self._controller.access.disk
        short = {(name,): float(disk.shortage(name) is not None) for name in disk.names}
        text = "1 while a volume has too little room or does not answer, so that no gang starts, else 0."
        return _gauge("muster_volume_short", text, ["volume"], short)

    def _store(self) -> Iterator[Metric]:
        calls = self._controller.access.calls
        states = {("busy",): float(min(calls.open, THREADS)), ("waiting",): float(max(0, calls.open - THREADS))}
        yield _gauge("muster_store_calls", "Requests that use the store, by state.", ["state"], states)
        refused = "Requests that were refused since the store did not answer."
        yield CounterMetricFamily("muster_store_calls_refused", refused, calls.refused)

    def _hosts(self) -> Iterator[GaugeMetricFamily]:
        hosts, gpus, cpus = _Sums(float), _Sums(float), _Sums(float)
        for name, capacity in self._controller.engines.capacity().items():
            for host in [host for host in capacity.places if not host.unavailable]:
                if not host.queue:
                    hosts[(name,)] += 1
                gpus[(name,)] += len(host.gpus)
                cpus[(name,)] += host.cpus
        for name, amounts in (("hosts", hosts), ("gpus", gpus), ("cpus", cpus)):
            what = f"{name if name == 'hosts' else name[:-1].upper() + 's'} of an engine, as last reported."
            yield _gauge(f"muster_{name}", what, ["engine"], amounts)


def _gauge(name: str, text: str, labels: list[str], values: Mapping[Any, float]) -> GaugeMetricFamily:
    family = GaugeMetricFamily(name, text, labels=labels)
    for each, value in sorted(values.items()):
        family.add_metric(each, value)
    return family
