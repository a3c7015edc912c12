"""Bundles of policies as ``muster export`` writes them, without a training, and the policy node that runs them as a process."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from shared_store.volume.layout import Run
from tests.conftest import REPOSITORY
from worker.deploy import bundle
from worker.tasks.run.policy_contract import policy_contract
from worker.tasks.run.task import Task

NODE = [sys.executable, "-m", "muster_policy.cli"]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(REPOSITORY / "policy_node")}


def bundle_of(task: Task, policy: Any, folder: Path, **config: Any) -> Path:
    """The bundle of a task's policy, below ``folder``."""
    name = type(task).__name__
    facts = {"task": name, "algorithm": "ppo", "train": {"task": name, "config": config}, "settings": {}, "files": {}}
    checkpoint: Any = SimpleNamespace(name="00000001-e1", iteration=1, manifest=facts)
    contract = policy_contract(task, name, policy.module())
    return bundle.export(Run(folder), checkpoint, task, (policy, policy), contract, rounds=0)
