"""SubmitJob and DescribeJobs side by side with moto's server, and the controller with 100,000 waiting jobs.

``make bench-api`` prints the table and writes it to ``benchmarks/api.md``. Jobs wait (the controller has no room for them), so that
nothing but the API is measured; moto's simple backend marks them as done.
"""

from __future__ import annotations

import os
import platform
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import boto3
import httpx
from botocore.config import Config

from tests.conftest import Serving

SAMPLES = 200
LEVELS = (0, 1_000, 10_000)
MOTO_SECONDS = 150
"""How long moto is given to reach the next number of jobs."""
CONTAINER = {"image": "x", "vcpus": 64, "memory": 128, "command": ["true"]}


def batch_of(url: str) -> Any:
    """A boto3 client."""
    config = Config(retries={"total_max_attempts": 1})
    keys = {"aws_access_key_id": "any", "aws_secret_access_key": "any"}
    return boto3.client("batch", endpoint_url=url, region_name="us-east-1", config=config, **keys)


@contextmanager
def moto() -> Iterator[str]:
    """moto's server with one queue and one definition."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    quiet = subprocess.DEVNULL
    process = subprocess.Popen([sys.executable, "-m", "moto.server", "-p", str(port)], stdout=quiet, stderr=quiet)
    url = f"http://127.0.0.1:{port}"
    try:
        until(lambda: httpx.post(f"{url}/moto-api/config", json={"batch": {"use_docker": False}}).is_success)
        keys = {"aws_access_key_id": "any", "aws_secret_access_key": "any", "region_name": "us-east-1"}
        role = boto3.client("iam", endpoint_url=url, **keys).create_role(
            RoleName="bench", AssumeRolePolicyDocument="{}"
        )
        environment = {"computeEnvironmentName": "bench", "type": "UNMANAGED", "serviceRole": role["Role"]["Arn"]}
        made = batch_of(url).create_compute_environment(**environment)["computeEnvironmentArn"]
        order = [{"order": 1, "computeEnvironment": made}]
        batch_of(url).create_job_queue(
            jobQueueName="default", state="ENABLED", priority=1, computeEnvironmentOrder=order
        )
        yield url
    finally:
        process.kill()


def until(condition: Callable[[], bool]) -> None:
    """Poll until it is true and raises nothing."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        try:
            if condition():
                return
        except httpx.HTTPError:
            pass
        time.sleep(0.1)
    raise SystemExit("a server did not come up within 60 s")


def timed(body: Callable[[], object], samples: int = SAMPLES) -> tuple[float, float, float]:
    """Calls per second, p50 [ms], p99 [ms]."""
    taken = []
    for _ in range(samples):
        started = time.perf_counter()
        body()
        taken.append(time.perf_counter() - started)
    cut = statistics.quantiles(taken, n=100)
    return samples / sum(taken), cut[49] * 1e3, cut[98] * 1e3


def submitter(url: str, http: httpx.Client) -> Callable[[], Any]:
    request = {"jobName": "bench", "jobQueue": "default", "jobDefinition": "bench"}
    return lambda: http.post(f"{url}/v1/submitjob", json=request).raise_for_status().json()


def compare(name: str, url: str, most: int = LEVELS[-1]) -> list[str]:
    """Rows of one server, at growing numbers of jobs that are there."""
    batch_of(url).register_job_definition(jobDefinitionName="bench", type="container", containerProperties=CONTAINER)
    rows, there, client = [], 0, batch_of(url)
    with httpx.Client(timeout=60) as http:
        submit = submitter(url, http)
        for level in LEVELS:
            deadline = time.monotonic() + MOTO_SECONDS
            while there < min(level, most) and time.monotonic() < deadline:
                job, there = submit(), there + 1
            raw = timed(submit)
            through = timed(lambda: client.submit_job(jobName="bench", jobQueue="default", jobDefinition="bench"))
            job = submit()["jobId"]
            shown = timed(lambda job=job: http.post(f"{url}/v1/describejobs", json={"jobs": [job]}).raise_for_status())
            for what, figures in (("SubmitJob", raw), ("SubmitJob, boto3", through), ("DescribeJobs", shown)):
                rows.append(
                    f"| {name} | {there:,} | {what} | {figures[0]:,.0f} | {figures[1]:.1f} | {figures[2]:.1f} |"
                )
                print(rows[-1], flush=True)
            there += 2 * SAMPLES + 1
            if level and there < level:
                rows.append(f"| {name} | {there:,} | *did not reach {level:,} jobs in {MOTO_SECONDS} s* | | | |")
                break
    return rows


def resident(pid: int) -> float:
    """Memory of a process [MB]."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def crowd(server: Serving) -> list[str]:
    """The controller with 100,000 waiting jobs: ten arrays of 10,000."""
    rows = [f"| memory before | {resident(server.process.pid):.0f} MB |"]
    batch = batch_of(server.url)
    started = time.perf_counter()
    array = {"arrayProperties": {"size": 10_000}}
    jobs = [
        batch.submit_job(jobName="crowd", jobQueue="default", jobDefinition="bench", **array)["jobId"]
        for _ in range(10)
    ]
    rows.append(f"| submitting 10 arrays of 10,000 | {time.perf_counter() - started:.1f} s |")
    last = f"{jobs[-1]}:9999"
    started = time.perf_counter()
    while "needs" not in batch.describe_jobs(jobs=[last])["jobs"][0].get("statusReason", ""):
        time.sleep(0.5)
    rows.append(f"| until the last of them says why it waits | {time.perf_counter() - started:.1f} s |")
    rows.append(f"| memory with 100,000 waiting | {resident(server.process.pid):.0f} MB |")
    used = cpu_seconds(server.process.pid)
    time.sleep(20)
    rows.append(
        f"| CPU of the controller while nothing changes | {(cpu_seconds(server.process.pid) - used) / 20:.0%} |"
    )
    shown = timed(lambda: batch.describe_jobs(jobs=[last]), 50)
    rows.append(f"| DescribeJobs, p50 / p99 | {shown[1]:.1f} / {shown[2]:.1f} ms |")
    page = timed(lambda: batch.list_jobs(arrayJobId=jobs[-1], jobStatus="RUNNABLE", maxResults=100), 50)
    rows.append(f"| ListJobs, a page of 100, p50 / p99 | {page[1]:.1f} / {page[2]:.1f} ms |")
    server.kill()
    started = time.perf_counter()
    server.start()
    rows.append(f"| kill -9 → serves again | {time.perf_counter() - started:.1f} s |")
    return rows


def main() -> int:
    """Measure, print, write the page."""
    server = Serving(Path(tempfile.mkdtemp(prefix="muster-bench-")), "--cpus", "0.1", "--rate-limit", "0")
    try:
        ours = compare("Muster", server.url)
        with moto() as url:
            theirs = compare("moto", url)
        many = crowd(server)
    finally:
        server.close()
    page = f"""# The API

`make bench-api`, {os.cpu_count()} cores (load {os.getloadavg()[0]:.1f} at the end, shared machine), Python {platform.python_version()}, SQLite with
`synchronous=FULL`: what was acknowledged survives a power cut. moto keeps everything in memory. One client, one connection.

| server | jobs there | operation | per second | p50 [ms] | p99 [ms] |
|---|--:|---|--:|--:|--:|
{chr(10).join(ours + theirs)}

| 100,000 waiting jobs | |
|---|--:|
{chr(10).join(many)}
"""
    print(page)
    (Path(__file__).parent / "api.md").write_text(page)
    return 0


if __name__ == "__main__":
    sys.exit(main())
