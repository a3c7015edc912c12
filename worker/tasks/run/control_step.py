"""The launches of a control step: generated kernels, physics, sensors, terms in torch."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
import warp as wp

from worker.simulation.episodes import STEP, check_group, check_observations
from worker.simulation.latency import Latency
from worker.simulation.robot_arrays import BodyArrays
from worker.simulation.sensors.camera import Camera
from worker.simulation.sensors.differential_ik import IkSolver
from worker.simulation.sensors.rays import RayCasting
from worker.tasks.compile.compiler import Kernels, further
from worker.tasks.compile.external import ExternalArrays
from worker.tasks.run.step_needs import StepNeeds
from worker.tasks.run.torch_terms import TorchTerms, external_arrays

if TYPE_CHECKING:
    from worker.tasks.run.task import Task


class ControlStep:
    """The parts of a control step of all worlds, which the task captures.

    Args:
        task: The task, whose sensors and buffers exist.
        bodies: Poses and velocities of the bodies.

    Attributes:
        numbers: All numbers of the declaration, by their index in the plan.
        rows: Of each further observation group, the present rows and those before the reset; shape ``(worlds, columns)``.
        needs: What the step must update.
        kernels: The generated kernels.
        common: The inputs that all of them take.
        latency: Delays the controls; None: nothing does.
    """

    def __init__(self, task: Task, bodies: BodyArrays) -> None:
        self._task, self._worlds = task, task.worlds
        plan, device, count = task.plan, task.device, task.world_count
        episodes = task._episodes
        self.numbers = wp.array(plan.numbers.values or [0.0], dtype=wp.float32, device=device)
        self._past = wp.zeros((count, plan.past), dtype=wp.float32, device=device)
        self._external: ExternalArrays = external_arrays(plan, count, device)
        self.rows = {
            group: tuple(
                wp.zeros((count, sum(seen.size for seen in plan.groups[group])), dtype=wp.float32, device=device)
                for _ in range(2)
            )
            for group in further(plan)
        }
        structs: dict[str, Any] = {"bodies": bodies, "terrain": self._worlds.ground and self._worlds.ground.arrays}
        structs |= {f"robot_{name}": arrays for name, arrays in task.robots.items()}
        structs |= {f"sensor_{name}": sensor.arrays for name, sensor in task.sensors.items()}
        self._torch_terms = TorchTerms(task, plan, self._external)
        self.needs = StepNeeds(plan, task.sensors, self._torch_terms)
        self.kernels = Kernels(plan, self.needs.apart)
        # generating the source collects the selections that are not ranges
        indices = wp.array(plan.binder.indices or [0], dtype=wp.int32, device=device)
        self.common = [self.numbers, indices, self._past, self._external, 1.0 / task.config.control_hz]
        self.common += [self._worlds.arrays, episodes, *(structs[name] for name in self.kernels.structs)]
        self._movers = [sensor for sensor in task.sensors.values() if isinstance(sensor, IkSolver)]
        self._sees = any(isinstance(sensor, Camera | RayCasting) for sensor in task.sensors.values())
        greatest = task.config.randomize.action_latency
        self.latency = Latency(greatest, self._worlds, episodes) if greatest else None

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """Live views of what its kernels read in the next step."""
        tensors = {"past": wp.to_torch(self._past)} if self._past.size else {}
        tensors |= self.latency.state_tensors() if self.latency else {}
        return tensors | {f"group_{group}": wp.to_torch(rows) for group, (rows, _) in self.rows.items()}

    def parts(self) -> list[tuple[bool, Callable[[], None]]]:
        """The parts, in order, and whether to capture each; torch terms are not captured, unless torch captures all."""
        terms = self._torch_terms
        if not terms.any:
            return [(True, self.whole)]
        parts: list[tuple[bool, Callable[[], None]]] = [(True, self._simulate), (False, terms.judge)]
        if not terms.observe_any:
            return [*parts, (True, lambda: self._judge_and_observe(int(STEP)))]
        return [
            *parts,
            (True, lambda: self._judge(int(STEP))),
            (False, terms.observe),
            (True, lambda: self.observe(int(STEP))),
        ]

    def whole(self) -> None:
        """A whole step of a task without torch terms."""
        self._simulate()
        self._judge_and_observe(int(STEP))

    def startup(self) -> None:
        """Run the startup events."""
        if self.kernels.startup is not None:
            self._launch(self.kernels.startup, self.common)

    def _launch(self, kernel: wp.Kernel, inputs: list[Any]) -> None:
        wp.launch(kernel, dim=self._task.world_count, inputs=inputs, device=self._task.device)

    def _simulate(self) -> None:
        """Actions, physics, sensors."""
        self._launch(self.kernels.act, self.common)
        for mover in self._movers:
            mover.act()
        if self.latency:
            self.latency.delay()
        self._task.move()
        self._measure()

    def _measure(self) -> None:
        """Update bodies and sensors after the physics."""
        if self.needs.bodies:
            self._worlds.update_bodies()
        for sensor in self._task.sensors.values():
            sensor.advance()

    def judge_and_observe(self, mode: int) -> None:
        """Reward the state as it stands, or reset all worlds; then observe, by launches alone."""
        if mode == STEP:
            self._measure()
            if self._torch_terms.any:  # a reset judges nothing
                self._torch_terms.judge()
        self._judge(mode)
        if self._torch_terms.observe_any:
            self._torch_terms.observe()
        self.observe(mode)

    def _judge_and_observe(self, mode: int) -> None:
        self._judge(mode)
        self.observe(mode)

    def inputs(self, mode: int) -> list[Any]:
        """The inputs of the kernels that judge and observe."""
        rows = [array for both in self.rows.values() for array in both]
        return [mode, self._task.max_episode_length, *rows, *self.common]

    def _judge(self, mode: int) -> None:
        """Rewards, terminations, resets; then update the worlds that begin: drives, bodies, sensors."""
        self._launch(self.kernels.judge, self.inputs(mode))
        if self._task.randomizations:
            self._task.randomizations.settle()
        if self._worlds.drives:
            self._worlds.drives.settle(self._task._episodes.ages)
        if self._sees or self.needs.placed:
            self._worlds.update_bodies()
        if self._sees:
            self._worlds.update_shapes()
        for sensor in self._task.sensors.values():
            sensor.settle()

    def observe(self, mode: int) -> None:
        """Observe where observations have a kernel of their own, and check the observations of all groups."""
        if self.kernels.observe is not None:
            self._launch(self.kernels.observe, self.inputs(mode))
        episodes, first = self._task._episodes, len(self._task.observation_names)
        self._launch(check_observations, [episodes])
        for both in self.rows.values():
            self._launch(check_group, [first, episodes, *both])
            first += both[0].shape[1]
