"""The store stalls: what needs it is refused with the reason, and nothing else waits for it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest

from orchestrator.client import Client
from orchestrator.server import Server
from shared_store.layout import Run
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
    *("/jobs/{reference}", "/jobs/{reference}/log", "/jobs/{reference}/log/search", "/models", "/lineage", "/tracks"),
    *("/queues", "/submit/task/Cartpole", "/submit/yaml?job={reference}"),
)
AT_ONCE = 12


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


def asked(server: Server, path: str) -> httpx.Response:
    return httpx.get(f"{server.url}{path}", timeout=60)


def test_hanging_reads_keep_neither_the_loop_nor_a_stop_nor_a_submission_waiting(server: Server) -> None:
    with Client(server.url) as client, ThreadPoolExecutor(40) as threads:
        job = submit_gang(client, FOREVER, env={"MUSTER_RUN": "running"})
        await_status(client, job, "RUNNING")
        with stalled(*hanging(server.store.run("taught")), *hanging(server.store.run("running"))):
            paths = ["/api/runs/taught", "/api/runs/taught/metrics", f"/api/jobs/{job}", "/runs/taught"] * 5
            reads = [threads.submit(asked, server, path) for path in paths]
            wait_for(lambda: connections_of(server) == 0, 10, "that no request holds a connection")
            for _ in range(10):
                assert asked(server, "/healthz").status_code == 200
            assert "muster_store_calls{" in asked(server, "/metrics").text
            assert server.reconciler.heartbeat.age < 5 and not any(read.done() for read in reads)
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
        assert asked(server, "/api/runs/taught").status_code == 200


def test_no_request_reads_the_store_inside_a_transaction(server: Server) -> None:
    """Each page and each read of the API is sent to a run that hangs, some at a time: each hangs on a thread of its own."""
    with Client(server.url) as client, ThreadPoolExecutor(AT_ONCE) as threads:
        job = submit_gang(client, FOREVER, env={"MUSTER_RUN": "running"})
        await_status(client, job, "RUNNING")
        server.reconciler.calls.patience = 4.0
        paths = list(addresses(server, job))
        assert len(paths) > 20
        for start in range(0, len(paths), AT_ONCE):
            with stalled(*hanging(server.store.run("taught")), *hanging(server.store.run("running"))):
                sent = {path: threads.submit(asked, server, path) for path in paths[start : start + AT_ONCE]}
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
    pool: Any = server.reconciler.database.engine.pool
    return int(pool.checkedout())


def test_what_continues_a_run_reads_it_before_it_holds_the_database(server: Server) -> None:
    with Client(server.url) as client, ThreadPoolExecutor(20) as threads:
        server.reconciler.calls.patience = 4.0
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
            assert not any(each.done() for each in sent) and not server.reconciler.writing.locked()
            assert connections_of(server) == 0
            submit_gang(client, "pass")
            refused = sent[0].result()
            assert refused.status_code == 503 and "does not answer" in refused.json()["message"]
        assert [each.result().status_code for each in sent[1:]] == [200, 200]


def test_a_store_whose_volume_is_known_to_be_silent_is_not_even_tried(server: Server) -> None:
    with stalled(server.store.path):
        silent: Callable[[], bool] = lambda: server.reconciler.disk.is_silent("store")  # noqa: E731
        wait_for(silent, 60, "that the volume is silent")
        answer = asked(server, "/api/runs")
        assert answer.status_code == 503 and "its volume is silent" in answer.json()["message"]
        assert asked(server, "/api/jobs").status_code == 200
