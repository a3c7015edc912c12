"""A task: many worlds of one robot, with its actions, observations, reward terms and resets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, ClassVar, Self

import newton
import torch
import warp as wp
from newton.solvers import SolverMuJoCo

from worker.settings.task import TaskConfig, default_rewards, value_at
from worker.simulation.capture import CapturedStep, on_torch_stream
from worker.simulation.episodes import (
    NO_MISHAP,
    RESET,
    STEP,
    WATCHED,
    EpisodeArrays,
    check_observations,
    mishap_causes,
    randomize_ages,
    read_mishap,
)
from worker.simulation.randomization import Randomizer
from worker.simulation.terrain import Terrain
from worker.simulation.world_cameras import WorldCameras
from worker.simulation.worlds import Worlds
from worker.tasks.declare.interface import Interface
from worker.tasks.run.adapting import Adapting
from worker.tasks.run.episode_records import LastEpisodes
from worker.tasks.run.saved import check_state, completed
from worker.tasks.run.task_checks import assert_replays, check_arguments, noise_of
from worker.tasks.run.task_report import Telling


class Task(Telling):
    """A vector of Newton worlds that act, observe, are rewarded and reset themselves on the device.

    A subclass names its configuration, terms and kernels and builds one world; this class does the rest. Every tensor
    below is a fixed buffer on ``device``, shared with Warp; its address never changes.

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
        observations: The policy's input, shape ``(worlds, *observation_shape)``: float32, or uint8 with a camera.
        states: The output of ``observe``, named by ``observation_names``, shape ``(worlds, states)``, float32; without a camera,
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
        mishap: A world that failed and was reset since :meth:`clear_statistics`, and the cause: see :meth:`read_mishap`; shape
            ``(1,)``, int32.
        ended: The last finished episode of each world, see :class:`worker.tasks.run.episode_records.LastEpisodes`.
        randomizer: How the worlds differ, see :class:`worker.simulation.randomization.Randomizer`.
        captured: Whether :meth:`step` replays a graph; true after construction, which captures one on trial.
    """

    config_type: ClassVar[type[TaskConfig]]
    """Type of the configuration."""
    parameters_type: ClassVar[Any]
    """Warp struct for the kernels; its fields are filled from the configuration's fields of the same names.

    A pair of numbers becomes a ``wp.vec2``."""
    reward_terms: tuple[str, ...]
    """Names of the reward terms, in the order of the configuration's ``rewards`` and of the kernel's indices; on the class, the default ones."""
    observation_names: tuple[str, ...]
    """Name of each observation, in order."""
    further_names: tuple[str, ...] = ()
    """Name of each column of the further observation groups, such as ``critic.speed``; of declared tasks."""
    action_names: tuple[str, ...]
    """Name of each action, in order (the joint that it drives); of a task with discrete actions, of each choice."""
    discrete: bool = False
    """Whether an action is one of several choices: its number, from 0, is then ``episodes.actions[world, 0]``."""
    act: ClassVar[wp.Kernel]
    """Kernel ``(parameters, worlds, episodes)`` over worlds: from ``episodes.actions`` to ``worlds.controls``."""
    observe: ClassVar[wp.Kernel]
    """Kernel ``(mode, max_age, parameters, worlds, episodes)`` over worlds; see :mod:`worker.simulation.episodes`."""
    ground: ClassVar[bool] = False
    """Whether the worlds stand on a ground plane."""
    metric_names: tuple[str, ...] = ()
    """Names of the metrics, which are logged besides the rewards as means over the steps; of declared tasks."""
    termination_names: tuple[str, ...] = ()
    """Names of the terminations, which are counted; of declared tasks."""
    success: str | None = None
    """The metric or termination that makes an evaluated episode a success; None: an episode that only the clock ended is one."""
    memory_size: int = 0
    """Numbers per world in ``episodes.memory``, such as commands; they are part of the state."""
    lasting_size: int = 0
    """Numbers that survive episodes, in ``episodes.lasting``."""
    solver_options: Mapping[str, Any] = {}
    """Options of ``newton.solvers.SolverMuJoCo``."""
    template: newton.ModelBuilder  # of a sketch
    adapting: Adapting | None = None
    _exact: tuple[wp.array[Any], wp.array[Any]] | None = None

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if hasattr(cls, "config_type"):
            cls.reward_terms = tuple(default_rewards(cls.config_type))

    def __init__(
        self, config: TaskConfig, world_count: int, *, seed: int = 0, first_world: int = 0, device: str = "cpu"
    ) -> None:
        check_arguments(type(self), config, world_count, seed, first_world)
        self.config = config
        self.reward_terms = tuple(config.rewards)
        self.world_count = world_count
        self.device = "cuda:0" if device == "cuda" else device
        self.max_episode_length = max(1, round(config.episode_seconds * config.control_hz))
        self.first_world = first_world
        template = self._template()
        self.action_size = len(self.action_names)
        self.observation_shape: tuple[int, ...] = (len(self.observation_names),)
        self.statistic_names: tuple[str, ...] = (
            *("episodes", "episode_return", "episode_length"),
            *(*(f"reward_{name}" for name in self.reward_terms), *self.metric_names),
            *("nan_worlds", "solver_overflows", "squared_return"),
            *self.termination_names,
        )
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
        noise = self._noise()
        wp.synchronize_device(self.device)

        self.seed(seed)
        camera = getattr(config, "camera", None)
        with on_torch_stream(self.device):
            self.randomizer = Randomizer(config.randomize, self.worlds, self._episodes, config.control_hz, noise)
            self._camera = WorldCameras(camera, config.randomize, self.worlds, self._episodes) if camera else None
            if self._camera:
                self.observations = self._camera.images
                self.observation_shape = tuple(self.observations.shape[1:])
            self.groups, self.terminal_groups = self._group()
            self._begin()
            for _, part in self._parts():  # Load every kernel; not every platform can load one during a capture.
                part()
        self._looks: dict[str, Callable[[], None] | None] = {}
        self._steps = [CapturedStep(part, self.device).launch if whole else part for whole, part in self._parts()]
        self.captured = assert_replays(self, self._steps)
        self.restart(seed, first_world)

    @classmethod
    def sketch(cls, config: TaskConfig) -> Self:
        """The task without worlds: names, one world (``template``), a declared task's :attr:`plan`. Raises ValueError for a wrong one."""
        task = cls.__new__(cls)
        task.config = config
        task.reward_terms = tuple(config.rewards)
        task.template = task._template()
        return task

    def _template(self) -> newton.ModelBuilder:
        template = newton.ModelBuilder()
        SolverMuJoCo.register_custom_attributes(template)
        self.build(template)
        return template

    def build(self, builder: newton.ModelBuilder) -> None:
        """Add one world to an empty builder; MuJoCo's custom attributes are already registered."""
        raise NotImplementedError

    def stands_on(self) -> bool | Terrain:
        """The terrain, or whether the worlds stand on a plane."""
        return self.ground

    def read_model(self, parameters: Any) -> None:
        """Fill the kernel parameters that depend on the built model (``self.worlds``); there are none by default."""

    def interface(self) -> Interface | None:
        """The meaning of the policy's numbers on a robot, in the order of ``observation_names`` and ``action_names``; None: not declared.

        It is exported with the policy. It also says which observations are measured; only these get noise.
        """
        return None

    def begin_iteration(self, iteration: int, reward: float | None, episode_length: float | None) -> None:
        """Called before every training iteration, outside the CUDA graph: the place for a curriculum.

        By default it sets the numbers that ``config.curriculum`` names. A subclass may also fill device arrays that its kernels
        read. The result must depend on the arguments alone, which are the same on every rank and after a restart.

        Args:
            iteration: Number of finished iterations.
            reward: Mean return of the episodes that ended last; None before the first.
            episode_length: Their mean length [steps].
        """
        for name, points in self.config.curriculum.items():
            self._number(name).fill_(value_at(points, iteration))

    def _number(self, name: str) -> torch.Tensor:
        """The number that a curriculum changes under this name."""
        return self.level if name == "level" else self._weights[self.reward_terms.index(name)]

    def step(self, actions: torch.Tensor) -> None:
        """Act, simulate one control step, reward, and reset the worlds whose episode ended; nothing waits for the host.

        Args:
            actions: Copied into :attr:`actions`; of its shape and type.
        """
        self.actions.copy_(actions)
        for launch in self._steps:
            launch()

    def watch(self, look: Callable[[], None] | None, by: str = "tap") -> None:
        """Call ``look`` after every control step, instead of an earlier one ``by`` the same name; None: call nothing.

        It launches kernels alone, which it has run once and which write nothing that the task reads. Graphs of :meth:`step` are captured anew.
        """
        self._looks[by] = None if look is None else CapturedStep(look, self.device).launch
        self._steps[len(self._parts()) :] = filter(None, self._looks.values())

    def reset(self) -> None:
        """Begin a new episode with new random numbers in every world."""
        with on_torch_stream(self.device):
            self._launch_observe(RESET)

    def restart(self, seed: int, first_world: int) -> None:
        """Turn the worlds into those of another seed or global index, as if they had just been built.

        The physics and the scene that ``config.randomize`` drew for each world stay as they are (``config.randomize.draws_worlds``).

        Args:
            seed: Any integer >= 0.
            first_world: Global index of world 0.
        """
        self.first_world = first_world
        with on_torch_stream(self.device):
            self.worlds.restore_defaults()
            self._lasting.zero_()
            self.seed(seed)
            self._begin()
        self.clear_statistics()
        self.reset()

    def seed(self, seed: int) -> None:
        """Restart all random streams from another seed; the worlds change at their next reset.

        The physics that ``randomize`` drew at construction stays.

        Args:
            seed: Any integer >= 0.

        Raises:
            ValueError: ``seed`` is negative.
        """
        if seed < 0:
            raise ValueError(f"seed is {seed}; use an integer >= 0")
        folded = (seed ^ (seed >> 32)) & 0xFFFFFFFF
        self._random[:, 0] = folded - (1 << 32) if folded >= 1 << 31 else folded
        self._random[:, 1] = torch.arange(self.first_world, self.first_world + self.world_count, dtype=torch.int32)
        self._random[:, 2] = 0

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
        self.mishap.fill_(int(NO_MISHAP))

    def read_mishap(self, code: int) -> tuple[int, str] | None:
        """Decode a value of :attr:`mishap`: the index of the failed world in this task and the cause; None: no world failed."""
        return None if code == NO_MISHAP else read_mishap(code, self._causes)

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
            ValueError: A tensor is missing, unknown, or of another shape or type, or the worlds' physics was drawn
                differently; nothing has changed.
        """
        tensors = self.state_tensors()
        # older states lack tensors that begin an episode at 0
        state = completed(tensors, state, len(self.metric_names))
        check_state(f"the saved state of task {type(self).__name__}", tensors, state)
        for name, tensor in tensors.items():
            tensor.copy_(state[name])

    def _noise(self) -> list[float]:
        """Standard deviation of the noise on each observation. Raises ValueError for an interface or a noise that does not fit."""
        return noise_of(self)

    def _allocate(self) -> None:
        """Allocate every buffer once, as views that torch and Warp share."""
        count, device = self.world_count, self.device

        def buffer(name: str, shape: tuple[int, ...], dtype: Any) -> torch.Tensor:
            array = wp.zeros(shape, dtype=dtype, device=device)
            setattr(self._episodes, name, array)
            shared: torch.Tensor = wp.to_torch(array)
            return shared

        self._episodes = EpisodeArrays()
        self._episodes.warm_start = self.worlds.arrays.warm_start
        self._episodes.activations = self.worlds.arrays.activations
        self.actions = buffer("actions", (count, 1 if self.discrete else self.action_size), wp.float32)
        states = len(self.observation_names)
        self.states = self.observations = buffer("observations", (count, states), wp.float32)
        self.terminal_observations = buffer("terminal_observations", (count, states), wp.float32)
        self.rewards = buffer("rewards", (count,), wp.float32)
        self.dones = buffer("dones", (count,), wp.bool)
        self.time_outs = buffer("time_outs", (count,), wp.bool)
        self.episode_length = buffer("ages", (count,), wp.int32)
        self._sums = buffer("sums", (count, 2 + len(self.reward_terms) + len(self.metric_names)), wp.float32)
        self._random = buffer("random", (count, 3), wp.int32)
        buffer("terms", (min(WATCHED, count), len(self.reward_terms)), wp.float32)
        self._memory = buffer("memory", (count, self.memory_size), wp.float32)
        self._lasting = buffer("lasting", (count, self.lasting_size), wp.float32)
        self._last_actions = buffer("last_actions", tuple(self.actions.shape), wp.float32)
        self._earlier_actions = buffer("earlier_actions", tuple(self.actions.shape), wp.float32)
        self._broken = buffer("broken", (count,), wp.int32)
        self.mishap = buffer("mishap", (1,), wp.int32)
        self._causes = mishap_causes(self.reward_terms, (*self.observation_names, *self.further_names))
        self._episodes.causes_of_mishaps = len(self._causes)
        self._weights = buffer("weights", (len(self.reward_terms),), wp.float32)
        self._weights.copy_(torch.tensor(list(self.config.rewards.values())))
        self.level = buffer("level", (1,), wp.float32)
        self.level.fill_(1.0)
        self.statistics = buffer("statistics", (len(self.statistic_names),), wp.float64)
        self.ended = LastEpisodes.of(self, buffer)

    def _group(self) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
        """The observation groups, and those before the reset. The critic's have buffers of their own only where there is noise."""
        if self.randomizer.has_noise:
            self._exact = (
                wp.zeros_like(self._episodes.observations),
                wp.zeros_like(self._episodes.terminal_observations),
            )
            known, ended = map(wp.to_torch, self._exact)
        else:
            known, ended = self.states, self.terminal_observations
        seen = {"policy": self.observations, "critic": known}
        before = {"critic": ended} if self._camera else {"policy": self.terminal_observations, "critic": ended}
        return seen, before

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """Views of all state that persists between control steps."""
        arrays = self.worlds.arrays
        own = {"memory": self._memory, "activations": wp.to_torch(arrays.activations)}
        return {
            **{name: tensor for name, tensor in own.items() if tensor.numel()},
            **({"images": self._camera.images} if self._camera else {}),
            **self.randomizer.state_tensors(),
            "joint_q": wp.to_torch(arrays.joint_q),
            "joint_qd": wp.to_torch(arrays.joint_qd),
            "solver_warm_start": wp.to_torch(arrays.warm_start),
            "observations": self.states,
            **({"exact_observations": wp.to_torch(self._exact[0])} if self._exact else {}),
            "episode_length": self.episode_length,
            "episode_sums": self._sums,
            "random": self._random,
            "broken": self._broken,
        }

    def _prepare(self) -> None:
        """Prepare the kernels' inputs other than the worlds and episodes."""
        self._parameters = self.parameters_type()
        for item in fields(self.config):
            if hasattr(self._parameters, item.name):
                value = getattr(self.config, item.name)
                setattr(self._parameters, item.name, wp.vec2(*value) if isinstance(value, tuple) else value)
        self.read_model(self._parameters)

    def _begin(self) -> None:
        """Initialise each world once: called after the random streams are seeded, and again after the trial step."""

    def _parts(self) -> list[tuple[bool, Callable[[], None]]]:
        """The parts of the control step, in order, and whether a graph holds each."""
        return [(True, self._launch_step)]

    def _launch_step(self) -> None:
        """Launch the whole control step."""
        self.randomizer.push()
        wp.launch(
            self.act,
            dim=self.world_count,
            inputs=[self._parameters, self.worlds.arrays, self._episodes],
            device=self.device,
        )
        self.randomizer.delay()
        self.worlds.simulate()
        self._launch_observe(STEP)

    def _launch_observe(self, mode: int) -> None:
        wp.launch(
            self.observe,
            dim=self.world_count,
            inputs=[int(mode), self.max_episode_length, self._parameters, self.worlds.arrays, self._episodes],
            device=self.device,
        )
        wp.launch(check_observations, dim=self.world_count, inputs=[self._episodes], device=self.device)
        if self._exact:
            wp.copy(self._exact[0], self._episodes.observations)
            wp.copy(self._exact[1], self._episodes.terminal_observations)
        self.randomizer.add_noise(int(mode))
        if self._camera:
            self._camera.render(int(mode))
