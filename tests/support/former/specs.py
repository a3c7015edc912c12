"""The specs that an older commit ran before its home became an archive."""

from __future__ import annotations

from typing import Any

TRAINING: dict[str, Any] = {
    "name": "whole",
    "nodes": 2,
    "resources": {"cpus": 0.5, "memory": "1GiB"},
    "train": {"task": "Cartpole", "worlds": 8, "iterations": 60, "seed": 1, "ppo": {"hidden_sizes": [16, 16]}},
    "checkpoint": {"every": 10, "keep": 10},
    "retry": {"attempts": 3},
}


def _small(name: str, train: dict[str, Any]) -> dict[str, Any]:
    seeded = {"task": "Cartpole", "worlds": 8, "iterations": 12, "seed": 1, **train}
    return {**TRAINING, "name": name, "nodes": 1, "train": seeded, "checkpoint": {"every": 4, "keep": 10}}


_MEMORY = {"class_name": "RNNModel", "rnn_type": "gru", "rnn_hidden_dim": 8, "rnn_num_layers": 1, "hidden_dims": [8]}
_NOISE = {"class_name": "GaussianDistribution", "init_std": 1.0}
_SAC = {
    **{"actor_sizes": [16, 16], "critic_sizes": [16, 16], "atoms": 11, "batch_size": 32, "updates": 2},
    **{"replay_steps": 32, "warm_up": 2, "save_replay": True},
}
OTHERS = [
    _small("sac", {"algorithm": "sac", "sac": _SAC}),
    _small(
        "gru",
        {
            "algorithm": "rsl_rl",
            "rsl_rl": {
                "num_steps_per_env": 8,
                "algorithm": {"num_mini_batches": 2, "num_learning_epochs": 2},
                "actor": {**_MEMORY, "distribution_cfg": _NOISE},
                "critic": _MEMORY,
            },
        },
    ),
    _small("ant", {"task": "Ant", "worlds": 4, "ppo": {"steps": 8, "hidden_sizes": [16, 16]}}),
    _small("racer", {"task": "Racer", "worlds": 4, "ppo": {"steps": 8, "hidden_sizes": [16, 16]}}),
]
"""Trainings with the other algorithms, of a robot with contacts, and of the racer."""
