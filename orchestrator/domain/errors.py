"""The errors that end a command in one line; nothing here is slow to import."""

from __future__ import annotations


class ServerError(Exception):
    """A controller can't start; the message says why and what to do."""


class Unavailable(Exception):
    """Something that the controller needs can't be used now; the message says what, why, and what to do."""


class UsageError(ServerError):
    """An option or argument can't be used; the message says why and what to give instead."""


class RequestError(Exception):
    """A request can't be carried out as it stands; nothing has changed."""

    status = 400
    """Of the HTTP answer."""


class ClientError(RequestError):
    """The request can't be carried out as it stands: AWS's ``ClientException``, HTTP 400 (or ``status``)."""

    def __init__(self, message: str, status: int = 400) -> None:
        super().__init__(message)
        self.status = status


class SpecError(ClientError):
    """A spec can't be used; the message is one line: file, line, key, what was expected."""


class ApiError(Exception):
    """The controller refused a request; ``status`` is the HTTP status."""

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status


class Unreachable(Exception):
    """No controller answers; the message gives the address that was tried and how to start a controller."""


class NoUrl(Unreachable):
    """The given address is not a controller's."""


class NotServing(ApiError, Unreachable):
    """The controller answers 503: it can't serve now, and says why. Followers wait for it as they do when it does not answer."""
