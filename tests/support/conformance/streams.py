"""Log streams for tests: a real client, jobs that print, and lines written as a supervisor writes them."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import boto3
from botocore.config import Config

from shared_store.volume.logs import format_line
from tests.conftest import Serving

GROUP = "/aws/batch/job"
ARN = f"arn:aws:logs:us-east-1:000000000000:log-group:{GROUP}"


def client_of(url: str, service: str = "logs") -> Any:
    return boto3.client(
        service,
        endpoint_url=url,
        region_name="us-east-1",
        aws_access_key_id="any",
        aws_secret_access_key="any",
        config=Config(retries={"max_attempts": 0}, inject_host_prefix=False, read_timeout=60),
    )


def stream_of(server: Serving, job: str, node: int = 0) -> str:
    return f"{server.detail(job)['name']}/{job}/1/node-{node}"


def log_of(server: Serving, job: str, node: int = 0) -> Path:
    return Path(server.detail(job)["attempts"][0]["nodes"][node]["log"])


def write(path: Path, *texts: str, seconds: float | None = None) -> None:
    """Add lines as a supervisor would, but in one go, at Unix time ``seconds`` (now)."""
    lines = "".join(format_line(time.time() if seconds is None else seconds, 0, "o", text) for text in texts)
    with open(path, "ab", buffering=0) as file:
        file.write(lines.encode())


def append(server: Serving, job: str, *texts: str, node: int = 0, seconds: float | None = None) -> None:
    """Add lines to the log of a node of the first attempt."""
    write(log_of(server, job, node), *texts, seconds=seconds)


def finished(server: Serving, script: str, nodes: int = 1, name: str = "logs") -> str:
    job = server.gang(script, nodes, name)
    server.wait(job)
    return job


def messages(page: dict[str, Any]) -> list[str]:
    return [event["message"] for event in page["events"]]
