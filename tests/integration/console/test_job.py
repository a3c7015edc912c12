"""The page of a job, through a real server: what it shows, what it follows, what a person can do there, and its live view."""

from __future__ import annotations

import json
import sys
from types import SimpleNamespace
from typing import Any, cast

import pytest

from orchestrator.console import job_view
from orchestrator.console.job_view import JobViewState, Views
from orchestrator.domain.errors import ApiError, ClientError
from shared_store.volume.layout import Run, Store
from shared_store.volume.logs import format_line
from shared_store.volume.metrics import MetricsWriter
from tests.conftest import submit_gang, wait_for
from tests.support.console.fixtures import Console
from tests.support.console.visitor import Page, Visitor
from tests.support.definitions import container, single
from tests.support.orchestrator.jobs import FOREVER, await_status
from tests.support.orchestrator.trained import SPEC, add_checkpoint, add_run

HOSTILE = "</pre><script>alert(1)</script><img src=x onerror=alert(1)> {{ 7 * 7 }} \x1b[31m \u202e\u2028"


@pytest.fixture(scope="module")
def store(console: Console) -> Store:
    """The store of a server on which only small jobs of the queue ``first`` start; it has a trained run with three checkpoints and its metrics."""
    order = [{"order": 1, "computeEnvironment": "local"}]
    console.client.batch("CreateJobQueue", jobQueueName="first", priority=9, computeEnvironmentOrder=order)
    await_status(console.client, submit_gang(console.client, FOREVER, name="blocker", cpus="0.5"), "RUNNING")
    store = Store(console.server.home / "store")
    add_run(store, "taught", {**SPEC, "environment": {"LEVEL": "of-nobody-else"}})
    for iteration in (3, 6, 9):
        add_checkpoint(store, "taught", iteration, score=float(iteration), score_error=0.5)
    with MetricsWriter(store.run("taught"), 1, 0) as metrics:
        for iteration in range(1, 10):
            last = (
                {"warnings": ["it unlearns: mean return 1.00 (RUN@best)"], "action_std": 0.41} if iteration == 9 else {}
            )
            metrics.write({"iteration": iteration, "reward": iteration / 2, "reward_alive": 1.0, "kl": None, **last})
    return store


@pytest.fixture(scope="module")
def training(console: Console, store: Store) -> str:
    """Id of a job that waits to continue the run."""
    return str(console.client.post("/api/runs/taught/resume", {"set": ["train.iterations=20"]})["jobId"])


@pytest.fixture(scope="module")
def talking(console: Console, store: Store) -> str:
    """Id of a job on two nodes that has printed much and failed."""
    script = (
        "import os, sys, time\n"
        "node = int(os.environ['AWS_BATCH_JOB_NODE_INDEX'])\n"
        f"print({HOSTILE!r})\n"
        "for i in range(600): print('line', i, 'of', node, flush=True)\n"
        "time.sleep(1 if node == 0 else 60)\n"
        "raise ValueError('the reason')\n"
    )
    job = submit_gang(console.client, script, 2, "talks", queue="first")
    await_status(console.client, job, "FAILED")
    return job


def spec_of(console: Console, answer: Any) -> dict[str, Any]:
    """The spec of the job to whose page an answer leads."""
    assert answer.status_code == 200, answer.text
    job = answer.json()["location"].removeprefix("/jobs/")
    found: dict[str, Any] = console.client.get(f"/api/jobs/{job}")["spec"]
    return found


def log_of(visitor: Visitor, job: str, path: str = "", **query: Any) -> dict[str, Any]:
    answer = visitor.http.get(f"/jobs/{job}/log{path}", params=query, headers={"Accept": "application/json"})
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def texts(result: dict[str, Any]) -> list[str]:
    return [each[5] for each in result["lines"]]


def test_a_job_that_waits_says_why_and_shows_what_it_will_do(console: Console, training: str) -> None:
    page = console.visitor().page(f"/jobs/{training}")
    assert "RUNNABLE" in page.text and "CPU" in page.text and "The job has not started yet" in page.text
    assert "iterations: 20" in page.text and "Cartpole" in page.text and "muster view" in page.text
    assert page.is_inert and "Warning it unlearns: mean return 1.00 (taught@best)" in page.text
    assert "Learning deviation of actions 0.41" in page.text
    (charts,) = page.all("section", **{"data-curves": "/runs/taught/curves"})
    labels = {"kl": "KL divergence [nat]", "saturation": "Saturation"}
    assert json.loads(str(charts["data-labels"])).items() >= labels.items()


def test_a_job_is_found_by_its_name_and_by_the_start_of_its_id(visitor: Visitor, training: str) -> None:
    for reference in ("taught", training[:8]):
        assert visitor.http.get(f"/jobs/{reference}").url.path == f"/jobs/{training}"
    assert "does not exist" in visitor.page("/jobs/nothing", 404).text


def test_an_ended_job_has_its_attempt_on_a_line_of_time_and_how_each_node_ended(console: Console, talking: str) -> None:
    page = console.visitor().page(f"/jobs/{talking}")
    assert "FAILED" in page.text and "1 of 1" in page.text
    assert "node 0 on localhost (exit 1" in page.text and "; node 1 on localhost" in page.text
    (bar, *_) = page.all("rect", **{"class": "span"})
    assert bar["data-state"] == "failed" and 0 <= float(bar["x"] or -1) < 100 and float(bar["width"] or 0) > 0
    assert "It came through the Batch API" in page.text and page.all("button", form="with-checkpoint") == []


def test_what_a_job_says_is_text_wherever_it_is_shown(console: Console, talking: str, store: Store) -> None:
    visitor = console.visitor()
    answer = visitor.http.get(f"/jobs/{talking}/log/search", params={"text": "ALERT(1)", "node": "0"})
    assert answer.headers["content-type"] == "application/json" and HOSTILE in texts(answer.json())
    waiting = console.submit(console.register("hostile"), "hostile")
    console.client.batch("TerminateJob", jobId=waiting, reason=HOSTILE)
    await_status(console.client, waiting, "FAILED")
    spec = {**SPEC, "name": "odd", "environment": {"TEXT": HOSTILE}}
    add_run(store, "odd", spec)
    odd = console.client.post("/api/runs/odd/resume", {})["jobId"]
    for job in (talking, waiting, odd):
        page = Page(visitor.http.get(f"/jobs/{job}").text)
        assert page.is_inert and page.all("script", src="x") == [] and page.all("img", src="x") == []
    assert "<script>alert" not in visitor.http.get(f"/jobs/{waiting}").text
    assert "<script>alert(1)</script>" in visitor.page(f"/jobs/{waiting}").text, "as text it is there"


def test_the_log_is_read_back_in_windows_and_by_node_rank_and_attempt(visitor: Visitor, talking: str) -> None:
    last = log_of(visitor, talking, node="0")
    assert len(last["lines"]) == 400 and last["more"]
    first = log_of(visitor, talking, node="0", before=json.dumps(last["first"]))
    whole = [each for each in texts(first) + texts(last) if each.startswith("line ")]
    assert whole == [f"line {i} of 0" for i in range(600)] and not first["more"]
    onwards = log_of(visitor, talking, node="0", after=json.dumps(first["last"]))
    assert texts(onwards)[:400] == texts(last)
    assert {each[2] for each in log_of(visitor, talking)["lines"]} == {0, 1}
    assert log_of(visitor, talking, rank="7")["lines"] == [] and log_of(visitor, talking, attempt="2")["lines"] == []
    for wrong in ({"before": "x"}, {"before": '{"1/0": -1}'}, {"node": "x"}):
        assert visitor.http.get(f"/jobs/{talking}/log", params=wrong).status_code == 400


def test_the_stream_has_what_changed_and_ends_with_the_job(visitor: Visitor, talking: str) -> None:
    events = list(visitor.events(f"/jobs/{talking}/stream"))
    names = [name for name, _, _ in events]
    assert names == ["parts", "end"], "the page has the lines already"
    headline = Page(events[0][1]["headline"])
    assert "FAILED" in headline.text and not headline.all("button")
    assert json.loads(events[0][2])["l"] == log_of(visitor, talking)["last"]


def test_a_page_goes_on_with_the_line_after_the_last_one_that_it_has(visitor: Visitor, talking: str) -> None:
    middle = log_of(visitor, talking, before=json.dumps(log_of(visitor, talking)["first"]))
    had = json.dumps({"i": None, "l": middle["last"]})
    expected = texts(log_of(visitor, talking))
    by_header = visitor.events(f"/jobs/{talking}/stream", **{"Last-Event-ID": had})
    by_query = visitor.events(f"/jobs/{talking}/stream?last={had}")
    for events in (by_header, by_query):
        lines = [line[5] for name, data, _ in events if name == "lines" for line in data["lines"]]
        assert lines == expected


def test_a_page_that_missed_too_much_gets_the_last_lines(console: Console, talking: str, store: Store) -> None:
    run = store.run(console.client.get(f"/api/jobs/{talking}")["run"])
    with open(run.log(talking, 1, 0), "a") as file:
        file.writelines(format_line(4e9, 0, "o", f"late {i} " + "x" * 100) for i in range(20_000))
    visitor = console.visitor()
    events = visitor.events(f'/jobs/{talking}/stream?last={{"i":0,"l":{{}}}}')
    (window,) = [data for name, data, _ in events if name == "window"]
    assert len(window["lines"]) == 400 and window["skipped"] > 2 << 20
    assert texts(window)[-1].startswith("late 19999 ")


def test_the_stream_has_new_iterations_and_tells_what_went_back(visitor: Visitor, training: str, store: Store) -> None:
    result = visitor.http.get("/runs/taught/curves", params={"name": "reward*"}).json()
    assert result["series"]["reward"] == [i / 2 for i in range(1, 10)] and result["last"] == 9
    had = json.dumps({"i": 7, "l": {}})
    metrics = (data for name, data, _ in visitor.events(f"/jobs/{training}/stream?last={had}") if name == "metrics")
    series = {"reward": [4.0, 4.5], "reward_alive": [1.0, 1.0], "action_std": [None, 0.41]}
    assert next(metrics) == {"iterations": [8, 9], "series": series}
    run: Run = store.run("taught")
    with MetricsWriter(run, 2, 4) as writer:
        writer.write({"iteration": 5, "reward": 50.0})
    assert next(metrics) == {"again": True}
    assert visitor.http.get("/runs/taught/curves", params={"name": "reward"}).json()["series"]["reward"][-1] == 50.0
    metrics.close()
    (run.metrics / "metrics-e2.jsonl").unlink()


def test_checkpoints_are_listed_with_their_scores_and_the_best_one(console: Console, training: str) -> None:
    page = console.visitor().page(f"/jobs/{training}")
    assert [each["value"] for each in page.all("input", type="radio") if each.get("value")] == ["9", "6", "3"]
    assert "9 ± 0.5" in page.text and "newest, best" in page.text


def test_a_checkpoint_is_evaluated_exported_and_recorded_by_jobs_of_their_own(console: Console, training: str) -> None:
    visitor = console.visitor()
    evaluated = spec_of(console, visitor.submit(f"/jobs/{training}/evaluate", checkpoint="6"))
    assert evaluated["evaluate"]["run"] == "taught" and evaluated["evaluate"]["checkpoint"] == 6
    assert "accept_changed_robot" not in evaluated["evaluate"]
    exported = spec_of(console, visitor.submit(f"/jobs/{training}/export"))
    assert exported["export"]["checkpoint"] == 9 and exported["queue"] == "default"
    recorded = spec_of(console, visitor.submit(f"/jobs/{training}/record", checkpoint="best"))
    assert recorded["record"]["checkpoint"] == 9
    assert visitor.page(f"/jobs/{training}").all("input", name="accept_changed_robot", type="checkbox")
    for kind in ("evaluate", "export", "record"):
        accepting = spec_of(console, visitor.submit(f"/jobs/{training}/{kind}", accept_changed_robot="yes"))
        assert accepting[kind]["accept_changed_robot"] is True
    assert "available: 3, 6, 9" in visitor.refusal(f"/jobs/{training}/evaluate", checkpoint="7", status=404)
    assert visitor.submit(f"/jobs/{training}/evaluate", checkpoint="x").status_code == 400


def test_a_run_goes_on_from_an_older_checkpoint_once_the_person_confirmed(console: Console, store: Store) -> None:
    add_run(store, "again", {**SPEC, "name": "again"})
    for iteration in (3, 6):
        add_checkpoint(store, "again", iteration)
    first = console.client.post("/api/runs/again/resume", {})["jobId"]
    console.client.batch("TerminateJob", jobId=first, reason="enough")
    await_status(console.client, first, "FAILED")
    visitor = console.visitor()
    question = visitor.submit(f"/jobs/{first}/resume", checkpoint="3")
    assert question.status_code == 409 and "after iteration 3 no longer counts" in question.json()["question"]["text"]
    sent = {"confirmed": "yes", "changes": "train.iterations=30\n\n", "accept_changed_robot": "yes"}
    answer = visitor.submit(f"/jobs/{first}/resume", checkpoint="3", **sent)
    resumed = spec_of(console, answer)["train"]
    assert (
        resumed["iterations"] == 30
        and resumed["accept_changed_robot"] is True
        and "from iteration 3" in answer.json()["message"]
    )
    page = visitor.page(answer.json()["location"])
    assert "Compared with the job before it, again" in page.text and "train.iterations 9 30" in page.text
    assert "expected KEY=VALUE" in visitor.refusal(f"/jobs/{first}/resume", changes="nonsense", status=400)


def test_a_clone_shows_what_is_different_from_its_parent(visitor: Visitor, training: str) -> None:
    assert "give the new run a name" in visitor.refusal(f"/jobs/{training}/clone", checkpoint="6", status=400)
    answer = visitor.submit(f"/jobs/{training}/clone", checkpoint="6", name="copied", changes="train.seed=7")
    assert "cloned taught@6 as run copied" in answer.json()["message"]
    page = visitor.page(answer.json()["location"])
    assert "Started from taught@6" in page.text and "Compared with its parent taught" in page.text
    assert "train.seed" in page.text and page.all("td", **{"class": "new"})


def test_only_an_exported_checkpoint_becomes_a_model(console: Console, training: str) -> None:
    answer = console.visitor().submit(f"/jobs/{training}/register", name="walker", checkpoint="6")
    assert answer.status_code == 400 and "export" in answer.json()["message"]
    assert console.client.get("/api/models") == []


def test_a_job_is_stopped_once_the_person_has_confirmed(console: Console, visitor: Visitor, store: Store) -> None:
    job = submit_gang(console.client, FOREVER, name="runs", queue="first")
    await_status(console.client, job, "RUNNING")
    assert visitor.submit(f"/jobs/{job}/stop").json()["question"]["title"] == f"Stop runs ({job[:8]})?"
    saved = wait_for(  # a job may run before its node is on the bus
        lambda: answer if (answer := visitor.submit(f"/jobs/{job}/save")).status_code != 503 else None, 20, "the node"
    )
    assert saved.status_code == 409 and "nothing to save" in saved.json()["message"]
    assert visitor.submit(f"/jobs/{job}/stop", confirmed="yes").json()["message"].endswith("is asked to stop")
    ended = await_status(console.client, job, "FAILED")
    assert ended["statusReason"] == "stopped in the console by key admin"


def test_a_read_only_key_sees_no_buttons_nor_values_and_is_refused_actions(console: Console, training: str) -> None:
    visitor = console.visitor("reader")
    page = visitor.page(f"/jobs/{training}")
    assert "taught" in page.text and page.all("form", method="post") == [{"method": "post", "action": "/logout"}]
    assert "LEVEL: (hidden)" in page.text and "of-nobody-else" not in page.source
    assert page.all("input", type="radio") == []
    jobs = console.client.get("/api/jobs")["total"]
    for action in ("stop", "save", "resume", "clone", "evaluate", "export", "record", "register"):
        assert "is read-only" in visitor.refusal(f"/jobs/{training}/{action}", name="x", confirmed="yes")
    assert console.client.get("/api/jobs")["total"] == jobs


def test_a_key_of_another_queue_sees_nothing_of_the_job_and_changes_nothing(console: Console, training: str) -> None:
    visitor = console.visitor("lab")
    for path in ("", "/stream", "/log", "/log/search?text=x"):
        assert visitor.http.get(f"/jobs/{training}{path}").status_code == 404, path
    for path in ("/runs/taught/curves", "/runs/taught/files/metrics/metrics-e1.jsonl"):
        assert visitor.http.get(path).status_code == 404, path
    for action in ("stop", "save", "resume", "evaluate", "register"):
        assert visitor.submit(f"/jobs/{training}/{action}", name="x", confirmed="yes").status_code == 404, action


def test_files_of_a_run_are_downloads_and_none_leads_out_of_it(console: Console, training: str, store: Store) -> None:
    run, visitor = store.run("taught"), console.visitor()
    run.recordings.mkdir()
    (run.recordings / "gait.gif").write_bytes(b"GIF89a")
    (run.recordings / "page.html").write_bytes(b"<script>alert(1)</script>")
    (run.recordings / "way-out").symlink_to("/etc/passwd")
    page = visitor.page(f"/jobs/{training}")
    assert [each["src"] for each in page.all("img")] == ["/runs/taught/files/recordings/gait.gif"]
    assert "recordings/page.html" in page.text and "way-out" not in page.text
    picture = visitor.http.get("/runs/taught/files/recordings/gait.gif")
    assert (picture.content, picture.headers["content-type"]) == (b"GIF89a", "image/gif")
    download = visitor.http.get("/runs/taught/files/recordings/page.html")
    assert download.headers["content-type"] == "application/octet-stream"
    assert download.headers["content-disposition"].startswith("attachment")
    assert "sandbox" in ", ".join(download.headers.get_list("content-security-policy"))
    up = ("../run.json", "..%2f..%2frun.json", ".x", "no")
    for path in ("run.json", *(f"recordings/{each}" for each in up)):
        assert visitor.http.get(f"/runs/taught/files/{path}").status_code == 404, path
    assert visitor.http.get("/runs/taught/files/recordings/way-out").status_code == 409


def test_the_page_of_an_array_leads_to_its_jobs(console: Console, store: Store) -> None:
    console.client.batch("RegisterJobDefinition", **single("child", container(cpus="4")))
    sent = {"jobName": "many", "jobQueue": "default", "jobDefinition": "child", "arrayProperties": {"size": 3}}
    job = console.client.batch("SubmitJob", **sent)["jobId"]
    page = console.visitor().page(f"/jobs/{job}")
    found = [each["href"] for each in page.all("a") if f"{job}:" in str(each["href"])]
    assert found == [f"/jobs/{job}:{i}" for i in range(3)]
    wait_for(
        lambda: console.visitor().page(f"/jobs/{job}").text.count("4 CPUs") == 4,
        20,
        "the reasons of the array and of its children",
    )
    wait_for(lambda: "RUNNABLE" in console.visitor().page(f"/jobs/{job}:1").text, 20, "the child's reason")
    with pytest.raises(ApiError):
        console.client.get(f"/api/jobs/{job}:7")


# -- live views: when one starts and ends, with real processes in place of the viewer ----------------------------------


OPEN = "import time; print('note: 2 worlds'); print('the view is at http://127.0.0.1:9', flush=True); time.sleep(600)"
LEFT = "print('muster: the training is on another machine'); raise SystemExit(1)"
SHOWN, CLOSED = JobViewState(url="http://127.0.0.1:9"), JobViewState()


def start(views: Views, job: str, text: str, state: JobViewState) -> None:
    """Start a view by a script, and wait for its state."""
    views.start(job, [sys.executable, "-c", text])
    wait_for(lambda: views.state(job) == state, 20, f"{job}: {state}")


def test_a_view_is_open_until_it_is_closed_and_a_server_has_two_at_once() -> None:
    views = Views()
    assert views.state("a") == CLOSED
    for job in ("a", "b", "a"):
        start(views, job, OPEN, SHOWN)
    with pytest.raises(ClientError, match="2 live views are open on this server; close one first"):
        start(views, "c", OPEN, SHOWN)
    for job in ("a", "b", "nobody's"):
        views.end(job)
        wait_for(lambda job=job: views.state(job) == CLOSED, 20, "its end")  # type: ignore[misc]
    start(views, "c", LEFT, JobViewState(problem="the training is on another machine"))
    start(views, "c", "raise SystemExit(3)", JobViewState(problem="exit code 3"))


def test_a_view_ends_when_nobody_looks_at_its_page(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(job_view, "_UNSEEN", 2.0)
    views = Views()
    start(views, "a", OPEN, SHOWN)
    assert views.state("a", is_seen=True) == SHOWN
    wait_for(lambda: views.state("a") == CLOSED, 20, "its end")


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("127.0.0.1:8080", "http://127.0.0.1:8080"),
        ("LOCALHOST", "http://localhost:80"),
        ("[::1]:8080", "http://[::1]:8080"),
        ("127.0.0.1:8080; script-src *", None),
        ("127.0.0.1 *", None),
        ("robots.example:8080", None),
        ("", None),
    ],
)
def test_a_viewer_may_be_framed_by_the_console_of_this_machine_alone(host: str, origin: str | None) -> None:
    request = cast(Any, SimpleNamespace(headers={"host": host}, url=SimpleNamespace(scheme="http")))
    assert job_view.is_near(request) == (origin is not None)
    if origin is not None:
        assert job_view._origin(request) == origin


def test_what_can_t_be_watched_is_refused_in_one_line(console: Console) -> None:
    job = console.submit(console.register("waits"), "waits")
    answer = console.visitor().submit(f"/jobs/{job}/view")
    assert answer.status_code == 409
    assert answer.json()["message"] == "job waits is not a running training; its checkpoints can be recorded"
    assert console.visitor("reader").submit(f"/jobs/{job}/view").status_code == 403
    far = console.visitor().http.post(f"/jobs/{job}/view", headers={"Host": "robots.example", "Accept": "*/*"})
    assert far.status_code == 403
    console.client.batch("TerminateJob", jobId=job, reason="seen")
