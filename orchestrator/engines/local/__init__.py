"""The local engine."""

from __future__ import annotations

from orchestrator.engines.api import Engine, EngineType, SecretValues, Setting, Traits

TRAITS = Traits(users=True, secrets=SecretValues.ENVIRONMENT, launches=4, gpu_ids=True)


def _make(setting: Setting) -> Engine:
    from orchestrator.engines.local.engine import LocalEngine

    return LocalEngine(setting.home, setting.cpus, setting.gpus)


ENGINE = EngineType(_make, traits=TRAITS)
