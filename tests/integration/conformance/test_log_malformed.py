"""Whatever is sent to ``POST /`` and to operations of Batch: a refusal in AWS's shape, never an internal error."""

from __future__ import annotations

import httpx
import pytest

from tests.conftest import Serving

BODIES = [
    b"", b"[]", b"{", b"null", b'"x"', b"\xff\xfe", b"[" * 5000, b'{"a":' * 5000, b'{"logGroupName": 3}',
    b'{"logGroupName": "/aws/batch/job", "logStreamName": "\\ud800", "logStreamNamePrefix": "\\ud800"}',
    b'{"logGroupName": "/aws/batch/job", "logStreamNamePrefix": "a\\u0000"}',
    b'{"logGroupName": "/aws/batch/job", "startTime": ' + b"9" * 60 + b"}",
    b'{"logGroupName": "/aws/batch/job", "logStreamName": "a/b/1/node-0", "startTime": -1}',
    b'{"logGroupName": "/aws/batch/job", "logStreamName": "a/b/1/node-0", "limit": 1e3}',
    b'{"logGroupName": "/aws/batch/job", "logStreamName": "a/b/1/node-0", "limit": null}',
    b'{"logGroupName": "/aws/batch/job", "nextToken": "f%s", "limit": 0}' % (b"9" * 56),
    b'{"logGroupName": "/aws/batch/job", "orderBy": "x", "logStreamNames": [null], "descending": "yes"}',
    b'{"logGroupName": "/aws/batch/job", "nextToken": "/", "logStreamNames": {}}',
    b'{"logGroupIdentifiers": []}', b'{"logGroupIdentifiers": ["/aws/batch/job"], "logStreamNames": []}',
    b'{"logGroupIdentifiers": ["/aws/batch/job"], "logStreamNames": ["a"], "logStreamNamePrefixes": ["a"]}',
    b'{"logGroupNamePrefix": "a", "logGroupNamePattern": "b"}', b'{"nextToken": "x"}',
]  # fmt: skip


@pytest.mark.parametrize("operation", ["GetLogEvents", "FilterLogEvents", "DescribeLogStreams", "StartLiveTail", "No"])
def test_no_malformed_request_is_a_server_error(shared_server: Serving, operation: str) -> None:
    for body in BODIES:
        headers = {"X-Amz-Target": f"Logs_20140328.{operation}"}
        answer = httpx.post(shared_server.url, content=body, headers=headers)
        assert answer.status_code == 400, (body, answer.text)
        kind = answer.json()["__type"]
        assert kind in ("InvalidParameterException", "ResourceNotFoundException") and answer.json()["message"]
        assert "\n" not in answer.json()["message"] and answer.headers["content-type"] == "application/x-amz-json-1.1"


@pytest.mark.parametrize("target", [None, "", "Logs_20140328.", "Logs_20140328.__class__"])
def test_a_request_without_a_known_target_is_refused(shared_server: Serving, target: str | None) -> None:
    headers = {} if target is None else {"X-Amz-Target": target}
    answer = httpx.post(shared_server.url, content=b"{}", headers=headers)
    assert answer.status_code == 400 and "supported are" in answer.json()["message"]


@pytest.mark.parametrize("body", [*BODIES[:3], b'"x"', b'{"jobs": 3}', b'{"jobs": [null]}', b"\xff\xfe", b"[" * 5000])
def test_no_malformed_request_of_batch_is_a_server_error(shared_server: Serving, body: bytes) -> None:
    for operation in ("describejobs", "submitjob", "registerjobdefinition", "listjobs", "terminatejob", "nonsense"):
        answer = httpx.post(f"{shared_server.url}/v1/{operation}", content=body)
        assert answer.status_code == 400, answer.text
        assert answer.headers["x-amzn-errortype"] == "ClientException" and "\n" not in answer.json()["message"]
