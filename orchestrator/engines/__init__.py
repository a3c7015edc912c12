"""Engines: what starts gangs on machines, by name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from orchestrator.engines.base import Engine, EngineError

ENGINES = ("local", "docker", "ray", "slurm", "aws-batch")


def make_engine(name: str, home: Path, cpus: float | None = None, gpus: Sequence[str] | None = None) -> Engine:
    """The engine called ``name``.

    Args:
        name: One of :data:`ENGINES`.
        home: ``$MUSTER_HOME``.
        cpus: CPU cores of this machine to hand out, where the engine runs nodes on it; all by default.
        gpus: Ids of its GPUs to hand out; all by default.

    Raises:
        EngineError: There is none, it is not installed, or it does not answer; one line with what to do.
    """
    if name == "local":
        from orchestrator.engines.local import LocalEngine

        return LocalEngine(home, cpus, gpus)
    if name == "docker":
        try:
            from orchestrator.engines.docker import DockerEngine
        except ModuleNotFoundError as error:
            raise EngineError("the docker engine is not installed: pip install 'muster[docker]'") from error
        return DockerEngine(home, cpus, gpus)
    if name == "ray":
        from orchestrator.engines.ray import RayEngine

        return RayEngine(home)
    if name == "slurm":
        from orchestrator.engines.slurm import SlurmEngine

        return SlurmEngine()
    if name == "aws-batch":
        try:
            from orchestrator.engines.aws_batch import AwsBatchEngine
        except ModuleNotFoundError as error:
            raise EngineError("the aws-batch engine is not installed: pip install 'muster[aws]'") from error
        return AwsBatchEngine(home)
    raise EngineError(f"there is no engine {name!r}; there are {', '.join(ENGINES)}")
