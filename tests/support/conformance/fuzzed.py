"""A server to which malformed requests are sent, and what each answer of it must be."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import httpx
import pytest

from orchestrator.domain.errors import ApiError
from tests.conftest import Serving
from tests.support.conformance import fuzz_requests as good
from tests.support.conformance.fuzzing import Call

TOKEN = "fuzz-token-for-tests"
KEPT = {"default", "local", "fuzz", "fair", "spare", "made"}
"""Queues and compute environments that the requests name; others are removed now and then, since there may be only 50."""


class Fuzzed(Serving):
    """A server with a token (so that odd Host headers get past the guard), whose errors are kept in a file."""

    token = TOKEN

    def __init__(self, home: Path, *options: str) -> None:
        self.names: dict[str, str] = {}
        """Ids for the placeholders of drawn requests."""
        self.counts: Counter[int] = Counter()
        """Requests by the status of the answer."""
        self.offset = 0
        super().__init__(home, *options)

    def start(self) -> None:
        self.errors = self.home.parent / "stderr"
        super().start()
        self.http = httpx.Client(base_url=self.url, timeout=60, trust_env=False)

    def restart(self, *options: str) -> None:
        """Go on with other options on the same home."""
        super().close()
        self.options = options
        self.start()

    def restore(self) -> None:
        """Bring back what requests have deleted or changed, so that names go on hitting something."""
        for queue in self._names("DescribeJobQueues", "jobQueues", "jobQueueName") - KEPT:
            self._try("UpdateJobQueue", jobQueue=queue, state="DISABLED")
            self._try("DeleteJobQueue", jobQueue=queue)
        for compute_environment in (
            self._names("DescribeComputeEnvironments", "computeEnvironments", "computeEnvironmentName") - KEPT
        ):
            self._try("UpdateComputeEnvironment", computeEnvironment=compute_environment, state="DISABLED")
            self._try("DeleteComputeEnvironment", computeEnvironment=compute_environment)
        for name in ("fuzz", "spare", "made"):
            self._try("CreateComputeEnvironment", **good.environment(name))
            self._try("CreateSchedulingPolicy", **good.policy(name))
            self._try("CreateJobQueue", **good.queue(name))
        self._try("CreateJobQueue", **good.queue("fair", schedulingPolicyArn=good.POLICY))
        for queue in self._names("DescribeJobQueues", "jobQueues", "jobQueueName") & KEPT:
            self._try("UpdateJobQueue", jobQueue=queue, state="ENABLED")
        for name in ("gang", "single"):
            if not self.client.batch("DescribeJobDefinitions", jobDefinitionName=name, status="ACTIVE")[
                "jobDefinitions"
            ]:
                self._try("RegisterJobDefinition", **getattr(good, name)(name))
        kinds: dict[str, dict[str, Any]] = {"waiting": {}, "array": {"arrayProperties": {"size": 3}}}
        for name, more in kinds.items():
            submitted = self._try("SubmitJob", **good.submission("single", **more))
            self.names |= {name: submitted["jobId"]} if submitted else {}

    def _names(self, operation: str, member: str, key: str) -> set[str]:
        return {each[key] for each in self.client.batch(operation)[member]}

    def _try(self, operation: str, **request: Any) -> dict[str, Any] | None:
        try:
            return self.client.batch(operation, **request)
        except ApiError as error:
            assert error.status < 500, error
            return None

    def send(self, call: Call) -> None:
        """Send the call as it is and check what every answer must be."""
        if sum(self.counts.values()) % 100 == 99:
            self.restore()
        call = call.fill({**self.names, "new": f"new-{sum(self.counts.values())}"})
        supplied = {"Authorization": f"Bearer {TOKEN}", **call.headers}
        headers = [(name.encode(), value.encode("latin-1")) for name, value in supplied.items()]
        target = {"target": call.target.encode()}
        with self.http.stream(call.method, "/", headers=headers, content=call.body, extensions=target) as answer:
            if "eventstream" not in answer.headers.get("content-type", ""):  # which would go on for hours
                answer.read()
            self.check(answer, call)

    def check(self, answer: httpx.Response, call: Call) -> None:
        self.counts[answer.status_code] += 1
        output = self.complaints()
        assert answer.status_code < 500 and "Traceback" not in output, (
            f"{answer.status_code} for {call}\n{output[-6000:]}"
        )
        if answer.status_code >= 400:
            assert answer.headers.get("x-amzn-errortype"), (call, answer.status_code, answer.headers)
            if call.method != "HEAD":
                message = answer.json()["message"]
                assert isinstance(message, str) and message, call
        elif answer.is_success and "json" in (kind := answer.headers.get("content-type", "")) and call.method != "HEAD":
            for document in answer.content.splitlines() if "ndjson" in kind else [answer.content]:
                json.loads(document, parse_constant=lambda name: pytest.fail(f"{name} in the answer to {call}"))

    def complaints(self) -> str:
        """What the server wrote to its standard error since the last call."""
        with open(str(self.errors), encoding="latin-1", newline="") as errors:  # a character a byte
            errors.seek(self.offset)
            output = errors.read()
        self.offset += len(output)
        return output

    def close(self) -> None:
        super().close()
        self.http.close()
