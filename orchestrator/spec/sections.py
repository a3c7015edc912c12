"""Sections of a job YAML shared by several kinds of jobs: nodes, resources, checkpoints, logs, retries, evaluation."""

from __future__ import annotations

import operator
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from orchestrator.domain.gang import MOST_NODES
from orchestrator.domain.identifiers import SHARE
from orchestrator.spec.values import Memory, RunName, Section, Size
from shared_store.contract.node import LEAST_LOG_LIMIT, LOG_LIMIT

ACCEPT = Field(
    default=False,
    exclude_if=operator.not_,
    description="whether to continue although the robot's file loads differently from the checkpoint's training",
)
CheckpointName = int | Literal["best", "latest"]
"""An iteration, or what ``RUN@best`` and ``RUN@latest`` mean."""
Share = Annotated[str, Field(pattern=f"^{SHARE}$")]


class NodeRange(Section):
    """Number of nodes: ``nodes: 3`` or ``nodes: {min: 2, max: 4}`` (start with as many as are free)."""

    min: int = Field(ge=1, le=MOST_NODES)
    max: int = Field(ge=1, le=MOST_NODES)

    @model_validator(mode="before")
    @classmethod
    def _from_number(cls, value: object) -> object:
        if isinstance(value, dict):
            return value
        if isinstance(value, int) and not isinstance(value, bool):
            return {"min": value, "max": value}
        raise ValueError("expected an integer number of nodes, or {min: 2, max: 4}")

    @model_validator(mode="after")
    def _ordered(self) -> NodeRange:
        if self.min > self.max:
            raise ValueError(f"min ({self.min}) is more than max ({self.max})")
        return self


class Resources(Section):
    """Resources of each node."""

    cpus: float = Field(default=1.0, gt=0, description="CPU cores; fractions are allowed")
    gpus: int = Field(default=0, ge=0, description="GPUs; one rank process is started for each")
    memory: Memory = Field(default=1024, ge=4, description="memory, such as 4GiB")


class CheckpointPolicy(Section):
    """When checkpoints are written, and how many are kept (always including the best one)."""

    every: Annotated[int, Field(ge=1)] | Literal["auto"] = Field(
        default=25, description="iterations; auto: as often as 1 % of the time allows"
    )
    keep: int = Field(default=5, ge=2)


class Logs(Section):
    """Limit of the kept output of each node."""

    limit: Annotated[Size, Field(ge=LEAST_LOG_LIMIT)] = Field(
        default=LOG_LIMIT,
        description="of each node in each attempt, at least 1MiB; of a longer log its beginning and its end are kept",
    )


class Retry(Section):
    """Total number of attempts of a failing gang."""

    attempts: int = Field(default=3, ge=1, le=10)


class Evaluation(Section):
    """Evaluate every few checkpoints of a training, each in a job of its own beside it."""

    every: int = Field(ge=1, description="checkpoints from one evaluation to the next")
    episodes: int = Field(default=100, ge=1, le=1_000_000)
    worlds: int = Field(default=1024, ge=1, description="simulated worlds, at most one for each episode")
    queue: str | None = Field(default=None, description="job queue; that of the training where absent")
    share: Share | None = Field(default=None, description="share identifier in that queue")
    resources: Resources | None = Field(
        default=None, description="of the one node; where absent those of a node of the training, with at most one GPU"
    )
    retry: Retry = Field(default_factory=Retry)


def _checkpoint(value: object) -> object:
    if value in (None, "best", "latest") or (isinstance(value, int) and not isinstance(value, bool) and value >= 0):
        return value
    raise ValueError("expected an iteration, best or latest")


class OfCheckpoint(Section):
    """What every job says that reads a checkpoint of a run."""

    run: RunName
    checkpoint: Annotated[CheckpointName | None, BeforeValidator(_checkpoint)] = Field(
        default=None, description="iteration, best or latest; the latest where absent"
    )
    accept_changed_robot: bool = ACCEPT
