"""The local engine."""

from __future__ import annotations

from orchestrator.engines.api import Engine, EngineType, Setting


def _make(setting: Setting) -> Engine:
    from orchestrator.engines.local.engine import LocalEngine

    return LocalEngine(setting.home, setting.cpus, setting.gpus)


ENGINE = EngineType(_make)
