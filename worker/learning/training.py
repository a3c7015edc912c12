"""The training of a job: task, algorithm and all settings, resolved once, before any world is built."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from worker.learning import algorithms
from worker.learning.algorithm import Algorithm
from worker.learning.job import Job, configure

if TYPE_CHECKING:
    from worker.settings.task import TaskConfig
    from worker.tasks.run.task import Task


@dataclass(frozen=True)
class Training:
    """A job's ``train`` and ``checkpoint`` sections with all defaults filled in."""

    job: Job
    task_type: type[Task]
    config: TaskConfig
    """The task's configuration."""
    algorithm: str
    """Name of the algorithm in the job's YAML."""
    algorithm_type: type[Algorithm]
    settings: Any
    """Settings of the algorithm, of its ``config_type``."""
    iterations: int
    """Iteration at which training ends."""
    seed: int
    save_every: int | str
    """Iterations between two saves, or ``auto``."""
    keep: int
    """Number of checkpoints to keep."""

    @classmethod
    def of(cls, job: Job, task_type: type[Task]) -> Training:
        """Raises UserError that names the wrong key."""
        config, name = configure(task_type, job.section), job.section.get("algorithm", algorithms.DEFAULT)
        algorithm = algorithms.find_algorithm(name)
        checkpoints = job.spec.get("checkpoint") or {}
        return cls(
            job,
            task_type,
            config,
            algorithm=name,
            algorithm_type=algorithm,
            settings=algorithms.settings(algorithm, name, config, job.section),
            iterations=job.setting("iterations", 100),
            seed=job.setting("seed", 0, least=0),
            save_every=checkpoints.get("every", 25),
            keep=int(checkpoints.get("keep", 5)),
        )
