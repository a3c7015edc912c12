"""What a step of retention looks at, what it finds there, and for whom."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from orchestrator.domain.retention import Decision, RunFacts
from shared_store.volume import trash


@dataclass(frozen=True)
class Whose:
    """Who asks: nothing but what is theirs goes."""

    name: str
    queues: frozenset[str] | None = None
    """None: everything is theirs."""

    def owns(self, owner: str | None, queue: str) -> bool:
        """Whether a job or a run is theirs."""
        return self.queues is None or (owner == self.name and queue in self.queues)


CONTROLLER = Whose("this controller")


@dataclass(frozen=True)
class RetentionStep:
    """What a step does, or would do, with a run and its jobs."""

    run: str
    decision: Decision
    facts: RunFacts | None
    """The run as it was; None where the store has no such run."""
    directories: tuple[Path, ...]
    """That go."""

    def described(self) -> dict[str, Any]:
        """For the API; sizes in bytes."""
        sizes = [trash.size_of(path) for path in self.directories]
        return {
            "run": self.run,
            "whole": self.decision.run,
            "jobs": list(self.decision.jobs),
            "bytes": sum(size for size, _ in sizes),
            "files": sum(count for _, count in sizes),
            "kept": list(self.decision.reasons),
        }


@dataclass
class PassTotals:
    """What a pass has taken."""

    jobs: int = 0
    runs: int = 0
    kept: int = 0
    bytes: int = 0

    def add(self, looks: Sequence[Mapping[str, Any]]) -> None:
        self.jobs += sum(len(each["jobs"]) for each in looks)
        self.runs += sum(each["whole"] for each in looks)
        self.bytes += sum(each["bytes"] for each in looks)
        self.kept += sum(bool(each["kept"]) for each in looks)

    def __str__(self) -> str:
        return f"{self.jobs} jobs and {self.runs} runs ({self.bytes / 2**20:.1f} MiB)"


@dataclass(frozen=True)
class PassCursor:
    """Where a pass is: everything that ended before was looked at."""

    stopped_at: int = -1
    job: str = ""

    def __str__(self) -> str:
        return f"{self.stopped_at}.{self.job}"

    @classmethod
    def of(cls, text: str) -> PassCursor:
        """Raises ValueError."""
        moment, dot, job = text.partition(".")
        if not dot or not moment.isdecimal() or len(moment) > 16:
            raise ValueError(f"{text[:100]!r} is no place of a pass")
        return cls(int(moment), job)


Step = tuple[list[dict[str, Any]], PassCursor | None]
"""What a step has found, as :meth:`RetentionStep.described`, and where the next one begins."""
