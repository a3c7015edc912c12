"""rsl-rl's own runner on one of our tasks: the alternative to Muster's learner, on the same simulation."""

from __future__ import annotations

import contextlib
import io
import time
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner

from worker.learning.rsl.vector_environment import TaskVecEnv
from worker.settings.ppo import PPOConfig
from worker.tasks.run.task import Task


def stock_config(task: Task, ppo: PPOConfig) -> dict[str, Any]:
    """rsl-rl's own keys for the hyperparameters of ``ppo``."""
    network: dict[str, Any] = {
        "class_name": "MLPModel",
        "hidden_dims": list(ppo.hidden_sizes),
        "activation": ppo.activation,
        "obs_normalization": ppo.normalize_observations,
    }
    images = len(task.observation_shape) > 1
    if images:
        layers: dict[str, Any] = {"output_channels": list(ppo.channels), "kernel_size": list(ppo.kernel_sizes)}
        layers |= {"stride": list(ppo.strides), "activation": ppo.activation}
        network |= {"class_name": "CNNModel", "cnn_cfg": layers}
    return {
        "num_steps_per_env": ppo.steps,
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


def stock_runner(task: Task, ppo: PPOConfig, log_dir: str | None = None, **changes: Any) -> OnPolicyRunner:
    """rsl-rl's runner with the hyperparameters of ``ppo``; it writes nothing without a ``log_dir``."""
    config = stock_config(task, ppo) | {"save_interval": 10**9} | changes
    with contextlib.redirect_stdout(io.StringIO()):
        return OnPolicyRunner(TaskVecEnv(task), config, log_dir, task.device)


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def stock_seconds(runner: OnPolicyRunner, iterations: int, warm: int = 5) -> float:
    """Seconds per iteration, after ``warm`` iterations."""
    with contextlib.redirect_stdout(io.StringIO()):
        runner.learn(warm)
        _wait()
        started = time.perf_counter()
        runner.learn(iterations)
        _wait()
    return (time.perf_counter() - started) / iterations
