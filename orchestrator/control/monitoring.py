"""Monitoring: a controller's counters for Prometheus, since it began.

Names and units are Prometheus's: base units, ``_total`` for what only grows. Counters begin at 0 with each controller, as Prometheus
expects.
"""

from __future__ import annotations

from collections.abc import Callable

from prometheus_client import CollectorRegistry, Counter, Histogram

from orchestrator.domain.hosts import engine_of
from orchestrator.persistence.batch_models import Attempt, Job

_WAITS = (0.1, 0.5, 1, 5, 15, 60, 300, 900, 3600, 4 * 3600, 24 * 3600)
_PASSES = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1, 3, 10)
USED = ("queue", "engine")


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
            "muster_restarts", "Attempts that were begun after a job's first one.", USED, registry=registry
        )
        self._attempts = Counter(
            "muster_attempts_ended", "Attempts that ended, by how.", [*USED, "ending"], registry=registry
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
                USED,
                registry=registry,
            )
            for unit, name in (("gpu", "GPUs"), ("cpu", "CPUs"))
        }
        self._lost = {
            unit: Counter(
                f"muster_{unit}_seconds_lost",
                f"Those of muster_{unit}_seconds_total after the last checkpoint of an attempt that did not end well.",
                USED,
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

        queue, engine, number = job.queue, engine_named(attempt), attempt.number
        return note

    def ended(self, job: Job, attempt: Attempt) -> Callable[[], None]:
        """To be called once it is committed that an attempt, whose usage was charged, has ended."""

        def note() -> None:
            self._attempts.labels(*labels, ending).inc()
            for counters, amounts in ((self._seconds, used), (self._lost, lost)):
                for unit, seconds in amounts.items():
                    counters[unit].labels(*labels).inc(max(0.0, seconds))

        labels, ending = (job.queue, engine_named(attempt)), str(attempt.ending or "unknown")
        used = {"gpu": attempt.gpu_seconds, "cpu": attempt.cpu_seconds}
        lost = {"gpu": attempt.wasted_gpu_seconds, "cpu": attempt.wasted_cpu_seconds}
        return note


def engine_named(attempt: Attempt) -> str:
    return engine_of(attempt.nodes[0].host)
