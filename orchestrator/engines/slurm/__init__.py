"""The Slurm engine."""

from __future__ import annotations

from orchestrator.engines.api import Engine, EngineType, Option, Setting, Traits

SBATCH = (
    Option("partition", "a partition"),
    Option("account", "an account"),
    Option("qos", "a quality of service"),
    Option("time", "a time limit, as 8:00:00"),
    Option("constraint", "features that its nodes must have"),
    Option("reservation", "a reservation"),
    Option("nodelist", "nodes that it must have"),
    Option("exclude", "nodes that it must not have"),
)
"""Options that sbatch has by the same names."""

TRAITS = Traits(elastic=True, launches=2, squeue=True)


def _make(setting: Setting) -> Engine:
    from orchestrator.engines.slurm.engine import SlurmEngine

    return SlurmEngine(setting.squeue_interval)


ENGINE = EngineType(
    _make,
    (
        *SBATCH,
        Option("gpu", "a type of GPU, as a100"),
        Option("nice", "sbatch's --nice of a job without priority", int),
        Option("cancellations", "how often a job is submitted again after its Slurm job was cancelled by others", int),
    ),
    TRAITS,
)
