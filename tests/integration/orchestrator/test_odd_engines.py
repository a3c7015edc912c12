"""A controller with an engine that hangs, or that queues and places gangs by itself: what it is handed, and what is told of it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import httpx
import pytest

from orchestrator import server as servers
from orchestrator.client import Client
from orchestrator.domain.errors import ApiError
from orchestrator.domain.hosts import Host, Limit, Queued
from orchestrator.domain.resources import Resources
from orchestrator.engines import registry, runner
from orchestrator.engines.api import Engine, Handle, NotYet, Setting
from orchestrator.engines.installed import make_engine
from orchestrator.engines.testing.fake import FakeEngine
from orchestrator.engines.toolkit.stopping import stop_within
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.model import validate
from tests.conftest import submit_gang, wait_for
from tests.support.definitions import container, multinode
from tests.support.orchestrator.jobs import FOREVER, await_status, detail, serving
from tests.support.processes import end_all


class Hanging(FakeEngine):
    """Hangs until a test lets it answer; it stops nothing while ``deaf``."""

    deaf = False

    def __init__(self) -> None:
        super().__init__()
        self.answers.clear()

    def stop(self, handle: Handle, grace: float) -> None:
        def step() -> str:
            if self.deaf:
                raise NotYet("the daemon is away")
            FakeEngine.stop(self, handle, grace)
            return ""

        stop_within(0.05, step, engine=self.name, gang=handle.gang, pause=0.01)


@pytest.fixture
def hanging() -> Hanging:
    return Hanging()


@pytest.fixture
def client(hanging: Hanging, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Client]:
    def make(name: str, setting: Setting) -> Engine:
        return hanging if name == "fake" else make_engine(name, setting)

    monkeypatch.setattr(servers, "make_engine", make)
    monkeypatch.setattr(registry, "START", 0.2)
    with serving(tmp_path, engines=("local", "fake")) as client:
        yield client
        hanging.answers.set()
    end_all(tmp_path)


def test_an_engine_that_hangs_at_the_start_keeps_its_own_jobs_waiting_alone(client: Client, hanging: Hanging) -> None:
    waiting = submit_gang(client, "pass", queue="fake")
    await_status(client, submit_gang(client, "print('here')"), "SUCCEEDED")
    silent = "the fake engine has not answered "  # yet, and later since when
    said = f"CAPACITY:INSUFFICIENT_INSTANCE_CAPACITY - needs 1 node with 0.1 CPUs, 0 GPUs, 16 MiB in all; {silent}"
    wait_for(lambda: detail(client, waiting)["statusReason"].startswith(said), 20, "the reason")
    engines = {each["name"]: each for each in client.get("/api/queues")["engines"]}
    assert engines["local"]["problem"] is None and engines["local"]["toldAt"] is not None
    assert engines["fake"]["problem"].startswith(silent) and engines["fake"]["toldAt"] is None
    document = {"name": "large", "command": ["true"], "resources": {"cpus": 99, "memory": "1GiB"}}
    large = {"definition": compile_definition(validate(document, "job.yaml"), "/"), "queue": "fake"}
    assert client.post("/api/fit", large) == {"problem": None}, "nobody knows"
    hanging.answers.set()
    await_status(client, waiting, "RUNNING")
    assert hanging.threads == {"engine fake"}
    with pytest.raises(ApiError, match="the largest host has 8 CPUs"):
        client.post("/api/plan", large)


def test_an_engine_that_hangs_later_delays_no_gang_of_another_engine(
    client: Client, hanging: Hanging, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(runner, "OVERDUE", 1.0)
    hanging.answers.set()
    running = submit_gang(client, FOREVER)
    await_status(client, running, "RUNNING")
    wait_for(lambda: len(client.get("/api/capacity")["hosts"]) > 1, 20, "the hosts of both")
    hanging.answers.clear()
    hung = submit_gang(client, "pass", queue="fake")
    said = "the fake engine has not answered since "
    wait_for(lambda: said in detail(client, hung)["statusReason"], 30, "the reason")
    # all of this while one call to the engine is in the air
    await_status(client, submit_gang(client, "print('here')"), "SUCCEEDED")
    await_status(client, submit_gang(client, FOREVER, timeout=60), "RUNNING")
    hosts = {host["name"].partition("/")[0] for host in client.get("/api/capacity")["hosts"]}
    assert hosts == {"localhost", "fake"}
    planned = client.post("/api/plan", {"definition": multinode("planned", container(cpus="1")), "queue": "fake"})
    assert (planned["engine"], len(planned["nodes"])) == ("fake", 1)
    client.batch("TerminateJob", jobId=running, reason="enough")
    await_status(client, running, "FAILED")
    assert detail(client, hung)["status"] in ("RUNNABLE", "STARTING")
    told = [record for record in caplog.records if said in record.getMessage()]
    assert len(told) == 1 and told[0].exc_info is None


def test_a_stop_that_is_not_answered_is_the_job_s_reason_and_tried_again(client: Client, hanging: Hanging) -> None:
    hanging.answers.set()
    job = submit_gang(client, "pass", queue="fake")
    await_status(client, job, "RUNNING")
    hanging.deaf = True
    client.batch("TerminateJob", jobId=job, reason="enough")
    said = (
        rf"attempt 1 can't be stopped: the fake engine has not ended gang {job}/1/\d+ within 0\.05 s; "
        "last answer: the daemon is away; trying again"
    )
    wait_for(lambda: re.fullmatch(said, detail(client, job)["statusReason"]), 20, "the reason")
    hanging.deaf = False
    await_status(client, job, "FAILED")
    assert detail(client, job)["statusReason"] == "enough"


# -- an engine that queues --------------------------------------------------------------------------------------------


@pytest.fixture
def engine() -> FakeEngine:
    return FakeEngine(capacity=Queued(Limit("fake/q", Resources(8.0, 2, 8192))))


@pytest.fixture
def queued(engine: FakeEngine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Client]:
    monkeypatch.setattr(servers, "make_engine", lambda name, setting: engine)
    with serving(tmp_path, cpus=None, engines=("fake",)) as client:
        yield client


def test_gangs_are_handed_over_although_others_run_there(queued: Client, engine: FakeEngine) -> None:
    jobs = [submit_gang(queued, "pass", nodes=2, cpus="3", name=f"job-{number}") for number in range(3)]
    for job in jobs:
        await_status(queued, job, "RUNNING")
    hosts = {placement.host for plan in engine.cluster.launched for placement in plan.gang.placements}
    assert len(engine.cluster.launched) == 3 and hosts == {"fake/q"}


def test_a_node_is_on_the_host_that_the_engine_tells_later(queued: Client, engine: FakeEngine) -> None:
    job = submit_gang(queued, "pass", nodes=2)
    [attempt] = await_status(queued, job, "RUNNING")["attempts"]
    assert attempt["computeEnvironment"] == "fake" and [node["host"] for node in attempt["nodes"]] == ["fake/q"] * 2
    [nodes] = engine.cluster.gangs.values()
    nodes[1] = replace(nodes[1], host="fake/m7")
    hosts = lambda: [node["host"] for node in detail(queued, job)["attempts"][0]["nodes"]]  # noqa: E731
    wait_for(lambda: hosts() == ["fake/q", "fake/m7"], 20, "the host")


def test_a_gang_beyond_the_limit_is_refused_and_the_limit_is_not_called_a_host(queued: Client) -> None:
    limit = "queue fake/q gives a gang at most 8 CPUs, 2 GPUs, 8 GiB"
    for nodes, cpus, needs in (
        (1, "12", "each node needs 12 CPUs, 0 GPUs, 16 MiB"),
        (3, "3", "needs 3 nodes with 9 CPUs, 0 GPUs, 48 MiB in all"),
    ):
        with pytest.raises(ApiError) as refused:
            queued.post("/api/plan", {"definition": multinode("a", container(cpus=cpus), nodes)})
        assert str(refused.value).endswith(f"{needs}; {limit}")


def test_its_limit_is_told_apart_from_hosts(queued: Client, engine: FakeEngine) -> None:
    told = queued.get("/api/capacity")
    assert told["hosts"] == []
    assert told["queued"] == {"fake": {"queue": "fake/q", "cpus": 8.0, "gpus": 2, "memory": 8192}}
    metrics = httpx.get(f"{queued.url}/metrics").text
    assert 'muster_cpus{engine="fake"} 8.0' in metrics and "muster_hosts{" not in metrics
    engine.offered = Queued([Host("fake/a", 4.0, (), 1024, single=True)])
    told = queued.get("/api/capacity")
    assert [host["name"] for host in told["hosts"]] == ["fake/a"] and told["queued"] == {"fake": None}
