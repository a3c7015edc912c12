"""A task: many worlds of a robot, made of named terms for its actions, observations, rewards, ends and resets; the kernels follow."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import torch
import warp as wp

from shared_store.contract.error_text import nearest
from worker.settings.task import TaskConfig, value_at
from worker.simulation.capture import CapturedStep, on_torch_stream
from worker.simulation.episodes import (
    NO_FAILED_WORLD,
    RESET,
    EpisodeArrays,
    causes_of_failures,
    randomize_ages,
    read_failed_world,
)
from worker.simulation.randomizations import Randomizations
from worker.simulation.rendering import paint
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.robot_view import body_arrays
from worker.simulation.sensors.camera import Camera
from worker.simulation.sensors.sensor import SensorContext
from worker.simulation.worlds import Worlds
from worker.tasks.compile.configured import FACTOR_STREAMS
from worker.tasks.compile.contract import contract
from worker.tasks.compile.declaration_checks import placed
from worker.tasks.compile.numbers import flat
from worker.tasks.declare.interface import Interface
from worker.tasks.run.adapting import Adapting
from worker.tasks.run.buffers import Buffers
from worker.tasks.run.control_step import ControlStep
from worker.tasks.run.episode_records import LastEpisodes
from worker.tasks.run.saved import check_state, completed
from worker.tasks.run.sketch import TaskSketch
from worker.tasks.run.task_checks import assert_replays, check_arguments


class Task(TaskSketch):
    """A vector of Newton worlds that act, observe, are rewarded and reset themselves on the device.

    A subclass gives its robot and its declaration; the kernels are compiled from the terms::

        class Reach(Task, config={"episode_seconds": 5.0}):
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

    Every tensor below is a fixed buffer on ``device``, shared with Warp; its address never changes.

    Args:
        config: The task's configuration, of type ``config_type``.
        seed: Seed of all random numbers (any integer >= 0; 64 bits count).
        first_world: Global index of world 0. Random numbers are keyed by (seed, global index, draws so far), so N ranks
            with W / N worlds each see the worlds of one rank with W.
        device: ``"cpu"`` or ``"cuda:<n>"``.

    Raises:
        ValueError: An argument or a field of the configuration is out of range, or the robot can't be driven.

    Attributes:
        world_count: Number of worlds.
        max_episode_length: Control steps after which the clock ends an episode.
        actions: The next actions, shape ``(worlds, action_size)``, or ``(worlds, 1)`` of discrete choices; float32.
        observations: The policy's input, shape ``(worlds, *observation_shape)``: float32, or uint8 of an image.
        states: The columns named by ``observation_names``, shape ``(worlds, states)``, float32; unless the policy sees an image,
            the observations.
        terminal_observations: The states before the reset, valid where ``dones``; same shape as ``states``, float32.
        groups: The observation groups by name: ``policy`` is :attr:`observations`, ``critic`` the states without noise.
        terminal_groups: The groups before the reset, valid where ``dones``; images are not among them.
        rewards: Shape ``(worlds,)``, float32.
        dones: Whether the episode ended, shape ``(worlds,)``, bool.
        time_outs: Whether it ended by the clock alone, shape ``(worlds,)``, bool.
        episode_length: Steps on the clock of the running episode, shape ``(worlds,)``, int32.
        statistics: Running totals since :meth:`clear_statistics`, named by ``statistic_names``, shape ``(k,)``,
            float64. They are not part of the state: read and clear them before it is saved.
        failed_world: A world that failed and was reset since :meth:`clear_statistics`, and the cause: see :meth:`read_failed_world`; shape
            ``(1,)``, int32.
        ended: The last finished episode of each world, see :class:`worker.tasks.run.episode_records.LastEpisodes`.
        captured: Whether :meth:`step` replays a graph; true after construction, which captures one on trial.
        views: Joints, bodies, sites and geoms of each robot and object, by its name.
        readings: How the file of each robot was read, by its name.
        declaration: The result of :meth:`declare`, with what the configuration adds.
        plan: The declaration, bound to the robots.
        robots: Columns of each robot or object in the rows of a world, by its name.
        bodies: Poses and velocities of the bodies of all worlds.
        sensors: The declared sensors, by name.
        randomizations: The quantities that differ from world to world.
    """

    device: str
    world_count: int
    worlds: Worlds
    robots: dict[str, RobotArrays]
    bodies: BodyArrays
    sensors: dict[str, Any]
    _episodes: EpisodeArrays
    randomizations: Randomizations | None = None
    adapting: Adapting | None = None

    def __init__(
        self, config: TaskConfig, world_count: int, *, seed: int = 0, first_world: int = 0, device: str = "cpu"
    ) -> None:
        check_arguments(type(self), config, world_count, seed, first_world)
        self.config = config
        self.world_count = world_count
        self.device = "cuda:0" if device == "cuda" else device
        self.first_world = first_world
        template = self._template()
        config = self.config
        self.max_episode_length = max(1, round(config.episode_seconds * config.control_hz))
        self.observation_shape: tuple[int, ...] = (len(self.observation_names),)
        try:
            self.worlds = Worlds(
                template,
                world_count,
                self.device,
                timestep=1.0 / (config.control_hz * config.substeps),
                substeps=config.substeps,
                fastest=config.fastest,
                ground=self.stands_on(),
                solver_options=self.solver_options,
            )
        except ValueError as error:
            raise ValueError(f"task {type(self).__name__}: {error}") from error
        wp.synchronize_device(self.device)  # the worlds are built on Warp's own stream
        # torch fills some of the buffers; Warp's own stream could otherwise clear them afterwards
        with on_torch_stream(self.device):
            self._allocate()
            self._prepare()
            self._control = ControlStep(self, self.bodies)
        wp.synchronize_device(self.device)
        self.seed(seed)
        with on_torch_stream(self.device):
            self.groups, self.terminal_groups = self._group()
            self._begin()
            for _, part in self._control.parts():
                part()  # loads every kernel: not every platform can load one during a capture
        self._watchers: dict[str, Callable[[], None] | None] = {}
        self._steps = [
            CapturedStep(part, self.device).launch if whole else part for whole, part in self._control.parts()
        ]
        self.captured = assert_replays(self, self._steps)
        self.restart(seed, first_world)

    def interface(self) -> Interface:
        """The policy's contract, derived from the declaration."""
        return contract(self.plan, self.worlds)

    def bundle_documents(self, algorithm: str) -> Mapping[str, Mapping[str, Any]]:
        """Further JSON documents of the bundle of a policy that ``algorithm``, a name, trained; by file name."""
        return {}

    def _allocate(self) -> None:
        """Allocate every buffer once, as views that torch and Warp share."""
        self._causes = causes_of_failures(self.reward_terms, (*self.observation_names, *self.further_names))
        self._buffers = buffers = Buffers(self, len(self._causes))
        self._episodes = buffers.arrays
        self.actions = buffers["actions"]
        self.states = self.observations = buffers["observations"]
        self.terminal_observations = buffers["terminal_observations"]
        self.rewards, self.dones, self.time_outs = buffers["rewards"], buffers["dones"], buffers["time_outs"]
        self.episode_length = buffers["ages"]
        self.failed_world, self.statistics = buffers["failed_world"], buffers["statistics"]
        self.ended = LastEpisodes.of(self, buffers)

    def _prepare(self) -> None:
        """Build the sensors."""
        self.bodies = body_arrays(self.worlds)
        self.robots = {name: view.arrays(self.worlds) for name, view in self.views.items()}
        context = SensorContext(
            self.worlds,
            self.views,
            self.robots,
            self.bodies,
            self._episodes,
            self.ground_terrain,
            self.config.control_hz,
        )
        self.sensors = {
            name: self._build_sensor(name, each, context) for name, each in self.declaration.sensors.items()
        }
        samplings = {name: getattr(sensor, "sampling", None) for name, sensor in self.sensors.items()}  # of motions
        self._samplings = {name: each for name, each in samplings.items() if each is not None and each.is_adaptive}

    def _build_sensor(self, name: str, declared: Any, context: SensorContext) -> Any:
        with placed(f"task {type(self).__name__}: sensors.{name}"):
            return declared.build(dataclasses.replace(context, name=name))

    def _begin(self) -> None:
        """Once the random streams are seeded: draw each world's physics and patch of terrain, and run the startup events."""
        cameras = [sensor for sensor in self.sensors.values() if isinstance(sensor, Camera)]
        if self.randomizations is None:
            if cameras:
                paint(self.worlds, self._episodes, self.config.randomize.colors)
            self.randomizations = Randomizations(
                self.declaration.randomize,
                self.worlds,
                self._episodes,
                self.views,
                self.robots,
                self.config.control_hz,
                FACTOR_STREAMS,
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
        for camera in cameras:
            camera.begin(self.config.randomize)
        self._control.startup()

    def _group(self) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
        """The observation groups, and those before the reset; without a group of its own the critic sees the policy's."""
        seen = {"policy": self.observations, "critic": self.states}
        ended = {"policy": self.terminal_observations, "critic": self.terminal_observations}
        for group, (rows, last) in self._control.rows.items():
            seen[group], ended[group] = wp.to_torch(rows), wp.to_torch(last)
        for group, name in self.plan.images.items():
            seen[group] = self.sensors[name].images
        if "policy" in self.plan.images:
            self.observations = seen["policy"]
            self.observation_shape = tuple(self.observations.shape[1:])
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
        view: torch.Tensor = wp.to_torch(self._control.numbers)[first : first + count]
        return view

    def begin_iteration(self, iteration: int, reward: float | None, episode_length: float | None) -> None:
        """Called before every training iteration, outside the CUDA graph: the place for a curriculum.

        By default it sets the adaptive numbers, then those that ``config.curriculum`` names. A subclass may also fill device arrays that
        its kernels read. The result must depend on the arguments alone, which are the same on every rank and after a restart.

        Args:
            iteration: Number of finished iterations.
            reward: Mean return of the episodes that ended last; None before the first.
            episode_length: Their mean length [steps].
        """
        if self.adapting:
            self.adapting.begin(iteration, reward, episode_length)
        for name, points in self.config.curriculum.items():
            self._number(name).fill_(value_at(points, iteration))

    def _number(self, name: str) -> torch.Tensor:
        """The number that a curriculum changes under this name."""
        if "." in name:
            return self.numbers(name)
        if name == "level":
            return self._buffers["level"]
        return self._buffers["weights"][self.reward_terms.index(name)]

    def own_counts(self) -> Mapping[str, torch.Tensor]:
        """The failures in each part of each motion."""
        return {name: sampling.own_failures() for name, sampling in self._samplings.items()}

    def take_counts(self, others: Mapping[str, torch.Tensor]) -> None:
        """See :meth:`TaskReport.take_counts`."""
        for name, failures in others.items():
            self._samplings[name].take_failures(failures)

    def step(self, actions: torch.Tensor) -> None:
        """Act, simulate one control step, reward, and reset the worlds whose episode ended; nothing waits for the host.

        Args:
            actions: Copied into :attr:`actions`; of its shape and type.
        """
        self.actions.copy_(actions)
        for launch in self._steps:
            launch()

    def move(self) -> None:
        """Advance all worlds by one control step, by kernel launches alone: physics, or a subclass's own rule of motion."""
        self.worlds.simulate()

    def watch(self, watcher: Callable[[], None] | None, by: str = "tap") -> None:
        """Call ``watcher`` after every control step, instead of an earlier one ``by`` the same name; None: call nothing.

        It launches kernels alone, which it has run once and which write nothing that the task reads. Graphs of :meth:`step` are captured anew.
        """
        self._watchers[by] = None if watcher is None else CapturedStep(watcher, self.device).launch
        self._steps[len(self._control.parts()) :] = filter(None, self._watchers.values())

    def reset(self) -> None:
        """Begin a new episode with new random numbers in every world."""
        with on_torch_stream(self.device):
            self._control.judge_and_observe(int(RESET))

    def restart(self, seed: int, first_world: int) -> None:
        """Turn the worlds into those of another seed or global index, as if they had just been built.

        The scene that ``config.randomize`` drew for each world stays as it is.

        Args:
            seed: Any integer >= 0.
            first_world: Global index of world 0.
        """
        self.first_world = first_world
        with on_torch_stream(self.device):
            self.worlds.restore_defaults()
            self._buffers["lasting"].zero_()
            self.seed(seed)
            self._begin()
        self.clear_statistics()
        self.reset()

    def seed(self, seed: int) -> None:
        """Restart all random streams from another seed; the worlds change at their next reset, their physics at a restart.

        Args:
            seed: Any integer >= 0.

        Raises:
            ValueError: ``seed`` is negative.
        """
        if seed < 0:
            raise ValueError(f"seed is {seed}; use an integer >= 0")
        folded = (seed ^ (seed >> 32)) & 0xFFFFFFFF
        random = self._buffers["random"]
        random[:, 0] = folded - (1 << 32) if folded >= 1 << 31 else folded
        random[:, 1] = torch.arange(self.first_world, self.first_world + self.world_count, dtype=torch.int32)
        random[:, 2] = 0

    def set_random_episode_length(self) -> None:
        """Set the clock of every world to a random age, so that the worlds do not all time out in the same step."""
        with on_torch_stream(self.device):
            wp.launch(
                randomize_ages,
                dim=self.world_count,
                inputs=[self.max_episode_length, self._episodes],
                device=self.device,
            )

    def clear_statistics(self) -> None:
        """Set all running totals to zero."""
        self.statistics.zero_()
        self.failed_world.fill_(int(NO_FAILED_WORLD))

    def read_failed_world(self, code: int) -> tuple[int, str] | None:
        """Decode a value of :attr:`failed_world`: the index of the failed world in this task and the cause; None: no world failed."""
        return None if code == NO_FAILED_WORLD else read_failed_world(code, self._causes)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """The state from which :meth:`load_state_dict` continues bit for bit (on the CPU), copied to host memory.

        Returns:
            Tensors by name, each with leading dimension ``world_count``, so that worlds can be resharded.
        """
        return {name: tensor.detach().cpu().clone() for name, tensor in self.state_tensors().items()}

    def load_state_dict(self, state: Mapping[str, torch.Tensor]) -> None:
        """Continue from :meth:`state_dict`, in place. Worlds keep their seed and global index.

        Args:
            state: From :meth:`state_dict` of the same task with as many worlds.

        Raises:
            ValueError: A tensor is missing, unknown, or of another shape or type; nothing has changed.
        """
        tensors = self.state_tensors()
        drawn = self.randomizations.names if self.randomizations else ()
        state = completed(tensors, state, len(self.metric_names), drawn)
        check_state(f"the saved state of task {type(self).__name__}", tensors, state)
        for name, tensor in tensors.items():
            tensor.copy_(state[name])
        if self.adapting:
            self.adapting.read()
        with on_torch_stream(self.device):
            if self.randomizations:
                self.randomizations.apply()
            if self._control.needs.placed:
                self.worlds.update_bodies()

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """Live views of all state that persists between control steps."""
        arrays, buffers = self.worlds.arrays, self._buffers
        optional = {"memory": buffers["memory"], "activations": wp.to_torch(arrays.activations)}
        optional["lasting"] = buffers["lasting"]
        tensors = {
            **{name: tensor for name, tensor in optional.items() if tensor.numel()},
            "joint_q": wp.to_torch(arrays.joint_q),
            "joint_qd": wp.to_torch(arrays.joint_qd),
            "solver_warm_start": wp.to_torch(arrays.warm_start),
            "observations": self.states,
            "episode_length": self.episode_length,
            "episode_sums": buffers["sums"],
            **{name: buffers[name] for name in ("random", "broken", "last_actions", "earlier_actions")},
            **self._control.state_tensors(),
        }
        if self.adapting:
            tensors["adaptive_numbers"] = self.adapting.state
        for name, sensor in self.sensors.items():
            tensors |= {f"sensor_{name}_{key}": tensor for key, tensor in sensor.state_tensors().items()}
        for part in (self.worlds.ground, self.worlds.drives, self.randomizations):
            tensors |= part.state_tensors() if part else {}
        return tensors
