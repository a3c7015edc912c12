"""The page of queues and compute, through a real server."""

from __future__ import annotations

from typing import Any

import pytest

from orchestrator.client import Client
from tests.conftest import wait_for
from tests.support.console.fixtures import Console
from tests.support.console.visitor import Page
from tests.support.orchestrator.jobs import await_status

POLICY = {"shareDecaySeconds": 600, "shareDistribution": [{"shareIdentifier": "red", "weightFactor": 0.5}]}


@pytest.fixture(scope="module")
def waiting(console: Console) -> dict[str, str]:
    """A job that waits in each of three queues, by queue; ``shared`` is served by fair share."""
    policy = console.client.batch("CreateSchedulingPolicy", name="even", fairsharePolicy=POLICY)["arn"]
    order = [{"order": 1, "computeEnvironment": "local"}]
    shared = {"jobQueueName": "shared", "priority": 7, "schedulingPolicyArn": policy}
    console.client.batch("CreateJobQueue", **shared, computeEnvironmentOrder=order)
    definition = console.register("waits")
    found = {queue: console.submit(definition, f"in-{queue}", queue) for queue in ("default", "lab")}
    job = {"jobName": "in-shared", "jobQueue": "shared", "jobDefinition": definition, "shareIdentifier": "red"}
    found["shared"] = console.client.batch("SubmitJob", **job)["jobId"]

    def has_all() -> Any:
        told = console.client.get("/api/queues")
        return {job["id"] for queue in told["queues"] for job in queue["front"]} == {*found.values()} and told["hosts"]

    wait_for(has_all, 30, "a scheduling pass")
    return found


def rows_of(page: Page, key: str) -> int:
    return len(page.all("tr", **{"data-key": key}))


def test_a_person_sees_the_queues_who_waits_for_what_and_the_hosts(console: Console, waiting: dict[str, str]) -> None:
    page = console.visitor().page("/queues")
    assert all(rows_of(page, key) for key in ("default", "lab", "shared", "localhost", *waiting.values()))
    assert "fair share: even" in page.text and "first in, first out" in page.text
    assert "0 of 1" in page.text and "answers" in page.text
    keys = [each["data-key"] for each in page.all("tr") if each.get("data-key")]
    assert keys.index("shared") < keys.index("default"), "the queue of the highest priority is served first"


def test_why_a_job_waits_is_what_the_api_says(console: Console, waiting: dict[str, str]) -> None:
    reason = console.client.get(f"/api/jobs/{waiting['shared']}")["statusReason"]
    page = console.visitor().page("/queues?queue=shared")
    assert " ".join(reason.split()) in page.text
    assert not rows_of(page, waiting["default"]) and rows_of(page, waiting["shared"])
    (told,) = console.client.get("/api/queues", queue="shared")["queues"]
    (front,) = told["front"]
    assert (front["id"], front["reason"], front["share"]) == (waiting["shared"], reason, "red")


def test_a_key_sees_its_queues_alone(console: Console, waiting: dict[str, str]) -> None:
    page = console.visitor("lab").page("/queues")
    assert rows_of(page, waiting["lab"]) and not rows_of(page, waiting["default"]) and "in-shared" not in page.text
    with Client(console.url, console.secrets["lab"]) as client:
        assert [each["name"] for each in client.get("/api/queues")["queues"]] == ["lab"]
    refused = console.visitor("lab").page("/queues?queue=shared", 404)
    assert "there is no queue 'shared'; there is lab" in refused.text


def test_one_stream_renews_all_tables(console: Console, waiting: dict[str, str]) -> None:
    stream = console.visitor().events("/queues/stream?queue=lab")
    first = dict((name, data) for name, data, _ in (next(stream) for _ in range(6)))
    assert first["waiting"]["order"] == [waiting["lab"]] and first["hosts"]["rows"]["localhost"]["cpus"] == "0 of 1"
    assert first["engines"]["rows"]["local"]["state"] == "answers" and first["shares"] == {"order": []}
    console.client.batch("TerminateJob", jobId=waiting["lab"], reason="enough")
    while True:
        name, data, _ = next(stream)
        assert "order" not in data or name == "waiting"
        if name == "waiting" and data.get("order") == []:
            break
    stream.close()


def test_a_share_in_use_is_told_with_its_weight_and_the_host_as_full(console: Console, waiting: dict[str, str]) -> None:
    definition = console.register("runs", cpus="1", command=["sleep", "600"])
    job = {"jobName": "runs", "jobQueue": "shared", "jobDefinition": definition, "shareIdentifier": "red"}
    running = console.client.batch("SubmitJob", **job)["jobId"]
    await_status(console.client, running, "RUNNING")
    told = console.client.get("/api/queues", queue="shared")
    (share,) = told["queues"][0]["shares"]
    assert (share["share"], share["weight"], share["inUse"]) == ("red", 0.5, {"cpus": 1.0, "gpus": 0})
    assert share["score"] == pytest.approx(share["used"] * 0.5)
    assert told["hosts"][0]["inUse"]["cpus"] == 1.0 and told["queues"][0]["inUse"] == {"cpus": 1.0, "gpus": 0}
    page = console.visitor().page("/queues")
    assert rows_of(page, "shared/red") and "1 of 1" in page.text
    console.client.batch("TerminateJob", jobId=running, reason="enough")
    await_status(console.client, running, "FAILED")


def test_hostile_names_are_text(console: Console) -> None:
    visitor = console.visitor()
    for text in ("</td><script>alert(1)</script>", '" onload="alert(1)', "{{ 7 * 7 }}"):
        answer = visitor.http.get("/queues", params={"queue": text})
        assert answer.status_code == 404 and Page(answer.text).is_inert and "<script>alert" not in answer.text
    hostile = "<img src=x onerror=alert(1)>"
    odd = {"computeEnvironmentName": "odd", "type": "UNMANAGED", "tags": {"muster:hosts": hostile}}
    console.client.batch("CreateComputeEnvironment", **odd)
    wait_for(lambda: hostile in visitor.page("/queues").text, 10, "the new one")
    page = visitor.page("/queues")
    assert page.is_inert and not page.all("img")
