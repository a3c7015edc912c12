"""Clients with keys, and refusals of a server that demands one."""

from __future__ import annotations

import json
from typing import Any

import boto3
from botocore.config import Config


def client(url: str, access: str, secret: str, service: str = "batch", **config: Any) -> Any:
    return boto3.client(
        service,
        endpoint_url=url,
        region_name="eu-north-1",
        aws_access_key_id=access,
        aws_secret_access_key=secret,
        config=Config(**{"retries": {"max_attempts": 0}, **config}),
    )


def refused(answer: Any, kind: str, part: str = "", status: int = 403) -> None:
    """The error is AWS's, in its header and in its body, and one line."""
    body = json.loads(answer.content)
    assert (answer.status_code, answer.headers["x-amzn-errortype"], body["__type"]) == (status, kind, kind), body
    assert part in body["message"] and "\n" not in body["message"], body
