"""The section ``race`` of a job."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from orchestrator.spec.sections import OfCheckpoint
from racer.store.races import DEFAULTS, TRIALS


class Race(OfCheckpoint):
    """Have a checkpoint of a racer's run drive laps from the start line, in a world each."""

    trials: int = Field(default=TRIALS, ge=1, le=100, description="laps")
    continuous: bool = Field(
        default=DEFAULTS["continuous"], description="whether a car is put back; else a lap ends with its first incident"
    )
    off_track_penalty: float = Field(default=DEFAULTS["off_track_penalty"], ge=0, description="of each time [s]")
    crash_penalty: float = Field(default=DEFAULTS["crash_penalty"], ge=0, description="of each obstacle [s]")
    max_resets: int = Field(default=DEFAULTS["max_resets"], ge=0, le=1_000_000, description="in a lap")
    seconds: float = Field(default=DEFAULTS["seconds"], gt=0, le=3600, description="simulated, of a lap")
    track: Annotated[str, Field(min_length=1, max_length=100)] | list[str] | None = Field(
        default=None,
        description="name, or names that are dealt to the laps in turn; those of the training where absent",
    )
    seed: int | None = Field(
        default=None, ge=0, lt=2**63, description="of the worlds; by default one that follows from the training's"
    )
    config: dict[str, Any] = Field(
        default_factory=dict, description="further changes of the configuration with which the run was trained"
    )
    keep: bool = Field(default=True, description="whether the checkpoint is kept from now on")
