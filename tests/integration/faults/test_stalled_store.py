"""The store stalls: what needs it is refused with the reason, and nothing else waits for it."""

from __future__ import annotations

import html
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest

from orchestrator.client import Client
from orchestrator.control.store_calls import THREADS
from orchestrator.domain.errors import ApiError
from orchestrator.server import Server
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.model import validate
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.initial_weights import WeightsCopy
from shared_store.volume.layout import Run, Store
from tests.conftest import submit_gang
from tests.support.definitions import container, multinode
from tests.support.faults.stalled import stalled
from tests.support.orchestrator.jobs import FOREVER, await_status
from tests.support.orchestrator.trained import add_checkpoint, add_run
from tests.support.waiting import wait_for

PARAMETERS = {"{name}": "taught", "{number}": "1"}
PAGES = (
    *(
        "/",
        "/runs",
        "/runs/{name}",
        "/runs/{name}/files/metrics/reward.png",
        "/runs/{name}/curves",
        "/compare?run={name}",
    ),
    *("/jobs/{reference}", "/jobs/{reference}/log", "/jobs/{reference}/log/search", "/models", "/lineage"),
    *("/queues", "/submit/task/Cartpole", "/submit/yaml?job={reference}"),
)
AT_ONCE = 12
CHATTING = "import time\nwhile True: print('still here', flush=True); time.sleep(0.5)"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    server = Server(tmp_path / "home", cpus=2)
    server.start()
    add_run(server.store, "taught")
    add_checkpoint(server.store, "taught", 3)
    yield server
    server.close()


def hanging(run: Run) -> list[Path]:
    return [path for path in (run.path, *run.path.rglob("*")) if path.is_dir()]


def requested(server: Server, path: str) -> httpx.Response:
    return httpx.get(f"{server.url}{path}", timeout=60)


def test_hanging_reads_keep_neither_the_loop_nor_a_stop_nor_a_submission_waiting(server: Server) -> None:
    with Client(server.url) as client, ThreadPoolExecutor(40) as threads:
        job = submit_gang(client, FOREVER, env={"MUSTER_RUN": "running"})
        await_status(client, job, "RUNNING")
        with stalled(*hanging(server.store.run("taught")), *hanging(server.store.run("running"))):
            paths = ["/api/runs/taught", "/api/runs/taught/metrics", f"/api/jobs/{job}", "/runs/taught"] * 5
            reads = [threads.submit(requested, server, path) for path in paths]
            wait_for(lambda: connections_of(server) == 0, 10, "that no request holds a connection")
            for _ in range(10):
                assert requested(server, "/healthz").status_code == 200
            assert "muster_store_calls{" in requested(server, "/metrics").text
            assert server.controller.monitoring.loop_age < 5 and not any(read.done() for read in reads)
            client.batch("TerminateJob", jobId=job, reason="enough")
            other = submit_gang(client, "pass")
            described = lambda: client.batch("DescribeJobs", jobs=[other])["jobs"][0]["status"]  # noqa: E731
            wait_for(lambda: described() == "SUCCEEDED", 60, "a job beside a stalled run")
            answers = [read.result() for read in reads]
            assert {answer.status_code for answer in answers} == {200, 503}
        for path, answer in zip(paths, answers, strict=True):
            if path.startswith("/api/jobs/"):  # what the database knows is shown all the same
                assert answer.status_code == 200 and answer.json()["id"] == job
                assert answer.json()["results"] is None and "does not answer" in answer.json()["storeProblem"]
            else:
                assert answer.status_code == 503 and "does not answer" in answer.text
        await_status(client, job, "FAILED")
        assert requested(server, "/api/runs/taught").status_code == 200


def test_no_request_reads_the_store_inside_a_transaction(server: Server) -> None:
    """Each page and each read of the API is sent to a run that hangs, some at a time: each hangs on a thread of its own."""
    with Client(server.url) as client, ThreadPoolExecutor(AT_ONCE) as threads:
        job = submit_gang(client, FOREVER, env={"MUSTER_RUN": "running"})
        await_status(client, job, "RUNNING")
        server.controller.access.calls.patience = 4.0
        paths = list(addresses(server, job))
        assert len(paths) > 20
        for start in range(0, len(paths), AT_ONCE):
            with stalled(*hanging(server.store.run("taught")), *hanging(server.store.run("running"))):
                sent = {path: threads.submit(requested, server, path) for path in paths[start : start + AT_ONCE]}
                time.sleep(1.5)
                wait_for(lambda: connections_of(server) == 0, 2, f"that none of {list(sent)} holds a connection")
            assert all(answer.result().status_code < 504 for answer in sent.values())
        client.batch("TerminateJob", jobId=job, reason="enough")


def addresses(server: Server, job: str) -> Iterator[str]:
    found = [path for path, methods in server.app.openapi()["paths"].items() if "get" in methods]
    for path in (*found, *PAGES):
        for name, value in {**PARAMETERS, "{reference}": job}.items():
            path = path.replace(name, value)
        yield path


def connections_of(server: Server) -> int:
    """The connections to the database that requests hold."""
    pool: Any = server.controller.database.engine.pool
    return int(pool.checkedout())


def test_what_continues_a_run_reads_it_before_it_holds_the_database(server: Server) -> None:
    with Client(server.url) as client, ThreadPoolExecutor(20) as threads:
        server.controller.access.calls.patience = 4.0
        definition = multinode("again", container(env={"MUSTER_RUN": "taught"}))
        registered = client.batch("RegisterJobDefinition", **definition)["jobDefinitionArn"]
        submit = {"jobName": "again", "jobQueue": "default", "jobDefinition": registered}
        with stalled(*hanging(server.store.run("taught"))):
            sent = [
                threads.submit(httpx.post, f"{server.url}{path}", json=body, timeout=60)
                for path, body in (
                    ("/v1/submitjob", submit),
                    ("/api/runs/taught/resume", {"set": ["train.iterations=20"]}),
                    ("/api/runs/taught/clone", {"name": "copied"}),
                )
            ]
            time.sleep(1.0)
            assert not any(each.done() for each in sent) and not server.controller.writes.lock.locked()
            assert connections_of(server) == 0
            submit_gang(client, "pass")
            refused = sent[0].result()
            assert refused.status_code == 503 and "does not answer" in refused.json()["message"]
        assert [each.result().status_code for each in sent[1:]] == [200, 200]


@pytest.mark.parametrize("existing", ["nothing", "another store"])
def test_while_the_store_is_not_there_what_needs_it_is_refused_with_the_reason(
    server: Server, tmp_path: Path, existing: str
) -> None:
    path = server.store.path
    with Client(server.url) as client:
        job = submit_gang(client, FOREVER, env={"MUSTER_RUN": "running"})
        await_status(client, job, "RUNNING")
        path.rename(tmp_path / "unmounted")
        try:
            if existing == "another store":
                add_run(Store(path).open(), "foreign")
            message = (
                f"{'another store is' if existing == 'another store' else 'there is no store'} at {path}; see whether"
            )
            assert requested(server, "/api/runs/taught").status_code == 503, (
                "what is missing is not taken for deleted meanwhile"
            )
            # the look before may have found the path empty
            wait_for(
                lambda: message in (server.controller.access.disk.unavailable("store") or ""), 60, "that it is seen"
            )
            answers = [
                requested(server, each) for each in ("/api/runs", "/api/runs/taught", "/api/models", "/runs/taught")
            ]
            for asks in ("runs/taught/resume", "runs/taught/clone", "runs/taught/models"):
                body = {"name": "copied"}
                answers.append(httpx.post(f"{server.url}/api/{asks}", json=body, timeout=60))
            for answer in answers:
                assert answer.status_code == 503 and message in html.unescape(answer.text), answer.text
            assert [each["id"] for each in requested(server, "/api/jobs").json()["jobs"]] == [job]
            assert message in requested(server, f"/api/jobs/{job}").json()["storeProblem"]
            client.batch("TerminateJob", jobId=job, reason="enough")
        finally:
            path.rename(tmp_path / "wrong") if path.exists() else None
            (tmp_path / "unmounted").rename(path)
        await_status(client, job, "FAILED")
        wait_for(lambda: requested(server, "/api/runs/taught").status_code == 200, 30, "the store")


def test_a_download_whose_file_stalls_is_cut_off_and_keeps_nobody_waiting(server: Server) -> None:
    server.controller.access.calls.patience = 2.0
    exports = server.store.run("taught").path / "exports"
    exports.mkdir()
    (exports / "policy.bin").write_bytes(b"policy")
    with stalled(exports, reads=True):
        with pytest.raises(httpx.RemoteProtocolError):
            requested(server, "/runs/taught/files/exports/policy.bin")
        assert httpx.get(f"{server.url}/healthz", timeout=10).status_code == 200
        assert is_open(exports / "policy.bin")
    wait_for(lambda: not is_open(exports / "policy.bin"), 20, "that the file is closed")


def test_pages_that_wait_for_the_store_report_it_and_the_others_stay_live(server: Server) -> None:
    with Client(server.url) as client, ThreadPoolExecutor(40) as threads:
        job = submit_gang(client, CHATTING, env={"MUSTER_RUN": "running"})
        await_status(client, job, "RUNNING")
        waiting = [threads.submit(first_event, server, f"/jobs/{job}/stream", "trouble") for _ in range(2)]
        assert all(first_event(server, f"/jobs/{job}/stream", "parts") for _ in range(2))
        assert first_line(server, job), "the directory of its log is there"
        with stalled(*hanging(server.store.run("running"))):
            followers = [threads.submit(first_line, server, job) for _ in range(THREADS)]
            assert all("has not answered for 5 s" in each.result() for each in waiting)
            wait_for(lambda: server.controller.access.followed.open >= THREADS, 30, "looks that hang")
            for page in ("queues", "keys", "jobs"):
                assert first_event(server, f"/{page}/stream", "parts")
        assert all(each.result() for each in followers), "they go on"
        client.batch("TerminateJob", jobId=job, reason="enough")


def first_event(server: Server, path: str, name: str) -> str:
    """The data of the first event of that name."""
    with httpx.stream("GET", f"{server.url}{path}", timeout=60) as events:
        lines, over = events.iter_lines(), time.monotonic() + 60
        while time.monotonic() < over:
            if next(lines) == f"event: {name}":
                return next(lines)
    raise AssertionError(f"{path} sent no event {name}")


def first_line(server: Server, job: str) -> str:
    """The first line of a log that is followed; on a busy machine it may be refused at first, since too many others ask at once."""
    while True:
        with httpx.stream("GET", f"{server.url}/api/jobs/{job}/logs?follow=true", timeout=60) as lines:
            if lines.status_code != 503:
                return next(filter(None, lines.iter_lines()))
        time.sleep(0.2)


def test_a_clone_whose_publication_hangs_holds_neither_the_database_nor_the_lock(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Client(server.url) as client, ThreadPoolExecutor(1) as threads, ExitStack() as stack:
        stall_after_the_copy(server, stack, monkeypatch)
        cloned = threads.submit(
            httpx.post, f"{server.url}/api/runs/taught/clone", json={"name": "copied"}, timeout=60, trust_env=False
        )
        wait_for(lambda: "copied" in server.controller.access.beginning, 30, "the publication")
        assert_all_else_goes_on(server, client)
        with pytest.raises(ApiError, match="run copied is being begun by another request"):
            submit_gang(client, "pass", env={"MUSTER_RUN": "copied"})
        assert not cloned.done()
        stack.close()
        answer = cloned.result().json()
        description = server.store.run("copied").description() or {}
        assert answer["run"] == "copied" and description["job"] == answer["jobId"]
        assert client.batch("DescribeJobs", jobs=[answer["jobId"]])["jobs"] and not server.controller.access.beginning


def test_a_teacher_whose_publication_hangs_is_taken_back_when_the_store_answers_again(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    server.controller.access.calls.patience = 6.0
    with Client(server.url) as client, ThreadPoolExecutor(1) as threads, ExitStack() as stack:
        pupil = distilling(client)
        stall_after_the_copy(server, stack, monkeypatch)
        submitted = threads.submit(httpx.post, f"{server.url}/v1/submitjob", json=pupil, timeout=60, trust_env=False)
        wait_for(lambda: server.controller.access.beginning, 30, "the publication")
        assert_all_else_goes_on(server, client)
        answer = submitted.result()
        assert answer.status_code == 503 and "does not answer (not within 6 s)" in answer.json()["message"]
        stack.close()
        wait_for(lambda: not server.controller.access.beginning, 30, "that the copy is taken back")
        assert [path.name for path in (server.store.path / "runs").iterdir() if "pupil" in path.name] == []
        job = client.batch("SubmitJob", **pupil)["jobId"]
        run = server.store.run(client.batch("DescribeJobs", jobs=[job])["jobs"][0]["jobName"] + f"-{job[:8]}")
        assert [each.iteration for each in list_checkpoints(run.teacher("taught"))] == [3]


def test_copies_of_teachers_that_hang_leave_threads_for_other_requests(server: Server) -> None:
    with Client(server.url) as client, ThreadPoolExecutor(40) as threads:
        pupil = distilling(client)
        with stalled(*server.store.run("taught").checkpoints.glob("*/learner.pt")):
            sent = [
                threads.submit(httpx.post, f"{server.url}/v1/submitjob", json=pupil, timeout=90, trust_env=False)
                for _ in range(40)
            ]
            wait_for(lambda: server.controller.access.calls.open == THREADS, 30, "copies that hang")
            assert_all_else_goes_on(server, client)
        codes = [each.result().status_code for each in sent]
        assert set(codes) == {200, 503} and codes.count(200) >= THREADS


def stall_after_the_copy(server: Server, stack: ExitStack, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the directory of the runs stall as soon as weights are copied."""
    copy = WeightsCopy.copy

    def copy_and_stall(self: WeightsCopy, place: str = "parent") -> None:
        copy(self, place)
        monkeypatch.undo()
        stack.enter_context(stalled(server.store.path / "runs"))

    monkeypatch.setattr(WeightsCopy, "copy", copy_and_stall)


def distilling(client: Client) -> dict[str, Any]:
    """The submission of a job that imitates run ``taught``."""
    settings = {"algorithm": {"class_name": "Distillation"}, "teacher_checkpoint": "taught@3"}
    train = {"task": "Cartpole", "worlds": 4, "iterations": 2, "algorithm": "rsl_rl", "rsl_rl": settings}
    spec = validate({"name": "pupil", "resources": {"cpus": 1, "memory": 64}, "train": train}, "pupil")
    client.batch("RegisterJobDefinition", **compile_definition(spec, "/"))
    return {"jobName": "pupil", "jobQueue": "default", "jobDefinition": "pupil"}


def assert_all_else_goes_on(server: Server, client: Client) -> None:
    """Nothing is locked, and jobs are submitted, described and stopped."""
    wait_for(lambda: not server.controller.writes.lock.locked(), 2, "that the lock is free")
    assert connections_of(server) == 0
    job = submit_gang(client, "pass")
    client.batch("TerminateJob", jobId=job, reason="enough")
    assert client.batch("DescribeJobs", jobs=[job])["jobs"]
    assert httpx.get(f"{server.url}/healthz", timeout=10).status_code == 200


def is_open(path: Path) -> bool:
    return any(each.resolve() == path for each in Path("/proc/self/fd").iterdir())
