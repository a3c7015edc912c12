"""The console's pages in a real browser: ``python -m benchmarks.console [--loaded-anyway]`` writes ``benchmarks/console.md``.

The server has 1,000 jobs and one training whose run has 10,000 iterations of 50 metrics, and whose log has 1 GB. A page's *first content*
is when the browser has painted something (first contentful paint); it is *interactive* when its last row or chart is there, its scripts
have run and its stream is open. Both count from the begin of the navigation, in a browser that has the server's files already.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import statistics
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
from playwright.sync_api import Browser, Page, sync_playwright

from benchmarks import load
from orchestrator.client import Client
from shared_store.volume.layout import Store
from shared_store.volume.metrics import MetricsWriter
from tests.conftest import Serving, submit_gang

JOBS = 1000
ITERATIONS = 10_000
METRICS = 50
LOG_BYTES = 1_000_000_000
OPEN = 20
"""Pages that are open at once."""
WATCHED = 20.0
"""For how long the server is watched [s]."""
VISITS = 7
EVENTS = 20
TABLE = Path(__file__).with_suffix(".md")
_LINE = "2026-01-01T00:00:{:02}.{:06}Z 0 o iteration {}/10000  reward 1.25  length 84.0  steps/s 3982  lr 3.0e-04  kl 0.010\n"
_TALKS = "import time\nwhile True: print('printed', time.time(), flush=True); time.sleep(0.5)"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    load.add_option(parser)
    watch = load.Watch(parser.parse_args().loaded_anyway)
    home = Path(tempfile.mkdtemp(prefix="muster-console-"))
    server = Serving(home, "--cpus", "2")
    try:
        trained, talking = fill(server)
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
            rows = [
                visits(
                    browser,
                    server.url,
                    "Jobs (1,000 jobs)",
                    "/",
                    "() => document.querySelectorAll('tr[data-key]').length >= 50",
                ),
                visits(
                    browser,
                    server.url,
                    "Job (10,000 iterations × 50 metrics, 1 GB log)",
                    f"/jobs/{trained}",
                    "() => document.querySelectorAll('[data-charts] svg').length > 3 && document.querySelectorAll('.line').length > 100",
                ),
            ]
            late = {
                "state of a job, in the table": states(browser, server),
                "point of a curve": points(browser, server),
                "line of a log": lines(browser, server, talking),
            }
            browser.close()
        servers = open_pages(server, trained)
        TABLE.write_text(table(rows, late, servers, load.reported([watch.check("during the measurement")])))
        print(TABLE.read_text())
    finally:
        server.close()
        shutil.rmtree(home, ignore_errors=True)


def fill(server: Serving) -> tuple[str, str]:
    """The ids of the training with the long log and of a job that prints; the server has its 1,000 jobs then."""
    trained = train(server, 3)
    server.wait(trained)
    run = Store(server.home / "store").run(server.detail(trained)["run"])
    with MetricsWriter(run, 9, 3) as metrics:
        for iteration in range(4, ITERATIONS + 1):
            metrics.write({"iteration": iteration, "reward": iteration**0.5, **terms(iteration)})
    (log,) = run.path.glob(f"logs/{trained}/1/node-0.log")
    with log.open("a") as file:
        for start in range(0, LOG_BYTES // len(_LINE.format(0, 0, 0)) // 10_000):
            file.write("".join(_LINE.format(start % 60, i, i) for i in range(10_000)))
    waits = definition(server.client)
    with ThreadPoolExecutor(4) as pool:
        for _ in pool.map(lambda i: submit(server.client, waits, f"waits-{i:04}"), range(JOBS - 2)):
            pass
    talking = submit_gang(server.client, _TALKS, name="talks")
    server.wait(talking, "RUNNING")
    return trained, talking


def train(server: Serving, iterations: int) -> str:
    """The id of a training with two worlds."""
    supplied = (f"--set={key}" for key in ("nodes=1", "train.worlds=2", f"train.iterations={iterations}"))
    reported = server.muster("submit", "job_specs/cartpole.yaml", "--json", *supplied)
    assert reported.returncode == 0, reported.stderr
    job: str = json.loads(reported.stdout)["jobId"]
    return job


def terms(iteration: int) -> dict[str, float]:
    return {f"reward_{number}": (iteration * number % 97) / 97 for number in range(1, METRICS)}


def definition(client: Client) -> str:
    """Of jobs that need more than the machine has, so that they wait."""
    needs = [{"type": "VCPU", "value": "64"}, {"type": "MEMORY", "value": "16"}]
    container = {"image": "muster", "command": ["true"], "resourceRequirements": needs}
    ranges = [{"targetNodes": "0:", "container": container}]
    properties = {"numNodes": 1, "mainNode": 0, "nodeRangeProperties": ranges}
    client.batch("RegisterJobDefinition", jobDefinitionName="waits", type="multinode", nodeProperties=properties)
    return "waits"


def submit(client: Client, definition: str, name: str) -> str:
    return str(client.batch("SubmitJob", jobName=name, jobQueue="default", jobDefinition=definition)["jobId"])


def visits(browser: Browser, url: str, name: str, path: str, exists: str) -> dict[str, Any]:
    """Medians over visits: times [s], bytes over the wire of a first visit, and of the script's heap."""
    context = browser.new_context(base_url=url)
    page = context.new_page()
    sizes = list[int]()
    page.on(
        "requestfinished",
        lambda request: sizes.append(
            sum(request.sizes()[each] for each in ("responseBodySize", "responseHeadersSize"))
        ),
    )
    found = [visit(page, path, exists) for _ in range(VISITS + 1)]
    context.close()
    with httpx.Client(base_url=url) as plain:
        size = len(plain.get(path).content)
    return {"name": name, "html": size, **{key: statistics.median(each[key] for each in found[1:]) for key in found[0]}}


def visit(page: Page, path: str, exists: str) -> dict[str, float]:
    page.goto(path, wait_until="load")
    page.wait_for_function(exists, polling="raf")
    page.wait_for_function("() => performance.getEntriesByName('first-contentful-paint').length", polling="raf")
    reported: dict[str, float] = page.evaluate(
        """() => {
          const [navigation] = performance.getEntriesByType("navigation");
          const [paint] = performance.getEntriesByName("first-contentful-paint");
          return { first_byte: navigation.responseStart, content: paint.startTime, interactive: Math.max(performance.now(), navigation.loadEventEnd) };
        }"""
    )
    session = page.context.new_cdp_session(page)
    session.send("Performance.enable")
    metrics = {each["name"]: each["value"] for each in session.send("Performance.getMetrics")["metrics"]}
    session.detach()
    return {**{key: value / 1000 for key, value in reported.items()}, "heap": metrics["JSHeapUsedSize"]}


def states(browser: Browser, server: Serving) -> list[float]:
    """Seconds from the answer to a stop until the table has the new state."""
    page = browser.new_page(base_url=server.url)
    page.goto("/")
    found = []
    for row in page.locator("tr[data-key]").all()[:EVENTS]:
        job = str(row.get_attribute("data-key"))
        if server.detail(job)["status"] != "RUNNABLE":
            continue
        server.client.batch("TerminateJob", jobId=job, reason="measured")
        stopped = time.time()
        existing = (
            "job => document.querySelector(`tr[data-key='${job}'] .badge`).textContent === 'FAILED' && Date.now()"
        )
        found.append(page.wait_for_function(existing, arg=job, polling="raf").json_value() / 1000 - stopped)
    page.close()
    return [max(0.0, each) for each in found]


def points(browser: Browser, server: Serving) -> list[float]:
    """Seconds from just before an iteration is written until its reward is beside the curve of a training that runs."""
    job = train(server, 10**9)
    server.wait(job, "RUNNING")
    page, found = browser.new_page(base_url=server.url), []
    with MetricsWriter(Store(server.home / "store").run(server.detail(job)["run"]), 9, 10**9) as metrics:
        metrics.write({"iteration": 10**9, "reward": 0})
        page.goto(f"/jobs/{job}")
        page.wait_for_selector("[data-charts] svg")
        existing = "shown => [...document.querySelectorAll('[data-charts] li b')].some((each) => each.textContent === shown) && Date.now()"
        for number in range(1, EVENTS + 1):
            time.sleep(0.37)  # in step with nothing
            written = time.time()
            metrics.write({"iteration": 10**9 + number, "reward": 5000 + number})
            shown = page.wait_for_function(existing, arg=str(5000 + number), polling="raf").json_value()
            found.append(shown / 1000 - written)
    page.close()
    server.client.batch("TerminateJob", jobId=job, reason="measured")
    server.wait(job)
    return found


def lines(browser: Browser, server: Serving, job: str) -> list[float]:
    """Seconds from just before ``print`` in a rank until its line is in the page."""
    page = browser.new_page(base_url=server.url)
    page.goto(f"/jobs/{job}")
    page.wait_for_selector(".line")
    reported = page.evaluate(
        """count => new Promise((done) => {
          const late = [];
          new MutationObserver((changes) => {
            for (const { addedNodes } of changes) for (const node of addedNodes) for (const [, time] of node.textContent.matchAll(/printed ([0-9.]+)/g))
              late.push(Date.now() / 1000 - Number(time));
            if (late.length >= count) done(late);
          }).observe(document.querySelector("[data-log]"), { childList: true });
        })""",
        EVENTS,
    )
    page.close()
    return [float(each) for each in reported]


def open_pages(server: Serving, trained: str) -> list[dict[str, Any]]:
    """What the server uses with no page open and with 20: half of them the table, half the page of the training."""
    found = [{"pages": 0, **watched(server)}]
    paths = ["/jobs/stream", f"/jobs/{trained}/stream"] * (OPEN // 2)
    with followed(server.url, paths) as counts:
        time.sleep(3)
        found.append({"pages": OPEN, **watched(server), "events": sum(counts) / OPEN})
    return found


@contextmanager
def followed(url: str, paths: list[str]) -> Iterator[list[int]]:
    """Streams as browsers read them, in threads of this process; the number of events of each."""
    counts, over = [0] * len(paths), threading.Event()

    def read(index: int) -> None:
        while not over.is_set():
            with httpx.stream("GET", url + paths[index], timeout=30, trust_env=False) as answer:
                for line in answer.iter_lines():
                    counts[index] += line.startswith("data:")
                    if over.is_set():
                        return

    threads = [threading.Thread(target=read, args=(index,), daemon=True) for index in range(len(paths))]
    for each in threads:
        each.start()
    yield counts
    over.set()


def watched(server: Serving) -> dict[str, float]:
    """CPU (share of a core), memory [B] and the loop's passes while a job changes each second."""
    pid = str(server.process.pid)
    waiting = [each["id"] for each in server.client.get("/api/jobs", status="RUNNABLE", max=50)["jobs"]]
    before, began, cpu = passes(server), time.monotonic(), load.own_seconds(pid)
    while time.monotonic() - began < WATCHED:
        server.client.batch("TerminateJob", jobId=waiting.pop(), reason="measured")
        time.sleep(1)
    took, after = time.monotonic() - began, passes(server)
    count = after[0] - before[0]
    return {
        "cpu": (load.own_seconds(pid) - cpu) / took,
        "memory": resident(pid),
        "pass": (after[1] - before[1]) / count if count else 0.0,
        "passes": count,
    }


def passes(server: Serving) -> tuple[float, float]:
    """Number and total length [s] of the scheduling passes."""
    text = httpx.get(f"{server.url}/metrics", trust_env=False).text
    kinds = (
        re.search(rf"^muster_scheduling_pass_seconds_{kind} (\S+)", text, re.MULTILINE) for kind in ("count", "sum")
    )
    count, total = (float(found[1]) if found else 0.0 for found in kinds)
    return count, total


def resident(pid: str) -> float:
    """Memory of the server's own process [B]."""
    status = Path(f"/proc/{pid}/status").read_text()
    (kilobytes,) = re.findall(r"^VmRSS:\s+(\d+)", status, re.MULTILINE)
    return 1024.0 * int(kilobytes)


def table(rows: list[dict[str, Any]], late: dict[str, list[float]], servers: list[dict[str, Any]], loaded: str) -> str:
    """The page of results."""
    pages = "\n".join(
        f"| {each['name']} | {1000 * each['first_byte']:.0f} ms | {1000 * each['content']:.0f} ms | "
        f"{1000 * each['interactive']:.0f} ms | {each['html'] / 1000:.0f} kB | {each['heap'] / 1e6:.1f} MB |"
        for each in rows
    )
    updates = "\n".join(
        f"| {name} | {1000 * statistics.median(each):.0f} ms | {1000 * max(each):.0f} ms | {len(each)} |"
        for name, each in late.items()
    )
    used = "\n".join(
        f"| {each['pages']} | {100 * each['cpu']:.0f} % | {each['memory'] / 1e6:.0f} MB | {1000 * each['pass']:.1f} ms | {each['passes']:.0f} |"
        for each in servers
    )
    grown = (servers[1]["memory"] - servers[0]["memory"]) / OPEN / 1e6
    return f"""# The console's pages

`python -m benchmarks.console`, on {load.machine()}. {loaded} Chromium runs on the same cores.

| page | first byte | first content | interactive | HTML | its scripts' memory |
|---|---|---|---|---|---|
{pages}

Medians of {VISITS} visits. Goals: first content under 0.5 s, interactive under 1.5 s.

| update | median | slowest | number |
|---|---|---|---|
{updates}

From the answer to the stop, from just before an iteration is written, or from just before `print` in the rank, until the browser has it.

| open pages | server, of a core | server's memory | scheduling pass | passes |
|---|---|---|---|---|
{used}

{WATCHED:.0f} s each, in which one job changes each second and the training's page has its 1 GB log. Half of the pages are the table, half the
page of the training; {grown:.1f} MB for each. The goal is less than 30 % of a core for {OPEN} pages.
"""


if __name__ == "__main__":
    main()
