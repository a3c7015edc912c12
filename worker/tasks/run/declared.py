"""A task by declaration: its robot, its scene and its named terms; the kernels follow."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import newton
import torch
import warp as wp

from shared_store.contract.error_text import nearest
from worker.simulation.capture import on_torch_stream
from worker.simulation.episodes import STEP, check_group, check_observations
from worker.simulation.randomization_targets import check_patterns
from worker.simulation.randomizations import Randomizations
from worker.simulation.robot_reading import Reading
from worker.simulation.robot_view import RobotView, body_arrays
from worker.simulation.sensors.camera import Camera
from worker.simulation.sensors.differential_ik import IkSolver
from worker.simulation.sensors.rays import RayCasting
from worker.simulation.sensors.sensor import SensorContext
from worker.simulation.terrain import Terrain
from worker.simulation.world_cameras import paint
from worker.tasks.compile.compiler import Kernels, further
from worker.tasks.compile.contract import contract
from worker.tasks.compile.declaration_checks import placed
from worker.tasks.compile.numbers import flat
from worker.tasks.compile.plan import KernelPlan, stacked
from worker.tasks.declare.declaration import Choice, Declaration
from worker.tasks.declare.interface import Interface
from worker.tasks.run.adapting import Adapting
from worker.tasks.run.step_needs import StepNeeds
from worker.tasks.run.task import Task
from worker.tasks.run.task_checks import checked_interface
from worker.tasks.run.torch_terms import TorchTerms


class DeclaredTask(Task):
    """A task whose kernels are compiled from named terms.

    A subclass names its configuration and gives its robot and its declaration::

        class Reach(DeclaredTask):
            config_type = ReachConfig

            def robot(self, config): return Robot("arm.xml")
            def declare(self, config): return Declaration(actions=…, observations=…, rewards=…)

    A control step is, in this order:

    1. ``actions``: from the policy's output to the actuators.
    2. Physics: ``config.substeps`` steps; after it sensors measure.
    3. ``terminations``, then ``rewards`` and ``metrics``, of worlds whose physics did not fail.
    4. The end of the step: clock, sums, statistics; selection of the worlds that begin a new episode.
    5. For an episode that ended, the last observation, then ``curricula``.
    6. In a world that goes on, ``commands`` whose time is up are drawn again, then ``events`` at intervals.
    7. In a world that begins, memory and solver are cleared and every joint is at the model's position; ``events`` at a
       reset place it, then ``commands`` are drawn.
    8. ``observations`` of every world, with noise, clip, scale, delay and history.

    Attributes:
        views: Joints, bodies, sites and geoms of each robot and object, by its name.
        readings: How the file of each robot was read, by its name.
        declaration: The result of :meth:`declare`.
        plan: The declaration, bound to the robots.
        sensors: The declared sensors, by name.
        randomizations: The declared quantities that differ from world to world.
    """

    solver_options: Mapping[str, Any] = {}
    randomizations: Randomizations | None = None

    def robot(self, config: Any) -> Any:
        """The robot: a :class:`worker.simulation.robot.Robot`."""
        raise NotImplementedError

    def objects(self, config: Any) -> Mapping[str, Any]:
        """Further objects in each world, by name: robots, boxes, spheres, capsules."""
        return {}

    def terrain(self, config: Any) -> Any:
        """The ground, a :class:`worker.simulation.terrain.Terrain`; None: a plane if ``ground`` is true."""
        return None

    def declare(self, config: Any) -> Declaration:
        """The terms. :attr:`views` already has the robots."""
        raise NotImplementedError

    def build(self, builder: newton.ModelBuilder) -> None:
        """Add robots and objects, and bind the terms to them."""
        config: Any = self.config
        entities = {"robot": self.robot(config), **self.objects(config)}
        self.readings: dict[str, Reading] = {}
        for name, entity in entities.items():
            self._add(name, entity, builder)
        self.views = {name: RobotView(builder, name) for name in entities}
        self.declaration = self.declare(config)
        if not isinstance(self.declaration, Declaration):
            found = type(self.declaration).__name__
            raise ValueError(f"task {type(self).__name__}: declare() returned {found}, not a Declaration")
        self.ground_terrain = self.terrain(config)
        sensors = self.declaration.sensors
        for name, sensor in sensors.items():
            if hasattr(sensor, "rows"):  # a task's own sensor may have no columns
                with placed(f"task {type(self).__name__}: sensors.{name}"):
                    sensor.rows(self.views)
        try:
            self.plan = KernelPlan(self.declaration, config, self.views, sensors, self.ground_terrain is not None)
            check_patterns(self.declaration.randomize, self.views)
            if isinstance(self.ground_terrain, Terrain):
                self.ground_terrain.check_memory()
        except ValueError as error:
            # an error in a job's setting names its place in the job alone
            where = "" if str(error).startswith("config.") else f"task {type(self).__name__}: "
            raise ValueError(f"{where}{error}") from error
        self._name()

    def _add(self, name: str, entity: Any, builder: newton.ModelBuilder) -> None:
        where = f"task {type(self).__name__}: {'' if name == 'robot' else 'objects: '}"
        if not dataclasses.is_dataclass(entity) or isinstance(entity, type) or not hasattr(entity, "add_to"):
            found = "robot() returned" if name == "robot" else f"{name} is"
            raise ValueError(f"{where}{found} {type(entity).__name__}, which can't be put into a world")
        with placed(where.removesuffix(": ")):
            reading = dataclasses.replace(entity, name=name).add_to(builder)
        if isinstance(reading, Reading):
            self.readings[name] = reading

    def notes(self) -> Sequence[str]:
        """What a user should know of its robots, one sentence each."""
        found = {name: (*each.lines(), *self.views[name].beyond_limits()) for name, each in self.readings.items()}
        return [f"{name}: {line}" for name, lines in found.items() for line in lines]

    def stands_on(self) -> bool | Terrain:
        """The result of :meth:`terrain`, or whether there is a plane."""
        return self.ground_terrain or self.ground

    def _name(self) -> None:
        """Take names from the terms."""
        plan = self.plan
        self.observation_names, self.action_names = plan.names, plan.actions
        groups = {group: plan.groups[group] for group in further(plan)}
        self.further_names = tuple(
            f"{group}.{name}" for group, terms in groups.items() for seen in terms for name in stacked(seen)
        )
        self.discrete = isinstance(self.declaration.actions, Choice)
        self.memory_size, self.lasting_size = plan.binder.memory, plan.binder.lasting
        metrics = {f"metric_{name}": term for name, term in self.declaration.metrics.items()}
        self.metric_names = tuple(metrics)
        self.final_metrics = tuple(name for name, term in metrics.items() if term.at_end)
        self.shown_metrics = {name: term.shown for name, term in metrics.items() if term.shown is not None}
        self.success = self.declaration.success
        self.termination_names = tuple(f"termination_{name}" for name in (*self.declaration.terminations, "time_out"))

    def interface(self) -> Interface:
        """The policy's contract, derived from the declaration."""
        return contract(self.plan, self.worlds)

    def bundle_documents(self, algorithm: str) -> Mapping[str, Mapping[str, Any]]:
        """Further JSON documents of the bundle of a policy that ``algorithm``, a name, trained; by file name."""
        return {}

    def _prepare(self) -> None:
        """Prepare the kernels' inputs on the device."""
        plan, device, count = self.plan, self.device, self.world_count
        self._numbers = wp.array(plan.numbers.values or [0.0], dtype=wp.float32, device=device)
        self._past = wp.zeros((count, plan.past), dtype=wp.float32, device=device)
        self._external = wp.zeros((count, plan.binder.external), dtype=wp.float32, device=device)
        self._rows = {
            group: tuple(
                wp.zeros((count, sum(seen.size for seen in plan.groups[group])), dtype=wp.float32, device=device)
                for _ in range(2)
            )
            for group in further(plan)
        }
        self._further = [array for both in self._rows.values() for array in both]
        bodies = body_arrays(self.worlds)
        self.robots = {name: view.arrays(self.worlds) for name, view in self.views.items()}
        context = SensorContext(
            self.worlds, self.views, self.robots, bodies, self._episodes, self.ground_terrain, self.config.control_hz
        )
        self.sensors = {
            name: self._build_sensor(name, each, context) for name, each in self.declaration.sensors.items()
        }
        self._cameras = [sensor for sensor in self.sensors.values() if isinstance(sensor, Camera)]
        samplings = {name: getattr(sensor, "sampling", None) for name, sensor in self.sensors.items()}  # of motions
        self._samplings = {name: each for name, each in samplings.items() if each is not None and each.is_adaptive}
        self._movers = [sensor for sensor in self.sensors.values() if isinstance(sensor, IkSolver)]
        self._sees = any(isinstance(sensor, Camera | RayCasting) for sensor in self.sensors.values())
        structs: dict[str, Any] = {
            "bodies": bodies,
            "terrain": self.worlds.ground.arrays if self.worlds.ground else None,
        }
        structs |= {f"robot_{name}": arrays for name, arrays in self.robots.items()}
        structs |= {f"sensor_{name}": sensor.arrays for name, sensor in self.sensors.items()}
        self._torch_terms = TorchTerms(self, plan, self._external)
        self._needs = StepNeeds(plan, self.sensors, self._torch_terms)
        self._kernels = Kernels(type(self).__name__, plan, self._needs.apart)
        # generating the source collects the selections that are not ranges
        self._indices = wp.array(plan.binder.indices or [0], dtype=wp.int32, device=device)
        self._common = [self._numbers, self._indices, self._past, self._external, 1.0 / self.config.control_hz]
        self._common += [self.worlds.arrays, self._episodes, *(structs[name] for name in self._kernels.structs)]

    def _build_sensor(self, name: str, declared: Any, context: SensorContext) -> Any:
        with placed(f"task {type(self).__name__}: sensors.{name}"):
            return declared.build(dataclasses.replace(context, name=name))

    def _begin(self) -> None:
        """Once the random streams are seeded: draw each world's physics and patch of terrain, and run the startup events."""
        if self.randomizations is None:
            if self._cameras and not self._camera:
                paint(self.worlds, self._episodes, self.config.randomize.colors)
            self.randomizations = Randomizations(
                self.declaration.randomize,
                self.worlds,
                self._episodes,
                self.views,
                self.robots,
                self.config.control_hz,
            )
            for place, value in self.config.numbers.items():
                if place.startswith("randomize."):
                    view = self.numbers(place)
                    view.copy_(torch.tensor(flat(f"config.numbers.{place}", value, view.numel())).view_as(view))
            if rules := self.plan.adaptive:
                self.adapting = Adapting(rules, self.numbers, self.world_count, self.device)
        self.randomizations.restart()
        if self.worlds.ground:
            self.worlds.ground.deal(self._episodes)
        for camera in self._cameras:
            camera.begin(self.config.randomize)
        if self._kernels.startup is not None:
            wp.launch(self._kernels.startup, dim=self.world_count, inputs=self._common, device=self.device)

    def _group(self) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
        """The observation groups, and those before the reset; without a group of its own the critic sees the policy's."""
        seen = {"policy": self.observations, "critic": self.states}
        ended = {"policy": self.terminal_observations, "critic": self.terminal_observations}
        for group, (rows, last) in self._rows.items():
            seen[group], ended[group] = wp.to_torch(rows), wp.to_torch(last)
        for group, name in self.plan.images.items():
            seen[group] = self.sensors[name].images
        if "policy" in self.plan.images:
            self.observations = seen["policy"]
            self.observation_shape = tuple(self.observations.shape[1:])
        if len(self.observation_shape) > 1:
            del ended["policy"]
        return seen, ended

    def numbers(self, place: str) -> torch.Tensor:
        """A live view of the numbers of a place, such as ``events.push.speed``; writing to it changes the task from the next step on.

        Raises:
            ValueError: The place does not exist.
        """
        if place.startswith("randomize."):
            known = self.randomizations.numbers() if self.randomizations else {}
            if (entry := place.removeprefix("randomize.")) not in known:
                raise ValueError(f"task {type(self).__name__}: it has no number {place}; {nearest(entry, known)}")
            return known[entry]
        first, count = self.plan.numbers.find(place, f"task {type(self).__name__}")
        view: torch.Tensor = wp.to_torch(self._numbers)[first : first + count]
        return view

    def begin_iteration(self, iteration: int, reward: float | None, episode_length: float | None) -> None:
        """Set the adaptive numbers, then those of ``config.curriculum``. See :meth:`Task.begin_iteration`."""
        if self.adapting:
            self.adapting.begin(iteration, reward, episode_length)
        super().begin_iteration(iteration, reward, episode_length)

    def own_counts(self) -> Mapping[str, torch.Tensor]:
        """The failures in each part of each motion."""
        return {name: sampling.own_failures() for name, sampling in self._samplings.items()}

    def take_counts(self, others: Mapping[str, torch.Tensor]) -> None:
        """See :meth:`Telling.take_counts`."""
        for name, failures in others.items():
            self._samplings[name].take_failures(failures)

    def _number(self, name: str) -> torch.Tensor:
        return self.numbers(name) if "." in name else super()._number(name)

    def _noise(self) -> list[float]:
        """No noise from the randomizer: the kernels add the configured noise."""
        checked_interface(self)
        return [0.0] * len(self.observation_names)

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """As :meth:`Task.state_tensors`, with the buffers of delays, past actions and sensors."""
        tensors = super().state_tensors()
        tensors |= {"last_actions": self._last_actions, "earlier_actions": self._earlier_actions}
        if self.adapting:
            tensors["adaptive_numbers"] = self.adapting.state
        if self.plan.past:
            tensors["past"] = wp.to_torch(self._past)
        if self.lasting_size:
            tensors["lasting"] = self._lasting
        for group, (rows, _) in self._rows.items():
            tensors[f"group_{group}"] = wp.to_torch(rows)
        for name, sensor in self.sensors.items():
            tensors |= {f"sensor_{name}_{key}": tensor for key, tensor in sensor.state_tensors().items()}
        for part in (self.worlds.ground, self.worlds.drives, self.randomizations):
            tensors |= part.state_tensors() if part else {}
        return tensors

    def load_state_dict(self, state: Mapping[str, torch.Tensor]) -> None:
        """As :meth:`Task.load_state_dict`; restores the physics that was drawn for each world."""
        super().load_state_dict(state)
        if self.adapting:
            self.adapting.read()
        with on_torch_stream(self.device):
            if self.randomizations:
                self.randomizations.apply()
            if self._needs.placed:
                self.worlds.update_bodies()

    def _parts(self) -> list[tuple[bool, Callable[[], None]]]:
        """The parts of the control step, in order, and whether to capture each; torch terms are not captured, unless torch captures all."""
        if not self._torch_terms.any:
            return [(True, self._whole)]
        parts: list[tuple[bool, Callable[[], None]]] = [(True, self._simulate), (False, self._torch_terms.judge)]
        if not self._torch_terms.observe_any:
            return [*parts, (True, lambda: self._judge(int(STEP)))]
        return [
            *parts,
            (True, lambda: self._judge_alone(int(STEP))),
            (False, self._torch_terms.observe),
            (True, lambda: self._observe_alone(int(STEP))),
        ]

    def _whole(self) -> None:
        self._simulate()
        self._judge(int(STEP))

    def _simulate(self) -> None:
        """Actions, physics, sensors."""
        self.randomizer.push()
        wp.launch(self._kernels.act, dim=self.world_count, inputs=self._common, device=self.device)
        for mover in self._movers:
            mover.act()
        self.randomizer.delay()
        self.move()
        self._measure()

    def move(self) -> None:
        """Advance all worlds by one control step, by kernel launches alone: physics, or a subclass's own rule of motion."""
        self.worlds.simulate()

    def _measure(self) -> None:
        """Update bodies and sensors after the physics."""
        if self._needs.bodies:
            self.worlds.update_bodies()
        for sensor in self.sensors.values():
            sensor.advance()

    def _launch_observe(self, mode: int) -> None:
        """Compute rewards or reset, and observe, by kernel launches alone."""
        if mode == STEP:
            self._measure()
            if self._torch_terms.any:  # a reset judges nothing
                self._torch_terms.judge()
        self._judge_alone(mode)
        if self._torch_terms.observe_any:
            self._torch_terms.observe()
        self._observe_alone(mode)

    def _judge(self, mode: int) -> None:
        self._judge_alone(mode)
        self._observe_alone(mode)

    def _judge_alone(self, mode: int) -> None:
        """Rewards, terminations, resets; then update the worlds that begin: drives, bodies, sensors."""
        inputs = [mode, self.max_episode_length, *self._further, *self._common]
        wp.launch(self._kernels.judge, dim=self.world_count, inputs=inputs, device=self.device)
        if self.randomizations:
            self.randomizations.settle()
        if self.worlds.drives:
            self.worlds.drives.settle(self._episodes.ages)
        if self._sees or self._needs.placed:
            self.worlds.update_bodies()
        if self._sees:
            self.worlds.update_shapes()
        for sensor in self.sensors.values():
            sensor.settle()

    def _observe_alone(self, mode: int) -> None:
        if self._kernels.observe is not None:
            inputs = [mode, self.max_episode_length, *self._further, *self._common]
            wp.launch(self._kernels.observe, dim=self.world_count, inputs=inputs, device=self.device)
        wp.launch(check_observations, dim=self.world_count, inputs=[self._episodes], device=self.device)
        first = len(self.observation_names)
        for both in self._rows.values():
            wp.launch(check_group, dim=self.world_count, inputs=[first, self._episodes, *both], device=self.device)
            first += both[0].shape[1]
        if self._camera:
            self._camera.render(mode)
