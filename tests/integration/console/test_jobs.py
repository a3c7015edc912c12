"""The pages of all jobs and of the queues, through a real server."""

from __future__ import annotations

from typing import Any

import pytest

from orchestrator.client import Client
from tests.conftest import wait_for
from tests.support.console.fixtures import Console
from tests.support.console.visitor import Page, Visitor
from tests.support.orchestrator.jobs import await_status

# -- jobs --------------------------------------------------------------------------------------------------------------


HOSTILE = ("</td><script>alert(1)</script>", '" onload="alert(1)', "{{ 7 * 7 }}", "' or 1=1 --")


@pytest.fixture(scope="module")
def definition(console: Console) -> str:
    return console.register("waits")


def names(page: Page) -> list[str]:
    """The jobs of the table that can be marked."""
    return [str(each["aria-label"]) for each in page.all("input", name="job")]


def link(page: Page, rel: str) -> str:
    """The address of the page beside this one."""
    (found,) = page.all("a", rel=rel)
    return str(found["href"])


@pytest.fixture(scope="module")
def many(console: Console, definition: str) -> list[str]:
    """Ids of 120 jobs that wait, one of them in the queue ``lab``."""
    return [console.submit(definition, f"job-{i}", "lab" if i == 60 else "default") for i in range(120)]


def test_the_newest_jobs_come_first_a_page_at_a_time(visitor: Visitor, many: list[str]) -> None:
    assert visitor.http.get("/jobs", follow_redirects=False).headers["location"] == "/"
    first = visitor.page("/")
    assert names(first) == [f"job-{i}" for i in range(119, 69, -1)]
    assert "50 of 120" in first.text and not first.all("a", rel="prev")
    second = visitor.page(link(first, "next"))
    assert names(second)[0] == "job-69" and "Newest" in second.text
    last = visitor.page(link(second, "next"))
    assert len(names(last)) == 20 and not last.all("a", rel="next")
    assert names(visitor.page(link(last, "prev"))) == names(second)
    assert names(visitor.page(link(visitor.page(link(last, "prev")), "prev"))) == names(first)
    beyond = visitor.page("/?after=1-none")
    assert names(beyond) == [] and "This page of the table is empty" in beyond.text
    assert "'x' is not a place in the list of jobs" in visitor.page("/?after=x", 400).text
    assert "after a place or before one, not both" in visitor.page("/?after=1-a&before=1-b", 400).text


def test_jobs_are_found_by_state_queue_and_part_of_a_name(visitor: Visitor, many: list[str]) -> None:
    assert names(visitor.page("/?search=JOB-11")) == [f"job-{i}" for i in (*range(119, 109, -1), 11)]
    assert names(visitor.page(f"/?search={many[7][:8]}")) == ["job-7"]
    assert names(visitor.page("/?queue=lab")) == ["job-60"]
    assert names(visitor.page("/?status=succeeded")) == []
    assert "No job matches" in visitor.page("/?status=failed").text
    assert len(names(visitor.page("/?status=waiting&search=job-1"))) == 31
    assert "it is one of waiting" in visitor.page("/?status=x", 400).text


@pytest.mark.parametrize("path", ["/", "/jobs/stream"])
@pytest.mark.parametrize(
    "query", ["status=failed&status=waiting", "queue=lab&after=1-a&queue=default", "after=1-a&after=1-a"]
)
def test_a_filter_that_an_address_gives_twice_is_refused_by_name(console: Console, path: str, query: str) -> None:
    answer = console.visitor().http.get(f"{path}?{query}", headers={"Accept": "application/json"})
    assert answer.status_code == 400
    assert answer.json()["message"] == f"the address has {query.partition('=')[0]} 2 times; give it once"


def test_a_key_sees_the_jobs_of_its_queues_alone_and_counts_no_others(console: Console, many: list[str]) -> None:
    page = console.visitor("lab").page("/")
    assert names(page) == ["job-60"] and "1 of 1" in page.text
    assert [each["value"] for each in page.all("option") if each.get("value")] == []
    assert "default" not in page.text


def test_a_read_only_key_sees_no_buttons_and_changes_nothing(console: Console, many: list[str]) -> None:
    visitor = console.visitor("reader")
    page = visitor.page("/")
    assert "job-119" in page.text and "(read-only)" in page.text
    assert page.all("form", method="post") == [{"method": "post", "action": "/logout"}]
    assert page.all("input", name="job") == []
    assert "is read-only" in visitor.refusal("/jobs/stop", job=many[0], confirmed="yes")


def test_names_of_others_are_text_and_nothing_else(console: Console, definition: str) -> None:
    job = console.submit(definition, "hostile", "lab")
    for text in HOSTILE:
        console.client.batch("TerminateJob", jobId=job, reason=text)
        await_status(console.client, job, "FAILED")
        visitor = console.visitor("lab")
        for path in ("/?search=hostile", f"/?search={text}", f"/?queue={text}", f"/?status={text}"):
            answer = visitor.http.get(path)
            assert Page(answer.text).is_inert and "<script>alert" not in answer.text, path
        assert text in Page(visitor.http.get("/", params={"search": text}).text).all("input", name="search")[0].values()
        job = console.submit(definition, "hostile", "lab")
    assert HOSTILE[0] in visitor.page("/?search=hostile").text
    console.client.batch("TerminateJob", jobId=job, reason="x")


def test_the_stream_has_the_page_first_and_then_only_what_changes(console: Console, many: list[str]) -> None:
    visitor = console.visitor()
    stream = visitor.events("/jobs/stream?search=job-3")
    name, first, _ = next(stream)
    assert name == "parts" and len(first["jobs"]["order"]) == 11 and "11 of 11" in first["pages"]
    console.client.batch("TerminateJob", jobId=many[30], reason="enough")
    row = Page("")
    while "FAILED" not in row.text:
        _, data, _ = next(stream)
        table = data.get("jobs", {"rows": {}})
        assert set(table["rows"]) <= {many[30]} and "order" not in table
        row = Page(table["rows"].get(many[30], row.source))
    assert "enough" in row.text and not row.all("input")
    row_of_page = visitor.page("/?search=job-30").all("tr", **{"data-key": many[30]})
    assert row_of_page == row.all("tr"), "the page itself is written in the same way"
    stream.close()


def test_marked_jobs_are_stopped_once_the_person_has_confirmed(console: Console, many: list[str]) -> None:
    visitor = console.visitor()
    question = visitor.submit("/jobs/stop", job=many[:2])
    assert question.status_code == 409 and question.json()["question"]["title"] == "Stop 2 jobs?"
    assert console.client.get(f"/api/jobs/{many[0]}")["status"] == "RUNNABLE"
    result = visitor.submit("/jobs/stop", job=many[:2], confirmed="yes").json()
    assert result == {"location": "/", "message": "2 jobs asked to stop"}
    for job in many[:2]:
        await_status(console.client, job, "FAILED")
    assert console.client.get(f"/api/jobs/{many[0]}")["statusReason"] == "stopped in the console by key admin"


def test_without_scripts_a_page_asks_and_its_form_goes_on(console: Console, visitor: Visitor, many: list[str]) -> None:
    token = visitor.page("/").form_token
    question = visitor.http.post("/jobs/stop", data={"form_token": token, "job": many[2:4], "search": "job-2"})
    page = Page(question.text)
    assert question.status_code == 409 and "Stop 2 jobs?" in page.text
    fields: dict[str, list[str]] = {"confirmed": ["yes"]}
    for each in page.all("input", type="hidden"):
        fields.setdefault(str(each["name"]), []).append(str(each["value"]))
    answer = visitor.http.post("/jobs/stop", data=fields)
    assert answer.status_code == 200 and answer.url.query == b"search=job-2"
    for job in many[2:4]:
        await_status(console.client, job, "FAILED")


def test_all_that_the_filter_finds_is_stopped_also_beyond_the_page(console: Console, many: list[str]) -> None:
    visitor = console.visitor()
    question = visitor.submit("/jobs/stop", all="yes", search="job-1")
    assert question.json()["question"]["title"] == "Stop 30 jobs?"
    lab = console.visitor("lab")
    assert "limited to job queue lab" in lab.refusal("/jobs/stop", job=[many[5]], confirmed="yes")
    assert visitor.submit("/jobs/stop", all="yes", search="job-", confirmed="yes").status_code == 200
    done = wait_for(lambda: not names(visitor.page("/?status=waiting&search=job-")), 60, "the end of all")
    assert done and console.client.get("/api/jobs", status="FAILED", search="job-")["total"] == 120


# -- queues ------------------------------------------------------------------------------------------------------------


POLICY = {"shareDecaySeconds": 600, "shareDistribution": [{"shareIdentifier": "admin", "weightFactor": 0.5}]}


@pytest.fixture(scope="module")
def waiting(console: Console) -> dict[str, str]:
    """A job that waits in each of three queues, by queue; ``shared`` is served by fair share."""
    policy = console.client.batch("CreateSchedulingPolicy", name="even", fairsharePolicy=POLICY)["arn"]
    order = [{"order": 1, "computeEnvironment": "local"}]
    shared = {"jobQueueName": "shared", "priority": 7, "schedulingPolicyArn": policy}
    console.client.batch("CreateJobQueue", **shared, computeEnvironmentOrder=order)
    definition = console.register("waits")
    found = {queue: console.submit(definition, f"in-{queue}", queue) for queue in ("default", "lab")}
    job = {"jobName": "in-shared", "jobQueue": "shared", "jobDefinition": definition, "shareIdentifier": "admin"}
    found["shared"] = console.client.batch("SubmitJob", **job)["jobId"]

    def has_all() -> Any:
        result = console.client.get("/api/queues")
        return {job["id"] for queue in result["queues"] for job in queue["front"]} == {*found.values()} and result[
            "hosts"
        ]

    wait_for(has_all, 30, "a scheduling pass")
    return found


def rows_of(page: Page, key: str) -> int:
    return len(page.all("tr", **{"data-key": key}))


def test_a_person_sees_the_queues_who_waits_for_what_and_the_hosts(console: Console, waiting: dict[str, str]) -> None:
    page = console.visitor().page("/queues")
    assert all(rows_of(page, key) for key in ("default", "lab", "shared", "localhost", *waiting.values()))
    assert "fair share: even" in page.text and "first in, first out" in page.text
    assert "0 of 1" in page.text and "healthy" in page.text
    keys = [each["data-key"] for each in page.all("tr") if each.get("data-key")]
    assert keys.index("shared") < keys.index("default"), "the queue of the highest priority is served first"


def test_why_a_job_waits_is_what_the_api_says(console: Console, waiting: dict[str, str]) -> None:
    reason = console.client.get(f"/api/jobs/{waiting['shared']}")["statusReason"]
    page = console.visitor().page("/queues?queue=shared")
    assert " ".join(reason.split()) in page.text and reason in console.visitor().page("/?queue=shared").text
    assert not rows_of(page, waiting["default"]) and rows_of(page, waiting["shared"])
    (result,) = console.client.get("/api/queues", queue="shared")["queues"]
    (front,) = result["front"]
    assert (front["id"], front["reason"], front["share"]) == (waiting["shared"], reason, "admin")


def test_a_key_sees_its_queues_alone(console: Console, waiting: dict[str, str]) -> None:
    page = console.visitor("lab").page("/queues")
    assert rows_of(page, waiting["lab"]) and not rows_of(page, waiting["default"]) and "in-shared" not in page.text
    with Client(console.url, console.secrets["lab"]) as client:
        assert [each["name"] for each in client.get("/api/queues")["queues"]] == ["lab"]
    refused = console.visitor("lab").page("/queues?queue=shared", 404)
    assert "Job queue shared does not exist; available: lab" in refused.text


def test_one_stream_renews_all_tables(console: Console, waiting: dict[str, str]) -> None:
    stream = console.visitor().events("/queues/stream?queue=lab")
    _, first, _ = next(stream)
    assert first["waiting"]["order"] == [waiting["lab"]] and "0 of 1" in first["hosts"]["rows"]["localhost"]
    assert "healthy" in first["engines"]["rows"]["local"] and first["shares"] == {"order": [], "rows": {}}
    console.client.batch("TerminateJob", jobId=waiting["lab"], reason="enough")
    while True:
        _, data, _ = next(stream)
        assert all("order" not in table for name, table in data.items() if name != "waiting")
        if data.get("waiting", {}).get("order") == []:
            break
    stream.close()


def test_a_share_in_use_is_shown_with_its_weight_and_the_host_as_full(
    console: Console, waiting: dict[str, str]
) -> None:
    definition = console.register("runs", cpus="1", command=["sleep", "600"])
    job = {"jobName": "runs", "jobQueue": "shared", "jobDefinition": definition, "shareIdentifier": "admin"}
    running = console.client.batch("SubmitJob", **job)["jobId"]
    await_status(console.client, running, "RUNNING")
    result = console.client.get("/api/queues", queue="shared")
    (share,) = result["queues"][0]["shares"]
    assert (share["share"], share["weight"], share["inUse"]) == ("admin", 0.5, {"cpus": 1.0, "gpus": 0})
    assert share["score"] == pytest.approx(share["used"] * 0.5)
    assert result["hosts"][0]["inUse"]["cpus"] == 1.0 and result["queues"][0]["inUse"] == {"cpus": 1.0, "gpus": 0}
    page = console.visitor().page("/queues")
    assert rows_of(page, "shared/admin") and "1 of 1" in page.text
    console.client.batch("TerminateJob", jobId=running, reason="enough")
    await_status(console.client, running, "FAILED")


def test_hostile_names_are_text(console: Console, visitor: Visitor) -> None:
    for text in HOSTILE:
        answer = visitor.http.get("/queues", params={"queue": text})
        assert answer.status_code == 404 and Page(answer.text).is_inert and "<script>alert" not in answer.text
    hostile = "<img src=x onerror=alert(1)>"
    odd = {"computeEnvironmentName": "odd", "type": "UNMANAGED", "tags": {"muster:hosts": hostile}}
    console.client.batch("CreateComputeEnvironment", **odd)
    wait_for(lambda: hostile in visitor.page("/queues").text, 10, "the new one")
    page = visitor.page("/queues")
    assert page.is_inert and not page.all("img")
