"""Commands while the controller or its store is away: what needs neither goes on, and who follows a job waits."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.conftest import MUSTER, Serving, submit_gang
from tests.support.orchestrator.jobs import FOREVER, await_status, jobs_of
from tests.support.waiting import wait_for

SLEEPS = "name: sleeper\nresources: {cpus: 1, memory: 64MiB}\ncommand: [sleep, '600']\n"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Serving]:
    with Serving(tmp_path / "home", "--cpus", "2") as serving:
        yield serving


@pytest.fixture
def follower(server: Serving, tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A ``muster run`` that follows its job; what it complains of is in the file ``errors``."""
    (tmp_path / "job.yaml").write_text(SLEEPS)
    with open(tmp_path / "errors", "wb") as errors:
        env = {**os.environ, "MUSTER_HOME": str(server.home)}
        command = [MUSTER, "run", str(tmp_path / "job.yaml")]
        process = subprocess.Popen(command, env=env, stdout=subprocess.DEVNULL, stderr=errors)
    yield process
    process.kill()
    process.wait()


def running(server: Serving) -> str:
    [job] = wait_for(lambda: jobs_of(server.client), 60, "the job")
    await_status(server.client, job["jobId"], "RUNNING")
    return str(job["jobId"])


def test_a_follower_waits_for_the_service_and_does_not_take_its_place(
    server: Serving, follower: subprocess.Popen[bytes], tmp_path: Path
) -> None:
    job = running(server)
    server.kill()
    complaint = f"no controller answers at {server.url}; waiting up to 120 s for one"
    wait_for(lambda: complaint in (tmp_path / "errors").read_text(), 60, "that it waits")
    server.start()
    server.client.batch("TerminateJob", jobId=job, reason="enough")
    assert follower.wait(120) == 1
    lines = (tmp_path / "errors").read_text().splitlines()
    assert [line for line in lines if "STARTING" not in line] == [complaint]


def test_without_the_store_jobs_are_listed_shown_and_stopped_and_who_follows_one_waits(
    server: Serving, follower: subprocess.Popen[bytes], tmp_path: Path
) -> None:
    job, store = running(server), server.home / "store"
    other = submit_gang(server.client, FOREVER)
    await_status(server.client, other, "RUNNING")
    store.rename(tmp_path / "unmounted")
    try:
        wait_for(lambda: httpx.get(f"{server.url}/healthz").status_code == 503, 60, "that it is seen")
        for command in (["list"], ["show", job], ["queues"], ["stop", other, "--no-wait"]):
            done = server.muster(*command)
            assert done.returncode == 0, (command, done.stderr)
        why = f"there is no store at {store}; see whether its volume is mounted"
        assert why in server.muster("show", job).stdout
        page = httpx.get(f"{server.url}/jobs/{job}", timeout=60)
        assert page.status_code == 200 and "sleeper" in page.text and "there is no store at" in page.text
        assert follower.poll() is None
    finally:
        (tmp_path / "unmounted").rename(store)
    await_status(server.client, other, "FAILED")
    server.client.batch("TerminateJob", jobId=job, reason="enough")
    assert follower.wait(120) == 1


def test_a_start_that_is_refused_leaves_no_directory_where_the_volume_belongs(server: Serving, tmp_path: Path) -> None:
    server.kill()
    store = server.home / "store"
    store.rename(tmp_path / "unmounted")
    done = server.muster("serve", "--port", "0")
    assert done.returncode == 1 and "there is no store there" in done.stderr and not store.exists()
    (tmp_path / "unmounted").rename(store)
    server.start()
