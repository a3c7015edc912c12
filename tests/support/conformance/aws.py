"""What the conformance tests share: jobs through the real boto3, commands through the real ``aws``, refusals as AWS words them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from botocore.exceptions import ClientError

from tests.conftest import Serving
from tests.support import definitions
from tests.support.conformance.streams import GROUP, client_of
from tests.support.waiting import PATIENCE, wait_for

AWS = str(Path(sys.executable).parent / "aws")
PREFIX = "arn:aws:batch:us-east-1:000000000000:"
OVER = ("SUCCEEDED", "FAILED")
EXITED = "Essential container in task exited"
"""What AWS says of every attempt whose main container ended by itself (reference §3.6)."""
NO_ROOM = "CAPACITY:INSUFFICIENT_INSTANCE_CAPACITY"
UNTIL = 'until [ -e "$GATE/{}" ]; do sleep 0.05; done'
"""Shell: wait until the test opens a gate (:func:`gate`), so that nothing depends on how fast anything is."""


class Batch:
    """A real server, seen through boto3 only."""

    def __init__(self, server: Serving) -> None:
        self.server = server
        self.api, self.logs = client_of(server.url, "batch"), client_of(server.url)

    def multinode(self, name: str, script: str, nodes: int = 2, main: int = 0, **changes: Any) -> str:
        """Register a shell script for all of ``nodes``; returns the definition's ARN. ``changes``: see :func:`container`."""
        properties = {
            "numNodes": nodes,
            "mainNode": main,
            "nodeRangeProperties": changes.pop("ranges", None)
            or [{"targetNodes": changes.pop("target", "0:"), "container": container(script, changes)}],
        }
        return self.register(name, "multinode", nodeProperties=properties, **changes)

    def single(self, name: str, script: str, **changes: Any) -> str:
        """The same for a job of type ``container``."""
        return self.register(name, "container", containerProperties=container(script, changes), **changes)

    def register(self, name: str, kind: str, **request: Any) -> str:
        answer = self.api.register_job_definition(jobDefinitionName=name, type=kind, **request)
        return str(answer["jobDefinitionArn"])

    def submit(self, definition: str, name: str | None = None, queue: str = "default", **request: Any) -> str:
        """Submit; the job is called like its definition unless ``name`` says otherwise. Returns its id."""
        name = name or definition.rpartition("/")[2].partition(":")[0]
        return str(self.api.submit_job(jobName=name, jobQueue=queue, jobDefinition=definition, **request)["jobId"])

    def describe(self, job: str) -> dict[str, Any]:
        [detail] = self.api.describe_jobs(jobs=[job])["jobs"]
        return dict(detail)

    def wait(self, job: str, *statuses: str, timeout: float = 60) -> dict[str, Any]:
        """The job's (or node's, or child's) detail, once it is in one of ``statuses`` (by default, over)."""
        requested = statuses or OVER
        existing = lambda: (detail := self.describe(job))["status"] in requested and detail  # noqa: E731
        found: dict[str, Any] = wait_for(existing, timeout, f"{job} {requested}")
        return found

    def reason(self, job: str, part: str) -> str:
        """The job's ``statusReason``, once it contains ``part``."""
        has = lambda: part in (text := self.describe(job).get("statusReason", "")) and text  # noqa: E731
        found: str = wait_for(has, 30, f"{part!r} of {job}")
        return found

    def lines(self, job: str) -> list[str]:
        """What a job (its main node) or a node (``id#N``) printed in its newest attempt; nothing before it runs."""
        detail = self.describe(job)
        if "nodeProperties" in detail:
            detail = self.describe(f"{job}#{detail['nodeProperties']['mainNode']}")
        name = detail["container"].get("logStreamName")
        return self.stream(name) if name else []

    def stream(self, name: str) -> list[str]:
        page = self.logs.get_log_events(logGroupName=GROUP, logStreamName=name, startFromHead=True)
        return [event["message"] for event in page["events"]]

    def front(self, queue: str) -> list[str]:
        """Ids of the waiting jobs in the order in which GetJobQueueSnapshot shows them."""
        snapshot = self.api.get_job_queue_snapshot(jobQueue=queue)
        return [each["jobArn"].rpartition("/")[2] for each in snapshot["frontOfQueue"]["jobs"]]

    def compute_environment(self, name: str, cpus: int = 8, state: str = "ENABLED") -> str:
        """A compute environment of at most ``cpus``; a DISABLED one holds its jobs RUNNABLE for as long as a test likes."""
        resources = {"type": "EC2", "maxvCpus": cpus, "subnets": ["subnet-none"]}
        facts = {"computeEnvironmentName": name, "type": "MANAGED", "state": state}
        self.api.create_compute_environment(**facts, computeResources=resources)
        return name

    def queue(self, name: str, compute_environment: str, priority: int = 1, **request: Any) -> str:
        order = [{"order": 1, "computeEnvironment": compute_environment}]
        self.api.create_job_queue(jobQueueName=name, priority=priority, computeEnvironmentOrder=order, **request)
        return name

    def remove(self, queues: list[str], compute_environments: list[str]) -> None:
        """Delete queues with all their jobs, then compute environments: other tests of the same server have at most 50 of each, too."""
        for queue in queues:
            self.api.update_job_queue(jobQueue=queue, state="DISABLED")
            self.api.delete_job_queue(jobQueue=queue)
        for compute_environment in compute_environments:
            self.api.update_compute_environment(computeEnvironment=compute_environment, state="DISABLED")
        gone = lambda: not queues or not self.api.describe_job_queues(jobQueues=queues)["jobQueues"]  # noqa: E731
        wait_for(gone, 60, f"the end of {queues}")
        for compute_environment in compute_environments:
            self.api.delete_compute_environment(computeEnvironment=compute_environment)


def container(script: str, changes: dict[str, Any]) -> dict[str, Any]:
    """``containerProperties`` for ``sh -c script``; takes ``env``, ``cpus`` and ``container`` out of ``changes``."""
    base = definitions.container(["sh", "-c", script], changes.pop("cpus", "0.1"), changes.pop("env", {}))
    return {**base, "image": "any", **changes.pop("container", {})}


def pairs(environment: dict[str, str]) -> list[dict[str, str]]:
    return [{"name": name, "value": value} for name, value in environment.items()]


def gate(folder: Path, name: str) -> None:
    """Let those go on who wait with :data:`UNTIL`."""
    (folder / name).touch()


@contextmanager
def refused(*parts: str, status: int = 400) -> Iterator[None]:
    """The call inside is refused with AWS's ClientException, in one line that contains ``parts``."""
    with pytest.raises(ClientError) as caught:
        yield
    answer = caught.value.response
    assert type(caught.value).__name__ == answer["Error"]["Code"] == "ClientException", answer
    assert answer["ResponseMetadata"]["HTTPStatusCode"] == status
    message = answer["Error"]["Message"]
    assert all(part in message for part in parts) and "\n" not in message, message


def aws(url: str, *arguments: str, fails: bool = False) -> Any:
    """The real command, as a person types it: its JSON answer, or with ``fails`` what it says on standard error."""
    done = subprocess.run(
        [AWS, *arguments, "--endpoint-url", url],
        env={
            **{name: value for name, value in os.environ.items() if not name.startswith("AWS_")},
            "AWS_ACCESS_KEY_ID": "x",
            "AWS_SECRET_ACCESS_KEY": "y",
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_CONFIG_FILE": os.devnull,
            "AWS_SHARED_CREDENTIALS_FILE": os.devnull,
        },
        capture_output=True,
        text=True,
        timeout=60 * PATIENCE,
    )
    assert (done.returncode != 0) is fails, done.stdout + done.stderr
    return done.stderr if fails else json.loads(done.stdout or "{}")
