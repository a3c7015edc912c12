"""The phases of a training: what it does at present, as the main rank reports it to the supervisor, and the supervisor to the bus."""

from __future__ import annotations

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
    def words(self) -> str:
        """For people; kernels may be in the cache already."""
        return "loading kernels (compiling them the first time takes minutes)" if self is Phase.COMPILING else str(self)

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
