"""A reward function as a task's configuration has it: the text of its file, which stays with the run. Imported without numpy and torch."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from shared_store.wording import Refused
from worker.racer.rewards.guard import LARGEST, read, read_file
from worker.racer.rewards.problems import RewardRefused
from worker.tasks.config import STRICT


@dataclass(frozen=True, config=STRICT)
class RewardFile:
    """A learner's reward function.

    Raises:
        ValueError: The guard refuses the text; nothing of it is run.
    """

    file: Annotated[str, Field(min_length=1, max_length=1000)] = "reward_function.py"
    """Name of the file, in messages."""
    text: Annotated[str, Field(max_length=LARGEST)] = ""
    """Its content."""

    def __post_init__(self) -> None:
        if problem := read(self.text, self.file):
            raise Refused((), str(problem))


def reward_file(value: RewardFile | str) -> RewardFile:
    """The reward function of a configuration, which may name its path, relative to the working directory.

    Raises:
        Refused: The file can't be read, or the guard refuses its text.
    """
    if isinstance(value, RewardFile):
        return value
    try:
        return RewardFile(value, read_file(Path(value)))
    except RewardRefused as refused:
        raise Refused((), str(refused)) from None
