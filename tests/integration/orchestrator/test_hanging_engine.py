"""A controller with an engine that hangs: it starts, and jobs of its other engines run."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from orchestrator import server as servers
from orchestrator.client import Client
from orchestrator.domain.errors import ApiError
from orchestrator.engines import registry
from orchestrator.engines.api import Engine, Handle, NotYet, Setting
from orchestrator.engines.installed import make_engine
from orchestrator.engines.testing.fake import FakeEngine
from orchestrator.engines.toolkit.stopping import stop_within
from orchestrator.server import Server
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.model import validate
from tests.conftest import submit_gang, wait_for
from tests.support.orchestrator.jobs import await_status, detail


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
    server = Server(tmp_path, port=0, cpus=2, engines=("local", "fake"))
    server.start()
    try:
        with Client(server.url) as client:
            yield client
    finally:
        hanging.answers.set()
        server.close()


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
