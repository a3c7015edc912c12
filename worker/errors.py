"""Errors that are told in one line, without a traceback. Imports nothing slow: signals are caught and errors told from the start."""

from __future__ import annotations


class UserError(Exception):
    """Something that the user can put right: the message says what, where and how."""


class GangError(Exception):
    """The gang can't be formed; the message names the ranks that are the cause, and what to look at."""


class TrainingError(Exception):
    """Training can't go on (the loss is not finite, …)."""
