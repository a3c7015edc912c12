"""The phases of a training: what it does at present, as the main rank reports it to the supervisor, and the supervisor to the bus."""

from __future__ import annotations

import re
from collections.abc import Mapping
from enum import StrEnum
from typing import Any


class Phase(StrEnum):
    """The parts of a training, in their order."""

    COMPILING = "compiling kernels"
    BUILDING = "building worlds"
    TRAINING = "training"
    SAVING = "saving the last checkpoint"
    EVALUATING = "evaluating"
    WRITING = "writing the results"
    DRAWING = "drawing the policy"

    @property
    def is_before_training(self) -> bool:
        """Whether no iteration has begun."""
        return self in (Phase.COMPILING, Phase.BUILDING)


def phase_in(progress: Mapping[str, Any] | None) -> Phase | None:
    """The phase in a node's progress; None where it has none: the node loads libraries, or its program reports nothing."""
    try:
        return Phase((progress or {})["phase"])
    except (KeyError, ValueError):  # a program writes what it likes
        return None


def count_in(progress: Mapping[str, Any] | None) -> str | None:
    """How far the phase in a node's progress is, such as ``37/120`` kernels; None where it does not count."""
    count = (progress or {}).get("phase_count")
    is_count = isinstance(count, str) and re.fullmatch(r"\d{1,7}/\d{1,7}", count)
    return count if is_count and phase_in(progress) else None


def shown_phase(progress: Mapping[str, Any] | None) -> str:
    """The phase in words for people: ``compiling kernels 37/120``; empty without one."""
    return " ".join(filter(None, (phase_in(progress), count_in(progress))))
