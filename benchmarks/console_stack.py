"""Why the console's pages are rendered on the server: ``python -m benchmarks.console_stack [--loaded-anyway]`` writes ``benchmarks/console_stack.md``.

The same table of 1,000 jobs as the console has it, and as NiceGUI 3 has it (``benchmarks/console_nicegui.py``, in an environment that is
made for this and removed): both send 50 rows at a time. In each, one job changes every second. Then NiceGUI's page
is opened under the console's ``Content-Security-Policy``, and under the least one with which it works.
"""

from __future__ import annotations

import argparse
import json
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
from playwright.sync_api import Browser, sync_playwright

from benchmarks import load
from benchmarks.console import JOBS, OPEN, VISITS, definition, resident, submit
from orchestrator.console.pages import POLICY
from tests.conftest import Serving

WATCHED = 15.0
"""For how long a server is watched with the pages open [s]."""
SETTLING = 10.0
"""From the last page's begin until the server is watched [s]."""
APPLICATION = Path(__file__).with_name("console_nicegui.py")
TABLE = Path(__file__).with_suffix(".md")
LEAST = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
    "font-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)
"""NiceGUI's page stays empty or unstyled if any directive that permits something is left out; the others forbid everything else."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    load.add_option(parser)
    watch = load.Watch(parser.parse_args().loaded_anyway)
    place = Path(tempfile.mkdtemp(prefix="muster-stack-"))
    try:
        python = environment(place)
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
            server = Serving(place / "home", "--cpus", "1")
            try:
                jobs = fill(server)
                pid = server.process.pid
                found = [measured(browser, "console", server.url, pid, "tr[data-key]", lambda: stop(server, jobs))]
                source = place / "jobs.json"
                source.write_text(json.dumps(rows(server)))
            finally:
                server.close()
            with nicegui(python, source, 50) as (url, pid):
                found.append(measured(browser, "NiceGUI", url, pid, "tbody tr", lambda: None))
            policies = []
            for name, policy in (("the console's", POLICY), ("the least", LEAST)):
                with nicegui(python, source, 50, policy) as (url, _):
                    policies.append((name, *under(browser, url)))
            seen = watch.check(
                "during the measurement"
            )  # before the close: the load of a closed browser would count as that of other processes
            browser.close()
        TABLE.write_text(table(found, policies, load.reported([seen])))
        print(TABLE.read_text())
    finally:
        shutil.rmtree(place, ignore_errors=True)


def environment(place: Path) -> str:
    """The Python of an environment with NiceGUI 3."""
    subprocess.run([sys.executable, "-m", "venv", place / "venv"], check=True)
    python = str(place / "venv" / "bin" / "python")
    subprocess.run(
        [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "nicegui>=3,<4"], check=True
    )
    return python


def fill(server: Serving) -> list[str]:
    """The ids of the server's 1,000 jobs, the newest first."""
    waits = definition(server.client)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda i: submit(server.client, waits, f"waits-{i:04}"), range(JOBS)))
    return [each["id"] for each in server.client.get("/api/jobs", max=50)["jobs"]]


def stop(server: Serving, jobs: list[str]) -> None:
    server.client.batch("TerminateJob", jobId=jobs.pop(0), reason="measured")


def rows(server: Serving) -> list[dict[str, Any]]:
    """The texts of the console's table, for NiceGUI."""
    reported = server.client.get("/api/jobs", max=50)["jobs"]
    kept = {
        "queue": "default",
        "nodes": 1,
        "progress": "",
        "rate": "",
        "reward": "",
        "created": "3 min",
        "ran": "",
        "owner": "user",
    }
    return [
        {
            "id": f"{i:036}",
            "name": f"waits-{i:04}",
            "status": "RUNNABLE",
            "reason": reported[-1]["statusReason"],
            **kept,
        }
        for i in range(JOBS)
    ]


@contextmanager
def nicegui(python: str, source: Path, count: int, *policy: str) -> Iterator[tuple[str, int]]:
    """Address and process of NiceGUI's server."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    process = subprocess.Popen([python, APPLICATION, str(port), source, str(count), *policy], stdout=subprocess.DEVNULL)
    url = f"http://127.0.0.1:{port}"
    try:
        for _ in range(300):
            try:
                httpx.get(url, trust_env=False)
                break
            except httpx.TransportError:
                time.sleep(0.1)
        yield url, process.pid
    finally:
        process.kill()
        process.wait()


def measured(browser: Browser, name: str, url: str, pid: int, row: str, change: Callable[[], None]) -> dict[str, Any]:
    """Bytes of a first visit, medians of the later ones' times [s], and what 20 open pages cost the server."""
    context = browser.new_context()
    page = context.new_page()
    sizes = list[float]()
    session = context.new_cdp_session(page)
    session.send("Network.enable")
    session.on("Network.loadingFinished", lambda event: sizes.append(event["encodedDataLength"]))
    times, first = [], 0.0
    for _ in range(VISITS + 1):
        page.goto(url, timeout=120_000)
        page.wait_for_function("([row]) => document.querySelectorAll(row).length >= 50", arg=[row], polling="raf")
        reported = "() => [performance.getEntriesByType('navigation')[0].responseStart, performance.now()].map((each) => each / 1000)"
        times.append(page.evaluate(reported))
        first = first or sum(sizes)
    html = len(httpx.get(url, trust_env=False).content)
    context.close()
    before = resident(str(pid))
    contexts = [browser.new_context() for _ in range(OPEN)]
    for each in contexts:
        each.new_page().goto(url, wait_until="commit", timeout=120_000)
    contexts[0].pages[0].wait_for_timeout(1000 * SETTLING)
    over = threading.Event()

    def keep_changing() -> None:
        while not over.wait(1):
            change()

    changing = threading.Thread(target=keep_changing)
    changing.start()
    began, cpu = time.monotonic(), load.own_seconds(str(pid))
    contexts[0].pages[0].wait_for_timeout(1000 * WATCHED)
    used = (load.own_seconds(str(pid)) - cpu) / (time.monotonic() - began)
    memory = (resident(str(pid)) - before) / OPEN
    over.set()
    changing.join()
    for each in contexts:
        each.close()
    byte, content = (statistics.median(each) for each in zip(*times[1:], strict=True))
    return {"name": name, "bytes": first, "html": html, "byte": byte, "content": content, "memory": memory, "cpu": used}


def under(browser: Browser, url: str) -> tuple[int, list[str]]:
    """Rows of the table that are shown under a policy, and the directives that were broken."""
    page = browser.new_page()
    output = list[str]()
    page.on("console", lambda message: output.append(message.text))
    page.goto(url)
    page.wait_for_timeout(5000)
    count = page.locator("tbody tr").count()
    page.close()
    words = ("script-src", "style-src", "trusted-types", "unsafe-eval", "font-src", "img-src", "connect-src")
    return count, sorted({word for word in words for text in output if word in text and "Policy" in text})


def table(found: list[dict[str, Any]], policies: list[tuple[str, int, list[str]]], loaded: str) -> str:
    """The page of results."""
    lines = "\n".join(
        f"| {each['name']} | {each['bytes'] / 1000:.0f} kB | {each['html'] / 1000:.0f} kB | {1000 * each['byte']:.0f} ms | "
        f"{1000 * each['content']:.0f} ms | {each['memory'] / 1e6:.2f} MB | {100 * each['cpu']:.0f} % |"
        for each in found
    )
    shown = "\n".join(
        f"| {name} | {count} | {', '.join(f'`{word}`' for word in broken) or 'none'} |"
        for name, count, broken in policies
    )
    return f"""# The table of jobs: rendered on the server, and in NiceGUI 3

`python -m benchmarks.console_stack`, on {load.machine()}. {loaded} Chromium runs on the same cores.

1,000 jobs, one of which changes every second. First visit: all bytes that a browser without a cache receives. The other times are medians of
{VISITS} visits of a browser that has the files.

| page | first visit | HTML | first byte | 50 rows there | server's memory, each open page | server with {OPEN} open pages, of a core |
|---|---|---|---|---|---|---|
{lines}

The console's server also schedules its 1,000 jobs meanwhile, and keeps them in a database; NiceGUI's server has a list in memory.

NiceGUI's page under a `Content-Security-Policy`:

| policy | rows shown | broken directives |
|---|---|---|
{shown}

The least policy with which it works: `{LEAST}`.
"""


if __name__ == "__main__":
    main()
