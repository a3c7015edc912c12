"""The Ray engine."""

from __future__ import annotations

from orchestrator.engines.api import Engine, EngineType, Setting, Traits

TRAITS = Traits(elastic=True)


def _make(setting: Setting) -> Engine:
    from orchestrator.engines.ray.engine import RayEngine

    return RayEngine(setting.home)


ENGINE = EngineType(_make, traits=TRAITS)
