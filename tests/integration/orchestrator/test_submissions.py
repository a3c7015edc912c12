"""Submissions by ``POST /api/jobs``: what is refused, by which rules, and that nothing of it stays."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from sqlalchemy import func, select

from orchestrator.domain.gang_checks import LARGEST_ENVIRONMENT, MOST_VARIABLES
from orchestrator.persistence.batch_models import Job, JobDefinition
from orchestrator.server import Server
from tests.support.definitions import container, multinode
from tests.support.orchestrator.trained import SPEC as TRAINED
from tests.support.orchestrator.trained import add_checkpoint, add_run
from tests.support.processes import end_all

SPEC: dict[str, Any] = {"name": "say", "command": ["true"], "resources": {"cpus": 0.1, "memory": 64}}
DEEP = '{"train":' * 900 + "{}" + "}" * 900
"""Of more levels than an answer may have, but not than Python reads."""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    home = tmp_path_factory.mktemp("home")
    server = Server(home, cpus=1)
    server.start()
    yield server
    server.close()
    end_all(home)


def sent(server: Server, path: str, body: dict[str, Any] | str, key: str | None = None) -> httpx.Response:
    """The answer to a request; a body of text is sent as it is."""
    text = body if isinstance(body, str) else json.dumps(body)  # half of a character is sent as \\ud800
    headers = {"content-type": "application/json", **({"x-muster-idempotency-key": key} if key else {})}
    return httpx.post(f"{server.url}{path}", content=text, headers=headers, timeout=60)


def rows(server: Server) -> tuple[int, int]:
    """The number of jobs and of definitions."""
    with server.controller.database.session() as session:
        jobs, definitions = (session.scalar(select(func.count()).select_from(each)) for each in (Job, JobDefinition))
    return jobs or 0, definitions or 0


def message(answer: httpx.Response) -> str:
    """The one line of a refusal with 400."""
    assert answer.status_code == 400, answer.text
    words = str(answer.json()["message"])
    assert words and "\n" not in words and "Traceback" not in words
    return words


ENVIRONMENTS: dict[str, tuple[dict[str, str], str]] = {
    "a spec that is not JSON": ({"MUSTER_SPEC": "{not json"}, "MUSTER_SPEC, .* is malformed"),
    "a spec that is a list": ({"MUSTER_SPEC": "[1]"}, "MUSTER_SPEC, .* is malformed"),
    "a spec with half of a character": ({"MUSTER_SPEC": '{"name": "\\ud800"}'}, "MUSTER_SPEC, .* is malformed"),
    "a spec of 900 levels": ({"MUSTER_SPEC": DEEP}, "MUSTER_SPEC, .* is malformed"),
    "a spec of 9,000 levels": ({"MUSTER_SPEC": "[" * 9000 + "]" * 9000}, "MUSTER_SPEC, .* is malformed"),
    "a limit of the log of letters": ({"MUSTER_LOG_LIMIT": "x"}, "MUSTER_LOG_LIMIT .* is malformed"),
    "a negative limit of the log": ({"MUSTER_LOG_LIMIT": "-5"}, "MUSTER_LOG_LIMIT .* is malformed"),
    "a time that is none": ({"MUSTER_STALL_TIMEOUT": "soon"}, "MUSTER_STALL_TIMEOUT, .* is malformed"),
    "a time without an end": ({"MUSTER_STALL_TIMEOUT": "nan"}, "MUSTER_STALL_TIMEOUT, .* is malformed"),
    "no ranks": ({"MUSTER_RANKS_PER_NODE": "0"}, "MUSTER_RANKS_PER_NODE .* is malformed"),
    "nodes in words": ({"MUSTER_MIN_NODES": "few"}, "MUSTER_MIN_NODES is 'few'; expected an integer"),
    "an unknown policy": ({"MUSTER_ON_CHILD_FAILURE": "garbage"}, "MUSTER_ON_CHILD_FAILURE: expected restart, fail or"),
    "no policy": ({"MUSTER_ON_CHILD_FAILURE": ""}, "MUSTER_ON_CHILD_FAILURE: expected restart, fail or"),
    "a run that can't be named so": ({"MUSTER_RUN": "../x"}, r"MUSTER_RUN '../x': a run is named with"),
    "an equals sign in a name": ({"A=B": "1"}, "environment variable 'A=B': neither '=' in the name nor"),
    "no name": ({"": "1"}, "an environment variable has no name"),
    "a reserved name": ({"AWS_BATCH_JOB_ID": "1"}, "environment variable AWS_BATCH_JOB_ID: names .* are reserved"),
    "a zero byte in a name": ({"A\0B": "1"}, "environment variable 'A.*B': neither .* nor a zero byte"),
    "a zero byte in a value": ({"A": "1\0"}, "environment variable 'A': neither .* nor a zero byte"),
    "half of a character in a name": ({"A\ud800": "1"}, "unicode|half of a character"),
    "half of a character in a value": ({"A": "\ud800"}, "unicode|half of a character"),
    "a long value": ({"A": "x" * 900_000}, f"variables have 900[0-9]{{3}} bytes, more than {LARGEST_ENVIRONMENT}"),
    "a long name": ({"A" * 60_000: ""}, "environment variables have [0-9]+ bytes, more than"),
    "many variables": ({f"V{number}": "" for number in range(40_000)}, f"a node has at most {MOST_VARIABLES}"),
}


@pytest.mark.parametrize("case", ENVIRONMENTS)
def test_variables_are_checked_as_those_of_aws_are(server: Server, case: str) -> None:
    environment, words = ENVIRONMENTS[case]
    before = rows(server)
    refused = message(sent(server, "/api/jobs", {"spec": SPEC, "environment": environment}))
    assert re.search(words, refused), refused
    assert rows(server) == before, "neither a job nor a definition"


TRAIN = {"name": "say", "train": {"task": "Cartpole", "worlds": 1, "iterations": 1}}
BODIES: dict[str, tuple[dict[str, Any] | str, str]] = {
    "a directory with a zero byte": ({"spec": SPEC, "directory": "/tmp\0"}, "directory: a zero byte is not possible"),
    "a directory with half of a character": ({"spec": SPEC, "directory": "/\ud800"}, "directory: .*unicode"),
    "a directory that is too long": ({"spec": SPEC, "directory": "x" * 5000}, "directory: .*4096"),
    "a deep spec": (f'{{"spec": {DEEP}}}', "spec: train: nested deeper than 100 levels"),
    "a deep command": (
        f'{{"spec": {{"name": "a", "command": {"[" * 500 + "]" * 500}}}}}',
        "spec: command: nested deeper",
    ),
    "a body that no parser reads": ("[" * 100_000 + "]" * 100_000, "parsing the body|deeper|dictionary"),
    "half of a character in a name": ({"spec": {**SPEC, "name": "a\ud800"}}, "spec: name: half of a character"),
    "half of a character in a key": ({"spec": {**SPEC, "\ud800": 1}}, "spec: half of a character"),
    "half of a character in a command": ({"spec": {**SPEC, "command": ["a", "\udfff"]}}, "spec: command.1: half of a"),
    "half of a character in a configuration": (
        {"spec": {**TRAIN, "train": {**TRAIN["train"], "config": {"deeper": ["\ud800"]}}}},
        "spec: train.config.deeper.0: half of a character",
    ),
    "a zero byte in a command": (
        {"spec": {**SPEC, "command": ["a\0"]}},
        "spec: command.0: expected a string without a",
    ),
    "a zero byte in an image": (
        {"spec": {**SPEC, "image": "a\0"}},
        "spec: image: expected a string without a zero byte",
    ),
    "a variable of Muster": (
        {"spec": {**SPEC, "environment": {"MUSTER_SPEC": "{}"}}},
        "environment: MUSTER_SPEC is res",
    ),
}


@pytest.mark.parametrize("case", BODIES)
def test_what_could_never_be_shown_again_is_refused(server: Server, case: str) -> None:
    body, words = BODIES[case]
    before = rows(server)
    refused = message(sent(server, "/api/jobs", body))
    assert re.search(words, refused), refused
    assert rows(server) == before, "neither a job nor a definition"


def test_a_large_definition_is_refused_by_its_size(server: Server) -> None:
    large = {**SPEC, "environment": {"A": "x" * 30_000}}
    refused = sent(server, "/api/jobs", {"spec": large})
    assert refused.status_code == 413 and "more than 24576 bytes" in refused.json()["message"]


def test_the_largest_environment_is_taken_and_shown(server: Server) -> None:
    environment = {"A": "x" * 50_000, **{f"V{number}": "é" for number in range(500)}}
    job = sent(server, "/api/jobs", {"spec": SPEC, "environment": environment}).json()["jobId"]
    assert httpx.get(f"{server.url}/api/jobs/{job}").status_code == 200


@pytest.mark.parametrize(
    ("path", "change", "words"),
    [
        ("resume", {"directory": "/\0"}, "directory: a zero byte is not possible"),
        ("clone", {"directory": "/\0", "name": "other"}, "directory: a zero byte is not possible"),
        ("resume", {"set": ['train.config.x="\\ud800"']}, "half of a character"),
        ("clone", {"set": ["name=x"], "name": "other\ud800"}, "unicode|half of a character"),
        ("resume", {"set": [f"train.config.x={'[' * 200 + ']' * 200}"]}, "nested deeper than 50 levels"),
    ],
)
def test_a_job_that_continues_a_run_is_checked_by_the_same_rules(
    server: Server, path: str, change: dict[str, Any], words: str
) -> None:
    trained(server)
    before = rows(server)
    refused = message(sent(server, f"/api/runs/trained/{path}", change))
    assert re.search(words, refused), refused
    assert rows(server) == before


@pytest.mark.parametrize(
    "spec", [r'{"name": "\ud800"}', DEEP, "{not json", "[1]"], ids=["half", "deep", "text", "list"]
)
def test_a_row_that_an_earlier_muster_has_stored_is_named_without_an_internal_error(server: Server, spec: str) -> None:
    job = sent(server, "/api/jobs", {"spec": SPEC}).json()["jobId"]
    stored = multinode("say", container(["true"], env={"MUSTER_SPEC": spec}))["nodeProperties"]
    with server.controller.database.session() as session:
        session.get_one(Job, job).node_properties = stored
    for path in (f"/api/jobs/{job}", f"/jobs/{job}"):
        answer = httpx.get(f"{server.url}{path}", headers={"accept": "text/html"})
        assert answer.status_code == 409 and "row in the database is damaged" in answer.text, answer.text
    assert httpx.get(f"{server.url}/api/jobs").status_code == 200
    described = httpx.post(f"{server.url}/v1/describejobs", json={"jobs": [job]})
    assert described.status_code in (200, 409), described.text


def trained(server: Server) -> None:
    """The run ``trained``, with a checkpoint, in the store."""
    if not server.store.run("trained").path.exists():
        add_run(server.store, "trained", TRAINED)
        add_checkpoint(server.store, "trained", 5)


OTHERS: dict[str, tuple[str, dict[str, Any]]] = {
    "another command": ("/api/jobs", {"spec": {**SPEC, "command": ["false"]}}),
    "another name": ("/api/jobs", {"spec": {**SPEC, "name": "other"}}),
    "another directory": ("/api/jobs", {"spec": SPEC, "directory": "/elsewhere"}),
    "another environment": ("/api/jobs", {"spec": SPEC, "environment": {"A": "b"}}),
    "SubmitJob": ("/v1/submitjob", {"jobName": "say", "jobQueue": "default", "jobDefinition": "say"}),
    "a resumed run": ("/api/runs/trained/resume", {}),
    "a clone": ("/api/runs/trained/clone", {"name": "of-trained"}),
}


@pytest.mark.parametrize("case", OTHERS)
def test_an_idempotency_key_answers_its_own_request_alone(server: Server, case: str) -> None:
    trained(server)
    key, (path, body) = f"key-of-{case.replace(' ', '-')}", OTHERS[case]
    first = sent(server, "/api/jobs", {"spec": SPEC}, key).json()
    before = rows(server)
    assert sent(server, "/api/jobs", {"spec": SPEC}, key).json() == first
    other = sent(server, path, body, key)
    assert other.status_code == 409, other.text
    assert other.json()["message"] == f"idempotency key {key} was used for another request (job {first['jobId']})"
    assert rows(server) == before


def test_a_key_of_aws_s_api_answers_no_native_request(server: Server) -> None:
    sent(server, "/api/jobs", {"spec": SPEC})
    body = {"jobName": "say", "jobQueue": "default", "jobDefinition": "say"}
    job = sent(server, "/v1/submitjob", body, "of-aws").json()["jobId"]
    assert sent(server, "/v1/submitjob", body, "of-aws").json()["jobId"] == job
    assert sent(server, "/api/jobs", {"spec": SPEC}, "of-aws").status_code == 409


def test_a_resumed_run_and_a_clone_answer_the_same_request_alone(server: Server) -> None:
    trained(server)
    for path, body in (("resume", {}), ("clone", {"name": "cloned-once"})):
        first = sent(server, f"/api/runs/trained/{path}", body, f"once-{path}")
        assert first.status_code == 200, first.text
        again = sent(server, f"/api/runs/trained/{path}", body, f"once-{path}")
        assert again.json()["jobId"] == first.json()["jobId"]
        changed = sent(server, f"/api/runs/trained/{path}", {**body, "set": ["train.iterations=8"]}, f"once-{path}")
        assert changed.status_code == 409 and "was used for another request" in changed.json()["message"]
        sent(server, "/v1/terminatejob", {"jobId": first.json()["jobId"], "reason": "seen"})
