"""Who gets in, as real AWS clients see it: boto3 and botocore's own signer against a real server with keys."""

from __future__ import annotations

import datetime
import itertools
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import botocore.auth
import httpx
import pytest
from botocore.awsrequest import AWSRequest, AWSResponse
from botocore.credentials import Credentials
from botocore.exceptions import ClientError
from botocore.httpsession import URLLib3Session

from orchestrator.client import Client
from orchestrator.persistence.access_keys import Key
from tests.conftest import Serving, call_muster, wait_for
from tests.support.conformance.keys import client, refused
from tests.support.definitions import container, multinode
from tests.support.keys import HomeKeys

ARN = "arn:aws:batch:us-east-1:000000000000:job/6c4a7d0e-0000-4000-8000-000000000000"
SIGNATURE_ERRORS = {
    *("UnrecognizedClientException", "InvalidSignatureException", "IncompleteSignature"),
    *("MissingAuthenticationToken", "RequestExpired"),
}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("home")


@pytest.fixture(scope="module")
def key(home: Path) -> Key:
    """A key that may do everything."""
    return HomeKeys(home).create("admin")


@pytest.fixture(scope="module")
def served(home: Path, key: Key) -> Iterator[Serving]:
    with Serving(home, "--cpus", "2") as server:
        server.client = Client(server.url, f"{key.access_key_id}:{key.secret}")
        yield server


def signed(key: Key, method: str, url: str, body: bytes = b"", service: str = "batch", **headers: str) -> AWSRequest:
    """A request as boto3 would sign it. ``headers``: with _ for -."""
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    request = AWSRequest(method, url, {"Content-Type": "application/json", **named}, body)
    signer = botocore.auth.SigV4Auth(Credentials(key.access_key_id, key.secret), service, "us-east-1")
    signer.add_auth(request)
    return request


def send(request: AWSRequest) -> AWSResponse:
    """By the transport of boto3, which sends the path as it stands."""
    return URLLib3Session().send(request.prepare())


def code(error: pytest.ExceptionInfo[ClientError]) -> tuple[str, int]:
    response = error.value.response
    return response["Error"]["Code"], response["ResponseMetadata"]["HTTPStatusCode"]


def definition(name: str, size: int = 0) -> dict[str, Any]:
    return multinode(name, container(env={"FILLING": "x" * size}))


def test_a_wrong_secret_and_an_unknown_key_get_different_errors(served: Serving, key: Key) -> None:
    with pytest.raises(ClientError, match="does not match the signature") as wrong:
        client(served.url, key.access_key_id, key.secret[::-1]).list_jobs(jobQueue="default")
    assert code(wrong) == ("InvalidSignatureException", 403)
    with pytest.raises(ClientError, match="muster keys list") as unknown:
        client(served.url, "MSTRAAAAAAAAAAAAAAAA", key.secret).list_jobs(jobQueue="default")
    assert code(unknown) == ("UnrecognizedClientException", 403)


def test_no_signature_is_refused_everywhere_but_at_the_health_check(served: Serving) -> None:
    for method, path in [
        ("POST", "/v1/listjobs"),
        ("POST", "/v1/submitjob"),
        ("POST", "/"),
        ("GET", "/api/runs"),
        ("GET", "/api/docs"),
        ("GET", "/api/openapi.json"),
        ("GET", "/metrics"),
        ("DELETE", "/v1/tags/x"),
        ("GET", "/healthz/../api/runs"),
    ]:
        refused(httpx.request(method, served.url + path), "MissingAuthenticationToken", "muster keys create")
    assert httpx.get(f"{served.url}/healthz").json()["status"] == "ok"


def test_a_websocket_needs_the_same_authentication(served: Serving) -> None:
    address = urlsplit(served.url)
    head = f"GET /live HTTP/1.1\r\nHost: {address.netloc}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    key = f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {'A' * 22}==\r\n\r\n"
    with socket.create_connection((address.hostname, address.port), timeout=30) as connection:
        connection.sendall((head + key).encode())
        assert connection.recv(65536).splitlines()[0].startswith(b"HTTP/1.1 403 ")


def test_an_encoded_arn_in_the_path_and_a_query_are_verified_as_they_were_signed(served: Serving, key: Key) -> None:
    batch = client(served.url, key.access_key_id, key.secret)
    for call in (
        lambda: batch.list_tags_for_resource(resourceArn=ARN),
        lambda: batch.untag_resource(resourceArn=ARN, tagKeys=["b c", "a/ä", "+&="]),
        lambda: batch.tag_resource(resourceArn=ARN, tags={"ä": "€"}),
    ):
        try:
            call()
        except ClientError as error:  # such a job there is none
            assert error.response["Error"]["Code"] not in SIGNATURE_ERRORS, error
    for path in ("/v1/tags/arn%3Aaws%3Abatch%3A%3Ajob%2Fx", "/api/runs?b=2&a=%20&b=1&flag", "/api//runs/./x/..?", "/"):
        answer = send(signed(key, "GET", served.url + path))
        assert answer.headers.get("x-amzn-errortype") not in SIGNATURE_ERRORS, (path, answer.content)


def test_logs_requests_are_verified_too_and_other_services_are_not(served: Serving, key: Key) -> None:
    logs = client(served.url, key.access_key_id, key.secret, "logs")
    try:
        logs.describe_log_groups()
    except ClientError as error:
        assert error.response["Error"]["Code"] not in SIGNATURE_ERRORS, error
    with pytest.raises(ClientError) as caught:
        client(served.url, key.access_key_id, key.secret[::-1], "logs").describe_log_groups()
    assert code(caught)[0] == "InvalidSignatureException"
    answer = send(signed(key, "POST", f"{served.url}/v1/listjobs", b"{}", service="s3"))
    refused(answer, "IncompleteSignature", "batch or logs")


def test_any_change_after_signing_is_detected(served: Serving, key: Key) -> None:
    url = f"{served.url}/v1/describejobs"

    def changed(request: AWSRequest, **changes: Any) -> AWSResponse:
        for name, value in changes.items():
            setattr(request, name, value)
        return send(request)

    assert send(signed(key, "POST", url, b'{"jobs": []}')).status_code == 200
    refused(changed(signed(key, "POST", url, b'{"jobs": []}'), data=b'{"jobs": ["x"]}'), "InvalidSignatureException")
    refused(changed(signed(key, "POST", url, b"{}"), url=f"{served.url}/v1/terminatejob"), "InvalidSignatureException")
    refused(changed(signed(key, "POST", url, b"{}"), url=f"{url}?x=1"), "InvalidSignatureException")
    refused(changed(signed(key, "POST", url, b"{}"), method="DELETE"), "InvalidSignatureException")
    for service in ("batch", "logs"):
        request = signed(key, "POST", url, b"{}", service)
        request.headers["X-Amz-Target"] = "Logs_20140328.DeleteLogGroup"
        refused(send(request), "InvalidSignatureException", "x-amz-target is not signed")


@pytest.mark.parametrize("digest", ["UNSIGNED-PAYLOAD", "STREAMING-AWS4-HMAC-SHA256-PAYLOAD", "0" * 64, ""])
def test_a_body_that_is_not_signed_is_refused(served: Serving, key: Key, digest: str) -> None:
    request = signed(key, "POST", f"{served.url}/v1/describejobs", b'{"jobs": []}', x_amz_content_sha256=digest)
    refused(send(request), "InvalidSignatureException", "the body must be signed")


@pytest.mark.parametrize("minutes", [-16, 16, -14, 14])
def test_a_signature_holds_15_minutes(served: Serving, key: Key, monkeypatch: pytest.MonkeyPatch, minutes: int) -> None:
    then = datetime.datetime.now(datetime.UTC) + datetime.timedelta(minutes=minutes)
    monkeypatch.setattr(botocore.auth, "get_current_datetime", lambda: then)
    answer = send(signed(key, "POST", f"{served.url}/v1/describejobs", b'{"jobs": []}'))
    if abs(minutes) < 15:
        assert answer.status_code == 200
    else:
        refused(answer, "RequestExpired", "set the client's clock")


def test_the_bearer_form_of_a_key_and_the_command_work(served: Serving, key: Key, home: Path) -> None:
    assert served.client.batch("DescribeJobs", jobs=["x"]) == {"jobs": []}
    assert served.client.get("/api/capacity")["hosts"]
    right = f"{key.access_key_id}:{key.secret}"
    assert call_muster("list", home=home, MUSTER_TOKEN=right).returncode == 0
    without = call_muster("list", home=home)
    assert without.returncode == 1 and without.stderr.startswith("muster: a token is needed"), without.stderr
    for wrong in (f"{right}x", right[:-1], key.secret, f"{key.access_key_id}:", ":", key.access_key_id):
        answer = httpx.get(f"{served.url}/api/runs", headers={"Authorization": f"Bearer {wrong}"})
        refused(answer, "UnrecognizedClientException", "set MUSTER_TOKEN")


def test_a_read_only_key_may_only_read(served: Serving, home: Path) -> None:
    reader = HomeKeys(home).create("reader", read_only=True)
    batch = client(served.url, reader.access_key_id, reader.secret)
    assert batch.describe_jobs(jobs=["x"])["jobs"] == []
    batch.list_jobs(jobQueue="default")
    logs = client(served.url, reader.access_key_id, reader.secret, "logs")
    for call in (
        lambda: batch.submit_job(jobName="x", jobQueue="default", jobDefinition="x"),
        lambda: logs.delete_log_group(logGroupName="x"),
    ):
        with pytest.raises(ClientError, match="key reader is read-only") as caught:
            call()
        assert code(caught) == ("AccessDeniedException", 403)
    bearer = {"Authorization": f"Bearer {reader.access_key_id}:{reader.secret}"}
    assert httpx.get(f"{served.url}/api/runs", headers=bearer).status_code == 200
    for path in ("/api/runs/x/resume", "/v1/SubmitJob", "/v1/describe/../submitjob", "/v1/getx%2Fy", "//v1/listjobs"):
        refused(httpx.post(served.url + path, headers=bearer, json={}), "AccessDeniedException")


def test_a_key_for_one_queue_changes_no_tag_of_what_others_depend_on(served: Serving, home: Path) -> None:
    robots = HomeKeys(home).create("robots", ("robots",))
    own, prefix = client(served.url, robots.access_key_id, robots.secret), "arn:aws:batch:us-east-1:000000000000:"
    for change in (
        lambda: own.tag_resource(resourceArn=f"{prefix}compute-environment/local", tags={"muster:hosts": "nobody"}),
        lambda: own.untag_resource(resourceArn=f"{prefix}job-queue/default", tagKeys=["a"]),
    ):
        with pytest.raises(ClientError, match="key robots is not authorized") as caught:
            change()
        assert code(caught) == ("AccessDeniedException", 403)


def test_no_host_that_a_web_page_can_name_reaches_an_open_server(shared_server: Serving) -> None:
    for host in ("127.evil.example", "evil.example", "[", "127.0.0.1.evil.example", "localhost.evil.example", ""):
        assert httpx.get(f"{shared_server.url}/api/runs", headers={"Host": host}).status_code == 403, host
    for host in ("localhost", "127.0.0.1:1", "[::1]:80"):
        assert httpx.get(f"{shared_server.url}/api/runs", headers={"Host": host}).status_code == 200, host


@pytest.mark.parametrize(
    "authorization",
    [
        b"\xff\xfe\x80",
        b"Bearer \xff\xff:\xff",
        b"AWS4-HMAC-SHA256",
        b"AWS4-HMAC-SHA256 Credential=/////, SignedHeaders=;;, Signature=\xff",
        b"AWS4-HMAC-SHA256 Credential=%s//us-east-1/batch/aws4_request, SignedHeaders=host;x-amz-date, Signature=0",
        b"AWS4-HMAC-SHA256 Credential=%s/2\xb2/\xe4/logs/aws4_request,SignedHeaders=host;x-amz-date;\xe4,Signature=\xe4",
        b"AWS4-HMAC-SHA256 Credential=%s/20260101/x/batch/aws4_request, SignedHeaders=host;x-amz-date, Signature=\xe4",
        b"AWS4-HMAC-SHA256 " + b"=," * 10000,
        b"AWS4-ECDSA-P256-SHA256 Credential=%s/20260101/batch/aws4_request, SignedHeaders=host, Signature=00",
        b"Basic YTpi",
    ],
)
@pytest.mark.parametrize("date", [b"20269999T999999Z", b"\xb2\xb2", b"{now}"])
def test_garbage_in_headers_is_refused_in_a_line(served: Serving, key: Key, authorization: bytes, date: bytes) -> None:
    now = datetime.datetime.now(datetime.UTC).strftime("%Y%m%dT%H%M%SZ").encode()
    signature = authorization.replace(b"%s", key.access_key_id.encode())
    headers = [(b"Authorization", signature), (b"X-Amz-Date", date.replace(b"{now}", now))]
    answer = httpx.post(f"{served.url}/v1/describejobs", headers=headers, content=b"\x00\xff")
    assert answer.status_code == 403 and answer.headers["x-amzn-errortype"] in SIGNATURE_ERRORS, answer.text
    assert "\n" not in answer.json()["message"]


def test_a_header_that_decides_may_not_be_sent_twice(served: Serving, key: Key) -> None:
    bearer = f"Bearer {key.access_key_id}:{key.secret}"
    answer = httpx.get(f"{served.url}/api/runs", headers=[("Authorization", bearer), ("Authorization", bearer)])
    refused(answer, "IncompleteSignature", "more than once")


def test_half_a_character_in_json_is_not_a_server_error(shared_server: Serving) -> None:
    for body in (b'{"jobQueue": "\\ud800"}', b'{"jobQueue": "\xed\xa0\x80"}', '{"jobQueue": "x"}'.encode("utf-16")):
        answer = httpx.post(f"{shared_server.url}/v1/listjobs", content=body)
        refused(answer, "ClientException", "not JSON", 400)


def test_requests_are_as_large_as_on_aws_and_no_larger(served: Serving, key: Key) -> None:
    batch = client(served.url, key.access_key_id, key.secret)
    batch.register_job_definition(**definition("sized", 20 << 10))
    with pytest.raises(batch.exceptions.ClientException, match=f"more than {24 << 10} bytes") as caught:
        batch.register_job_definition(**definition("sized", 24 << 10))
    assert code(caught)[1] == 413
    parameters = {"x": "y" * (30 << 10)}
    with pytest.raises(batch.exceptions.ClientException, match=f"more than {30 << 10} bytes"):
        batch.submit_job(jobName="x", jobQueue="default", jobDefinition="sized", parameters=parameters)
    assert batch.describe_jobs(jobs=["x" * (100 << 10)])["jobs"] == []
    bearer = {"Authorization": f"Bearer {key.access_key_id}:{key.secret}"}
    chunks = (b" " * 65536 for _ in range(17))  # without a Content-Length
    answer = httpx.post(f"{served.url}/api/runs/x/resume", headers=bearer, content=chunks)
    refused(answer, "ClientException", f"more than {1 << 20} bytes", 413)


def test_a_body_is_refused_by_its_declared_length_and_a_disconnecting_client_does_no_harm(served: Serving) -> None:
    address = urlsplit(served.url)
    for declared in (b"99999999", b"9" * 25):
        with socket.create_connection((address.hostname, address.port), timeout=30) as connection:
            head = b"POST /v1/describejobs HTTP/1.1\r\nHost: x\r\nContent-Length: " + declared + b"\r\n"
            bearer = served.client._http.headers["authorization"].encode()
            connection.sendall(head + b"Authorization: " + bearer + b"\r\n\r\n")
            assert b" 4" in connection.recv(65536).splitlines()[0]
    with socket.create_connection((address.hostname, address.port), timeout=30) as connection:
        connection.sendall(head.replace(b"9" * 25, b"5") + b"Authorization: " + bearer + b"\r\n\r\n{")
    assert served.client.get("/healthz")["status"] == "ok"


def test_over_the_rate_boto3_is_throttled_and_gets_through_by_trying_again(tmp_path: Path) -> None:
    key, other = HomeKeys(tmp_path).create("a"), HomeKeys(tmp_path).create("b")
    with Serving(tmp_path, "--cpus", "1", "--rate-limit", "5") as server:
        once = client(server.url, key.access_key_id, key.secret)
        with pytest.raises(ClientError, match="key a may send 5 requests per second") as caught:
            for _ in range(200):
                once.describe_jobs(jobs=["x"])
        assert code(caught) == ("TooManyRequestsException", 429)
        client(server.url, other.access_key_id, other.secret).describe_jobs(jobs=["x"])
        patient = client(server.url, key.access_key_id, key.secret, retries={"mode": "standard", "max_attempts": 10})
        retried = 0
        for _ in range(10):
            retried += patient.describe_jobs(jobs=["x"])["ResponseMetadata"]["RetryAttempts"]
        assert retried > 0
        with Client(server.url, f"{other.access_key_id}:{other.secret}") as own:
            for _ in range(15):  # our own client tries again by itself
                own.batch("DescribeJobs", jobs=["x"])
        addresses = (f"10.0.0.{number % 250}" for number in itertools.count())

        def guess() -> int:  # guessing is limited by the client's address, not by the one that it invents
            headers = {"Authorization": "Bearer wrong", "X-Forwarded-For": next(addresses)}
            return http.get("/api/runs", headers=headers).status_code

        with httpx.Client(base_url=server.url) as http:  # one for all: each takes long to make
            wait_for(lambda: guess() == 429, 10, "limited guesses")
