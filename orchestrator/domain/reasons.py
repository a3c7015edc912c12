"""Why a job waits or has ended: in Muster's words, and as AWS Batch states it."""

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


def named(name: str, job: str) -> str:
    """A job in words, such as ``ant (1f2e3d4c)``, and ``ant:3 (1f2e3d4c:3)`` for an array's child."""
    head, sign, index = job.partition(":")
    return f"{name}{sign}{index} ({head[:8]}{sign}{index})"
