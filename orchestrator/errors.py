"""The errors that end a command in one line; nothing here is slow to import."""

from __future__ import annotations


class ServerError(Exception):
    """A controller can't start; the message says why and what to do."""


class UsageError(ServerError):
    """An option or argument can't be used; the message says why and what to give instead."""


class SpecError(Exception):
    """A spec can't be used; the message is one line: file, line, key, what was expected."""


class ApiError(Exception):
    """The controller refused a request; ``status`` is the HTTP status."""

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status


class Unreachable(Exception):
    """No controller answers; the message says where one was looked for and how to start one."""


class NoUrl(Unreachable):
    """The address that was given is not that of a controller."""


class NotServing(ApiError, Unreachable):
    """The controller answers that it can't serve now (503), and why; followers wait for it as for one that is away."""
