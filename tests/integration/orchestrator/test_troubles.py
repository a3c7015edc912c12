"""What goes wrong under a running controller: damaged rows, starts that fail, a database that goes away. The rest goes on."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import socket
import sqlite3
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from orchestrator.client import Client
from orchestrator.control import disk
from orchestrator.domain.errors import ApiError, ServerError
from orchestrator.engines.local.engine import LocalEngine
from orchestrator.home import HomeLock
from orchestrator.server import Server
from tests.conftest import submit_gang, wait_for
from tests.support.orchestrator.jobs import FOREVER, await_status, detail, serving
from tests.support.processes import end_all, processes_of, processes_of_job


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Path]:
    """A home directory; whatever still runs for it at the end is killed."""
    yield tmp_path
    end_all(tmp_path)


def change(home: Path, statement: str, *values: str) -> list[Any]:
    """Run a statement on the database behind the controller's back."""
    with contextlib.closing(sqlite3.connect(home / "muster.db", timeout=30)) as database, database:
        return list(database.execute(statement, values))


def test_a_damaged_row_is_named_once_and_stops_no_other_job(home: Path, caplog: pytest.LogCaptureFixture) -> None:
    with serving(home) as client:
        running = submit_gang(client, FOREVER, name="running")
        await_status(client, running, "RUNNING")
        waiting = submit_gang(client, "pass", name="waiting", cpus="64")
        wait_for(lambda: "each node needs 64 CPUs" in detail(client, waiting)["statusReason"], 30, "that it waits")
    [[kept]] = change(home, "SELECT node_properties FROM jobs WHERE id = ?", running)
    change(home, "UPDATE jobs SET node_properties = '{broken' WHERE id IN (?, ?)", running, waiting)
    output = "the controller failed on this job (ValueError: nodeProperties are empty: the job's row in the database is damaged)"
    with serving(home) as client:
        reason = wait_for(lambda: output in (r := status_reason(home, running)) and r, 30, "the reason")
        assert reason == f"{output}; trying again"
        await_status(client, submit_gang(client, "print('here')"), "SUCCEEDED")
        wait_for(lambda: output in status_reason(home, waiting), 30, "the reason")
        change(home, "UPDATE jobs SET node_properties = ? WHERE id = ?", kept, running)
        client.batch("TerminateJob", jobId=running, reason="enough")
        assert await_status(client, running, "FAILED")["statusReason"] == "enough"
        client.batch("TerminateJob", jobId=waiting, reason="never mind")
        wait_for(lambda: status_reason(home, waiting) == "never mind", 30, "its end")
    failed = [record.getMessage().partition(":")[0] for record in caplog.records if record.exc_info]
    assert sorted(failed) == sorted([f"job {running}", f"job {waiting}"])


@pytest.fixture(scope="module")
def ended(inside: Server) -> tuple[str, str]:
    """Two jobs of the queue ``default`` that are over."""
    with Client(inside.url) as client:
        jobs = submit_gang(client, "print('here')", name="broken"), submit_gang(client, "print('here')", name="whole")
        for each in jobs:
            await_status(client, each, "SUCCEEDED")
    return jobs


@pytest.mark.parametrize("value", ["{broken", "null", "[]"])
def test_a_damaged_row_harms_no_other(inside: Server, http: httpx.Client, ended: tuple[str, str], value: str) -> None:
    broken, whole = ended
    home = Path(str(inside.controller.database.volume))
    [[kept]] = change(home, "SELECT node_properties FROM jobs WHERE id = ?", broken)
    requested = {"jobQueue": "default", "filters": [{"name": "AFTER_CREATED_AT", "values": ["0"]}]}
    run = http.get(f"/api/jobs/{broken}").json()["run"]
    before = http.post("/v1/describejobs", json={"jobs": [whole]}).json()["jobs"]
    change(home, "UPDATE jobs SET node_properties = ? WHERE id = ?", value, broken)
    try:
        answer = http.post("/v1/listjobs", json=requested)
        assert answer.status_code == 200, answer.text
        listed = {each["jobId"]: each for each in answer.json()["jobSummaryList"]}
        described = http.post("/v1/describejobs", json={"jobs": [broken, f"{broken}#0", whole]}).json()["jobs"]
        assert described[2:] == before and "container" in listed[whole]
        streams = {"X-Amz-Target": "Logs_20140328.DescribeLogStreams"}
        named = http.post("/", json={"logGroupName": "/aws/batch/job"}, headers=streams)
        assert named.status_code == 200 and f"whole/{whole}/1/node-0" in named.text, named.text
        for each in (listed[broken], *described[:2]):
            assert (each["jobName"], each["status"]) == ("broken", "SUCCEEDED")
            assert each["statusReason"].endswith("; the job's row in the database is damaged")
        pages = [http.get(f"/api/jobs/{broken}")]
        pages.append(http.post("/v1/listjobs", json={"multiNodeJobId": broken, "jobStatus": "SUCCEEDED"}))
        pages.append(http.get(f"/api/jobs/{broken}/logs"))
        for page in pages:
            output = f"job broken ({broken[:8]}): the job's row in the database is damaged; submit the job again"
            assert (page.status_code, page.json()["message"]) == (409, output)
        assert all(http.get(f"/api/{path}").status_code == 200 for path in (f"jobs/{whole}", "runs", f"runs/{run}"))
        change(home, "UPDATE jobs SET node_properties = ? WHERE id = ?", kept, broken)
        [[definition]] = change(home, "SELECT definition FROM jobs WHERE id = ?", broken)
        change(home, "UPDATE jobs SET definition = 'gone:9' WHERE id = ?", broken)
        first, second = http.post("/v1/describejobs", json={"jobs": [broken, whole]}).json()["jobs"]
        change(home, "UPDATE jobs SET definition = ? WHERE id = ?", definition, broken)
        assert first["statusReason"].endswith("; the job's row in the database is damaged")
        assert second["jobId"] == whole and "damaged" not in second.get("statusReason", "")
    finally:
        change(home, "UPDATE jobs SET node_properties = ? WHERE id = ?", kept, broken)


def status_reason(home: Path, job_id: str) -> str:
    [[reason]] = change(home, "SELECT status_reason FROM jobs WHERE id = ?", job_id)
    return str(reason)


def test_a_start_that_fails_stops_no_other_and_is_tried_again(home: Path, caplog: pytest.LogCaptureFixture) -> None:
    with serving(home) as client:
        blocked = home / "store" / "runs" / "blocked"
        blocked.parent.mkdir(exist_ok=True)
        blocked.write_text("a file where the run's directory belongs")
        first = submit_gang(client, "print('here')", env={"MUSTER_RUN": "blocked"})
        output = f"store {home / 'store'}: can't read run blocked now ([Errno 20] Not a directory"
        wait_for(lambda: status_reason(home, first).startswith(output), 30, "the reason")
        await_status(client, submit_gang(client, "print('here')", cpus="2"), "SUCCEEDED")
        blocked.unlink()
        done = await_status(client, first, "SUCCEEDED", "FAILED")
        assert (done["status"], len(done["attempts"])) == ("SUCCEEDED", 1), done["statusReason"]
    [reported] = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
    assert reported.startswith(f"job {first}: {output}")


@pytest.mark.parametrize("how", ["moved away", "replaced"])
def test_without_its_database_a_controller_accepts_nothing(
    home: Path, caplog: pytest.LogCaptureFixture, how: str
) -> None:
    database, absent = home / "muster.db", home / "away.db"
    with serving(home) as client:
        url = str(client._http.base_url)
        running = submit_gang(client, FOREVER)
        await_status(client, running, "RUNNING")
        before = processes_of(home)
        database.rename(absent)
        output = f"database {database} was deleted while the controller runs; put that file back"
        if how == "replaced":
            shutil.copy(absent, database)
            output = (
                f"database {database} was replaced by another file while the controller runs; put the former one back, "
            )
            output += "or restart the controller to use this one"
        health = wait_for(lambda: (h := httpx.get(f"{url}/healthz")).is_error and h, 10, "that the loop has noticed")
        assert (health.status_code, health.json()["message"]) == (503, output)
        with pytest.raises(ApiError, match=re.escape(output)):
            Client.connect(url, serving=True)
        for ask in (lambda: submit_gang(client, "pass"), lambda: detail(client, running)):
            with pytest.raises(ApiError) as refused:
                ask()
            assert (refused.value.status, str(refused.value).count(output)) == (503, 1), refused.value
        wait_for(lambda: any(output in record.getMessage() for record in caplog.records), 30, "a line in the log")
        waited: list[str] = []
        follower = Client(url)
        follower.notify = waited.append
        following = threading.Thread(target=lambda: list(follower.logs(running, follow=True)), daemon=True)
        following.start()
        wait_for(lambda: waited, 30, "a follower waits")
        assert how == "replaced" or not database.exists(), "no empty file was made in its place"
        assert set(before) <= set(processes_of(home))
        absent.rename(database)
        wait_for(lambda: httpx.get(f"{url}/healthz").status_code == 200, 30, "that it serves again")
        await_status(client, submit_gang(client, "print('here')"), "SUCCEEDED")
        assert detail(client, running)["status"] == "RUNNING" and set(before) <= set(processes_of(home))
        assert following.is_alive()
        client.batch("TerminateJob", jobId=running, reason="enough")
        await_status(client, running, "FAILED")
        following.join(60)
        assert not following.is_alive()
    assert sum(output in record.getMessage() for record in caplog.records) == 1


def test_gangs_of_a_deleted_database_are_named_at_the_next_start(home: Path, caplog: pytest.LogCaptureFixture) -> None:
    with serving(home) as client:
        known = submit_gang(client, FOREVER)
        await_status(client, known, "RUNNING")
    for path in home.glob("muster.db*"):
        path.unlink()
    with serving(home) as client:
        [line] = [record.getMessage() for record in caplog.records if "has no such job" in record.getMessage()]
        assert line.startswith(f"orphaned gang {known}/1/1 runs on this machine") and "terminate it with: kill " in line
        other = submit_gang(client, FOREVER)
        await_status(client, other, "RUNNING")
    for pid in line.partition("terminate it with: kill ")[2].split():
        os.kill(int(pid), signal.SIGTERM)
    wait_for(lambda: not processes_of_job(known), 30, "its end")
    with serving(home) as client:
        client.batch("TerminateJob", jobId=other, reason="enough")
        await_status(client, other, "FAILED")
    assert sum("has no such job" in record.getMessage() for record in caplog.records) == 1


def test_a_server_that_can_t_be_made_leaves_nothing_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[str] = []
    close = LocalEngine.close

    def noted(engine: LocalEngine) -> None:
        closed.append(engine.name)
        close(engine)

    monkeypatch.setattr(LocalEngine, "close", noted)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with pytest.raises(ServerError, match="there is no engine 'nosuch'"):
        Server(tmp_path, port=port, engines=("local", "nosuch"))
    assert closed == ["local"]
    before = len(os.listdir("/proc/self/fd"))
    (tmp_path / "muster.db").write_bytes(b"no database at all" * 1000)
    with pytest.raises(ServerError, match="file is not a database"):
        Server(tmp_path, port=port)
    assert len(os.listdir("/proc/self/fd")) == before
    HomeLock(tmp_path).release()
    with socket.create_server(("127.0.0.1", port)):
        pass
    (tmp_path / "muster.db").unlink()
    Server(tmp_path, port=port).close()  # never started
    assert closed == ["local"] * 3


def test_a_hanging_volume_is_named_and_delays_no_request(inside: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    look, answers = os.statvfs, threading.Event()

    def hanging(path: Any) -> os.statvfs_result:
        if path == inside.store.path:
            answers.wait()
        return look(path)

    monkeypatch.setattr(disk, "_PATIENCE", 0.2)
    monkeypatch.setattr(os, "statvfs", hanging)
    try:
        with Client(inside.url) as client:
            wait_for(inside.controller.access.disk.shortage, 30, "that the volume is missed")
            waiting = submit_gang(client, "print('at last')")
            [listed] = client.batch("ListJobs", jobQueue="default", jobStatus="RUNNABLE")["jobSummaryList"]
            assert listed["jobId"] == waiting
            missing = f"the volume of the store ({inside.store.path}) has not answered since 20"
            wait_for(lambda: missing in detail(client, waiting)["statusReason"], 30, "the reason why it waits")
            answers.set()
            await_status(client, waiting, "SUCCEEDED")
    finally:
        answers.set()
