"""A run's reports: a log line per iteration, the metrics file, TensorBoard events, failures of a user's functions."""

from __future__ import annotations

import math
import statistics
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import torch

from shared_store.contract.error_text import counted
from shared_store.volume.learning_metrics import in_log
from shared_store.volume.metrics import MetricsWriter, sampled, scalars, warnings_of
from worker.learning.hooks import Hook
from worker.learning.watch import HISTORY, Watch

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

    from worker.learning.loop import Loop
    from worker.learning.training import Training
    from worker.tasks.run.task_report import TaskReport


class Stopwatch:
    """Times iterations by the clock, and their parts: on CUDA with events, so that nothing waits."""

    def __init__(self, device: str) -> None:
        self._cuda = device.startswith("cuda")
        self._marks: list[Any] = []
        self._read_at = time.perf_counter()
        self.iteration = self.collect = self.learn = 0.0
        """Wall-clock seconds of the last iteration that was read, and of its two parts."""

    def begin(self) -> None:
        """The first iteration begins now."""
        self._read_at = time.perf_counter()

    @property
    def running(self) -> float:
        """Seconds since the last iteration that was read."""
        return time.perf_counter() - self._read_at

    def start(self) -> None:
        """The first part begins now."""
        self._marks = []
        self.mark()

    def read(self) -> None:
        """The iteration is over, and the device was waited for."""
        now = time.perf_counter()
        self.iteration, self._read_at = now - self._read_at, now
        self.collect, self.learn = (
            before.elapsed_time(after) / 1000.0 if self._cuda else after - before
            for before, after in pairwise(self._marks)
        )

    def mark(self) -> None:
        """The end of one part and the start of the next."""
        if not self._cuda:
            self._marks.append(time.perf_counter())
            return
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        self._marks.append(event)


class Reporting(Hook):
    """Reports the iterations of a training: to its log, metrics and supervisor. Writes nothing once a newer attempt owns the run."""

    def __init__(self, loop: Loop) -> None:
        self._loop = loop
        self._report: Report | None = None
        self._has_reported_graphs = False

    def begin(self, loop: Loop) -> None:
        if loop.gang.is_main:
            self._report = Report(loop.training, loop.state.progress.iteration, loop.gang.device)

    def iteration(self, record: dict[str, Any]) -> None:
        """Raises StaleEpoch if a newer attempt owns the run."""
        loop = self._loop
        loop.fence.check()
        if self._report:
            loop.reporter.do(loop.fence.guard, self._report.iteration, record)
        captured = [part for part in loop.graphs if part.captured]
        is_settled = all(part.captured or not part.can_be_captured for part in loop.graphs)
        if captured and is_settled and not self._has_reported_graphs:
            self._has_reported_graphs = True
            parts = ", ".join(f"{part.name} ({part.seconds:.1f} s to record)" for part in captured)
            loop.say(f"captured as CUDA graphs: {parts}")
        loop.beacon.send(iteration=record["iteration"], steps_per_second=record["steps_per_second"])

    def close(self) -> None:
        if self._report:
            self._loop.reporter.do(self._report.close)
        self._loop.reporter.close()
        self._loop.fence.close()


LONG_HOURS = 6.0
"""Estimated duration of a training without a GPU above which a warning is logged."""
WARMED = 2
"""The first iteration of an attempt whose rate is reported: the very first one also loads kernels."""
_SLOW, _NOTICED = 0.1, 0.1
"""A rank is reported as slow if waiting for it costs this share of the time, and this time of an iteration [s]."""
_MOST_RANKS = 32
"""Greatest number of ranks whose figures a record lists one by one."""
_MOST_FAILURES = 10
"""Lines about failures at once."""


class Report:
    """Writes the records of one attempt. Main rank only. A volume that refuses a record gets it later; it does not end the run.

    Args:
        training: The training.
        resumed_from: The last finished iteration.
        device: Its device, ``"cpu"`` or ``"cuda:<n>"``.
    """

    def __init__(self, training: Training, resumed_from: int, device: str) -> None:
        job, self._iterations = training.job, training.iterations
        self._task, self._run = str(job.section.get("task")), job.run
        self._rated_at = resumed_from + WARMED if device == "cpu" else 0
        self._metrics = MetricsWriter(job.run, job.epoch, resumed_from)
        self._watch = Watch(self._iterations, getattr(training, "settings", None))
        with suppress(OSError):  # without them it begins anew
            for record in sampled(job.run, HISTORY) if resumed_from else []:
                if record["iteration"] <= resumed_from:
                    self._watch.warnings(record)
        self._has_failed, self._warned_of = False, set[str]()
        threading.excepthook = partial(_thread_failed, threading.excepthook)
        self._epoch = job.epoch
        self._events: SummaryWriter | None = None

    def iteration(self, record: dict[str, Any]) -> None:
        """Print and store one iteration's ``record``."""
        width = len(str(self._iterations))
        shown = "".join(f"{name} {text}  " for name, text in record.get("shown", {}).items())
        notes = "".join(
            f"  {name} {record[name]:.0f}" for name in ("nan_worlds", "solver_overflows") if record.get(name)
        )
        excess = record.get("slowest_excess") or 0.0
        if excess > _SLOW and excess * (record["collect_seconds"] or 0.0) > _NOTICED:
            notes += f"  slow: rank {record['slowest_rank']} (+{100 * excess:.0f} %)"
        print(
            f"iteration {record['iteration']:>{width}}/{self._iterations}  reward {_text(record['reward'], '.2f')}  "
            f"length {_text(record['episode_length'], '.1f')}  {shown}steps/s {record['steps_per_second']:.0f}  "
            f"{in_log(record)}{notes}",
            flush=True,
        )
        if record["iteration"] == self._rated_at and (warning := self._long(record)):
            print(warning, flush=True)
        finite = {
            key: value if not isinstance(value, float) or math.isfinite(value) else None
            for key, value in record.items()
        }
        if warnings := self._watch.warnings(finite):
            finite["warnings"] = warnings
        for text in warnings_of(finite, self._run.name):
            kind = text.partition(":")[0]
            if (
                kind not in self._warned_of
            ):  # each kind once: some come and go, and their numbers change in every iteration
                self._warned_of.add(kind)
                print(f"warning: {text}", flush=True)
        failures = list[OSError]()
        for write in (self._write_record, self._write_events):
            try:
                write(finite)
            except OSError as error:
                failures.append(error)
                if self._events is None:
                    break  # on a full volume each iteration would begin another, empty file
        if failures and not self._has_failed:
            print(f"warning: metrics can't be written ({failures[0]}); training continues and retries", flush=True)
        self._has_failed = bool(failures)

    def _write_record(self, record: Mapping[str, Any]) -> None:
        self._metrics.write({**record, "time": time.time()})

    def _write_events(self, record: Mapping[str, Any]) -> None:
        if self._events is None:
            from torch.utils.tensorboard import SummaryWriter  # it takes a while, which no iteration waits for here

            self._run.metrics.stat()  # it would be made where another volume is
            self._events = SummaryWriter(
                str(self._run.metrics),
                purge_step=record["iteration"],
                filename_suffix=f".e{self._epoch}",
                flush_secs=10,
            )
        try:
            for name, value in scalars(record).items():
                self._events.add_scalar(name, value, record["iteration"])
        except OSError:
            self._events = None  # the writer's thread has ended: the next record opens another file
            raise

    def _long(self, record: dict[str, float | int | None]) -> str:
        """A warning about a training that takes very long without a GPU; empty for others."""
        left = self._iterations - int(record["iteration"] or 0)
        hours = left * float(record["iteration_seconds"] or 0.0) / 3600.0
        if hours <= LONG_HOURS:
            return ""
        takes = f"{hours / 24.0:.1f} days" if hours >= 48.0 else f"{hours:.0f} hours"
        return (
            f"no GPU: {self._task} trains at about {record['steps_per_second']:.0f} steps/s on these processors, so that the other "
            f"{left:,} iterations take about {takes}; --set train.worlds=16 --set train.iterations=20 tries it"
        )

    def close(self) -> None:
        """Flush everything."""
        try:
            self._metrics.close()
            if self._events is not None:
                self._events.close()
        except OSError as error:
            print(f"warning: metrics can't be written ({error})", flush=True)


def figures_of(
    totals: Mapping[str, float], episodes: float, steps: float, final: Sequence[str]
) -> dict[str, float | None]:
    """A task's statistics for a record: reward terms and ``final`` metrics as means over the finished episodes, other metrics as means
    over their steps, counts as they are. None if no episode has finished.
    """
    by = {
        name: episodes if name.startswith("reward_") or name in final else steps
        for name in totals
        if name.startswith(("reward_", "metric_"))
    }
    return {name: total if name not in by else total / by[name] if by[name] else None for name, total in totals.items()}


def shown_of(figures: Mapping[str, float | None], metrics: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """The part of a record for people who follow the training: ``metrics`` with their units, as text; empty without any."""
    if not metrics:
        return {}
    return {
        "shown": {
            name.removeprefix("metric_"): f"{_text(figures[name], '.1f')} {unit}".strip()
            for name, unit in metrics.items()
        }
    }


def _text(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def straggler(seconds: list[float]) -> dict[str, Any]:
    """The rank with the longest rollout in the previous iteration, and its excess over the median: all others wait for it.

    Args:
        seconds: By rank; empty figures for a gang of one. They are part of the figures of at most 32 ranks.
    """
    if len(seconds) == 1:
        return {}
    slowest = max(range(len(seconds)), key=seconds.__getitem__)
    usual = statistics.median(seconds)
    figures = {"slowest_rank": slowest, "slowest_excess": seconds[slowest] / usual - 1.0 if usual > 0 else 0.0}
    by_rank = [float(f"{each:.4g}") for each in seconds]
    return {**figures, **({"rank_collect_seconds": by_rank} if len(seconds) <= _MOST_RANKS else {})}


def _thread_failed(hook: Callable[[threading.ExceptHookArgs], object], failure: threading.ExceptHookArgs) -> None:
    """TensorBoard raises a failure of its thread again where the next event is added: its traceback says nothing more."""
    if not type(failure.thread).__module__.startswith("tensorboard."):
        hook(failure)


class Failures:
    """Reports each failure of a user's functions, such as a learner's reward, once, and all of them at the end. Every rank reports its own.

    Args:
        task: The task with the functions.
        say: Writes a line to the log.
    """

    def __init__(self, task: TaskReport, say: Callable[[str], None]) -> None:
        self._task, self._say = task, say
        self._reported: set[str] = set()

    def report(self, *, again: bool = False) -> None:
        """Report new failures, or all of them if ``again``; waits for the device."""
        found = [item for item in self._task.failures().items() if again or item[0] not in self._reported]
        for text, (count, world) in found[:_MOST_FAILURES]:
            self._reported.add(text)
            self._say(f"warning: {text} ({counted(count, 'call')} so far, first in world {world})")
