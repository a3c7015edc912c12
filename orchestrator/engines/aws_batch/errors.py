"""Errors of boto3, in one line with what to do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import boto3
from botocore.exceptions import BotoCoreError, ClientError, NoCredentialsError, NoRegionError
from botocore.parsers import ResponseParserError

from orchestrator.engines.api import EngineError, NotYet

FAILURES = (ClientError, BotoCoreError, ResponseParserError)
"""Exceptions of boto3: AWS refuses, is not reached, or answers nonsense."""
_TRANSIENT = (
    *("TooManyRequestsException", "ThrottlingException", "RequestLimitExceeded", "ServerException"),
    *("ExpiredToken", "ExpiredTokenException"),  # a person logs in again
)


def session_for(region: str | None, profile: str | None) -> boto3.Session:
    """A session that has credentials and a region. Raises NoCredentialsError, NoRegionError, and others of ``FAILURES``."""
    session = boto3.Session(region_name=region, profile_name=profile)
    if session.get_credentials() is None:
        raise NoCredentialsError
    if not session.region_name:
        raise NoRegionError
    return session


def words_of(error: BaseException) -> str:
    """The message of one of ``FAILURES``."""
    if isinstance(error, NoCredentialsError):
        return "no credentials; run `aws configure`, or set AWS_PROFILE"
    if isinstance(error, NoRegionError):
        return "no region; give --region, or set AWS_DEFAULT_REGION"
    answer = error.response.get("Error", {}) if isinstance(error, ClientError) else {}
    return f"{answer.get('Message') or answer.get('Code') or error}"


@contextmanager
def answered() -> Iterator[None]:
    """Around calls of AWS Batch.

    Raises:
        NotYet: AWS is not reached, or can't answer now.
        EngineError: It refuses, in its own words.
    """
    try:
        yield
    except ClientError as error:
        status = int(error.response.get("ResponseMetadata", {}).get("HTTPStatusCode", 0))
        if error.response.get("Error", {}).get("Code") in _TRANSIENT or status >= 500 or status == 429:
            raise NotYet(f"AWS Batch does not answer: {words_of(error)}; trying again") from None
        raise EngineError(f"AWS Batch refuses: {words_of(error)}") from None
    except FAILURES as error:
        raise NotYet(f"AWS Batch does not answer: {words_of(error)}; trying again") from None
