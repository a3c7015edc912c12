"""Costs of the engines: time to start a gang, to detect and repair a death, to stop; training speed and memory.

``make bench-engines`` writes ``benchmarks/engines.md``. The clusters are those of the tests (``tests/support/engines/``), all on this
machine, so this is a module for pytest. Gangs have two nodes. The death of a rank or node counts as noticed when the controller has
recorded it. A gang runs again when all its ranks have printed. A stop is complete when no process of the gang exists and the job is
FAILED.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from shared_store.volume.layout import Store
from shared_store.volume.metrics import read_metrics
from tests.support.engines.fixtures import sites
from tests.support.engines.sites import SITES, Site
from tests.support.engines.training import submit
from tests.support.processes import kill_rank, kill_supervisor, processes_of_job
from tests.support.waiting import wait_for

TRIES = 3
site = sites(*SITES)
TABLE = Path(__file__).with_suffix(".md")
STAYS = 'trap "exit 75" TERM; echo ready; while :; do sleep 0.02; done'
DAEMONS = {
    "docker": ("dockerd", "containerd", "containerd-shim"),
    "ray": ("raylet", "gcs_server", "ray::", "ray/dashboard", "ray/_private", "engines.ray_"),
    "slurm": ("slurmctld", "slurmd", "slurmstepd"),
}
"""The engine's own processes, identified by words in their commands."""
ROWS: dict[str, dict[str, str]] = {}


def seconds(since: float, what: Callable[[], Any]) -> float:
    """Seconds from ``since`` (monotonic) until ``what`` is true."""
    wait_for(what, 90, "what is measured")
    return time.monotonic() - since


def test_measure(site: Site) -> None:
    times: dict[str, list[float]] = {name: [] for name in ("first", "rank", "node", "again", "stop")}
    for _ in range(TRIES):
        memory = _try(site, times)
    row = {name: f"{statistics.median(found):.2f}" for name, found in times.items()}
    ROWS[site.engine] = {**row, **memory, "speed": _speed(site)}
    _write()


def _try(site: Site, times: dict[str, list[float]]) -> dict[str, str]:
    """One gang from its start to its stop; the memory of the engine while it ran."""

    def noticed() -> bool:
        attempts = site.serving.detail(job)["attempts"]
        return len(attempts) > attempt or bool(attempts[attempt - 1]["statusReason"])

    started = time.monotonic()
    job = site.submit(STAYS, nodes=2, attempts=4)
    times["first"].append(seconds(started, lambda: site.printed(job)))
    site.ready(job, 1, 2)
    kill: Callable[[str, int], None]
    for attempt, (name, kill) in enumerate((("rank", kill_rank), ("node", kill_supervisor)), 1):
        started = time.monotonic()
        kill(job, 1)
        times[name].append(seconds(started, noticed))
        again = seconds(started, lambda: site.printed(job, attempt + 1).count("ready") == 2)  # noqa: B023 at once
        if name == "node":
            times["again"].append(again)
    memory = _memory(site)
    started = time.monotonic()
    site.serving.client.batch("TerminateJob", jobId=job, reason="measured")
    times["stop"].append(
        seconds(started, lambda: not processes_of_job(job) and site.serving.detail(job)["status"] == "FAILED")
    )
    return memory


def _speed(site: Site) -> str:
    """Median steps/s of a cart-pole training on two nodes, from its metrics."""
    if site.engine == "aws-batch":
        return "-"  # its nodes run on the local engine
    job = submit(
        site.serving, "speed", site.engine, 40, "train.worlds=256", "checkpoint.every=1000", "resources.cpus=1"
    )
    assert site.serving.wait(job, timeout=180)["status"] == "SUCCEEDED", site.serving.detail(job)["statusReason"]
    found = [record["steps_per_second"] for record in read_metrics(Store(site.volume).run("speed"))[5:]]
    return f"{statistics.median(found):,.0f}"


def _memory(site: Site) -> dict[str, str]:
    """MiB (proportional set size) of the controller, and of the engine's own processes on all nodes together."""
    words = DAEMONS.get(site.engine, ())
    engine = 0.0
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != site.serving.process.pid:
            try:
                command = (entry / "cmdline").read_bytes().decode(errors="replace")
            except OSError:
                continue
            if any(word in command for word in words) and "pytest" not in command:
                engine += _pss(int(entry.name))
    return {"controller": f"{_pss(site.serving.process.pid):.0f}", "engine": f"{engine:.0f}" if words else "-"}


def _pss(pid: int) -> float:
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0
    return sum(int(line.split()[1]) for line in lines if line.startswith("Pss:")) / 1024


def _write() -> None:
    head = (
        "# Engines\n\nWritten by `make bench-engines`: gangs of two nodes, all on one machine (two CPU cores); seconds, medians of "
        f"{TRIES}. Memory is proportional set size in MiB:\nof the controller, and of what the engine itself runs on all its nodes "
        "together (Ray: a head and three nodes; Slurm: slurmctld and three slurmd).\n`aws-batch` is a second Muster in AWS's place: "
        "what AWS itself takes (instances, images) is not in it.\n"
        "Steps/s: cart-pole, two nodes of 256 worlds and a core each, all of the machine's. On Ray the last to go is the job's "
        "driver, which keeps\nthe gang's place for 15 s; the nodes themselves are gone at once. A node's death is that of its supervisor; of a whole machine's see the tests of each engine.\n\n"
        "| engine | submit → first rank | rank's death → noticed | node's death → noticed | → runs again | stop → nothing left | "
        "steps/s | controller | engine |\n|---|---|---|---|---|---|---|---|---|\n"
    )
    keys = ("first", "rank", "node", "again", "stop", "speed", "controller", "engine")
    TABLE.write_text(
        head + "".join(f"| {name} | {' | '.join(row[key] for key in keys)} |\n" for name, row in ROWS.items())
    )
