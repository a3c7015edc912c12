"""Lists of jobs at 100,000: ``python -m benchmarks.scale_lists [--jobs 125000] [--loaded-anyway]`` prints a table for ``benchmarks/scale.md``.

The database has the jobs of job_specs/cartpole.yaml in five queues: four in five wait, the others have ended. Requests reach the
server's application without a socket, one after the other; the controller has loaded its work queue and makes no pass. Nothing is kept
between two looks, as a page keeps it for half a second. Time and processor time are those of the whole process.
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import gc
import json
import resource
import tempfile
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from unittest import mock
from urllib.parse import urlencode
from uuid import UUID

from sqlalchemy import insert

from benchmarks.load import Watch, add_option, machine, reported
from orchestrator.console import jobs as jobs_page
from orchestrator.console import live
from orchestrator.console.live import Recent
from orchestrator.domain.job import Status
from orchestrator.persistence.batch_models import Attempt, Job, JobDefinition, JobQueue, Node
from orchestrator.persistence.session import Database
from orchestrator.server import Server
from orchestrator.services.arns import definition_arn
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.file import load
from tests.support.console.fixtures import secret_of
from tests.support.definitions import submission_of
from tests.support.keys import HomeKeys

REQUESTS = 300
QUEUES = ("default", "lab", "night", "robots", "students")
STATES = (*8 * (Status.RUNNABLE,), Status.SUCCEEDED, Status.FAILED)
DEFINITION = definition_arn("bench", 1)
AT_ONCE = 2000
Answer = tuple[int, bytes]


def fill(home: Path, count: int) -> None:
    """The database of a home directory, with so many jobs."""
    spec = load("job_specs/cartpole.yaml", [])
    definition = compile_definition(spec, str(home))
    request, properties = submission_of(spec, DEFINITION), definition["nodeProperties"]
    database = Database.at(home)
    with database.session() as session:
        session.add(JobDefinition(name="bench", revision=1, document=definition))
        session.add_all(JobQueue(name=name, priority=1, compute_environments=["local"]) for name in QUEUES[1:])
    for start in range(0, count, AT_ONCE):
        numbers = range(start, min(count, start + AT_ONCE))
        rows = [_row(number, request, properties) for number in numbers]
        ended = [row["id"] for row in rows if row["stopped_at"] is not None]
        with database.session() as session:
            session.execute(insert(Job), rows)
            session.execute(insert(Attempt), [{"job_id": each, "number": 1, "epoch": 1} for each in ended])
            nodes = [{"job_id": each, "attempt": 1, "host": "localhost", "cpus": 1.0, "memory": 512} for each in ended]
            session.execute(insert(Node), [{**each, "index": index} for each in nodes for index in range(2)])
    database.close()


def identity(number: int) -> str:
    """The id of a job."""
    return str(UUID(int=number * 0x9E3779B97F4A7C15F39CC0605CEDC835 % 2**128))


def _row(number: int, request: Mapping[str, Any], properties: Mapping[str, Any]) -> dict[str, Any]:
    status, name = STATES[number // len(QUEUES) % len(STATES)], f"ant-{number % 1000}"
    is_over, moment = status != Status.RUNNABLE, 1_750_000_000_000 + 1000 * number
    return {
        "id": identity(number),
        "name": name,
        "queue": QUEUES[number % len(QUEUES)],
        "owner": f"key person-{number % 12}",
        "definition": DEFINITION,
        "request": request,
        "own_node_properties": properties,
        "run": f"{name}-{number}",
        "status": status,
        "status_reason": "waiting for the scheduler" if not is_over else None,
        "created_at": moment,
        "queued_since": moment,
        "first_epoch": 1 if is_over else None,
        "started_at": moment if is_over else None,
        "stopped_at": moment + 900 if is_over else None,
    }


class Client:
    """Calls the application as the server does."""

    def __init__(self, server: Server, secret: str) -> None:
        self._app: Any = server.app
        self._authorization = f"Bearer {secret}".encode()

    async def get(self, path: str, *, is_enough: bytes = b"", method: str = "GET", body: bytes = b"") -> Answer:
        """The answer; of a stream what came up to ``is_enough``."""
        done, found, status = asyncio.Event(), bytearray(), 0
        address, _, query = path.partition("?")
        accept = b"text/html" if address == "/" else b"application/json"
        sent = iter([{"type": "http.request", "body": body, "more_body": False}])

        async def receive() -> Mapping[str, Any]:
            if (message := next(sent, None)) is not None:
                return message
            await done.wait()
            return {"type": "http.disconnect"}

        async def send(message: Mapping[str, Any]) -> None:
            nonlocal status
            status = message.get("status", status)
            found.extend(message.get("body", b""))
            if is_enough and is_enough in found:
                done.set()

        scope = {
            "type": "http",
            "asgi": {"version": "3.0"},
            "http_version": "1.1",
            "method": method,
            "scheme": "http",
            "path": address,
            "raw_path": address.encode(),
            "query_string": query.encode(),
            "root_path": "",
            "headers": [
                (b"host", b"127.0.0.1"),
                (b"accept", accept),
                (b"content-type", b"application/json"),
                (b"authorization", self._authorization),
            ],
            "client": ("127.0.0.1", 50000),
            "server": ("127.0.0.1", 8000),
        }
        await self._app(scope, receive, send)
        return status, bytes(found)


async def measure(name: str, call: Callable[[], Awaitable[Answer]], requests: int) -> str:
    """A row of the table."""
    walls, used = [], []
    for number in range(requests + 10):
        began, cpu = time.perf_counter(), time.process_time()
        status, body = await call()
        if number >= 10:  # the first ones fill caches
            walls.append(1000 * (time.perf_counter() - began))
            used.append(1000 * (time.process_time() - cpu))
        if status != 200:
            raise SystemExit(f"{name}: {status} {body[:300].decode()}")
    return (
        f"| {name} | "
        + " | ".join(f"{at(values, share):.1f}" for values in (walls, used) for share in (0.5, 0.99))
        + " |"
    )


def at(values: list[float], share: float) -> float:
    """The value below which this share of them is."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


def rows(server: Server, secrets: Mapping[str, str]) -> Iterator[tuple[str, Callable[[], Awaitable[Answer]]]]:
    """What is measured, by name."""
    admin, lab = (Client(server, secrets[each]) for each in ("admin", "lab"))

    def get(path: str, client: Client = admin, **query: Any) -> Callable[[], Awaitable[Answer]]:
        return lambda: client.get(f"{path}?{urlencode(query, doseq=True)}")

    def batch(operation: str, **request: Any) -> Callable[[], Awaitable[Answer]]:
        return lambda: admin.get(f"/v1/{operation}", method="POST", body=json.dumps(request).encode())

    middle = "1750000050000-0"
    yield "`GET /api/jobs`", get("/api/jobs")
    yield "the same from the middle on", get("/api/jobs", after=middle)
    yield "… before the middle", get("/api/jobs", before=middle)
    yield "… in the state SUCCEEDED", get("/api/jobs", status="SUCCEEDED")
    yield "… of one queue", get("/api/jobs", queue="lab")
    yield "… by a key of two queues, in two states", get("/api/jobs", lab, status=["FAILED", "RUNNABLE"])
    yield "… `search=` that finds 1,375", get("/api/jobs", search="ant-77")
    yield "… `search=` that finds nothing", get("/api/jobs", search="no such name")
    yield "console's first page", get("/")
    yield "console's waiting jobs", get("/", state="waiting")
    yield "console's first page, by a key of two queues", get("/", lab)
    yield "one look of its stream", lambda: admin.get("/jobs/stream", is_enough=b"event: rows")
    yield "one look at a search", lambda: admin.get("/jobs/stream?search=ant-77", is_enough=b"event: rows")
    by_name = [{"name": "JOB_NAME", "values": ["ant-77*"]}]
    waiting = {"jobQueue": "lab", "jobStatus": "RUNNABLE", "maxResults": 100}
    token = base64.b64encode(json.dumps([1_750_000_020_000, "0"]).encode()).decode()
    yield "ListJobs: a queue's 100 newest that wait", batch("listjobs", **waiting)
    yield "… 100 from a token on", batch("listjobs", **waiting, nextToken=token)
    yield "… 100 by the beginning of their names", batch("listjobs", jobQueue="lab", filters=by_name)
    yield "DescribeJobs: 100", batch("describejobs", jobs=[identity(number) for number in range(100)])


async def table(server: Server, secrets: Mapping[str, str], requests: int, only: str) -> list[str]:
    return [await measure(name, call, requests) for name, call in rows(server, secrets) if only in name]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=125_000)
    parser.add_argument("--requests", type=int, default=REQUESTS, help="of each kind")
    parser.add_argument("--only", default="", help="the rows whose name has this text")
    add_option(parser)
    options = parser.parse_args()
    watch = Watch(options.loaded_anyway)
    is_kept = (mock.patch.object(jobs_page, "_recent", Recent(0.0)), mock.patch.object(live, "_REST", 0.0))
    with tempfile.TemporaryDirectory() as folder, is_kept[0], is_kept[1]:
        home = Path(folder)
        fill(home, options.jobs)
        keys = HomeKeys(home)
        secrets = {key.name: secret_of(key) for key in (keys.create("admin"), keys.create("lab", ("lab", "night")))}
        began, used = time.monotonic(), time.process_time()
        server = Server(home, cpus=1, rate_limit=0, adopt_store=True)
        gc.collect()
        gc.freeze()  # as the server does when it starts
        print(f"loaded in {time.monotonic() - began:.1f} s, {time.process_time() - used:.1f} s of CPU", flush=True)
        try:
            found = asyncio.run(table(server, secrets, options.requests, options.only))
        finally:
            server.close()
        size = sum(each.stat().st_size for each in home.glob("muster.db*")) / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{machine()}. {reported([watch.check('during the measurement')])}")
    print(f"Database {size:.0f} MiB; peak memory of the process {peak:.0f} MiB.\n")
    print("| request | wall p50 [ms] | p99 | CPU p50 [ms] | p99 |\n|---|---|---|---|---|")
    print("\n".join(found))


if __name__ == "__main__":
    main()
