"""Reasons why a job waits or has ended: in Muster's words, and as AWS Batch states them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Reason:
    """``statusReason``, for each of the two APIs."""

    words: str
    """Begins with what matters; ``/api``, the command and the console show it."""
    aws: str
    """For the AWS Batch API, whose clients match it: AWS's own words, or its code and then ``words``."""

    @classmethod
    def plain(cls, words: str) -> Reason:
        """A reason that AWS has no words for."""
        return cls(words, words)

    @classmethod
    def coded(cls, code: str, words: str) -> Reason:
        """A reason for which AWS has a code, such as ``CAPACITY:INSUFFICIENT_INSTANCE_CAPACITY``."""
        return cls(words, f"{code} - {words}")

    @property
    def code(self) -> str:
        """What the AWS Batch API states beyond ``words``: AWS's code, or AWS's own words. Empty where both state the same."""
        return "" if self.aws == self.words else self.aws.removesuffix(f" - {self.words}")


def short_id(job: str) -> str:
    """The start of a job's id, as commands show it; of an array's child with its index."""
    parent, colon, index = job.partition(":")
    return parent[:8] + colon + index


def title(name: str, job: str) -> str:
    """The name by which commands find a job: of an array's child ``ant:3``."""
    _, colon, index = job.partition(":")
    return name + colon + index


def named(name: str, job: str) -> str:
    """A job in words, such as ``ant (1f2e3d4c)``, and ``ant:3 (1f2e3d4c:3)`` for an array's child."""
    return f"{title(name, job)} ({short_id(job)})"


def array_of(size: int | None) -> str:
    """What the AWS Batch API states of an array some of whose children have not ended."""
    return f"an array of {size}"
