"""What an operation answers when it refuses."""

from __future__ import annotations


class ClientError(Exception):
    """The request can't be carried out as it stands: AWS's ``ClientException``, HTTP 400 (or ``status``)."""

    def __init__(self, message: str, status: int = 400) -> None:
        super().__init__(message)
        self.status = status
