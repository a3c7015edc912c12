"""SAC learns Cartpole."""

from __future__ import annotations

from typing import Any

import torch

from tests.support.worker.loop import iterate, mean_return, setting_of
from worker.learning.sac.sac import SAC
from worker.settings.sac import SACConfig

torch.set_num_threads(1)

FOR_A_PROCESSOR: dict[str, Any] = {
    "steps": 4,
    "updates": 8,
    "batch_size": 256,
    "replay_steps": 500,
    "actor_sizes": (64, 64),
    "critic_sizes": (64, 64),
    "atoms": 51,
    "actor_learning_rate": 1e-3,
    "critic_learning_rate": 1e-3,
    "temperature_learning_rate": 1e-2,
    "init_temperature": 0.01,
}
CARTPOLE = SACConfig(**FOR_A_PROCESSOR, gamma=0.97, v_min=-5.0, v_max=5.0)


def test_it_learns_cartpole() -> None:
    """960 steps of 64 worlds, 61 440 in all; the greatest return that there could be is 30."""
    # the ranks below, which import this module too, can do without the simulation
    from worker.tasks.library.cartpole import Cartpole, CartpoleConfig

    torch.manual_seed(0)
    task, held_out = Cartpole(CartpoleConfig(), 64, seed=0), Cartpole(CartpoleConfig(), 64, seed=99)
    task.set_random_episode_length()
    sac = SAC(CARTPOLE, setting_of(task))
    assert mean_return(sac.policy(), held_out) < 10.0
    metrics = iterate(sac, task, 0, 240)
    assert mean_return(sac.policy(), held_out) > 27.0
    assert 1.5 < float(metrics["q_mean"]) < 3.5, "about 0.1 / (1 − γ)"
