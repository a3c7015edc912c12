"""Errors that are reported in one line, without a traceback. Imports nothing slow: signals are caught and errors reported from the start."""

from __future__ import annotations


class UserError(Exception):
    """Something that the user can put right: the message says what, where and how."""


class GangError(Exception):
    """The gang can't be formed; the message names the ranks that are the cause, and what to look at."""


class TrainingError(Exception):
    """Training can't go on (the loss is not finite, …).

    Args:
        message: The error.
        cause: As :attr:`shared_store.contract.faults.Fault.cause`.
    """

    def __init__(self, message: str, cause: str = "") -> None:
        super().__init__(message)
        self.cause = cause


def is_out_of_memory(error: BaseException) -> bool:
    """Whether torch, Warp or Python found no memory: torch says so with RuntimeErrors, of which not all have a type of their own."""
    phrases = ("Failed to allocate", "out of memory", "can't allocate memory")
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and any(phrase in str(error) for phrase in phrases)
    )
