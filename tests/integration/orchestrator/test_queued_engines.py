"""An engine that queues and places gangs by itself: what it is handed, what it is not, and how its capacity is told."""

from __future__ import annotations

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
from orchestrator.engines.testing.fake import FakeEngine
from orchestrator.server import Server
from tests.conftest import submit_gang, wait_for
from tests.support.orchestrator.jobs import await_status, detail


@pytest.fixture
def engine() -> FakeEngine:
    return FakeEngine(capacity=Queued(Limit("fake/q", Resources(8.0, 2, 8192))))


@pytest.fixture
def client(engine: FakeEngine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Client]:
    monkeypatch.setattr(servers, "make_engine", lambda name, setting: engine)
    server = Server(tmp_path, port=0, engines=("fake",))
    server.start()
    try:
        with Client(server.url) as client:
            yield client
    finally:
        server.close()


def test_gangs_are_handed_over_although_others_run_there(client: Client, engine: FakeEngine) -> None:
    jobs = [submit_gang(client, "pass", nodes=2, cpus="3", name=f"job-{number}") for number in range(3)]
    for job in jobs:
        await_status(client, job, "RUNNING")
    hosts = {placement.host for plan in engine.cluster.launched for placement in plan.gang.placements}
    assert len(engine.cluster.launched) == 3 and hosts == {"fake/q"}


def test_a_node_is_on_the_host_that_the_engine_tells_later(client: Client, engine: FakeEngine) -> None:
    job = submit_gang(client, "pass", nodes=2)
    [attempt] = await_status(client, job, "RUNNING")["attempts"]
    assert attempt["computeEnvironment"] == "fake" and [node["host"] for node in attempt["nodes"]] == ["fake/q"] * 2
    [nodes] = engine.cluster.gangs.values()
    nodes[1] = replace(nodes[1], host="fake/m7")
    hosts = lambda: [node["host"] for node in detail(client, job)["attempts"][0]["nodes"]]  # noqa: E731
    wait_for(lambda: hosts() == ["fake/q", "fake/m7"], 20, "the host")


def test_a_gang_beyond_the_limit_is_refused_and_the_limit_is_not_called_a_host(client: Client) -> None:
    with pytest.raises(ApiError) as refused:
        plan(client, nodes=1, cpus="12")
    limit = "queue fake/q gives a gang at most 8 CPUs, 2 GPUs, 8 GiB"
    assert str(refused.value).endswith(f"each node needs 12 CPUs, 0 GPUs, 16 MiB; {limit}")
    with pytest.raises(ApiError) as refused:
        plan(client, nodes=3, cpus="3")
    assert str(refused.value).endswith(f"needs 3 nodes with 9 CPUs, 0 GPUs, 48 MiB in all; {limit}")


def test_its_limit_is_told_apart_from_hosts(client: Client, engine: FakeEngine) -> None:
    told = client.get("/api/capacity")
    assert told["hosts"] == []
    assert told["queued"] == {"fake": {"queue": "fake/q", "cpus": 8.0, "gpus": 2, "memory": 8192}}
    metrics = httpx.get(f"{client.url}/metrics").text
    assert 'muster_cpus{engine="fake"} 8.0' in metrics and "muster_hosts{" not in metrics
    engine.offered = Queued([Host("fake/a", 4.0, (), 1024, single=True)])
    told = client.get("/api/capacity")
    assert [host["name"] for host in told["hosts"]] == ["fake/a"] and told["queued"] == {"fake": None}


def plan(client: Client, nodes: int, cpus: str) -> None:
    container = {
        "image": "muster",
        "command": ["true"],
        "resourceRequirements": [{"type": "VCPU", "value": cpus}, {"type": "MEMORY", "value": "16"}],
    }
    properties = {
        "numNodes": nodes,
        "mainNode": 0,
        "nodeRangeProperties": [{"targetNodes": "0:", "container": container}],
    }
    definition = {"jobDefinitionName": "a", "type": "multinode", "nodeProperties": properties}
    client.post("/api/plan", {"definition": definition})
