"""The Docker engine."""

from __future__ import annotations

from orchestrator.engines.api import Engine, EngineError, EngineType, SecretValues, Setting, Traits

TRAITS = Traits(images=True, users=True, as_owner=True, secrets=SecretValues.ENVIRONMENT, launches=4, gpu_ids=True)


def _make(setting: Setting) -> Engine:
    try:
        from orchestrator.engines.docker.engine import DockerEngine
    except ModuleNotFoundError as error:
        raise EngineError("the docker engine is not installed: pip install 'muster[docker]'") from error
    return DockerEngine(setting.home, setting.cpus, setting.gpus)


ENGINE = EngineType(_make, traits=TRAITS)
