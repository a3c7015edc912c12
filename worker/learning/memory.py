"""Whether the worlds fit into memory. What a world needs is measured on a few: the solver's and torch's buffers are theirs alone to know."""

from __future__ import annotations

import gc
import os
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from worker.distributed import Gang
from worker.errors import UserError
from worker.learning.ppo import PPO, Share

if TYPE_CHECKING:
    from worker.tasks.config import TaskConfig
    from worker.tasks.task import Task

FEW, MORE = 64, 2048
"""Worlds of two builds: the first loads kernels and libraries, the second is measured."""
CHECKED = {"cpu": 4 * MORE, "cuda": 64 * MORE}
"""From so many worlds on, memory is looked at beforehand: on the CPU the kernel kills who takes too much, and on a GPU building many
worlds takes long before it fails."""
SPARE = 0.9
"""Share of the free memory that may be taken: graphs and kernels take some more."""


@contextmanager
def within_memory(task_type: type[Task], config: TaskConfig, worlds: int, gang: Gang) -> Iterator[None]:
    """In here, worlds for which the memory does not suffice are the user's error, which says how many would do.

    Args:
        task_type: The task, with its ``config``.
        worlds: Of this rank.
        gang: On whose device they are to be.
    """
    free = free_bytes(gang.device)
    if worlds >= CHECKED[gang.device.partition(":")[0]]:
        size = bytes_per_world(task_type, config, gang)
        if worlds * size > free:
            raise UserError(_explain(task_type, worlds, gang, free, size))
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if not _is_out_of_memory(error):
            raise
        traceback.clear_frames(error.__traceback__)  # what was built so far goes
        try:
            size = bytes_per_world(task_type, config, gang)
        except Exception:  # a device that is in the middle of a recording, for one: the first error is what counts
            size = 0.0
        raise UserError(_explain(task_type, worlds, gang, free, size)) from error


def _is_out_of_memory(error: Exception) -> bool:
    known = isinstance(error, MemoryError | torch.OutOfMemoryError)
    return known or "Failed to allocate" in str(error) or "out of memory" in str(error)


def free_bytes(device: str) -> int:
    """Memory that this process can still take: of the GPU, or of the machine and the control group that it is in."""
    if device != "cpu":
        return torch.cuda.mem_get_info(device)[0]
    fields = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
    free = int(fields["MemAvailable"].split()[0]) * 1024
    try:
        limit = Path("/sys/fs/cgroup/memory.max").read_text().strip()
        if limit != "max":
            free = min(free, int(limit) - int(Path("/sys/fs/cgroup/memory.current").read_text()))
    except OSError:
        pass  # no control groups of version 2
    return max(free, 0)


def bytes_per_world(task_type: type[Task], config: TaskConfig, gang: Gang) -> float:
    """What a world takes with its part of the rollout. Takes some seconds."""
    _taken(task_type, config, FEW, gang)
    return _taken(task_type, config, MORE, gang) / MORE


def _taken(task_type: type[Task], config: TaskConfig, worlds: int, gang: Gang) -> int:
    """Memory that a build of ``worlds`` takes."""
    alone = Gang(gang.placement, gang.device, None, ["here"])
    alone.size, alone.rank = 1, 0
    before = _used(gang.device)
    task = task_type(config, worlds, device=gang.device)
    learner = PPO(config.ppo, Share(0, worlds, worlds), task.observation_shape, task.action_size, alone)
    taken = _used(gang.device) - before
    del task, learner
    return max(taken, 0)


def _used(device: str) -> int:
    gc.collect()
    if device == "cpu":
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    torch.cuda.synchronize(device)
    torch.cuda.empty_cache()
    free, total = torch.cuda.mem_get_info(device)
    return total - free


def _explain(task_type: type[Task], worlds: int, gang: Gang, free: int, size: float) -> str:
    """One line; ``size`` of one world in bytes, 0 where it could not be measured."""
    where = "memory" if gang.device == "cpu" else f"memory of {gang.device}"
    name, rank = task_type.__name__, gang.placement.rank
    start = f"worlds: {worlds:,} worlds of {name} on rank {rank} need more {where} than the {_gb(free)} that are free"
    if not size:
        return f"{start}; set fewer `worlds`, or use more ranks"
    fit = max(1, int(SPARE * free / size))
    return f"{start}: about {_gb(worlds * size)}. About {fit:,} fit: set `worlds`, or use more ranks"


def _gb(size: int) -> str:
    return f"{size / 1e9:.1f} GB"
