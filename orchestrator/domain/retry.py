"""``retryStrategy.evaluateOnExit``: whether an attempt that failed is tried again. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence


def retries(conditions: Sequence[Mapping[str, str]], exit_code: int | None, reason: str, status_reason: str) -> bool:
    """Whether the first matching condition says RETRY; True if none matches, as on AWS.

    Args:
        conditions: ``evaluateOnExit``; what one entry names must all match.
        exit_code: Of the main node's container; None where it has none.
        reason: Of the main node's container.
        status_reason: Of the attempt.
    """
    seen = {
        "onExitCode": "" if exit_code is None else str(exit_code),
        "onReason": reason,
        "onStatusReason": status_reason,
    }
    for condition in conditions:
        if all(_matches(condition[key], text) for key, text in seen.items() if condition.get(key)):
            return condition["action"].upper() == "RETRY"
    return True


def _matches(pattern: str, text: str) -> bool:
    """A pattern may end in ``*``."""
    return text.startswith(pattern[:-1]) if pattern.endswith("*") else text == pattern
