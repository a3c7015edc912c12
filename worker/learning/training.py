"""What a job trains: the task, the algorithm and all settings, resolved once, before any world is built."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from worker.learning import algorithms
from worker.learning.algorithm import Algorithm
from worker.learning.job import Job, configure

if TYPE_CHECKING:
    from worker.tasks.config import TaskConfig
    from worker.tasks.task import Task


@dataclass(frozen=True)
class Training:
    """A job's ``train`` and ``checkpoint`` sections with all defaults filled in."""

    job: Job
    task_type: type[Task]
    config: TaskConfig
    """The task's configuration."""
    algorithm: str
    """As the job's YAML calls it."""
    algorithm_type: type[Algorithm]
    settings: Any
    """The algorithm's, of its ``config_type``."""
    iterations: int
    """At which training ends."""
    seed: int
    save_every: int | str
    """Iterations between two saves, or ``auto``."""
    keep: int
    """How many checkpoints stay."""

    @classmethod
    def of(cls, job: Job, task_type: type[Task]) -> Training:
        """Raises UserError naming the key that is wrong."""
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
