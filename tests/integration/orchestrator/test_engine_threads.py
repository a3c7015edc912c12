"""Engines that hang, fail, are full, or queue by themselves: each on its own thread, none in the way of another; and what is reported of them."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import resource
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import httpx
import pytest

from orchestrator import server as servers
from orchestrator.client import Client
from orchestrator.domain.errors import ApiError
from orchestrator.domain.hosts import Host, Limit, Placement, Queued
from orchestrator.domain.resources import Resources
from orchestrator.engines import registry, runner
from orchestrator.engines.api import (
    Engine,
    EngineError,
    Gang,
    GangStatus,
    Handle,
    NotYet,
    Setting,
    Transient,
    read_handle,
)
from orchestrator.engines.installed import make_engine
from orchestrator.engines.local.engine import LocalEngine
from orchestrator.engines.registry import EngineSet
from orchestrator.engines.testing.fake import FakeEngine
from orchestrator.engines.toolkit.statuses import status_of
from orchestrator.engines.toolkit.waiting import stop_within
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.model import validate
from shared_store.volume.layout import Store
from tests.conftest import submit_gang, wait_for
from tests.support.definitions import container, multinode
from tests.support.engines.bench import make_gang
from tests.support.orchestrator.jobs import FOREVER, await_status, detail, serving
from tests.support.processes import end_all, gang_members, processes_of

HOST = "fake/host"


def gang(directory: Path, name: str = "job", host: str = HOST, script: str = "exec sleep 600", nodes: int = 1) -> Gang:
    placements = [Placement(host, (), 0.1, 16)] * nodes
    return make_gang(directory / "store", script, nodes, job=name, placements=placements, grace=1.0)


@contextlib.contextmanager
def engines(*made: Any) -> Iterator[EngineSet]:
    several = EngineSet(made)
    try:
        yield several
    finally:
        several.close()


def launched(several: EngineSet, what: Gang) -> str:
    def ask() -> str | None:
        try:
            return several.launch(what.name, [each.host for each in what.placements], lambda: several.plan(what))
        except NotYet:
            return None

    handle: str = wait_for(ask, 10, "the launch")
    return handle


def observed(several: EngineSet, handle: str) -> GangStatus | None:
    """The newest status, after a request for a newer one, as in a pass of the controller."""
    several.poll()
    return several.observe(handle)


TRANSIENT = "EMFILE ENFILE EAGAIN ENOMEM ESTALE ENOSPC EIO EDQUOT EROFS ETIMEDOUT ECONNREFUSED EBUSY EINTR"
FINAL = "ENOENT ENOTDIR EACCES EPERM E2BIG ENAMETOOLONG ENOEXEC"


def test_transient_errors_and_those_without_a_number_are_retried_and_others_are_final() -> None:
    engine = FakeEngine()
    with contextlib.closing(runner.Runner(engine, lambda _: None)) as requested:
        for name in (*TRANSIENT.split(), *FINAL.split(), "of a library"):
            error = OSError(getattr(errno, name), name) if name.isupper() else OSError(name)
            engine.plan = mock.Mock(side_effect=error)  # type: ignore[method-assign]
            with pytest.raises(EngineError) as raised:
                requested.plan(make_gang(Path("/")))
            assert isinstance(raised.value, Transient) is (name not in FINAL.split()), name


def test_without_descriptors_no_gang_counts_as_dead_and_no_half_gang_is_started(tmp_path: Path) -> None:
    Store(tmp_path / "store").open()
    engine = LocalEngine(tmp_path, cpus=4)
    with engines(engine) as several:
        handle = launched(several, gang(tmp_path, "running", "localhost"))
        wait_for(lambda: observed(several, handle), 10, "the first picture")
        taken = []
        before = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(map(int, os.listdir("/proc/self/fd"))) + 20, before[1]))
        try:
            with contextlib.suppress(OSError):
                while True:
                    taken.append(os.open("/dev/null", os.O_RDONLY))
            with pytest.raises(OSError, match="Too many open files"):
                status_of(engine, read_handle(handle))
            for spare in range(12):  # wherever it runs out of them
                for descriptor in taken[-spare:] if spare else []:
                    os.close(descriptor)
                del taken[len(taken) - spare :]
                try:
                    engine.launch(engine.plan(gang(tmp_path, f"half-{spare}", "localhost", nodes=2)))
                    break
                except (OSError, Transient):
                    pass
                with contextlib.suppress(OSError):
                    while True:
                        taken.append(os.open("/dev/null", os.O_RDONLY))
        finally:
            for descriptor in taken:
                os.close(descriptor)
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
        try:
            [node] = wait_for(lambda: (s := observed(several, handle)) and not s[0].words and s, 60, "that it is seen")
            assert node.running
            names = {member.gang for member in gang_members(tmp_path)}
            assert names <= {"running/1/1", f"half-{spare}/1/1"} and spare > 0, (names, spare)
        finally:
            several.stop(handle, 0)
            for name in range(spare + 1):
                engine.stop(Handle("local", f"half-{name}/1/1", 0, {"nodes": []}), 0)
    assert processes_of(tmp_path) == []


def test_a_transient_launch_error_keeps_the_attempts_and_a_permanent_one_ends_the_job(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    popen, number = subprocess.Popen, [errno.EAGAIN]

    def refused(command: Sequence[str], *arguments: Any, **options: Any) -> Any:
        if number and "worker.supervisor" in command:
            raise OSError(number[0], os.strerror(number[0]))
        return popen(command, *arguments, **options)

    monkeypatch.setattr("orchestrator.engines.local.engine.subprocess.Popen", refused)
    with serving(tmp_path) as client:

        def shows(job: str, *requested: str) -> dict[str, Any]:
            def existing() -> dict[str, Any] | None:
                found: dict[str, Any] = client.get(f"/api/jobs/{job}")
                return found if (found["status"], found["statusReason"])[: len(requested)] == requested else None

            found: dict[str, Any] = wait_for(existing, 30, f"{job} {requested}")
            return found

        output = "the local engine can't start the gang now ([Errno 11] Resource temporarily unavailable); trying again"
        job, other = (submit_gang(client, "print('here')", attempts=3) for _ in range(2))
        shows(job, "STARTING", output)
        shows(other, "STARTING", output)
        client.batch("TerminateJob", jobId=other, reason="enough")
        shows(other, "FAILED", "enough")
        number[:] = [errno.E2BIG]
        assert len(shows(job, "FAILED", "can't start the gang: [Errno 7] Argument list too long")["attempts"]) == 1
        number[:] = [errno.EMFILE]
        job = submit_gang(client, "print('here')", attempts=3)
        shows(job, "STARTING")
        number.clear()
        assert len(shows(job, "SUCCEEDED")["attempts"]) == 1
    assert sum(output in record.getMessage() for record in caplog.records) == 2, "once for each job"


# -- a controller with an engine that hangs ----------------------------------------------------------------------------


class Hanging(FakeEngine):
    """Hangs until a test lets it answer; it stops nothing while ``unresponsive``."""

    unresponsive = False

    def __init__(self) -> None:
        super().__init__()
        self.answers.clear()

    def stop(self, handle: Handle, grace: float) -> None:
        def step() -> str:
            if self.unresponsive:
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
    wait_for(lambda: detail(client, waiting)["statusReason"].startswith(silent), 20, "the reason")
    assert detail(client, waiting)["statusReason"].endswith("; needs 1 node with 0.1 CPUs, 0 GPUs, 64 MiB in all")
    assert detail(client, waiting)["awsCode"] == "CAPACITY:INSUFFICIENT_INSTANCE_CAPACITY"
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
    output = "the fake engine has not answered since "
    wait_for(lambda: output in detail(client, hung)["statusReason"], 30, "the reason")
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
    reported = [record for record in caplog.records if output in record.getMessage()]
    assert len(reported) == 1 and reported[0].exc_info is None


def test_a_stop_that_is_not_answered_is_the_job_s_reason_and_tried_again(client: Client, hanging: Hanging) -> None:
    hanging.answers.set()
    job = submit_gang(client, "pass", queue="fake")
    await_status(client, job, "RUNNING")
    hanging.unresponsive = True
    client.batch("TerminateJob", jobId=job, reason="enough")
    output = (
        rf"attempt 1 can't be stopped: the fake engine has not ended gang {job}/1/\d+ within 0\.05 s; "
        "last answer: the daemon is away; trying again"
    )
    wait_for(lambda: re.fullmatch(output, detail(client, job)["statusReason"]), 20, "the reason")
    hanging.unresponsive = False
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


def test_a_gang_beyond_the_limit_is_refused_and_the_limit_is_not_a_host(queued: Client, engine: FakeEngine) -> None:
    limit = "queue fake/q gives a gang at most 8 CPUs, 2 GPUs, 8 GiB"
    for nodes, cpus, needs in (
        (1, "12", "each node needs 12 CPUs, 0 GPUs, 64 MiB"),
        (3, "3", "needs 3 nodes with 9 CPUs, 0 GPUs, 192 MiB in all"),
    ):
        with pytest.raises(ApiError) as refused:
            queued.post("/api/plan", {"definition": multinode("a", container(cpus=cpus), nodes)})
        assert str(refused.value).endswith(f"{needs}; {limit}")
    reported = queued.get("/api/capacity")
    assert reported["hosts"] == []
    assert reported["queued"] == {"fake": {"queue": "fake/q", "cpus": 8.0, "gpus": 2, "memory": 8192}}
    metrics = httpx.get(f"{queued.url}/metrics").text
    assert 'muster_cpus{engine="fake"} 8.0' in metrics and "muster_hosts{" not in metrics
    engine.offered = Queued([Host("fake/a", 4.0, (), 1024, single=True)])
    reported = queued.get("/api/capacity")
    assert [host["name"] for host in reported["hosts"]] == ["fake/a"] and reported["queued"] == {"fake": None}
