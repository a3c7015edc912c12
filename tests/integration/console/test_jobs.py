"""The page of all jobs, through a real server."""

from __future__ import annotations

import pytest

from tests.conftest import wait_for
from tests.support.console.fixtures import Console
from tests.support.console.visitor import Page
from tests.support.orchestrator.jobs import await_status

HOSTILE = ("</td><script>alert(1)</script>", '" onload="alert(1)', "{{ 7 * 7 }}", "' or 1=1 --")


@pytest.fixture(scope="module")
def definition(console: Console) -> str:
    return console.register("waits")


def names(page: Page) -> list[str]:
    """The jobs of the table, without the row that scripts copy."""
    return [str(each["aria-label"]) for each in page.all("input", name="job") if each.get("value")]


@pytest.fixture(scope="module")
def many(console: Console, definition: str) -> list[str]:
    """Ids of 120 jobs that wait, one of them in the queue ``lab``."""
    return [console.submit(definition, f"job-{i}", "lab" if i == 60 else "default") for i in range(120)]


def test_the_newest_jobs_come_first_a_page_at_a_time(console: Console, many: list[str]) -> None:
    visitor = console.visitor()
    first = visitor.page("/")
    assert names(first) == [f"job-{i}" for i in range(119, 69, -1)]
    assert "1–50 of 120" in first.text
    (later,) = first.all("a", rel="next")
    second = visitor.page(str(later["href"]))
    assert names(second)[0] == "job-69"
    last = visitor.page("/?page=3")
    assert len(names(last)) == 20 and "hidden" in last.all("a", rel="next")[0]
    beyond = visitor.page("/?page=9")
    assert names(beyond) == [] and "This page of the table is empty" in beyond.text
    wrong = {"x": "a whole number, found a text ('x')", "0": "a value greater than or equal to 1, found '0'"}
    for page, words in wrong.items():
        assert f"page: expected {words}" in visitor.page(f"/?page={page}", 400).text


def test_jobs_are_found_by_state_queue_and_part_of_a_name(console: Console, many: list[str]) -> None:
    visitor = console.visitor()
    assert names(visitor.page("/?search=JOB-11")) == [f"job-{i}" for i in (*range(119, 109, -1), 11)]
    assert names(visitor.page(f"/?search={many[7][:8]}")) == ["job-7"]
    assert names(visitor.page("/?queue=lab")) == ["job-60"]
    assert names(visitor.page("/?state=succeeded")) == []
    assert "No job is like this" in visitor.page("/?state=failed").text
    assert len(names(visitor.page("/?state=waiting&search=job-1"))) == 31
    assert "it is one of waiting" in visitor.page("/?state=x", 400).text


@pytest.mark.parametrize("path", ["/", "/jobs/stream"])
@pytest.mark.parametrize("query", ["state=failed&state=waiting", "queue=lab&page=1&queue=default", "page=1&page=1"])
def test_a_filter_that_an_address_gives_twice_is_refused_by_name(console: Console, path: str, query: str) -> None:
    answer = console.visitor().http.get(f"{path}?{query}", headers={"Accept": "application/json"})
    assert answer.status_code == 400
    assert answer.json()["message"] == f"the address has {query.partition('=')[0]} 2 times; give it once"


def test_a_waiting_job_says_why_it_waits(console: Console, many: list[str]) -> None:
    told = console.visitor().page("/?search=job-119").text
    assert "RUNNABLE" in told and "4" in told and "cpu" in told.lower(), told


def test_a_key_sees_the_jobs_of_its_queues_alone_and_counts_no_others(console: Console, many: list[str]) -> None:
    page = console.visitor("lab").page("/")
    assert names(page) == ["job-60"] and "1–1 of 1" in page.text
    assert [each["value"] for each in page.all("option") if each.get("value")] == []
    assert "default" not in page.text


def test_a_read_only_key_sees_no_buttons_and_changes_nothing(console: Console, many: list[str]) -> None:
    visitor = console.visitor("reader")
    page = visitor.page("/")
    assert "job-119" in page.text and "(read-only)" in page.text
    assert page.all("form", method="post") == [{"method": "post", "action": "/logout"}]
    assert page.all("input", name="job") == []
    answer = visitor.submit("/jobs/stop", job=many[0], confirmed="yes")
    assert answer.status_code == 403 and "is read-only" in answer.json()["message"]


def test_names_of_others_are_text_and_nothing_else(console: Console, definition: str) -> None:
    job = console.submit(definition, "hostile", "lab")
    for text in HOSTILE:
        console.client.batch("TerminateJob", jobId=job, reason=text)
        await_status(console.client, job, "FAILED")
        visitor = console.visitor("lab")
        for path in ("/?search=hostile", f"/?search={text}", f"/?queue={text}", f"/?state={text}"):
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
    assert name == "rows" and len(first["order"]) == 11 and first["totals"]["shown"] == "1–11 of 11"
    console.client.batch("TerminateJob", jobId=many[30], reason="enough")
    changed: dict[str, str] = {}
    while changed.get("status") != "FAILED":
        _, data, _ = next(stream)
        assert set(data.get("rows", {})) <= {many[30]} and "order" not in data
        changed |= data.get("rows", {}).get(many[30], {})
    assert changed["reason"] == "enough" and changed["open"] == "" and "name" not in changed
    stream.close()


def test_marked_jobs_are_stopped_once_the_person_has_said_yes(console: Console, many: list[str]) -> None:
    visitor = console.visitor()
    asked = visitor.submit("/jobs/stop", job=many[:2])
    assert asked.status_code == 409 and asked.json()["question"]["title"] == "Stop 2 jobs?"
    assert console.client.get(f"/api/jobs/{many[0]}")["status"] == "RUNNABLE"
    told = visitor.submit("/jobs/stop", job=many[:2], confirmed="yes").json()
    assert told == {"location": "/", "message": "2 jobs asked to stop"}
    for job in many[:2]:
        await_status(console.client, job, "FAILED")
    assert console.client.get(f"/api/jobs/{many[0]}")["statusReason"] == "stopped in the console by key admin"


def test_without_scripts_a_page_asks_and_its_form_goes_on(console: Console, many: list[str]) -> None:
    visitor = console.visitor()
    token = visitor.page("/").form_token
    asked = visitor.http.post("/jobs/stop", data={"form_token": token, "job": many[2:4], "search": "job-2"})
    page = Page(asked.text)
    assert asked.status_code == 409 and "Stop 2 jobs?" in page.text
    fields: dict[str, list[str]] = {"confirmed": ["yes"]}
    for each in page.all("input", type="hidden"):
        fields.setdefault(str(each["name"]), []).append(str(each["value"]))
    answer = visitor.http.post("/jobs/stop", data=fields)
    assert answer.status_code == 200 and answer.url.query == b"search=job-2"
    for job in many[2:4]:
        await_status(console.client, job, "FAILED")


def test_all_that_the_filter_finds_is_stopped_also_beyond_the_page(console: Console, many: list[str]) -> None:
    visitor = console.visitor()
    asked = visitor.submit("/jobs/stop", all="yes", search="job-1")
    assert asked.json()["question"]["title"] == "Stop 30 jobs?"
    lab = console.visitor("lab")
    theirs = lab.submit("/jobs/stop", job=[many[5]], confirmed="yes")
    assert theirs.status_code == 403 and "may use job queue lab only" in theirs.json()["message"]
    assert visitor.submit("/jobs/stop", all="yes", search="job-", confirmed="yes").status_code == 200
    done = wait_for(lambda: not names(visitor.page("/?state=waiting&search=job-")), 60, "the end of all")
    assert done and console.client.get("/api/jobs", status="FAILED", search="job-")["total"] == 120
