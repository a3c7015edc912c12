"""How long a printed line takes to a client of CloudWatch Logs: ``python -m benchmarks.log_follow [lines]``.

A gang of three nodes prints the time, ``lines`` times in all; a follower reads it with nothing but HTTP, as boto3 would. A line's
latency is from just before ``print`` in the rank to the client that has parsed it. Prints a Markdown table.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
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
_SCRIPT = """
import time
time.sleep(3)
for _ in range({lines}): print("printed", time.time(), flush=True); time.sleep({pause})
print("last", flush=True)
time.sleep(3)
"""


def polled(url: str, **selection: Any) -> Iterator[str]:
    """Texts as a FilterLogEvents follower gets them: pages, then from the newest time on, each event once."""
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
    """Texts as a StartLiveTail session sends them."""
    headers, buffer = {"X-Amz-Target": "Logs_20140328.StartLiveTail"}, EventStreamBuffer()
    request = {"logGroupIdentifiers": [GROUP], **selection}
    with httpx.stream("POST", url, json=request, headers=headers, timeout=30) as answer:
        for chunk in answer.iter_raw():
            buffer.add_data(chunk)
            for message in buffer:
                for result in json.loads(message.payload).get("sessionResults", []):
                    yield result["message"]


def latencies(texts: Iterator[str], sources: int) -> list[float]:
    """Seconds from print to arrival, until the last line of every source has come."""
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
    """One gang and one follower of it, which is there before the first line: latencies [s], sorted."""
    container = {
        "image": "any",
        "command": ["python", "-u", "-c", _SCRIPT.format(lines=-(-lines // NODES), pause=PAUSE)],
        "resourceRequirements": [{"type": "VCPU", "value": "0.1"}, {"type": "MEMORY", "value": "16"}],
    }
    ranges = [{"targetNodes": "0:", "container": container}]
    properties = {"numNodes": NODES, "mainNode": 0, "nodeRangeProperties": ranges}
    with Client(url) as client:
        client.batch("RegisterJobDefinition", jobDefinitionName="ticker", type="multinode", nodeProperties=properties)
        job = client.batch("SubmitJob", jobName="ticker", jobQueue="default", jobDefinition="ticker")["jobId"]
        while client.get(f"/api/jobs/{job}")["status"] != "RUNNING":
            time.sleep(0.1)
        found = latencies(texts(f"ticker/{job}/1/node-"), sources)
        while client.get(f"/api/jobs/{job}")["status"] == "RUNNING":
            time.sleep(0.1)
    return sorted(found)


def measure(url: str, lines: int) -> list[tuple[str, list[float]]]:
    """Every kind of follower, one after the other."""
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
    lines = int(sys.argv[1]) if len(sys.argv) > 1 else 900
    with tempfile.TemporaryDirectory() as home:
        server = subprocess.Popen(
            [MUSTER, "serve", "--port", "0", "--cpus", "4"],
            env={**os.environ, "MUSTER_HOME": home},
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert server.stdout is not None
            rows = measure(server.stdout.readline().split()[2], lines)
        finally:
            server.terminate()
            server.wait()
    print(f"{os.cpu_count()} cores ({platform.machine()}), load {os.getloadavg()[0]:.1f}, {NODES} nodes")
    print()
    print("| line printed → client | lines | p50 | p99 |")
    print("|---|---|---|---|")
    for name, values in rows:
        middle, high = values[len(values) // 2] * 1000, values[int(len(values) * 0.99)] * 1000
        print(f"| {name} | {len(values)} | {middle:.0f} ms | {high:.0f} ms |")


if __name__ == "__main__":
    main()
