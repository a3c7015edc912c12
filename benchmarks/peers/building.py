"""Muster's own training of a case, like a job's: the task with the case's solver limits, network and steps."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from shared_store.volume.epoch import raise_epoch
from shared_store.volume.layout import Store
from worker.learning.distributed import RankPlacement, connect
from worker.learning.job import Job, StopRequest
from worker.learning.loop import Loop
from worker.learning.training import Training
from worker.tasks import find_task
from worker.tasks.run.task import Task


def limited(task: str, limits: Mapping[str, float]) -> tuple[type[Task], dict[str, Any]]:
    """A task whose solver has these limits, and its configuration (``train.config`` of a job) for them.

    Args:
        task: Name of a task.
        limits: ``iterations``, ``ls_iterations`` and ``tolerance`` of the solver.

    Raises:
        ValueError: The task does not exist.
    """
    task_type = find_task(task)
    known = {item.name for item in dataclasses.fields(task_type.config_type)}
    settings: dict[str, Any] = {}
    if "solver_iterations" in known:
        settings = {
            "solver_iterations": int(limits["iterations"]),
            "solver_line_search": int(limits["ls_iterations"]),
        }
    options = {**task_type.solver_options, **limits}
    if settings:  # then the configuration has them
        options = {**task_type.solver_options, "tolerance": limits["tolerance"]}
    if options == dict(task_type.solver_options):
        return task_type, settings
    return type(task_type.__name__, (task_type,), {"solver_options": options}), settings


def build_loop(requested: Mapping[str, Any], store: Path, loop_type: type[Loop] = Loop, **train: Any) -> Loop:
    """The training loop of ``muster run``, on its own store.

    Args:
        asked: ``task``, ``worlds``, ``iterations``, ``limits``, ``save_every`` and ``seed``; ``steps`` and ``hidden_sizes`` of ``ppo``,
            if given.
        store: Directory of the store.
        loop_type: Class of the loop.
        **train: More of the job's ``train`` section.

    Raises:
        ValueError: The task does not exist.
        UserError: A setting that the task or the algorithm refuses.
    """
    task_type, settings = limited(requested["task"], requested["limits"])
    placement = RankPlacement.from_env(os.environ)
    run = Store(store).open().run(f"peers-{requested['task']}-{requested['worlds']}-{requested['seed']}".lower())
    run.create({"run": run.name})
    raise_epoch(run, 1)
    network = {name: requested[name] for name in ("steps", "hidden_sizes") if name in requested}
    if train.get("algorithm", "ppo") != "ppo":  # other algorithms have their own networks and steps
        network = {}
    section = {name: requested[name] for name in ("task", "worlds", "iterations", "seed")}
    section |= ({"ppo": network} if network else {}) | train | {"config": settings | train.get("config", {})}
    # keep every checkpoint, to judge them afterwards
    spec = {"train": section, "checkpoint": {"every": requested["save_every"], "keep": 10**6}}
    job = Job(spec, Store(store), run, 1, 1, "peers", section=section)
    return loop_type(Training.of(job, task_type), connect(placement), StopRequest())
