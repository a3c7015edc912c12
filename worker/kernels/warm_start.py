"""The start of a task with its kernels there: in the cache, brought by a package, or compiled beside each other."""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import os
from collections.abc import Callable
from pathlib import Path

import warp as wp

from worker.kernels import compiling, package
from worker.kernels.ahead import Ahead
from worker.kernels.listing import kernels_of
from worker.settings.task import TaskConfig
from worker.tasks.run.task import Task

Progress = Callable[[int, int], object]
"""Called with how many kernels are compiled, of how many."""


def target_of(device: str) -> str:
    """What is compiled for a device: ``cpu``, ``sm90``, or ``ptx75`` for a GPU that Warp's compiler does not know."""
    found = wp.get_device(device)
    if found.is_cpu:
        return "cpu"
    kind = "ptx" if found.get_cuda_output_format() == "ptx" else "sm"
    return f"{kind}{found.get_cuda_compile_arch()}"


def mark_of(task_type: type[Task], target: str) -> str:
    """The name of the entry in Warp's cache by which the task's kernels are there; a hint: what is missing is compiled when it is launched.

    It changes with the task's source, the simulation's versions and the target. ``wp.clear_kernel_cache`` deletes it with the kernels.
    """
    parts = [f"{task_type.__module__}:{task_type.__qualname__}", target, *package.versions().values()]
    with contextlib.suppress(TypeError, OSError):
        # its kernels may lie in the modules of its bases
        parts += [Path(inspect.getfile(each)).read_text() for each in task_type.__mro__ if each is not object]
    return f"wp_muster_{hashlib.sha256(repr(parts).encode()).hexdigest()[:16]}"


def is_warm(task_type: type[Task], device: str, say: Callable[[str], object] = print) -> bool:
    """Whether the cache has the kernels of a task, or an installed package brought them now.

    Args:
        task_type: The task.
        device: ``"cpu"`` or ``"cuda:<n>"``.
        say: Called with why the cache or a package can't be used, in a line.

    Raises:
        TrainingError: Kernels can't be written anywhere.
    """
    cache, notice = compiling.open_cache()
    if notice:
        say(f"warning: {notice}")
    if (cache / mark_of(task_type, target_of(device))).exists():
        return True
    if (folder := package.installed()) is None or device == "cpu":
        return False
    gpu = package.Gpu(wp.get_device(device).arch, wp.get_cuda_driver_version() or (0, 0))
    try:
        target = package.unpack(folder, gpu, cache)
    except (package.Unfit, OSError) as error:
        reason = f"{error.filename or cache}: {error.strerror}" if isinstance(error, OSError) else error
        say(f"{package.NAME} is not used: {reason}; kernels are compiled")
        return False
    if not (cache / mark_of(task_type, target)).exists():
        return False
    if target.startswith("ptx") and target_of(device) != target:  # the driver compiles them, and keeps what it made
        wp.config.cuda_output, wp.config.ptx_target_arch = "ptx", int(target[3:])
    return True


def compile_kernels(
    task_type: type[Task],
    config: TaskConfig,
    device: str,
    workers: int,
    progress: Progress,
    *,
    has_picture: bool = False,
) -> None:
    """Find the task's kernels and compile beside each other those that the cache does not have.

    A mistake in the task is not reported here: the real worlds meet it again.

    Args:
        task_type: The task.
        config: Its configuration.
        device: ``"cpu"`` or ``"cuda:<n>"``.
        workers: Number of threads.
        progress: Reports the count.
        has_picture: Whether its policy is drawn in the end.

    Raises:
        TrainingError: The cache can't be written.
    """
    ahead = Ahead(device, workers)  # what all tasks need, while this one is listed
    try:
        kernels = kernels_of(task_type, config, device, has_picture=has_picture, ahead=ahead)
    except Exception:
        return
    finally:
        ahead.close()
    if absent := compiling.missing(kernels, device):
        progress(0, len(absent))
        compiling.load_all(absent, device, workers, progress)
    with contextlib.suppress(OSError):
        (compiling.directory() / mark_of(task_type, target_of(device))).mkdir(exist_ok=True)


def cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0))
