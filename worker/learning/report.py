"""What a run tells people and programs: a line an iteration, the metrics file, TensorBoard events."""

from __future__ import annotations

import math
import time
from typing import Any

import torch

from shared_store.metrics import MetricsWriter, scalars
from worker.learning.job import Job


class Stopwatch:
    """Times iterations by the clock, and their parts: on CUDA with events, so that nothing waits."""

    def __init__(self, device: str) -> None:
        self._cuda = device.startswith("cuda")
        self._marks: list[Any] = []
        self._read_at = time.perf_counter()
        self.iteration = self.collect = self.learn = 0.0
        """Seconds of the iteration that was read last, by the clock, and of its two parts."""

    def begin(self) -> None:
        """The first iteration begins now."""
        self._read_at = time.perf_counter()

    def start(self) -> None:
        """The first part begins now."""
        self._marks = []
        self.mark()

    def read(self) -> None:
        """The iteration is over, and the device was waited for."""
        now = time.perf_counter()
        self.iteration, self._read_at = now - self._read_at, now
        self.collect, self.learn = self.parts()

    def mark(self) -> None:
        """The end of one part and the start of the next."""
        if not self._cuda:
            self._marks.append(time.perf_counter())
            return
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        self._marks.append(event)

    def parts(self) -> list[float]:
        """Duration of each part [s]."""
        pairs = list(zip(self._marks, self._marks[1:], strict=False))
        if not self._cuda:
            return [after - before for before, after in pairs]
        return [before.elapsed_time(after) / 1000.0 for before, after in pairs]


class Report:
    """Writes the records of one attempt. Main rank only. A volume that refuses a record costs the record, not the run."""

    def __init__(self, job: Job, iterations: int, resumed_from: int) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._iterations = iterations
        self._warned = False
        self._metrics = MetricsWriter(job.run, job.epoch, resumed_from)
        self._events = SummaryWriter(
            str(job.run.metrics), purge_step=resumed_from + 1, filename_suffix=f".e{job.epoch}", flush_secs=10
        )

    def iteration(self, record: dict[str, float | int | None]) -> None:
        """Print and store one iteration's ``record``."""
        width = len(str(self._iterations))
        mishaps = "".join(
            f"  {name} {record[name]:.0f}" for name in ("nan_worlds", "solver_overflows") if record.get(name)
        )
        print(
            f"iteration {record['iteration']:>{width}}/{self._iterations}  reward {_text(record['reward'], '.2f')}  "
            f"length {_text(record['episode_length'], '.1f')}  steps/s {record['steps_per_second']:.0f}  "
            f"{_learnt(record)}{mishaps}{_slow(record)}",
            flush=True,
        )
        finite = {key: value if value is None or math.isfinite(value) else None for key, value in record.items()}
        try:
            self._metrics.write({**finite, "time": time.time()})
            for name, value in scalars(finite).items():
                self._events.add_scalar(name, value, record["iteration"])
        except OSError as error:
            if not self._warned:
                print(f"warning: metrics can't be written ({error}); training goes on without them", flush=True)
            self._warned = True

    def close(self) -> None:
        """Flush everything."""
        try:
            self._metrics.close()
            self._events.close()
        except OSError as error:
            print(f"warning: metrics can't be written ({error})", flush=True)


def _learnt(record: dict[str, float | int | None]) -> str:
    """The figures of learning that tell most at a glance, those of them that the algorithm has."""
    shown = {
        "learning_rate": ("lr", ".1e"),
        "kl": ("kl", ".3f"),
        "temperature": ("temperature", ".1e"),
        "q_mean": ("q", ".2f"),
    }
    return "  ".join(f"{word} {_text(record[name], form)}" for name, (word, form) in shown.items() if name in record)


def _slow(record: dict[str, float | int | None]) -> str:
    """The rank for which the others wait, where that costs a tenth of the time, and a time that a person would notice."""
    excess = record.get("slowest_excess") or 0.0
    is_slow = excess > _SLOW and excess * (record["collect_seconds"] or 0.0) > _NOTICED
    return f"  slow: rank {record['slowest_rank']} (+{100 * excess:.0f} %)" if is_slow else ""


_SLOW = 0.1
_NOTICED = 0.1
"""Seconds of an iteration."""


def _text(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
