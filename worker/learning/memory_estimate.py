"""The estimate of memory: whether the worlds fit. Measured on a few worlds, because solver and torch buffer sizes cannot be computed in advance."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import re
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil
import torch

from worker.learning.algorithm import Algorithm, WorldShare
from worker.learning.distributed import Gang
from worker.learning.host_copies import HostCopies
from worker.learning.setup import build_algorithm, build_task, load_kernels, transition
from worker.settings.errors import UserError, is_out_of_memory

if TYPE_CHECKING:
    from worker.settings.task import TaskConfig
    from worker.tasks.run.task import Task

Learner = tuple[type[Algorithm], Any]
"""An algorithm, and its settings."""
FEW, MORE = 64, 2048
"""Numbers of worlds in the measured builds, after one that loads kernels and libraries; the memory that both have in common is not
the worlds' (networks, a batch of fixed size)."""
CHECKED = {"cpu": 4 * MORE, "cuda": 64 * MORE}
"""Number of worlds from which memory is checked beforehand: on CPU the OOM killer strikes without a message; on GPU a too large build
fails only after minutes."""
SPARE = 0.9
"""Usable share of the free memory: graphs and kernels take some more."""


@contextmanager
def within_memory(
    task_type: type[Task],
    config: TaskConfig,
    learner: Learner,
    worlds: int,
    gang: Gang,
    starting: Callable[[], bool] = lambda: True,
) -> Iterator[None]:
    """In this context, too little memory for the worlds is the user's error, which says how many would fit.

    Args:
        task_type: The task, with its ``config``.
        learner: The algorithm, and its settings.
        worlds: The greatest number on any rank; the same value on all ranks.
        gang: The ranks, with their devices.
        starting: Whether an out-of-memory error now is due to the worlds; otherwise it passes.
    """
    free = free_bytes(gang)
    if worlds >= CHECKED[gang.device.partition(":")[0]]:
        need = measure(task_type, config, learner, gang)
        if need.of(worlds) > SPARE * free:
            raise UserError(_explain(task_type, worlds, gang, free, need))
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if not starting() or not is_out_of_memory(error):
            raise
        traceback.clear_frames(error.__traceback__)  # free the partial build
        try:
            need = measure(task_type, config, learner, gang)
        except Exception:  # on a full device, or during a capture: the first error counts
            need = Need(0.0, 0.0)
        raise UserError(_explain(task_type, worlds, gang, free, need)) from error


def free_bytes(gang: Gang) -> int:
    """Memory that this rank can still take: of its GPU, or its share of the host's memory (or of its control group's)."""
    if gang.device != "cpu":
        free: int = torch.cuda.mem_get_info(gang.device)[0]
        return free
    free = psutil.virtual_memory().available
    group = Path("/sys/fs/cgroup")
    with contextlib.suppress(OSError, ValueError):  # no control groups of version 2, or no limit
        limit = int((group / "memory.max").read_text())
        used = int((group / "memory.current").read_text())
        found = re.search(r"^inactive_file (\d+)$", (group / "memory.stat").read_text(), re.MULTILINE)
        free = min(free, limit - used + (int(found[1]) if found else 0))  # pages of files can be reclaimed
    return max(free, 0) // gang.placement.local_world_size


@dataclass(frozen=True)
class Need:
    """Memory need of a rank [bytes]."""

    fixed: float
    """Independent of the worlds: networks, optimizer, an update with a batch of fixed size."""
    world: float
    """Of each world, with its part of rollout, replay and update."""

    def of(self, worlds: int) -> float:
        """Total for this number of worlds [bytes]."""
        return self.fixed + worlds * self.world


def measure(task_type: type[Task], config: TaskConfig, learner: Learner, gang: Gang) -> Need:
    """Measure the memory of this task's worlds with this algorithm. Takes some seconds; every rank calls it."""
    load_kernels(learner[0], gang)
    _taken(task_type, config, learner, MORE, gang)  # first, because what torch sets up once is not the worlds'
    few, more = (_taken(task_type, config, learner, worlds, gang) for worlds in (FEW, MORE))
    world = max(more - few, 0) / (MORE - FEW)
    return Need(max(few - FEW * world, 0.0), world)


def _taken(task_type: type[Task], config: TaskConfig, learner: Learner, worlds: int, gang: Gang) -> int:
    """Peak memory [bytes] of building ``worlds``, learning once from an iteration without steps, and saving."""
    alone = Gang(gang.placement, gang.device, None, ["here"])
    alone.size, alone.rank = 1, 0
    gc.collect()
    before = _start_measuring(gang.device)
    share = WorldShare(0, worlds, worlds)
    task = build_task(task_type, config, share, gang, 0)
    algorithm = build_algorithm(*learner, task, share, alone, 0, rehearsal=True)
    step = transition(task)
    algorithm.begin(0)
    for _ in range(algorithm.steps):
        algorithm.act(step.observations)
        algorithm.record(step)
    algorithm.learn(step.observations)
    copies = HostCopies()  # which a save makes
    copied = copies.take((task.state_tensors(), dict(algorithm.world_state()), algorithm.state_dict()))
    taken = _most(gang.device) - before
    del task, algorithm, step, copies, copied
    gc.collect()
    return max(taken, 0)


def _start_measuring(device: str) -> int:
    """Reset the peak; returns the current use [bytes]."""
    if device == "cpu":
        with contextlib.suppress(AttributeError):
            ctypes.CDLL(None).malloc_trim(0)  # glibc keeps freed memory, and would build from it
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")  # resets VmHWM
        return _status("VmRSS")
    torch.cuda.synchronize(device)
    torch.cuda.empty_cache()
    return _most(device)


def _most(device: str) -> int:
    if device == "cpu":
        return _status("VmHWM")
    torch.cuda.synchronize(device)  # torch's cache still holds what the minibatch took
    free, total = torch.cuda.mem_get_info(device)
    return total - free


def _status(name: str) -> int:
    found = re.search(rf"^{name}:\s+(\d+) kB$", Path("/proc/self/status").read_text(), re.MULTILINE)
    return int(found[1]) * 1024 if found else 0


def _explain(task_type: type[Task], worlds: int, gang: Gang, free: int, need: Need) -> str:
    """The error in one line; ``need`` is 0 if it could not be measured."""
    where = "memory" if gang.device == "cpu" else f"memory of {gang.device}"
    start = f"worlds: {worlds:,} worlds of {task_type.__name__} on rank {gang.placement.rank} need more {where} than"
    if need.of(worlds) <= SPARE * free:  # other processes took the memory that was free at the start
        return f"{start} there is; set fewer `worlds`, or free some"
    room = SPARE * free - need.fixed
    short = f"{start} the {_gb(free)} that are free: about {_gb(need.of(worlds))}"
    if room < need.world:
        return f"{short}. Not even one fits: set smaller networks or batches"
    return f"{short}. About {int(room / need.world):,} fit: set `worlds`"


def _gb(size: float) -> str:
    return f"{size / 1e9:.1f} GB"
