"""One training of mjlab by its own script, in its own environment: ``python train_mjlab.py JSON``; ``benchmarks.peers.mjlab`` calls it.

The JSON has ``task``, ``worlds``, ``iterations``, ``steps``, ``hidden_sizes``, ``limits``, ``save_every``, ``seed``, ``logs``, ``out``
and ``began``. Only those numbers and the logger are changed; the logger is TensorBoard instead of a network service.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
from typing import Any

from clock import Clock, device_facts, versions


def contract(environment: Any) -> dict[str, Any]:
    """Meaning of the policy's numbers: its observations, and each action's joint, scale [rad] and offset [rad]."""
    from mjlab.rl.exporter_utils import get_base_metadata

    known: dict[str, Any] = get_base_metadata(environment, "-")
    action = environment.action_manager.get_term("joint_pos")
    widths = [shape[0] for shape in environment.observation_manager.group_obs_term_dim["actor"]]
    return {
        "observations": dict(zip(known["observation_names"], widths, strict=True)),
        "observation_scales": known["observation_terms_scale"],
        "joints": known["joint_names"],
        "positions": known["default_joint_pos"],
        "actions": list(action.target_names),
        "action_scale": known["action_scale"],
        "stiffness": known["joint_stiffness"],
        "damping": known["joint_damping"],
    }


def probe(runner: Any, least: int = 8) -> dict[str, Any]:
    """Actions of mjlab's own policy for some observations after the last iteration, to compare with converted weights."""
    import torch

    seen = runner.env.get_observations().to(runner.device)[:least]
    with torch.inference_mode():
        actions = runner.get_inference_policy()(seen)
    return {"observations": seen["actor"].tolist(), "actions": actions.tolist()}


def main() -> None:
    requested: dict[str, Any] = json.loads(sys.argv[1])
    os.environ.setdefault("WANDB_MODE", "disabled")
    import mjlab.tasks  # noqa: F401 - fills the registry
    import torch
    from mjlab.scripts.train import TrainConfig, launch_training
    from mjlab.tasks.registry import list_tasks

    if requested["task"] not in list_tasks():
        raise SystemExit(f"mjlab has no task {requested['task']}; it has {', '.join(list_tasks())}")
    device, wait = device_facts()
    clock = Clock(requested["began"], requested["worlds"], requested["steps"], wait)
    clock.install()
    training = TrainConfig.from_task(requested["task"])
    environment = training.env
    agent: Any = training.agent  # of the runner that has an actor and a critic, which the common base lacks
    environment.scene.num_envs = requested["worlds"]
    physics = environment.sim.mujoco
    for name, value in requested["limits"].items():
        setattr(physics, name, value)
    agent.max_iterations, agent.num_steps_per_env = requested["iterations"], requested["steps"]
    agent.actor.hidden_dims = agent.critic.hidden_dims = tuple(requested["hidden_sizes"])
    agent.seed, agent.save_interval = requested["seed"], requested["save_every"]
    agent.logger, agent.upload_model = "tensorboard", False
    on = [0] if torch.cuda.is_available() else None
    launch_training(requested["task"], dataclasses.replace(training, log_root=requested["logs"], gpu_ids=on))
    clock.write(
        requested["out"],
        device=device,
        solver={"timestep": physics.timestep, "decimation": environment.decimation, **dataclasses.asdict(physics)},
        network={"actor": agent.actor.hidden_dims, "critic": agent.critic.hidden_dims},
        contract=contract(clock.runner.env.unwrapped),
        probe=probe(clock.runner),
        versions=versions("mjlab", "mujoco", "mujoco-warp", "warp-lang", "rsl-rl-lib", "torch"),
    )


if __name__ == "__main__":
    main()
