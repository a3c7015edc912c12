"""Compiling ahead of a task the modules with kernels that every training with `ppo` loads."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import warp as wp
from warp._src import context

MODULES = (
    # the largest ones first
    *("newton._src.solvers.mujoco.kernels", "mujoco_warp._src.smooth", "mujoco_warp._src.forward"),
    *("mujoco_warp._src.derivative", "mujoco_warp._src.passive", "newton._src.geometry.bvh", "mujoco_warp._src.solver"),
    *("mujoco_warp._src.set_const", "mujoco_warp._src.support", "mujoco_warp._src.constraint"),
    *("worker.simulation.episodes", "worker.simulation.solver"),
    *("worker.learning.ppo.draws", "worker.learning.ppo.heads"),
)


class Ahead:
    """Compiles and loads them on threads, from now on.

    Args:
        device: ``"cpu"`` or ``"cuda:<n>"``.
        workers: Number of threads.
    """

    def __init__(self, device: str, workers: int) -> None:
        self._pool = ThreadPoolExecutor(workers)
        block_dim = context._resolve_launch_block_dim(wp.get_device(device), None)
        self._loads: dict[Any, Future[Any]] = {}
        for module in (context.user_modules[name] for name in MODULES if name in context.user_modules):
            module.get_module_hash(block_dim)  # names no file twice: hashes are of one thread's making
            self._loads[module] = self._pool.submit(module.load, device, block_dim)

    def wait(self, module: Any) -> None:
        """Wait for a module that is being compiled. A failure is left to its next load."""
        if (load := self._loads.get(module)) is not None:
            with suppress(Exception):
                load.result()

    def close(self) -> None:
        """Wait for all of them."""
        self._pool.shutdown()
