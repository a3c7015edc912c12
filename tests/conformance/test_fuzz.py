"""No request, however malformed, yields a 500 or a traceback: fuzzing over HTTP against a real server.

``make test`` sends the same few hundred requests each time; ``make fuzz`` sends ten thousand others each time ($MUSTER_FUZZ says
how many). The server has too little to start anything, so that nothing of what is submitted ever runs.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import boto3
import httpx
import pytest
import requests
import schemathesis
from botocore.config import Config
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from orchestrator.client import ApiError, Client
from tests.conformance import fuzzing
from tests.conformance.fuzzing import Call
from tests.conftest import MUSTER, Serving, processes_of

EXAMPLES = int(os.environ.get("MUSTER_FUZZ", "300"))
IS_LONG = "MUSTER_FUZZ" in os.environ
TOKEN = "fuzz-token"
KEPT = ("default", "fuzz", "fair", "spare")
"""Queues that the drawn requests name; others are removed now and then, since there may be only 50."""


def share(part: float) -> settings:
    """This part of all examples; the same ones each time, unless many are asked for."""
    return settings(
        max_examples=max(1, int(EXAMPLES * part)),
        derandomize=not IS_LONG,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )


class Fuzzed(Serving):
    """A server with a token (so that odd Host headers get past the guard), whose errors are kept in a file."""

    def start(self) -> None:
        self.errors = self.home.parent / "stderr"
        with open(self.errors, "ab") as errors:
            self.process = subprocess.Popen(
                [MUSTER, "serve", "--port", "0", *self.options],
                env={**os.environ, "MUSTER_HOME": str(self.home), "MUSTER_TOKEN": TOKEN},
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith("Muster serves "), line + self.errors.read_text()
        self.url = line.split()[2]
        self.client = Client(self.url, TOKEN)
        self.http = httpx.Client(base_url=self.url, timeout=60, trust_env=False)
        self.names: dict[str, str] = getattr(self, "names", {})
        self.counts: Counter[int] = Counter()
        self.fine: set[str] = set()
        """Targets that answered 200 at least once."""

    def restart(self, *options: str) -> None:
        """Go on with other options on the same home."""
        super().close()
        self.options = options
        self.start()

    def restore(self) -> None:
        """Bring back what requests have deleted or changed, so that names go on hitting something."""
        self._try("CreateComputeEnvironment", **fuzzing.environment("fuzz"))
        self._try("CreateComputeEnvironment", **fuzzing.environment("spare"))
        self._try("CreateSchedulingPolicy", **fuzzing.policy("fuzz"))
        for queue in (queue for queue in self._queues() if queue not in KEPT):
            self._try("UpdateJobQueue", jobQueue=queue, state="DISABLED")
            self._try("DeleteJobQueue", jobQueue=queue)
        self._try("CreateJobQueue", **fuzzing.queue("spare"))
        self._try("CreateJobQueue", **fuzzing.queue("fuzz"))
        self._try("CreateJobQueue", **fuzzing.queue("fair", schedulingPolicyArn=fuzzing.POLICY))
        for queue in KEPT:
            self._try("UpdateJobQueue", jobQueue=queue, state="ENABLED")
        for name in ("gang", "single"):
            if not self.client.batch("DescribeJobDefinitions", jobDefinitionName=name, status="ACTIVE")[
                "jobDefinitions"
            ]:
                self._try("RegisterJobDefinition", **getattr(fuzzing, name)(name))
        for name, more in (("waiting", {}), ("array", {"arrayProperties": {"size": 3}})):
            submitted = self._try("SubmitJob", **fuzzing.submission("single", **more))
            self.names |= {name: submitted["jobId"]} if submitted else {}

    def _queues(self) -> list[str]:
        return [queue["jobQueueName"] for queue in self.client.batch("DescribeJobQueues")["jobQueues"]]

    def _try(self, operation: str, **request: Any) -> dict[str, Any] | None:
        try:
            return self.client.batch(operation, **request)
        except ApiError as error:
            assert error.status < 500, error
            return None

    def send(self, call: Call) -> None:
        """Send the call as it is and check what every answer must be."""
        if sum(self.counts.values()) % 100 == 0:
            self.restore()
        call = call.fill(self.names)
        given = {"Authorization": f"Bearer {TOKEN}", **call.headers}
        headers = [(name.encode(), value.encode("latin-1")) for name, value in given.items()]
        target = {"target": call.target.encode()}
        with self.http.stream(call.method, "/", headers=headers, content=call.body, extensions=target) as answer:
            if "eventstream" not in answer.headers.get("content-type", ""):  # which would go on for hours
                answer.read()
            self.check(answer, call)

    def check(self, answer: httpx.Response, call: Call) -> None:
        self.counts[answer.status_code] += 1
        said = self.errors.read_text()
        assert answer.status_code < 500 and "Traceback" not in said, f"{answer.status_code} for {call}\n{said[-6000:]}"
        if answer.status_code == 200:
            self.fine.add(call.target if call.target != "/" else call.headers.get("X-Amz-Target", "/"))
        if answer.status_code >= 400:
            assert answer.headers.get("x-amzn-errortype"), (call, answer.status_code, answer.headers)
            if call.method != "HEAD":
                message = answer.json()["message"]
                assert isinstance(message, str) and message, call
        elif answer.is_success and "json" in answer.headers.get("content-type", "") and call.method != "HEAD":
            json.loads(answer.content, parse_constant=lambda name: pytest.fail(f"{name} in the answer to {call}"))

    def close(self) -> None:
        super().close()
        self.http.close()


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fuzzed]:
    """A server that has seen a gang, a single job and a run with logs, and has no room for anything more."""
    server = Fuzzed(tmp_path_factory.mktemp("fuzz") / "home", "--cpus", "2")
    batch = server.client.batch
    native = {"MUSTER_ON_CHILD_FAILURE": "restart", "MUSTER_SPEC": json.dumps({"name": "native", "command": ["true"]})}
    for name, changes in (("gang", {}), ("single", {}), ("native", {"environment": native})):
        definition = fuzzing.gang(name) if name != "single" else fuzzing.single(name)
        for each in definition.get("nodeProperties", {}).get("nodeRangeProperties", []):
            pairs = [{"name": key, "value": value} for key, value in changes.get("environment", {}).items()]
            each["container"]["environment"] += pairs
        batch("RegisterJobDefinition", **definition)
        server.names[name] = batch("SubmitJob", jobName=name, jobQueue="default", jobDefinition=name)["jobId"]
    runs = [server.wait(server.names[name])["run"] for name in ("gang", "single", "native")]
    server.names["run"] = runs[-1]
    server.restart("--cpus", "0.1", "--rate-limit", "0")
    yield server
    if IS_LONG:
        print(f"\n{sum(server.counts.values())} requests to {server.url}: {dict(sorted(server.counts.items()))}")
    server.close()


@share(0.35)
@given(call=fuzzing.batch_calls(spoil=False))
def test_batch_requests_within_the_schema(fuzzed: Fuzzed, call: Call) -> None:
    fuzzed.send(call)


@share(0.35)
@given(call=fuzzing.batch_calls(spoil=True))
def test_batch_requests_with_faults(fuzzed: Fuzzed, call: Call) -> None:
    fuzzed.send(call)


@share(0.15)
@given(call=fuzzing.logs_calls())
def test_logs_requests(fuzzed: Fuzzed, call: Call) -> None:
    fuzzed.send(call)


@share(0.1)
@given(call=fuzzing.tag_calls())
def test_tag_requests(fuzzed: Fuzzed, call: Call) -> None:
    fuzzed.send(call)


@share(0.05)
@given(call=fuzzing.stray_calls())
def test_stray_paths(fuzzed: Fuzzed, call: Call) -> None:
    fuzzed.send(call)
