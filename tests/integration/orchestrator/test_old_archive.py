"""A home of an older commit under today's controller: jobs, queues, definitions, runs, models, keys and webhooks are what they were.

``tests/data/former/README.md`` says how the home was made. The machine of this controller is too small for the jobs that were
running or waiting: that they go on is tested with real ranks, in ``tests/training/e2e/test_old_runs.py``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from botocore.exceptions import ClientError

from tests.support.conformance.keys import client as aws
from tests.support.former.archive import Archived, unpack
from tests.support.former.serving import KeyServing
from tests.support.waiting import wait_for

ENDED = ("SUCCEEDED", "FAILED")


@pytest.fixture(scope="module")
def archived(tmp_path_factory: pytest.TempPathFactory) -> Archived:
    return unpack(tmp_path_factory.mktemp("archived"))


@pytest.fixture(scope="module")
def served(archived: Archived) -> Iterator[KeyServing]:
    options = ("--cpus", "0.4", "--webhooks", str(archived.home / "webhooks.json"))
    with KeyServing(archived.home, *options, key=archived.facts["keys"]["me"]) as server:
        yield server


def without_reasons(job: dict[str, Any]) -> dict[str, Any]:
    """AWS says why a container ended only where it was not by itself; the old commit always did."""
    for attempt in job["attempts"]:
        attempt["container"].pop("reason", None)
    return job


def test_aws_api_describes_ended_jobs_queues_and_definitions_as_before(archived: Archived, served: KeyServing) -> None:
    listed = archived.facts["listed"]
    ended = [job for job in listed["jobs"] if job["status"] in ENDED]
    assert {job["jobName"].split("-")[0] for job in ended} >= {"whole", "evaluate", "export", "clone", "gang", "failed"}
    found = served.client.batch("DescribeJobs", jobs=[job["jobId"] for job in ended])["jobs"]
    by_id = {job["jobId"]: without_reasons(job) for job in found}
    for job in ended:
        assert by_id[job["jobId"]] == without_reasons(job)
    for operation, kind, key in (
        ("DescribeJobQueues", "queues", "jobQueues"),
        ("DescribeJobDefinitions", "definitions", "jobDefinitions"),
    ):
        arn = f"{key[:-1]}Arn"
        found = served.client.batch(operation)[key]
        assert sorted(found, key=lambda each: each[arn]) == sorted(listed[kind], key=lambda each: each[arn])


def test_commands_list_jobs_runs_models_and_checkpoints_as_before(archived: Archived, served: KeyServing) -> None:
    listed, run = archived.facts["listed"], archived.run("whole").name
    before = {job["jobId"]: job["jobName"] for job in listed["jobs"]}
    assert {job["jobId"]: job["jobName"] for job in served.answer("list")} == before
    assert [each["name"] for each in served.answer("checkpoints", run, "--verify")] == listed["checkpoints"]
    assert [f"{model['name']}@{model['version']}" for model in served.answer("models", "list")] == listed["models"]
    verified = served.muster("models", "verify", "pole@1")
    assert verified.returncode == 0, verified.stderr
    runs = served.answer("runs", "list")
    assert {each["run"] for each in runs} >= {archived.run(name).name for name in ("whole", "cut", "gang")}
    for name, lines in listed["logs"].items():
        shown = served.muster("logs", archived.facts["jobs"][name])
        assert shown.returncode == 0 and all(line in shown.stdout for line in lines), shown.stdout + shown.stderr
    shown = served.muster("show", archived.facts["jobs"]["failed"])
    assert "exited with code 3" in shown.stdout, shown.stdout + shown.stderr
    assert served.client.get(f"/api/runs/{run}/metrics") == listed["metrics"]


def test_keys_authenticate_with_the_rights_that_they_had(archived: Archived, served: KeyServing) -> None:
    def status(key: str | None, operation: str, **body: Any) -> int:
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        return httpx.post(f"{served.url}/v1/{operation}", json=body, headers=headers, timeout=60).status_code

    keys, jobs = archived.facts["keys"], archived.facts["jobs"]
    change = {"jobQueue": "robots", "priority": 5}
    assert [status(keys[name], "updatejobqueue", **change) for name in ("me", "alice", "wall")] == [200, 403, 403]
    assert [status(keys[name], "listjobs", jobQueue="default") for name in ("me", "alice", "wall")] == [200, 403, 200]
    assert status(keys["alice"], "listjobs", jobQueue="robots") == 200
    assert status(None, "listjobs", jobQueue="default") == 403
    assert status(keys["me"][:-1], "listjobs", jobQueue="default") == 403
    signed = aws(served.url, *keys["wall"].split(":"))
    assert signed.describe_jobs(jobs=[jobs["whole"]])["jobs"][0]["status"] == "SUCCEEDED"
    kept = ("accessKeyId", "name", "queues", "readOnly")
    before = [{key: each[key] for key in kept if key in each} for each in archived.facts["listed"]["keys"]]
    assert [{key: each[key] for key in kept if key in each} for each in served.answer("keys", "list")] == before


def test_webhooks_are_there(served: KeyServing) -> None:
    assert "chat" in served.muster("webhooks", "list").stdout


def test_jobs_that_were_not_over_wait_with_a_reason(archived: Archived, served: KeyServing) -> None:
    jobs = archived.facts["jobs"]
    cut = wait_for(
        lambda: (found := served.detail(jobs["cut"]))["status"] == "RUNNABLE" and found, 60, "the cut job waits"
    )
    assert [each["ending"] for each in cut["attempts"]] == ["failed"] and "CPU" in cut["statusReason"]
    assert served.detail(jobs["after"])["status"] == "PENDING"
    assert served.detail(jobs["waiting"])["status"] == "RUNNABLE"


def test_a_definition_is_its_owners_and_a_tag_still_shares_it(archived: Archived, served: KeyServing) -> None:
    """What a key with another queue may do with the definitions of the key that registered them."""
    url, keys = served.url, archived.facts["keys"]
    alice = aws(url, *keys["alice"].split(":"))
    submitted = alice.submit_job(jobName="hers", jobQueue="robots", jobDefinition="plain")
    assert served.detail(submitted["jobId"])["owner"] == "key alice"
    with pytest.raises(ClientError, match="job definition whole was registered by key me"):
        alice.submit_job(jobName="hers", jobQueue="robots", jobDefinition="whole")
