"""The file of a reward function in a task's configuration: its text, which stays with the run. Imported without numpy and torch."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from racer.rewards.guard import LARGEST, read, read_file
from racer.rewards.problems import RewardRefused
from shared_store.contract.error_text import Refused
from worker.settings.task import STRICT


@dataclass(frozen=True, config=STRICT)
class RewardFile:
    """A learner's reward function, with its text, or with the digest of a long text that is kept beside the job.

    Raises:
        ValueError: The guard refuses the text, of which nothing is run; or there are both a text and a digest.
    """

    file: Annotated[str, Field(min_length=1, max_length=1000)] = "reward_function.py"
    """Name of the file, in messages."""
    text: Annotated[str, Field(max_length=LARGEST)] = ""
    """Its content."""
    sha256: Annotated[str, Field(pattern=r"^([0-9a-f]{64})?$")] = ""
    """Of a text that is kept beside the job (:mod:`shared_store.volume.texts`), which the ranks get as ``text``."""

    def __post_init__(self) -> None:
        if self.sha256 and self.text:
            raise Refused((), "it has both a text and a sha256; leave one of them out")
        if not self.sha256 and (problem := read(self.text, self.file)):
            raise Refused((), str(problem))


def reward_file(value: RewardFile | str) -> RewardFile:
    """The reward function of a configuration, which may name its path, relative to the working directory.

    Raises:
        Refused: The file can't be read, the guard refuses its text, or only its digest is here.
    """
    if isinstance(value, RewardFile):
        if value.sha256:
            raise Refused(
                (), f"{value.file}: its text, with sha256 {value.sha256}, is kept beside a job; name the file itself"
            )
        return value
    try:
        return RewardFile(value, read_file(Path(value)))
    except RewardRefused as refused:
        raise Refused((), str(refused)) from None
