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
COMMAND: dict[str, Any] = {"resources": {"cpus": 0.5, "memory": "64MiB"}, "retry": {"attempts": 1}}
