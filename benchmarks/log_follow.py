"""Speed of reading logs: ``python -m benchmarks.log_follow [lines]``.

A gang of three nodes prints the time, ``lines`` times in all; a follower reads it over plain HTTP, as boto3 would. A line's latency is
the time from just before ``print`` in the rank until the client has parsed it. Then many follow at once, idle and not, and long logs
are read from beginning to end. Work is that of the controller's process alone, in CPU seconds, so that a busy machine changes it little.
``python -m benchmarks.log_follow followers`` measures many followers alone. Prints Markdown tables.
"""

from __future__ import annotations

import asyncio
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import httpx
from botocore.eventstream import EventStreamBuffer

from orchestrator.client import Client

MUSTER = str(Path(sys.executable).parent / "muster")
GROUP = "/aws/batch/job"
NODES = 3
PAUSE = 0.02
"""Seconds between two lines of a node."""
POLL = 0.2
"""Seconds between two polls of a FilterLogEvents follower."""
MEASURED = 20.0
"""Seconds for which many followers are measured."""
MANY = 100_000
"""Number of lines of a job whose log is read whole."""
_FLOOD = "for i in range({lines}): print('line', i, 'of the log of a program that prints much')"
_LAST = "\nimport os, time\nif os.environ['NODE_RANK'] == '0': time.sleep(5)"
"""The main node waits for the others, since its end ends them."""
_TIMES = re.compile(rb'{"time": "([^"]+)"')
_SILENT = "import time; print('begun', flush=True); time.sleep(600)"
_STEADY = "import time\nfor i in range(100_000): print('line', i, 'of a program that prints now and then', flush=True); time.sleep(0.02)"
_SCRIPT = """
import time
time.sleep(3)
for _ in range({lines}): print("printed", time.time(), flush=True); time.sleep({pause})
print("last", flush=True)
time.sleep(3)
"""


def polled(url: str, **selection: Any) -> Iterator[str]:
    """Texts that a FilterLogEvents follower receives: pages, then from the newest time on, each event once."""
    query: dict[str, Any] = {"logGroupName": GROUP, **selection}
    seen: set[str] = set()
    client = httpx.Client(base_url=url, headers={"X-Amz-Target": "Logs_20140328.FilterLogEvents"})
    while True:
        page = client.post("/", json=query).raise_for_status().json()
        for event in page["events"]:
            if event["eventId"] not in seen:
                seen.add(event["eventId"])
                query["startTime"] = event["timestamp"]
                yield event["message"]
        query.pop("nextToken", None)
        if "nextToken" in page:
            query["nextToken"] = page["nextToken"]
        else:
            time.sleep(POLL)


def tailed(url: str, **selection: Any) -> Iterator[str]:
    """Texts that a StartLiveTail session sends."""
    headers, buffer = {"X-Amz-Target": "Logs_20140328.StartLiveTail"}, EventStreamBuffer()
    request = {"logGroupIdentifiers": [GROUP], **selection}
    with httpx.stream("POST", url, json=request, headers=headers, timeout=30) as answer:
        for chunk in answer.iter_raw():
            buffer.add_data(chunk)
            for message in buffer:
                for result in json.loads(message.payload).get("sessionResults", []):
                    yield result["message"]


def latencies(texts: Iterator[str], sources: int) -> list[float]:
    """Seconds from print to arrival, until the last line of every source has arrived."""
    found: list[float] = []
    for text in texts:
        arrived = time.time()
        if text.startswith("printed "):
            found.append(arrived - float(text.split()[1]))
        sources -= text == "last"
        if not sources:
            break
    return found


def follow(url: str, lines: int, texts: Callable[[str], Iterator[str]], sources: int) -> list[float]:
    """Latencies [s], sorted, of one gang and one follower that starts before the first line."""
    script = _SCRIPT.format(lines=-(-lines // NODES), pause=PAUSE)
    with Client(url) as client:
        job = submit(client, "ticker", script, NODES)
        while client.get(f"/api/jobs/{job}")["status"] != "RUNNING":
            time.sleep(0.1)
        found = latencies(texts(f"ticker/{job}/1/node-"), sources)
        finish(client, job)
    return sorted(found)


def submit(client: Client, name: str, script: str, nodes: int) -> str:
    container = {
        "image": "any",
        "command": [sys.executable, "-u" if name == "ticker" else "-P", "-c", script],
        "resourceRequirements": [{"type": "VCPU", "value": "0.1"}, {"type": "MEMORY", "value": "16"}],
    }
    ranges = [{"targetNodes": "0:", "container": container}]
    properties = {"numNodes": nodes, "mainNode": 0, "nodeRangeProperties": ranges}
    client.batch("RegisterJobDefinition", jobDefinitionName=name, type="multinode", nodeProperties=properties)
    return str(client.batch("SubmitJob", jobName=name, jobQueue="default", jobDefinition=name)["jobId"])


def finish(client: Client, job: str) -> None:
    while client.get(f"/api/jobs/{job}")["status"] not in ("SUCCEEDED", "FAILED"):
        time.sleep(0.1)


def rates(url: str, home: str, controller: int) -> list[tuple[str, int, float, float]]:
    """For each reader: number of lines, lines per second, and the controller's CPU seconds per line, best of three."""
    rows = []
    with Client(url) as client:
        for nodes in (1, NODES):
            job = submit(client, f"flood-{nodes}", _FLOOD.format(lines=MANY // nodes) + _LAST, nodes)
            finish(client, job)
            what = "one node" if nodes == 1 else f"{nodes} nodes merged"
            readers: dict[str, Callable[[], int]] = {
                "GET /api/jobs/X/logs": partial(received, url, job),
                "GET …?follow=true": partial(received, url, job, follow="true"),
                "orchestrator.client": partial(batched, client, job),
                "muster logs": partial(printed, url, home, job),
            }
            for name, read in readers.items():
                took, worked = [], []
                for _ in range(3):
                    began, before = time.monotonic(), cpu_seconds(controller)
                    count = read()
                    took.append(time.monotonic() - began)
                    worked.append(cpu_seconds(controller) - before)
                rows.append((f"{name}, {what}", count, count / min(took), min(worked) / count))
    return rows


def batched(client: Client, job: str) -> int:
    return sum(map(len, client.log_batches(job)))


def followers(url: str, home: str, controller: int) -> list[tuple[str, float, float, float, list[float]]]:
    """For each kind of crowd: its size and work, the share of a core [%], MiB of memory added, lines a second that all
    received, and their ages [s].

    A key has at most 100 followers, so that a larger crowd has several keys.
    """
    environment = {**os.environ, "MUSTER_HOME": home}
    names = ["first", "second", "third"]
    made = [
        subprocess.run([MUSTER, "keys", "create", name, "--json"], env=environment, stdout=subprocess.PIPE, check=True)
        for name in names
    ]
    keys = [json.loads(each.stdout) for each in made]
    tokens = [f"{key['accessKeyId']}:{key['secretAccessKey']}" for key in keys]
    rows = []
    try:
        with Client(url, tokens[0]) as client:
            for crowd, count, script in (("idle", 300, _SILENT), ("at 50 lines/s", 100, _STEADY)):
                jobs = [submit(client, "ticker", script, 1) for _ in tokens[: count // 100]]
                for job in jobs:
                    while not any(client.logs(job)):
                        time.sleep(0.1)
                time.sleep(5)  # until the start of the job is over
                before = resident(controller), busy(controller, asyncio.sleep(MEASURED))
                reading = crowd_of(
                    url,
                    [(job, token) for job, token in zip(jobs, tokens, strict=False) for _ in range(100)],
                    controller,
                )
                work, memory, lines, ages = asyncio.run(reading)
                share = 100 * (work - before[1]) / MEASURED
                rows.append(
                    (f"{count} followers, {crowd}", share, (memory - before[0]) / 2**20, lines / MEASURED, ages)
                )
                for job in jobs:
                    client.batch("TerminateJob", jobId=job, reason="measured")
    finally:
        for name in names:
            subprocess.run([MUSTER, "keys", "delete", name], env=environment, stdout=subprocess.DEVNULL, check=True)
    return rows


def busy(controller: int, meanwhile: Any) -> float:
    """CPU seconds of the controller while ``meanwhile`` runs."""
    before = cpu_seconds(controller)
    asyncio.run(meanwhile)
    return cpu_seconds(controller) - before


async def crowd_of(url: str, follows: list[tuple[str, str]], controller: int) -> tuple[float, float, int, list[float]]:
    """CPU seconds of the controller, its memory [bytes], and the lines of all followers and their ages [s], once all have come."""
    host, _, port = url.removeprefix("http://").partition(":")
    lines, ages = 0, list[float]()

    async def one(job: str, token: str) -> None:
        nonlocal lines
        reader, writer = await asyncio.open_connection(host, int(port))
        writer.write(
            f"GET /api/jobs/{job}/logs?follow=true HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {token}\r\n\r\n".encode()
        )
        while chunk := await reader.read(1 << 16):
            lines += chunk.count(b'{"time"')
            for stamp in _TIMES.findall(chunk):
                ages.append(time.time() - datetime.fromisoformat(stamp.decode()).timestamp())

    tasks = [asyncio.ensure_future(one(*each)) for each in follows]
    while lines < len(tasks):
        await asyncio.sleep(0.1)
        for task in filter(asyncio.Task.done, tasks):
            raise SystemExit(f"a follower has left: {task.exception() or 'its stream ended'}")
    await asyncio.sleep(5)
    before, seen = cpu_seconds(controller), lines
    ages.clear()
    await asyncio.sleep(MEASURED)
    work, memory, count = cpu_seconds(controller) - before, resident(controller), lines - seen
    for task in tasks:
        task.cancel()
    return work, memory, count, sorted(ages)


def resident(pid: int) -> float:
    """Bytes."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def cpu_seconds(pid: int) -> float:
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def received(url: str, job: str, **query: str) -> int:
    """Lines received by a client that discards them."""
    with httpx.stream("GET", f"{url}/api/jobs/{job}/logs", params=query, timeout=120) as answer:
        return sum(chunk.count(b"\n") for chunk in answer.iter_bytes())


def printed(url: str, home: str, job: str) -> int:
    """Lines that the command prints."""
    environment = {**os.environ, "MUSTER_HOME": home, "MUSTER_URL": url}
    done = subprocess.run([MUSTER, "logs", job], env=environment, stdout=subprocess.PIPE, check=True)
    return done.stdout.count(b"\n")


def measure(url: str, lines: int) -> list[tuple[str, list[float]]]:
    """All kinds of followers, one after the other."""
    return [
        (
            "StartLiveTail, all nodes",
            follow(url, lines, lambda prefix: tailed(url, logStreamNamePrefixes=[prefix]), NODES),
        ),
        ("StartLiveTail, one node", follow(url, lines, lambda prefix: tailed(url, logStreamNames=[f"{prefix}0"]), 1)),
        (
            "FilterLogEvents every 0.2 s, all nodes",
            follow(url, lines, lambda prefix: polled(url, logStreamNamePrefix=prefix), NODES),
        ),
        (
            "FilterLogEvents every 0.2 s, one node",
            follow(url, lines, lambda prefix: polled(url, logStreamNames=[f"{prefix}0"]), 1),
        ),
    ]


def main() -> None:
    only = sys.argv[1:] == ["followers"]
    lines = int(sys.argv[1]) if len(sys.argv) > 1 and not only else 900
    with tempfile.TemporaryDirectory() as home:
        server = subprocess.Popen(
            [MUSTER, "serve", "--port", "0", "--cpus", "4"],
            env={**os.environ, "MUSTER_HOME": home},
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert server.stdout is not None
            url = server.stdout.readline().split()[2]
            rows, read = ([], []) if only else (measure(url, lines), rates(url, home, server.pid))
            many = followers(url, home, server.pid)
        finally:
            server.terminate()
            server.wait()
    print(f"{os.cpu_count()} cores ({platform.machine()}), load {os.getloadavg()[0]:.1f}, {NODES} nodes")
    print()
    print("| many at once | controller's CPU, share of a core | memory | lines/s received | p50 | p99 |")
    print("|---|---|---|---|---|---|")
    for name, share, memory, rate, ages in many:
        late = f"{_at(ages, 0.5)} | {_at(ages, 0.99)}" if ages else "– | –"
        print(f"| {name} | {share:.1f} % | {memory:.0f} MiB | {rate:,.0f} | {late} |")
    if only:
        return
    print()
    print("| line printed → client | lines | p50 | p99 |")
    print("|---|---|---|---|")
    for name, values in rows:
        print(f"| {name} | {len(values)} | {_at(values, 0.5)} | {_at(values, 0.99)} |")
    print()
    print("| a whole log read by | lines | lines/s | controller's CPU for a line |")
    print("|---|---|---|---|")
    for name, count, rate, work in read:
        print(f"| {name} | {count} | {round(rate, -3):,.0f} | {work * 1e6:.1f} µs |")


def _at(values: list[float], part: float) -> str:
    """The value below which that part of sorted values [s] lies."""
    return f"{values[int(len(values) * part)] * 1000:.0f} ms"


if __name__ == "__main__":
    main()
