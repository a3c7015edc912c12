"""Monitoring: a controller's counters for Prometheus, and the heartbeat of its loop, which any thread reads without waiting.

Names and units are Prometheus's: base units, ``_total`` for what only grows. Counters begin at 0 with each controller, as Prometheus
expects.
"""

from __future__ import annotations

from collections.abc import Callable

from prometheus_client import CollectorRegistry, Counter, Histogram

from orchestrator import machine
from orchestrator.domain.hosts import engine_of
from orchestrator.persistence.batch_models import Attempt, Job

LATE = 5.0
"""Seconds without progress after which the loop counts as stuck."""
_WAITS = (0.1, 0.5, 1, 5, 15, 60, 300, 900, 3600, 4 * 3600, 24 * 3600)
_PASSES = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1, 3, 10)
USED = ("queue", "engine")


class Monitoring:
    """Counters of one controller; its threads write them."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        waits, passes = "From the submission of a job to its first attempt.", "Length of a scheduling pass."
        self._waits = Histogram("muster_queue_wait_seconds", waits, ["queue"], buckets=_WAITS, registry=self.registry)
        self.passes = Histogram("muster_scheduling_pass_seconds", passes, buckets=_PASSES, registry=self.registry)
        loop = "Length of a pass of the controller's loop."
        self.loop = Histogram("muster_loop_seconds", loop, buckets=_PASSES, registry=self.registry)
        self._restarts = self._counter("restarts", "Attempts that were begun after a job's first one.", *USED)
        self._attempts = self._counter("attempts_ended", "Attempts that ended, by how.", *USED, "ending")
        tries = "Tries to deliver a message about a job's end, by what came of it."
        self._webhooks = self._counter("webhook_tries", tries, "webhook", "result")
        self._seconds, self._lost = dict[str, Counter](), dict[str, Counter]()
        for unit in ("gpu", "cpu"):
            held = f"{unit.upper()}s held by attempts that ended, times seconds."
            lost = (
                f"Those of muster_{unit}_seconds_total after the last checkpoint of an attempt that did not end well."
            )
            self._seconds[unit] = self._counter(f"{unit}_seconds", held, *USED)
            self._lost[unit] = self._counter(f"{unit}_seconds_lost", lost, *USED)
        self._progressed: float | None = None

    def _counter(self, name: str, text: str, *labels: str) -> Counter:
        return Counter(f"muster_{name}", text, labels, registry=self.registry)

    def beat(self) -> None:
        """The loop has made progress."""
        self._progressed = machine.monotonic()

    @property
    def loop_age(self) -> float:
        """Seconds since the loop's last progress; 0 before it begins."""
        return 0.0 if self._progressed is None else max(0.0, machine.monotonic() - self._progressed)

    def loop_problem(self) -> str | None:
        """Why the loop counts as stuck; None while it makes progress."""
        if (age := self.loop_age) <= LATE:
            return None
        return f"the controller's loop has made no progress for {age:.0f} s; if that lasts, restart the controller"

    def forget_queue(self, queue: str) -> None:
        """A queue was deleted: its series end, lest they grow with every queue that ever was."""
        for metric in (self._waits, self._restarts, self._attempts, *self._seconds.values(), *self._lost.values()):
            metric.remove_by_labels({"queue": queue})

    def webhook_tried(self, webhook: str, result: str) -> None:
        """A message was ``delivered``, has ``failed`` and is tried again, or was ``given up``."""
        self._webhooks.labels(webhook, result).inc()

    def started(self, job: Job, attempt: Attempt, waited: float) -> Callable[[], None]:
        """To be called once it is committed that an attempt begins, ``waited`` seconds after its job could."""
        if attempt.number > 1:
            return self._restarts.labels(job.queue, engine_named(attempt)).inc
        queue = job.queue
        return lambda: self._waits.labels(queue).observe(max(0.0, waited))

    def ended(self, job: Job, attempt: Attempt) -> Callable[[], None]:
        """To be called once it is committed that an attempt, whose usage was charged, has ended."""

        def note() -> None:
            self._attempts.labels(*labels, ending).inc()
            for counter, seconds in amounts:
                counter.labels(*labels).inc(max(0.0, seconds))

        labels, ending = (job.queue, engine_named(attempt)), str(attempt.ending or "unknown")
        amounts = (
            (self._seconds["gpu"], attempt.gpu_seconds),
            (self._seconds["cpu"], attempt.cpu_seconds),
            (self._lost["gpu"], attempt.wasted_gpu_seconds),
            (self._lost["cpu"], attempt.wasted_cpu_seconds),
        )
        return note


def engine_named(attempt: Attempt) -> str:
    """Name of the engine of an attempt."""
    return engine_of(attempt.nodes[0].host)
