"""No request, however malformed, yields a 500 or a traceback: fuzzing over HTTP against a real server.

``make test`` sends the same few hundred requests each time; ``make fuzz`` sends ten thousand others each time ($MUSTER_FUZZ says
how many). The server has too little to start anything, so that nothing of what is submitted ever runs.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import random
import socket
from collections import Counter
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
import requests
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.errors import Unsatisfiable

from tests.support.conformance import fuzz_requests as good
from tests.support.conformance import fuzzing
from tests.support.conformance.fuzzed import TOKEN, Fuzzed
from tests.support.conformance.fuzzing import Call
from tests.support.conformance.keys import client
from tests.support.keys import HomeKeys
from tests.support.processes import processes_of

EXAMPLES = int(os.environ.get("MUSTER_FUZZ", "300"))
IS_LONG = "MUSTER_FUZZ" in os.environ


def share(part: float) -> settings:
    """This part of all examples; the same ones each time, unless many are asked for."""
    always: dict[str, Any] = {"database": None, "deadline": None, "suppress_health_check": list(HealthCheck)}
    return settings(max_examples=max(1, int(EXAMPLES * part)), derandomize=not IS_LONG, **always)


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory, fuzz_report: Counter[str]) -> Iterator[Fuzzed]:
    """A server that has seen a gang, a single job and a run with logs, and has no room for anything more."""
    server = Fuzzed(tmp_path_factory.mktemp("fuzz") / "home", "--cpus", "2")
    batch = server.client.batch
    native = {"MUSTER_ON_CHILD_FAILURE": "restart", "MUSTER_SPEC": json.dumps({"name": "native", "command": ["true"]})}
    for name, changes in (("gang", {}), ("single", {}), ("native", {"environment": native})):
        definition = good.gang(name) if name != "single" else good.single(name)
        for each in definition.get("nodeProperties", {}).get("nodeRangeProperties", []):
            pairs = [{"name": key, "value": value} for key, value in changes.get("environment", {}).items()]
            each["container"]["environment"] += pairs
        batch("RegisterJobDefinition", **definition)
        server.names[name] = batch("SubmitJob", jobName=name, jobQueue="default", jobDefinition=name)["jobId"]
    runs = [server.wait(server.names[name])["run"] for name in ("gang", "single", "native")]
    server.names["run"] = runs[-1]
    server.restart("--cpus", "0.1", "--rate-limit", "0")
    server.restore()
    yield server
    for status, count in sorted(server.counts.items()):
        fuzz_report[f"malformed requests, answered with {status}"] += count
    server.close()


def test_single_faults(fuzzed: Fuzzed) -> None:
    """One value of a request that works is replaced; some of all such requests, or (``make fuzz``) as good as all."""
    calls = fuzzing.single_faults()
    random.Random(None if IS_LONG else 1).shuffle(calls)
    for operation, request in calls[: EXAMPLES * 2 if IS_LONG else EXAMPLES // 3]:
        fuzzed.send(fuzzing.call_of(operation, request))


DRAWN = {
    "Batch, within the schema": (0.35, fuzzing.batch_calls(spoil=False)),
    "Batch, with faults": (0.3, fuzzing.batch_calls(spoil=True)),
    "logs": (0.12, fuzzing.logs_calls()),
    "tags": (0.08, fuzzing.tag_calls()),
    "stray paths": (0.05, fuzzing.stray_calls()),
    "resume": (0.05, fuzzing.resume_calls()),
    "clone": (0.03, fuzzing.clone_calls()),
}
"""Kinds of drawn requests: which part of all they are."""


@pytest.mark.parametrize("kind", DRAWN)
def test_requests_of_every_kind(fuzzed: Fuzzed, kind: str) -> None:
    part, calls = DRAWN[kind]

    def send(call: Call) -> None:
        fuzzed.send(call)

    share(part)(given(call=calls)(send))()


def test_the_native_api_by_its_own_schema(fuzzed: Fuzzed) -> None:
    bearer = {"Authorization": f"Bearer {TOKEN}"}
    schema = schemathesis.openapi.from_url(f"{fuzzed.url}/api/openapi.json", headers=bearer)
    operations = [each.ok() for each in schema.get_all_operations()]
    names = fuzzed.names
    known = st.sampled_from((None, None, names["gang"], "gang", names["run"], f"{names['array']}:1"))
    with requests.Session() as session:
        session.trust_env = False

        def probe(case: schemathesis.Case, name: str | None) -> None:
            for key in case.path_parameters if name else ():
                case.path_parameters[key] = name
            case.query.pop("follow", None)  # the answer goes on until the job is over
            sent = {"session": session, "headers": bearer, "timeout": 60}
            answer = case.call(base_url=fuzzed.url, **sent)
            case.validate_response(answer, checks=[schemathesis.checks.not_a_server_error])
            fuzzed.counts[answer.status_code] += 1

        for operation, mode in itertools.product(operations, schemathesis.GenerationMode):
            cases = operation.as_strategy(generation_mode=mode)
            with contextlib.suppress(Unsatisfiable):  # no input is wrong where any text will do
                share(0.3 / len(operations))(given(case=cases, name=known)(probe))()
    assert "Traceback" not in fuzzed.complaints()


GARBAGE = (
    b"\r\n\r\n",
    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
    b"GET / HTTP/9.9\r\n\r\n",
    b"GET /\xff\xfe HTTP/1.1\r\nHost: x\r\n\r\n",
    b"POST http://elsewhere/v1/listjobs HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 2\r\n\r\n{}",
    b"OPTIONS * HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    b"POST /v1/listjobs HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: -1\r\n\r\n{}",
    b"POST /v1/listjobs HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 2\r\nContent-Length: 3\r\n\r\n{}",
    b"POST /v1/listjobs HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 99999999999999999999\r\n\r\n{}",
    b"POST /v1/listjobs HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n{}\r\n0\r\n\r\n",
    b"POST /v1/listjobs HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: gzip\r\n\r\n{}",
    b"POST /v1/listjobs HTTP/1.1\r\nHost: a\r\nHost: b\r\nContent-Length: 2\r\n\r\n{}",
    b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Amz-Target: \xff\xfe\r\nContent-Length: 2\r\n\r\n{}",
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n" + b"X: " + b"y" * 100_000 + b"\r\n\r\n",
    b"GET /" + b"x" * 100_000 + b" HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    b"GET / HTTP/1.0\r\n\r\n",
)


@pytest.mark.parametrize("token", ("", TOKEN))
@pytest.mark.parametrize("data", GARBAGE, ids=range(len(GARBAGE)))
def test_bytes_that_are_hardly_http(fuzzed: Fuzzed, data: bytes, token: str) -> None:
    data = data.replace(b"\r\nHost: 127.0.0.1", b"\r\nHost: 127.0.0.1\r\nAuthorization: Bearer " + token.encode())
    address = httpx.URL(fuzzed.url)
    with socket.create_connection((address.host, address.port), timeout=60) as connection:
        connection.sendall(data)
        connection.shutdown(socket.SHUT_WR)
        try:
            answer = connection.recv(1 << 16)
        except ConnectionResetError:
            answer = b""
    assert not answer or answer.split()[1].startswith(b"4"), answer
    assert "Traceback" not in (output := fuzzed.complaints()), output


def test_afterwards_a_real_client_sees_everything_and_nothing_ran(fuzzed: Fuzzed) -> None:
    """What all these requests have left behind spoils no answer, no pass of the scheduler and no start."""
    key = HomeKeys(fuzzed.home).create("reader")
    statuses = ("SUBMITTED", "PENDING", "RUNNABLE", "STARTING", "RUNNING", "SUCCEEDED", "FAILED")
    for _ in range(2):
        batch = client(fuzzed.url, key.access_key_id, key.secret)

        def pages(operation: str, member: str, batch: Any = batch, **request: Any) -> list[Any]:
            return [each for page in batch.get_paginator(operation).paginate(**request) for each in page[member]]

        assert pages("describe_compute_environments", "computeEnvironments")
        assert pages("describe_job_definitions", "jobDefinitions")
        assert pages("list_scheduling_policies", "schedulingPolicies")
        jobs = {status: 0 for status in statuses}
        for queue in pages("describe_job_queues", "jobQueues"):
            batch.get_job_queue_snapshot(jobQueue=queue["jobQueueName"])
            for status in statuses:
                found = pages("list_jobs", "jobSummaryList", jobQueue=queue["jobQueueName"], jobStatus=status)
                jobs[status] += len(found)
                for start in range(0, len(found), 100):
                    some = [each["jobId"] for each in found[start : start + 100]]
                    assert len(batch.describe_jobs(jobs=some)["jobs"]) == len(some)
        assert jobs["SUCCEEDED"] == 3 and jobs["STARTING"] == jobs["RUNNING"] == 0 < jobs["RUNNABLE"]
        assert processes_of(fuzzed.home) == []
        fuzzed.restart("--cpus", "0.1")
    assert "Traceback" not in fuzzed.complaints()
