"""Engines that hang, fail and are full: each on its own thread, none in the way of another."""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from orchestrator.domain.hosts import Host, Hosts, Placement
from orchestrator.engines import runner
from orchestrator.engines.api import (
    EngineError,
    Gang,
    GangStatus,
    Handle,
    NodePhase,
    NodeStatus,
    NotYet,
    Plan,
    Traits,
    Transient,
    read_handle,
)
from orchestrator.engines.local.engine import LocalEngine
from orchestrator.engines.registry import EngineSet
from orchestrator.engines.transience import is_final
from shared_store.layout import Store
from tests.conftest import submit_gang, wait_for
from tests.support.engines.bench import make_gang
from tests.support.orchestrator.jobs import serving
from tests.support.processes import gang_members, processes_of

HOST = "engine/host"


def gang(directory: Path, name: str = "job", host: str = HOST, script: str = "exec sleep 600", nodes: int = 1) -> Gang:
    placements = [Placement(host, (), 0.1, 16)] * nodes
    return make_gang(directory / "store", script, nodes, job=name, placements=placements, grace=1.0)


class Fake:
    """An engine whose calls do what a test wants, and note on which thread they did."""

    name, traits, address = "engine", Traits(), None

    def __init__(self) -> None:
        self.free, self.threads, self.closed = threading.Event(), set[str](), 0
        self.free.set()
        self.error: Exception | None = None

    def _do(self) -> None:
        self.threads.add(threading.current_thread().name)
        self.free.wait()
        if self.error is not None:
            raise self.error

    def capacity(self) -> Hosts:
        self._do()
        return Hosts([Host(HOST, 4, (), 1024)])

    def plan(self, gang: Gang) -> Plan[None]:
        return Plan(gang, [], None)

    def launch(self, plan: Plan[None]) -> Handle:
        self._do()
        return Handle(self.name, plan.gang.name, len(plan.gang.placements), {})

    def observe(self, handle: Handle) -> GangStatus:
        self._do()
        return [NodeStatus(NodePhase.RUNNING, "here")]

    def stop(self, handle: Handle, grace: float) -> None:
        if self.error is not None:
            raise self.error

    def close(self) -> None:
        self.closed += 1


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


@pytest.mark.parametrize(
    ("number", "final"),
    [
        *((name, False) for name in ("EMFILE", "ENFILE", "EAGAIN", "ENOMEM", "ESTALE", "ENOSPC", "EIO", "EDQUOT")),
        *((name, False) for name in ("EROFS", "ETIMEDOUT", "ECONNREFUSED", "EBUSY", "EINTR")),
        *((name, True) for name in ("ENOENT", "ENOTDIR", "EACCES", "EPERM", "E2BIG", "ENAMETOOLONG", "ENOEXEC")),
    ],
)
def test_transient_errors_are_retried_and_others_are_final(number: str, final: bool) -> None:
    assert is_final(OSError(getattr(errno, number), number)) is final


def test_an_error_without_a_number_is_not_final() -> None:
    assert not is_final(OSError("a library's own"))


def test_an_engine_that_hangs_keeps_nobody_waiting_and_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(runner, "OVERDUE", 0.2)
    fake = Fake()
    with engines(fake) as several:
        handle = launched(several, gang(tmp_path))
        wait_for(lambda: several.observe(handle), 10, "the first picture")
        fake.free.clear()
        before = time.monotonic()

        def says() -> str:
            [node] = several.observe(handle) or []
            assert node.running and node.address == "here"
            return node.words

        said = wait_for(says, 10, "that it does not answer")
        assert said.startswith("the engine engine has not answered since "), said
        assert several.capacity(patience=60) == {"engine": Hosts([Host(HOST, 4, (), 1024)])}, "what it told last"
        with pytest.raises(NotYet, match="has not answered since") as wait:
            several.launch("other/1/1", [HOST], lambda: several.plan(gang(tmp_path, "other")))
        assert wait.value.unknown, "it may have been started"
        assert time.monotonic() - before < 30
        fake.free.set()
        wait_for(lambda: not says(), 10, "that it answers again")
        launched(several, gang(tmp_path, "other"))
    assert [record.getMessage() for record in caplog.records] == [said, "the engine engine answers again"]
    assert fake.threads == {"engine engine"}, "the constructor's thread calls no engine"
    assert fake.closed == 1


def test_an_engine_that_fails_is_logged_once_its_gangs_run(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    fake = Fake()
    with engines(fake) as several:
        handle = launched(several, gang(tmp_path))
        wait_for(lambda: several.observe(handle), 10, "the first picture")
        for error, said in (
            (OSError(errno.EMFILE, "Too many"), "can't look at the gang now ([Errno 24] Too many)"),
            (RuntimeError("no\nwords"), "failed to look at the gang (RuntimeError: no words)"),
        ):
            fake.error = error
            [node] = wait_for(
                lambda said=said: (s := several.observe(handle)) and said in s[0].words and s,
                20,
                said,
            )
            assert node.running
            with pytest.raises(EngineError, match="trying again"):
                several.stop(handle, 0)
        fake.error = None
        wait_for(lambda: (s := several.observe(handle)) and not s[0].words, 20, "that it is seen again")
        assert several.stop(handle, 0) == [NodeStatus(NodePhase.RUNNING, "here")]
    looks = [record for record in caplog.records if "look at the gang" in record.getMessage()]
    assert len(looks) == 2 and [bool(record.exc_info) for record in looks] == [False, True], caplog.text


def test_without_descriptors_no_gang_counts_as_dead_and_no_half_gang_is_started(tmp_path: Path) -> None:
    Store(tmp_path / "store").open()
    engine = LocalEngine(tmp_path, cpus=4)
    with engines(engine) as several:
        handle = launched(several, gang(tmp_path, "running", "localhost"))
        wait_for(lambda: several.observe(handle), 10, "the first picture")
        taken = []
        before = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(map(int, os.listdir("/proc/self/fd"))) + 20, before[1]))
        try:
            with contextlib.suppress(OSError):
                while True:
                    taken.append(os.open("/dev/null", os.O_RDONLY))
            with pytest.raises(OSError, match="Too many open files"):
                engine.observe(read_handle(handle))
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
            [node] = wait_for(lambda: (s := several.observe(handle)) and not s[0].words and s, 60, "that it is seen")
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

        def shows(job: str, *wanted: str) -> dict[str, Any]:
            def there() -> dict[str, Any] | None:
                found: dict[str, Any] = client.get(f"/api/jobs/{job}")
                return found if (found["status"], found["statusReason"])[: len(wanted)] == wanted else None

            found: dict[str, Any] = wait_for(there, 30, f"{job} {wanted}")
            return found

        said = "the local engine can't start the gang now ([Errno 11] Resource temporarily unavailable); trying again"
        job, other = (submit_gang(client, "print('here')", attempts=3) for _ in range(2))
        shows(job, "STARTING", said)
        shows(other, "STARTING", said)
        client.batch("TerminateJob", jobId=other, reason="enough")
        shows(other, "FAILED", "enough")
        number[:] = [errno.E2BIG]
        assert len(shows(job, "FAILED", "can't start the gang: [Errno 7] Argument list too long")["attempts"]) == 1
        number[:] = [errno.EMFILE]
        job = submit_gang(client, "print('here')", attempts=3)
        shows(job, "STARTING")
        number.clear()
        assert len(shows(job, "SUCCEEDED")["attempts"]) == 1
    assert sum(said in record.getMessage() for record in caplog.records) == 2, "once for each job"
