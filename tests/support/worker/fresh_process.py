"""Tasks whose worlds go on in another process, and are the same bit for bit."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from tests.conftest import REPOSITORY
from tests.support.waiting import PATIENCE
from tests.support.worker.tasks import play, same
from worker.tasks import find_task
from worker.tasks.run.task import Task

Settings = Mapping[str, Mapping[str, Any]]
"""Of each case, whose first word is the name of its task, its configuration."""


def make(settings: Settings, name: str, worlds: int = 8, seed: int = 1, first_world: int = 0) -> Task:
    task = find_task(name.split()[0])
    return task(task.config_type(**settings[name]), worlds, seed=seed, first_world=first_world)


def resume(settings: str, saved: str, out: str) -> None:
    """What the fresh process does."""
    states = torch.load(saved, weights_only=True)
    cases, histories = json.loads(settings), {}
    for name in cases:
        # the seed of what happens is part of the state; the seed of what worlds are like, of a case of two words, must be the same
        task = make(cases, name, seed=1 if " " in name else 99)
        task.load_state_dict(states[name])
        histories[name] = [list(step) for step in play(task, 80, seed=8)]
    torch.save(histories, out)


def goes_on_in_a_fresh_process(settings: Settings, directory: Path) -> None:
    """Each case continues there as it does here."""
    tasks = {name: make(settings, name) for name in settings}
    saved = {}
    for name, task in tasks.items():
        task.set_random_episode_length()
        play(task, 20, seed=7)
        saved[name] = task.state_dict()
        assert all(len(tensor) == 8 for tensor in saved[name].values())
    torch.save(saved, directory / "saved.pt")
    script = f"import sys; from {__name__} import resume; resume(*sys.argv[1:])"
    files = [str(directory / "saved.pt"), str(directory / "out.pt")]
    subprocess.run(
        [sys.executable, "-c", script, json.dumps(settings), *files],
        check=True,
        cwd=REPOSITORY,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        timeout=200 * PATIENCE,
    )
    resumed = torch.load(directory / "out.pt", weights_only=True)
    for name, task in tasks.items():
        going_on = play(task, 80, seed=8)
        assert same(going_on, resumed[name]), name
        assert sum(int(step[2].sum()) for step in going_on) > 8, "resets were compared, too"
