"""Jobs as a client sees them."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from orchestrator.client import Client
from orchestrator.server import Server
from tests.conftest import REPOSITORY, Serving, call_muster
from tests.support.waiting import wait_for

FOREVER = "import time; time.sleep(600)"


@contextlib.contextmanager
def serving(home: Path, **options: Any) -> Iterator[Client]:
    """A client of a controller in this process, of two CPUs by default."""
    server = Server(home, **{"cpus": 2, **options})
    server.start()
    try:
        with Client(server.url) as client:
            yield client
    finally:
        server.close()


def jobs_of(client: Client, queue: str = "default") -> list[dict[str, Any]]:
    """All jobs of a queue, whatever their state."""
    filters = [{"name": "AFTER_CREATED_AT", "values": ["0"]}]
    found: list[dict[str, Any]] = client.batch("ListJobs", jobQueue=queue, filters=filters)["jobSummaryList"]
    return found


def detail(client: Client, job_id: str) -> dict[str, Any]:
    found: dict[str, Any] = client.get(f"/api/jobs/{job_id}")
    return found


def await_status(client: Client, job_id: str, *requested: str) -> dict[str, Any]:
    def existing() -> dict[str, Any] | None:
        found = detail(client, job_id)
        return found if found["status"] in requested else None

    found: dict[str, Any] = wait_for(existing, 30, f"job {job_id} {requested}")
    return found


def jobs_and_runs(server: Serving) -> set[str]:
    """Ids of all jobs of the queue ``default``, and names in the store's directory of runs."""
    return {each["jobId"] for each in jobs_of(server.client)} | set(os.listdir(server.home / "store" / "runs"))


def nothing_changed(server: Serving, before: set[str]) -> bool:
    """Whether jobs and runs are as :func:`jobs_and_runs` found them, but for hidden copies of earlier commands, which go by themselves."""
    now = jobs_and_runs(server)
    return {each for each in before if not each.startswith(".")} <= now <= before


def refusal(server: Serving, *arguments: str, code: int = 2) -> str:
    """The one line with which a command is refused; neither a job nor a run nor a hidden copy is left."""

    before = jobs_and_runs(server)
    done = server.muster(*arguments)
    assert done.returncode == code and len(done.stderr.splitlines()) == 1, (done.returncode, done.stdout, done.stderr)
    wait_for(lambda: nothing_changed(server, before), 10, "nothing that is left")  # a copy is deleted after the answer
    return done.stderr


def refused(arguments: list[str], home: Path, code: int, *parts: str, **env: str) -> None:
    """The command exits with ``code`` and one line on stderr that holds all ``parts``."""
    done = call_muster(*arguments, home=home, cwd=REPOSITORY, **env)
    assert done.returncode == code, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    assert len(lines) == 1 and "Traceback" not in done.stderr, done.stderr
    for part in parts:
        assert part in lines[0], f"{part!r} is not in: {lines[0]}"
