"""SAC learns: the point task and Cartpole alone, and the point task on two real ranks."""

from __future__ import annotations

import hashlib
import json
import os
from typing import Any

import torch

from tests.support.worker.loop import iterate, mean_return, setting_of
from tests.support.worker.point_task import Point, PointConfig
from tests.support.worker.ranks import run_ranks
from worker.distributed import Placement, connect
from worker.learning.algorithm import Share
from worker.learning.sac.sac import SAC
from worker.learning.sac.settings import SACConfig

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
POINT = SACConfig(**FOR_A_PROCESSOR, gamma=0.9, v_min=-10.0, v_max=10.0)
CARTPOLE = SACConfig(**FOR_A_PROCESSOR, gamma=0.97, v_min=-5.0, v_max=5.0)


def test_it_learns_the_point_task() -> None:
    """320 steps of 32 worlds, 10 240 in all; a point that a well-tuned law brings to the middle gets 18.7, one left alone −1.1."""
    torch.manual_seed(0)
    task, held_out = Point(PointConfig(), 32, seed=0), Point(PointConfig(), 64, seed=99)
    sac = SAC(POINT, setting_of(task))
    assert mean_return(sac.policy(), held_out) < 6.0
    iterate(sac, task, 0, 80)
    assert mean_return(sac.policy(), held_out) > 16.5


def test_it_learns_cartpole() -> None:
    """960 steps of 64 worlds, 61 440 in all; the greatest return that there could be is 30."""
    # the ranks below, which import this module too, can do without the simulation
    from worker.tasks.cartpole import Cartpole, CartpoleConfig

    torch.manual_seed(0)
    task, held_out = Cartpole(CartpoleConfig(), 64, seed=0), Cartpole(CartpoleConfig(), 64, seed=99)
    task.set_random_episode_length()
    sac = SAC(CARTPOLE, setting_of(task))
    assert mean_return(sac.policy(), held_out) < 10.0
    metrics = iterate(sac, task, 0, 240)
    assert mean_return(sac.policy(), held_out) > 27.0
    assert 1.5 < float(metrics["q_mean"]) < 3.5, "about 0.1 / (1 − γ)"


def test_two_ranks_learn_the_same_weights() -> None:
    first, second = run_ranks("long.learning.test_sac_learns:a_rank", 2, timeout=300.0)
    assert first[0] == second[0] == 0, first[2] + second[2]
    told = [json.loads(output.strip().splitlines()[-1]) for _, output, _ in (first, second)]
    assert told[0]["weights"] == told[1]["weights"], "the ranks' learners hold the same bits"
    assert told[0]["metrics"] == told[1]["metrics"]
    assert told[0]["replay"] != told[1]["replay"], "each rank has the steps of its own worlds"
    assert told[0]["return"] > 10.0


def a_rank() -> int:
    """One of several ranks that learn the point task with 16 worlds each; what became of it is the last line of its output."""
    gang = connect(Placement.from_env(os.environ))
    torch.manual_seed(gang.rank)  # weights start equal all the same
    share = Share.of(gang.rank, gang.size, 16 * gang.size)
    task = Point(PointConfig(), share.count, seed=0, first_world=share.first)
    sac = SAC(POINT, setting_of(task, gang=gang, share=share))
    metrics = iterate(sac, task, 0, 40)
    told = {
        "weights": digest(sac.state_dict()),
        "replay": digest(sac.world_state()),
        "metrics": {name: float(value) for name, value in metrics.items()},
        "return": mean_return(sac.policy(), Point(PointConfig(), 64, seed=99)),
    }
    print(json.dumps(told), flush=True)
    gang.close()
    return 0


def digest(state: Any) -> str:
    """Of all the tensors and values in a nested state."""
    if isinstance(state, torch.Tensor):
        return hashlib.sha256(state.contiguous().numpy().tobytes()).hexdigest()
    if isinstance(state, dict):
        return digest([digest([name, value]) for name, value in state.items()])
    if isinstance(state, list | tuple):
        return hashlib.sha256("".join(map(digest, state)).encode()).hexdigest()
    return hashlib.sha256(repr(state).encode()).hexdigest()
