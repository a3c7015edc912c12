"""The latency of controls, drawn for each episode."""

from __future__ import annotations

import torch
import warp as wp

from worker.simulation.episodes import STEPS, EpisodeArrays, random_stream
from worker.simulation.worlds import WorldArrays, Worlds

wp.set_module_options({"enable_backward": False})


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


class Latency:
    """Delays the controls of many worlds.

    Args:
        greatest: Greatest latency [control steps], 1 or more; each episode draws its own, from 0.
        worlds: The worlds.
        episodes: Their buffers.
    """

    def __init__(self, greatest: int, worlds: Worlds, episodes: EpisodeArrays) -> None:
        self._greatest, self._worlds, self._episodes = greatest, worlds, episodes
        count, actuators = worlds.arrays.controls.shape
        device = worlds.model.device
        self._delays = wp.zeros(count, dtype=wp.int32, device=device)
        self._history = wp.zeros((count, (greatest + 1) * actuators), dtype=wp.float32, device=device)

    def delay(self) -> None:
        """Delay the controls, after the actions wrote them."""
        inputs = [self._greatest, self._worlds.arrays, self._episodes, self._delays, self._history]
        wp.launch(_delay, dim=self._worlds.world_count, inputs=inputs, device=self._worlds.model.device)

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """Live views of the state kept between control steps, each with leading dimension ``worlds``."""
        return {"control_delays": wp.to_torch(self._delays), "control_history": wp.to_torch(self._history)}
