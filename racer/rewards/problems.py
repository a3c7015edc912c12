"""Problems with a reward function, in one line each."""

from __future__ import annotations

import re
from dataclasses import dataclass

from worker.settings.errors import UserError

LARGEST_REWARD = 1e5
"""Rewards are from minus this to this, as in AWS's check and in its simulator."""
KINDS = ("SYNTAX_ERROR", "IMPORT_ERROR", "FORBIDDEN", "TEST_FAILURE", "TIMEOUT")


@dataclass(frozen=True)
class Problem:
    """Why a reward function can't be used.

    Attributes:
        kind: One of :data:`KINDS`.
        message: One line.
        file: Its file.
        line: Where, from 1; 0 where no line is the cause.
    """

    kind: str
    message: str
    file: str
    line: int = 0

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line else self.file
        return f"{place}: {self.kind}: {self.message}"


class RewardRefused(UserError):
    """A reward function that the guard refused.

    Args:
        problem: Why.
    """

    def __init__(self, problem: Problem) -> None:
        super().__init__(str(problem))
        self.problem = problem


class RewardFailed(UserError):
    """A reward function that can't go on: it does not return, floods its output, or its process died. One line, with the car."""


@dataclass
class Failure:
    """Calls that gave no reward.

    Attributes:
        count: How many.
        car: The first car that had one.
    """

    count: int
    car: int


def out_of_range(value: float) -> str:
    """The fault of a reward beyond :data:`LARGEST_REWARD`."""
    return f"it returned {value:.9g}; a reward is from {-LARGEST_REWARD:,.0f} to {LARGEST_REWARD:,.0f}, as on AWS"


def alike(message: str) -> str:
    """A failure's message without its numbers: failures that differ in these alone count as one."""
    return re.sub(r"[-+]?\d[\d.]*(e[-+]?\d+)?", "#", message)


def one_line(error: BaseException) -> str:
    """An exception in one line."""
    try:
        text = str(error)
    except BaseException as other:  # a learner's own class
        text = f"its message can't be shown, since its __str__ raises {type(other).__name__}"
    return plain(f"{type(error).__name__}: {text}" if text else type(error).__name__)


def plain(text: str, most: int = 200) -> str:
    """A text in one line of at most so many characters; what does not print, such as a control character, is shown escaped."""
    line = " ".join(str.split(text[: 2 * most]))
    shown = "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in line)
    return shown if len(shown) <= most else shown[: most - 1] + "…"
