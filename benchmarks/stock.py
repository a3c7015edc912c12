"""rsl-rl's own runner on a task of ours: what a user would have without Muster's learner, on the same simulation."""

from __future__ import annotations

import contextlib
import io
import time
from typing import Any

import torch
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from worker.learning.ppo.settings import PPOConfig
from worker.tasks.task import Task


class StockEnv(VecEnv):
    """A task as rsl-rl wants it. Its simulation step stays the captured one."""

    def __init__(self, task: Task) -> None:
        self.task, self.cfg = task, {}
        self.num_envs, self.num_actions, self.device = task.world_count, task.action_size, task.device
        self.max_episode_length, self.episode_length_buf = task.max_episode_length, task.episode_length

    def get_observations(self) -> TensorDict:
        # a copy: rsl-rl keeps what it was given until after the next step. Its convolutions take floats.
        seen = self.task.observations
        seen = seen.float() / 255.0 - 0.5 if seen.dtype == torch.uint8 else seen.clone()
        return TensorDict({"policy": seen}, [self.num_envs], device=self.device)

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        self.task.step(actions)
        extras = {"time_outs": self.task.time_outs.float()}
        return self.get_observations(), self.task.rewards.clone(), self.task.dones.long(), extras


def stock_runner(task: Task, ppo: PPOConfig) -> OnPolicyRunner:
    """rsl-rl's runner with the hyperparameters of ``ppo``; it writes nothing."""
    network: dict[str, Any] = {
        "class_name": "MLPModel",
        "hidden_dims": list(ppo.hidden_sizes),
        "activation": ppo.activation,
        "obs_normalization": ppo.normalize_observations,
    }
    images = len(task.observation_shape) > 1
    if images:
        layers = {"output_channels": list(ppo.channels), "kernel_size": list(ppo.kernel_sizes)}
        layers |= {"stride": list(ppo.strides), "activation": ppo.activation}
        network |= {"class_name": "CNNModel", "cnn_cfg": layers}
    config = {
        "num_steps_per_env": ppo.steps,
        "save_interval": 10**9,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": {**network, "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": ppo.init_std}},
        "critic": dict(network),
        "algorithm": {
            "class_name": "PPO",
            **({"share_cnn_encoders": True} if images else {}),
            "num_learning_epochs": ppo.epochs,
            "num_mini_batches": ppo.minibatches,
            "clip_param": ppo.clip,
            "gamma": ppo.gamma,
            "lam": ppo.lam,
            "value_loss_coef": ppo.value_loss_coef,
            "entropy_coef": ppo.entropy_coef,
            "learning_rate": ppo.learning_rate,
            "max_grad_norm": ppo.max_grad_norm,
            "schedule": ppo.schedule,
            "desired_kl": ppo.desired_kl,
        },
    }
    with contextlib.redirect_stdout(io.StringIO()):
        return OnPolicyRunner(StockEnv(task), config, None, task.device)


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def stock_seconds(runner: OnPolicyRunner, iterations: int, warm: int = 5) -> float:
    """Seconds an iteration, after ``warm`` ones."""
    with contextlib.redirect_stdout(io.StringIO()):
        runner.learn(warm)
        _wait()
        started = time.perf_counter()
        runner.learn(iterations)
        _wait()
    return (time.perf_counter() - started) / iterations
