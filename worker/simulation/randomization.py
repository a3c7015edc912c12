"""Domain randomisation for any task: physics that differs between worlds, pushes, noise and delayed actions.

Each world's properties are drawn once, from only the seed and the world's global index. Later events come from its own random stream, so
a run resumes bit for bit and its worlds are the same on any number of ranks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import newton
import torch
import warp as wp

from worker.settings.task import FACTORS
from worker.simulation.episodes import STEP, STEPS, EpisodeArrays, numbered_stream, random_stream
from worker.simulation.worlds import WorldArrays, Worlds

if TYPE_CHECKING:
    from worker.settings.task import Randomization

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _draw_factors(episodes: EpisodeArrays, ends: wp.array[wp.vec2], factors: wp.array2d[wp.float32]):
    """Uniform factors of one world. Each has a stream of its own: what one is does not depend on what else is drawn."""
    world, factor = wp.tid()
    stream = numbered_stream(episodes, world, -1 - factor)
    factors[world, factor] = wp.randf(stream, ends[factor][0], ends[factor][1])


@wp.kernel
def _push(probability: float, velocity: float, worlds: WorldArrays, episodes: EpisodeArrays):
    """Now and then, change a world's first body's horizontal velocity at once."""
    world = wp.tid()
    stream = random_stream(episodes, world)
    if wp.randf(stream) < probability:
        for axis in range(2):
            change = episodes.level[0] * velocity * wp.randf(stream, -1.0, 1.0)
            worlds.joint_qd[world, axis] = worlds.joint_qd[world, axis] + change


@wp.kernel
def _delay(
    latency: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    delays: wp.array[wp.int32],
    history: wp.array2d[wp.float32],
):
    """Give the actuators the controls of some steps ago; until there are such, the first ones of the episode."""
    world = wp.tid()
    actuators = worlds.controls.shape[1]
    first_step = episodes.sums[world, STEPS] == 0.0
    if first_step:
        delays[world] = wp.randi(random_stream(episodes, world), 0, latency + 1)
    for actuator in range(actuators):
        control = worlds.controls[world, actuator]
        for back in range(latency):
            slot = (latency - back) * actuators + actuator
            if first_step:
                history[world, slot] = control
            else:
                history[world, slot] = history[world, slot - actuators]
        history[world, actuator] = control
        worlds.controls[world, actuator] = history[world, delays[world] * actuators + actuator]


@wp.func
def _blur(
    observations: wp.array2d[wp.float32], deviations: wp.array[wp.float32], world: int, stream: wp.uint32
) -> wp.uint32:
    """Add normal noise to the observations of one world that have any; returns the generator as it is afterwards."""
    for column in range(observations.shape[1]):
        if deviations[column] > 0.0:
            observations[world, column] = observations[world, column] + deviations[column] * wp.randn(stream)
    return stream


@wp.kernel
def _add_noise(mode: int, deviations: wp.array[wp.float32], episodes: EpisodeArrays):
    """Normal noise on what the policy sees, and on the last observation of an episode that ended."""
    world = wp.tid()
    stream = _blur(episodes.observations, deviations, world, random_stream(episodes, world))
    if mode == STEP and episodes.dones[world]:
        stream = _blur(episodes.terminal_observations, deviations, world, stream)


class Randomizer:
    """Differences between the worlds of one task. Disabled features cost nothing and draw no random numbers.

    Args:
        config: Enabled features and their magnitudes.
        worlds: The task's worlds. The constructor changes their model, so it must run before a capture.
        episodes: The task's buffers; ``random`` holds seed and global indices already.
        control_hz: Control steps per simulated second [Hz].
        noise: Standard deviation of the noise on each observation, as the policy sees it.

    Raises:
        ValueError: Pushes are enabled and the first body of the worlds has no free joint.

    Attributes:
        factors: Factors on the physics of each world, columns as in :data:`FACTORS`, shape ``(worlds, 5)``, float32; 1 where not
            randomised.
    """

    def __init__(
        self,
        config: Randomization,
        worlds: Worlds,
        episodes: EpisodeArrays,
        control_hz: float,
        noise: Sequence[float],
    ) -> None:
        self._config, self._worlds, self._episodes = config, worlds, episodes
        self._device = worlds.model.device
        if config.push_velocity and worlds.model.joint_type.numpy()[0] != int(newton.JointType.FREE):
            raise ValueError("randomize.push_velocity: the robot is fixed to the world, so it can't be pushed")
        self._push_probability = min(1.0, 1.0 / (config.push_interval * control_hz)) if config.push_interval else 0.0
        count, actuators = worlds.arrays.controls.shape
        self._delays = wp.zeros(count, dtype=wp.int32, device=self._device)
        self._noise = wp.array(list(noise), dtype=wp.float32, device=self._device) if any(noise) else None
        slots = config.action_latency + 1 if config.action_latency else 0
        self._history = wp.zeros((count, slots * actuators), dtype=wp.float32, device=self._device)
        factors = wp.ones((count, len(FACTORS)), dtype=wp.float32, device=self._device)
        self.factors = wp.to_torch(factors)
        self._drawn = {
            name: column
            for name, column in zip(FACTORS, self.factors.unbind(1), strict=True)
            if getattr(config, name) != (1.0, 1.0)
        }
        if self._drawn:
            ends = wp.array([getattr(config, name) for name in FACTORS], dtype=wp.vec2, device=self._device)
            wp.launch(_draw_factors, dim=factors.shape, inputs=[episodes, ends], outputs=[factors], device=self._device)
        self._apply()

    @property
    def has_noise(self) -> bool:
        """Whether any observation of the policy has noise."""
        return self._noise is not None

    def push(self) -> None:
        """Before a control step: apply pushes to some worlds."""
        if self._push_probability:
            inputs = [self._push_probability, self._config.push_velocity, self._worlds.arrays, self._episodes]
            wp.launch(_push, dim=self._worlds.world_count, inputs=inputs, device=self._device)

    def delay(self) -> None:
        """After ``act``: delay the controls."""
        if self._config.action_latency:
            inputs = [self._config.action_latency, self._worlds.arrays, self._episodes, self._delays, self._history]
            wp.launch(_delay, dim=self._worlds.world_count, inputs=inputs, device=self._device)

    def add_noise(self, mode: int) -> None:
        """After ``observe`` in ``mode``: add noise to the policy's observations."""
        if self._noise is not None:
            inputs = [mode, self._noise, self._episodes]
            wp.launch(_add_noise, dim=self._worlds.world_count, inputs=inputs, device=self._device)

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """Live views of the state kept between control steps, each with leading dimension ``worlds``.

        ``world_factors`` serves for comparison only: the model was changed before it was captured.
        """
        tensors = {"world_factors": self.factors} if self._drawn else {}
        if self._config.action_latency:
            tensors |= {"control_delays": wp.to_torch(self._delays), "control_history": wp.to_torch(self._history)}
        return tensors

    def _apply(self) -> None:
        """Scale the physics of every world."""
        model, solver, drawn = self._worlds.model, self._worlds.solver, self._drawn

        def scale(array: wp.array[Any], factor: torch.Tensor) -> None:
            rows = wp.to_torch(array).view(len(factor), -1)
            rows.mul_(factor[:, None])

        def tell(changed: newton.ModelFlags) -> None:
            # Torch wrote, and the solver reads, perhaps on another stream: synchronise.
            wp.synchronize_device(self._device)
            solver.notify_model_changed(changed)
            wp.synchronize_device(self._device)

        if "mass" in drawn:
            scale(model.body_mass, drawn["mass"])
            scale(model.body_inertia, drawn["mass"])
            scale(model.body_inv_mass, 1.0 / drawn["mass"])
            scale(model.body_inv_inertia, 1.0 / drawn["mass"])
            tell(newton.ModelFlags.BODY_INERTIAL_PROPERTIES)
        if "damping" in drawn:
            scale(model.joint_damping, drawn["damping"])
            tell(newton.ModelFlags.JOINT_DOF_FORCE_PROPERTIES)
        if "gravity" in drawn:
            # the last row belongs to no world
            scale(model.gravity[: self._worlds.world_count], drawn["gravity"])
            tell(newton.ModelFlags.MODEL_PROPERTIES)
        # Newton has one ground for all worlds, the solver one per world. The greater friction of two touching surfaces wins, so the
        # ground must be as slippery as the feet.
        if "friction" in drawn:
            scale(solver.mjw_model.geom_friction, drawn["friction"])
        # A motor's force is gain x control, a servo's gain x target plus bias x (1, angle, velocity).
        if "gains" in drawn:
            scale(solver.mjw_model.actuator_gainprm, drawn["gains"])
            scale(solver.mjw_model.actuator_biasprm, drawn["gains"])
