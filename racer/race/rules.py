"""The rules by which a job's section ``race`` evaluates a checkpoint."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from racer.settings.task import RacerConfig
from racer.store import races


class RaceRules:
    """As :class:`shared_store.contract.plugins.EvaluationRules`."""

    count = ("trials", races.TRIALS)

    def refusal(self, config: type) -> str | None:
        return None if issubclass(config, RacerConfig) else races.NO_RACER

    def changes(self, section: Mapping[str, Any]) -> dict[str, Any]:
        return races.race_changes(section)

    def key_of(self, section: Mapping[str, Any], path: tuple[str | int, ...]) -> str:
        return races.key_of(section, path)

    def lines(self, summary: Mapping[str, Any]) -> Iterator[str]:
        return races.lines(summary)


RULES = RaceRules()
