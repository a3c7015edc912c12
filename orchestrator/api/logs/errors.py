"""Errors of CloudWatch Logs: refusals as the exceptions of AWS's model."""

from __future__ import annotations

from starlette.responses import JSONResponse

from orchestrator.api.http.auth import error_response

JSON = "application/x-amz-json-1.1"


class LogsError(Exception):
    """A refusal, as one of the exceptions in AWS's model."""

    def __init__(self, kind: str, message: str, status: int = 400) -> None:
        super().__init__(message)
        self.kind, self.status = kind, status

    def response(self) -> JSONResponse:
        return error_response(str(self), self.status, self.kind, JSON)


def invalid(message: str) -> LogsError:
    return LogsError("InvalidParameterException", message)


def absent(what: str, name: str) -> LogsError:
    """No ``log group`` or ``log stream`` has this name."""
    return LogsError("ResourceNotFoundException", f"The specified {what} does not exist: {name[:600]}")


def present(what: str, name: str) -> LogsError:
    """A ``log group`` or ``log stream`` of this name exists."""
    return LogsError("ResourceAlreadyExistsException", f"The specified {what} already exists: {name[:600]}")
