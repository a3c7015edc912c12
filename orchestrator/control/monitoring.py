"""Monitoring of a controller by Prometheus: counters since it began, and values at the moment of a scrape.

Names and units are Prometheus's: base units, ``_total`` for what only grows. Counters begin at 0 with each controller, as Prometheus
expects. Nothing here looks into the store or waits for an engine: a volume that hangs keeps no scrape waiting.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
from prometheus_client.registry import Collector
from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator.control.snapshot import open_attempts
from orchestrator.control.store_calls import THREADS
from orchestrator.control.usage import held_by
from orchestrator.domain.hosts import engine_of
from orchestrator.domain.job import Status
from orchestrator.persistence.models import Attempt, Job, JobQueue
from orchestrator.persistence.session import DatabaseError
from shared_store import __version__

if TYPE_CHECKING:
    from orchestrator.control.reconciler import Reconciler

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_WAITS = (0.1, 0.5, 1, 5, 15, 60, 300, 900, 3600, 4 * 3600, 24 * 3600)
_PASSES = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1, 3, 10)
_TRAININGS = 500
"""The most trainings that have series of their own."""
_USED = ("queue", "engine")
_Sums = defaultdict[tuple[str, ...], float]


class Monitoring:
    """Counters of one controller; its threads write them."""

    def __init__(self) -> None:
        self.registry = registry = CollectorRegistry()
        self._waits = Histogram(
            "muster_queue_wait_seconds",
            "From the submission of a job to its first attempt.",
            ["queue"],
            buckets=_WAITS,
            registry=registry,
        )
        self._passes = Histogram(
            "muster_scheduling_pass_seconds", "Length of a scheduling pass.", buckets=_PASSES, registry=registry
        )
        self._loop = Histogram(
            "muster_loop_seconds", "Length of a pass of the controller's loop.", buckets=_PASSES, registry=registry
        )
        self._restarts = Counter(
            "muster_restarts", "Attempts that were begun after a job's first one.", _USED, registry=registry
        )
        self._attempts = Counter(
            "muster_attempts_ended", "Attempts that ended, by how.", [*_USED, "ending"], registry=registry
        )
        self._webhooks = Counter(
            "muster_webhook_tries",
            "Tries to deliver a message about a job's end, by what came of it.",
            ["webhook", "result"],
            registry=registry,
        )
        self._seconds = {
            unit: Counter(
                f"muster_{unit}_seconds",
                f"{name} held by attempts that ended, times seconds.",
                _USED,
                registry=registry,
            )
            for unit, name in (("gpu", "GPUs"), ("cpu", "CPUs"))
        }
        self._lost = {
            unit: Counter(
                f"muster_{unit}_seconds_lost",
                f"Those of muster_{unit}_seconds_total after the last checkpoint of an attempt that did not end well.",
                _USED,
                registry=registry,
            )
            for unit in ("gpu", "cpu")
        }

    def forget_queue(self, queue: str) -> None:
        """A queue was deleted: its series end, lest they grow with every queue that ever was."""
        of_queues = [self._waits, self._restarts, self._attempts, *self._seconds.values(), *self._lost.values()]
        for metric in of_queues:
            samples = [sample.labels for family in metric.collect() for sample in family.samples]
            known = [{name: value for name, value in labels.items() if name != "le"} for labels in samples]
            for values in {tuple(labels.values()) for labels in known if labels["queue"] == queue}:
                metric.remove(*values)

    def pass_took(self, seconds: float) -> None:
        """A scheduling pass was made."""
        self._passes.observe(seconds)

    def loop_took(self, seconds: float) -> None:
        """The loop has made a pass."""
        self._loop.observe(seconds)

    def webhook_tried(self, webhook: str, result: str) -> None:
        """A message was ``delivered``, has ``failed`` and is tried again, or was ``given up``."""
        self._webhooks.labels(webhook, result).inc()

    def begun(self, job: Job, attempt: Attempt, waited: float) -> Callable[[], None]:
        """To be called once it is committed that an attempt begins, ``waited`` seconds after its job could."""

        def note() -> None:
            if number == 1:
                self._waits.labels(queue).observe(max(0.0, waited))
            else:
                self._restarts.labels(queue, engine).inc()

        queue, engine, number = job.queue, _engine(attempt), attempt.number
        return note

    def ended(self, job: Job, attempt: Attempt) -> Callable[[], None]:
        """To be called once it is committed that an attempt, whose usage was charged, has ended."""

        def note() -> None:
            self._attempts.labels(*labels, ending).inc()
            for counters, amounts in ((self._seconds, used), (self._lost, lost)):
                for unit, seconds in amounts.items():
                    counters[unit].labels(*labels).inc(max(0.0, seconds))

        labels, ending = (job.queue, _engine(attempt)), str(attempt.ending or "unknown")
        used = {"gpu": attempt.gpu_seconds, "cpu": attempt.cpu_seconds}
        lost = {"gpu": attempt.wasted_gpu_seconds, "cpu": attempt.wasted_cpu_seconds}
        return note


def exposition(reconciler: Reconciler) -> bytes:
    """All of it in Prometheus's text format."""
    now = CollectorRegistry()
    now.register(_Moment(reconciler))
    return generate_latest(reconciler.monitoring.registry) + generate_latest(now)


class _Moment(Collector):
    """The values at the moment of a scrape."""

    def __init__(self, reconciler: Reconciler) -> None:
        self._reconciler = reconciler

    def describe(self) -> Iterable[GaugeMetricFamily]:
        return ()

    def collect(self) -> Iterator[GaugeMetricFamily | InfoMetricFamily | CounterMetricFamily]:
        reconciler = self._reconciler
        yield InfoMetricFamily("muster", "Version of the controller.", value={"version": __version__})
        age = "Seconds since the controller's loop made its last progress; /healthz fails above 5."
        yield _gauge("muster_loop_age_seconds", age, [], {(): reconciler.heartbeat.age})
        try:
            with reconciler.database.session() as session:
                found = [*self._jobs(session), *self._attempts(session)]
            usable = reconciler.trouble is None
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
        gangs = self._reconciler.database.counts.gangs()
        counts |= {kind: float(gangs[kind]) for kind in gangs.keys() & counts.keys()}  # a queue may be deleted
        yield _gauge("muster_jobs", "Jobs by state, as long as their history is kept.", ["queue", "status"], counts)
        moment, since = self._reconciler.clock.now(), dict[tuple[str, ...], int]()
        for each in self._reconciler.work_queue.waiting():
            since[each.queue,] = min(each.created_at, since.get((each.queue,), moment))
        waits = {queue: (moment - oldest) / 1000 for queue, oldest in since.items()}
        oldest = "How long the job that has waited longest for room has waited."
        yield _gauge("muster_queue_longest_wait_seconds", oldest, ["queue"], waits)

    def _attempts(self, session: Session) -> Iterator[GaugeMetricFamily]:
        held = {"gpus": _Sums(float), "cpus": _Sums(float)}
        series: dict[str, dict[tuple[str, ...], float]] = {"steps_per_second": {}, "iteration": {}}
        trainings = 0
        for job, attempt in open_attempts(session, self._reconciler.work_queue.active()):
            labels = (job.queue, _engine(attempt))
            given = held_by(attempt)
            held["gpus"][labels] += given.gpus
            held["cpus"][labels] += given.cpus
            try:
                main = job.gang.main
            except Exception:  # a damaged row, whose trouble is found, and said, by the look at the job
                continue
            progress = self._reconciler.bus.progress(job.id, attempt.number, main) or {}
            found = {name: value for name in series if isinstance(value := progress.get(name), int | float)}
            trainings += bool(found)
            if trainings <= _TRAININGS:
                for name, value in found.items():
                    series[name][*labels, job.id, job.name, job.run] = float(value)
        for unit, amounts in held.items():
            yield _gauge(
                f"muster_{unit}_in_use", f"{unit[:-1].upper()}s that running attempts hold.", [*_USED], amounts
            )
        of_job = [*_USED, "job", "name", "run"]
        steps = "Environment steps a second of a running training, all worlds together."
        yield _gauge("muster_training_steps_per_second", steps, of_job, series["steps_per_second"])
        done = "Iterations that a running training has done."
        yield _gauge("muster_training_iteration", done, of_job, series["iteration"])
        others = f"Running trainings that have no series of their own: at most {_TRAININGS} have."
        yield _gauge("muster_trainings_left_out", others, [], {(): float(max(0, trainings - _TRAININGS))})

    def _volumes(self) -> GaugeMetricFamily:
        disk = self._reconciler.disk
        short = {(name,): float(disk.shortage(name) is not None) for name in disk.names}
        said = "1 while a volume has too little room or does not answer, so that no gang starts, else 0."
        return _gauge("muster_volume_short", said, ["volume"], short)

    def _store(self) -> Iterator[GaugeMetricFamily | CounterMetricFamily]:
        calls = self._reconciler.calls
        states = {("busy",): float(min(calls.open, THREADS)), ("waiting",): float(max(0, calls.open - THREADS))}
        yield _gauge("muster_store_calls", "Requests that use the store, by state.", ["state"], states)
        refused = "Requests that were refused since the store did not answer."
        yield CounterMetricFamily("muster_store_calls_refused", refused, calls.refused)

    def _hosts(self) -> Iterator[GaugeMetricFamily]:
        hosts, gpus, cpus = _Sums(float), _Sums(float), _Sums(float)
        for name, capacity in self._reconciler.engine.capacity().items():
            for host in [host for host in capacity.places if not host.away]:
                if not host.queue:
                    hosts[(name,)] += 1
                gpus[(name,)] += len(host.gpus)
                cpus[(name,)] += host.cpus
        for name, amounts in (("hosts", hosts), ("gpus", gpus), ("cpus", cpus)):
            what = f"{name if name == 'hosts' else name[:-1].upper() + 's'} of an engine, as it told them last."
            yield _gauge(f"muster_{name}", what, ["engine"], amounts)


def _engine(attempt: Attempt) -> str:
    return engine_of(attempt.nodes[0].host)


def _gauge(name: str, text: str, labels: list[str], values: Mapping[Any, float]) -> GaugeMetricFamily:
    family = GaugeMetricFamily(name, text, labels=labels)
    for each, value in sorted(values.items()):
        family.add_metric(each, value)
    return family
