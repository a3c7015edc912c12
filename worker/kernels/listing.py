"""The listing of a task's kernels by a dry pass: its worlds are built and stepped once, with launches noted instead of made.

The solver makes about a hundred kernels as it first launches them. Compiled one by one they take minutes of one core. The dry pass
makes the same objects, which the real worlds use afterwards, so that they can be compiled beside each other.

The robots' files are read as ever. Newton asks the device for the initial joints alone: the pass answers with the model's own.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any, NamedTuple

import worker.simulation  # noqa: F401 - before Newton, whose kernels it keeps from having adjoints

# isort: split
import mujoco
import newton
import torch
import warp as wp
from newton.solvers import SolverMuJoCo
from warp._src import context

from worker.kernels.ahead import Ahead
from worker.learning.randomness import generator_state, restore_generators
from worker.settings.task import TaskConfig
from worker.tasks.run.task import Task


class KernelFile(NamedTuple):
    """One Warp module, compiled for one size of thread blocks: a file in the cache."""

    module: Any
    """``warp._src.context.Module``."""
    block_dim: int

    @property
    def name(self) -> str:
        """The name of its directory and of its files in Warp's cache; it ends with a hash of all that the code depends on."""
        name: str = self.module.get_module_identifier(self.block_dim)
        return name


def kernels_of(
    task_type: type[Task],
    config: TaskConfig,
    device: str,
    *,
    algorithms: tuple[ModuleType, ...] = (),
    has_picture: bool = False,
    for_gpu: bool = False,
    worlds: int = 2,
    noted: Callable[[KernelFile], object] = lambda _: None,
    ahead: Ahead | None = None,
) -> list[KernelFile]:
    """The kernels that the task launches, in the order of their first launch. Nothing is launched on the device.

    The global random generators are left as they were, and what the task prints or warns of is dropped: the real worlds say it again.

    Args:
        task_type: The task.
        config: Its configuration.
        device: ``"cpu"`` or ``"cuda:<n>"``.
        algorithms: Modules with kernels of learning algorithms.
        has_picture: Whether to list those of the evaluation's picture, too.
        for_gpu: Whether to list what a GPU would launch, on a machine without one.
        worlds: Number of worlds that are built; no kernel depends on it.
        noted: Called at each kernel's first launch, and again once another overload of a generic kernel is launched.
        ahead: What is being compiled already.

    Raises:
        Exception: Whatever the task's own code raises.
    """
    notes = _Notes(device, for_gpu, noted, ahead)
    state = generator_state()
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()), notes.taken():
            warnings.simplefilter("ignore")
            for module in algorithms:
                notes.add(wp.get_module(module.__name__))
            task = _built(task_type, config, worlds, device, notes)
            if has_picture:
                _draw(task)
    finally:
        restore_generators(state)
    return list(notes.found)


class _Captured(BaseException):
    """The step would be captured now: all its kernels have been launched. No ``except Exception`` of a task catches it."""


class _Notes:
    """Stands for Warp's launches while it is taken."""

    def __init__(
        self, device: str, for_gpu: bool, noted: Callable[[KernelFile], object], ahead: Ahead | None = None
    ) -> None:
        self.found: dict[KernelFile, None] = {}
        self._device = wp.get_device(device)
        self._as_gpu = for_gpu or self._device.is_cuda
        self._noted, self._ahead = noted, ahead
        self._names: set[str] = set()
        self._is_real = False

    @contextlib.contextmanager
    def real(self) -> Iterator[None]:
        """A block whose launches are made."""
        self._is_real = True
        try:
            yield
        finally:
            self._is_real = False

    @contextlib.contextmanager
    def taken(self) -> Iterator[None]:
        """A block whose launches are noted, but for those inside :meth:`real`."""
        replaced = [
            (context.Module, "load", self._load(context.Module.load)),
            (context, "_resolve_launch_block_dim", self._block_dim(context._resolve_launch_block_dim)),
            (SolverMuJoCo, "_update_mjc_data", self._keep_joints(SolverMuJoCo._update_mjc_data)),
            (wp, "get_suggested_block_size", self._suggest),
            (wp, "capture_while", lambda condition, while_body, stream=None, **values: while_body(**values)),
            (wp, "capture_if", _both),
            (wp, "ScopedCapture", _end),
            # what a kernel would have written is 0 wherever it is read
            (wp, "empty", wp.zeros),
            (wp, "empty_like", wp.zeros_like),
        ]
        if self._as_gpu and not self._device.is_cuda:
            replaced.append((newton._src.sim.articulation, "_fk_prefers_tiled", _prefers_tiled))
        before = [(owner, name, getattr(owner, name)) for owner, name, _ in replaced]
        try:
            for owner, name, value in replaced:
                setattr(owner, name, value)
            yield
        finally:
            for owner, name, value in before:
                setattr(owner, name, value)

    def _load(self, load: Callable[..., Any]) -> Callable[..., Any]:
        """In place of ``Module.load``: a launch of a module that is None does nothing."""

        def noted(module: Any, device: Any, block_dim: int | None = None, *further: Any, **named: Any) -> Any:
            if self._is_real or wp.get_device(device) != self._device:
                if self._ahead is not None:
                    self._ahead.wait(module)
                return load(module, device, block_dim, *further, **named)
            self._note(module, block_dim or module.options["block_dim"])
            return None

        return noted

    def add(self, module: Any) -> None:
        """Note a Warp module as if one of its kernels had been launched without a size of blocks."""
        self._note(module, context._resolve_launch_block_dim(self._device, module.options["block_dim"]))

    def _note(self, module: Any, block_dim: int) -> None:
        kernels = KernelFile(module, block_dim)
        self.found[kernels] = None
        if (name := f"{kernels.name} {block_dim}") not in self._names:
            self._names.add(name)
            self._noted(kernels)

    def _block_dim(self, resolve: Callable[..., int]) -> Callable[..., int]:
        """In place of Warp's choice: the CPU would launch every kernel with one thread a block."""

        def resolved(device: Any, block_dim: int | None) -> int:
            if self._is_real or not self._as_gpu or wp.get_device(device) != self._device:
                return resolve(device, block_dim)
            return int(block_dim) if block_dim and block_dim > 0 else 256

        return resolved

    def _suggest(self, kernel: Any, device: Any = None) -> tuple[int, int]:
        """In place of ``wp.get_suggested_block_size``, which loads the kernel on a GPU, with its module's own block size."""
        if self._as_gpu:
            self._note(kernel.module, kernel.module.options["block_dim"])
        return 256, 1

    def _keep_joints(self, update: Callable[..., Any]) -> Callable[..., Any]:
        """In place of the conversion of Newton's joints: MuJoCo's are the model's own, where Newton's were never computed."""

        def updated(solver: Any, data: Any, *further: Any, **named: Any) -> Any:
            if self._is_real or not isinstance(data, mujoco.MjData):
                return update(solver, data, *further, **named)
            joints, velocities = data.qpos.copy(), data.qvel.copy()
            result = update(solver, data, *further, **named)
            data.qpos[:], data.qvel[:] = joints, velocities
            return result

        return updated


def _built(task_type: type[Task], config: TaskConfig, worlds: int, device: str, notes: _Notes) -> Task:
    """The task up to the first capture of its step, when all its kernels have been launched."""
    task = task_type.__new__(task_type)

    def template() -> Any:
        with notes.real():  # the robots' files are read and judged, on the CPU
            return task_type._template(task)

    vars(task)["_template"] = template
    with contextlib.suppress(_Captured):
        task.__init__(config, worlds, device=device)  # type: ignore[misc]
    return task


def _draw(task: Task) -> None:
    """What the picture of a policy launches."""
    from worker.telemetry.picture import MOMENTS, StageCamera
    from worker.telemetry.stage import Stage
    from worker.telemetry.tap import Tap

    with contextlib.suppress(_Captured):
        Tap(task, 1, rows=MOMENTS).open()
    camera = StageCamera(Stage(type(task), task.config, 1, task.device), 64, 64)
    camera.take(torch.zeros(1, task.worlds.model.joint_coord_count // task.world_count).numpy())


def _both(condition: Any, on_true: Any = None, on_false: Any = None, stream: Any = None, **values: Any) -> None:
    """In place of ``wp.capture_if``: both ways."""
    for way in (on_true, on_false):
        if callable(way):
            way(**values)


def _end(*further: Any, **named: Any) -> Any:
    raise _Captured


def _prefers_tiled(model: Any) -> bool:
    """As Newton's own choice of the kinematics' kernel, for a model that is on the CPU."""
    from newton._src.sim.articulation_cuda import FK_TILE_MIN_LEVEL_WIDTH

    return model._fk_articulation_level_start is not None and model._fk_level_capacity >= FK_TILE_MIN_LEVEL_WIDTH
