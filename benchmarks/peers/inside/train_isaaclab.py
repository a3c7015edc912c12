"""One training of Isaac Lab on its Newton backend, by its own entry point: ``python train_isaaclab.py JSON``; ``benchmarks.peers.isaaclab``
calls it.

The JSON is that of ``train_mjlab.py``, with ``frontend`` (``torch`` or ``warp``). Nothing is replaced in Isaac Lab; its folder of
logs is where this runs. ``ISAACSIM_ASSET_ROOT`` names the folder of its robots.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

from clock import Clock, device_facts, versions


def main() -> None:
    requested: dict[str, Any] = json.loads(sys.argv[1])
    Path(requested["logs"]).mkdir(parents=True, exist_ok=True)
    os.chdir(requested["logs"])
    device, wait = device_facts()
    clock = Clock(requested["began"], requested["worlds"], requested["steps"], wait)
    clock.install()
    import isaaclab_rl.entrypoints.backends.train_rsl_rl as training

    built: dict[str, Any] = {}
    make = training.create_rsl_rl_runner

    def noted(environment: Any, agent: Any, **options: Any) -> Any:
        built.update(config=environment.unwrapped.cfg, agent=agent)
        return make(environment, agent, **options)

    training.create_rsl_rl_runner = noted
    on = "cpu" if device == "the CPU" else "cuda:0"
    options = {
        "--task": requested["task"],
        "--num_envs": requested["worlds"],
        "--max_iterations": requested["iterations"],
        "--seed": requested["seed"],
        "--device": on,
        "--frontend": requested["frontend"],
    }
    changes = {
        "physics": "newton_mjwarp",
        "agent.device": on,
        "agent.num_steps_per_env": requested["steps"],
        "agent.save_interval": requested["save_every"],
        "agent.actor.hidden_dims": json.dumps(requested["hidden_sizes"]),
        "agent.critic.hidden_dims": json.dumps(requested["hidden_sizes"]),
        **{f"env.sim.physics.solver_cfg.{name}": value for name, value in requested["limits"].items()},
    }
    training.run(
        [str(word) for option in options.items() for word in option] + [f"{key}={it}" for key, it in changes.items()]
    )
    config, agent = built["config"], built["agent"]
    physics = config.sim.physics
    names = ("solver", "integrator", "cone", "iterations", "ls_iterations", "tolerance", "njmax", "nconmax", "impratio")
    clock.write(
        requested["out"],
        device=device,
        frontend=requested["frontend"],
        solver={
            "timestep": config.sim.dt,
            "decimation": config.decimation,
            "substeps": physics.num_substeps,
            **{name: getattr(physics.solver_cfg, name, None) for name in names},
        },
        network={"actor": list(agent.actor.hidden_dims), "critic": list(agent.critic.hidden_dims)},
        versions=versions("isaaclab", "newton", "mujoco-warp", "warp-lang", "rsl-rl-lib", "torch"),
    )
    sys.stdout.flush()
    os._exit(0)  # its simulation does not end by itself


if __name__ == "__main__":
    main()
