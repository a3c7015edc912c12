"""The errors with which operations refuse requests."""

from __future__ import annotations

from orchestrator.domain.errors import RequestError


class ClientError(RequestError):
    """The request can't be carried out as it stands: AWS's ``ClientException``, HTTP 400 (or ``status``)."""

    def __init__(self, message: str, status: int = 400) -> None:
        super().__init__(message)
        self.status = status
