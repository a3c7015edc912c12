"""From YAML to the first iteration, steps per second on this machine, log latency, lines of code: ``python -m benchmarks.spine``.

Everything is measured through the real command and controller, with a new home directory; the table goes to ``spine.md``.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from datetime import datetime
from pathlib import Path
from typing import Any

from benchmarks.load import Watch, add_option, machine, reported
from orchestrator.client import Client

REPOSITORY = Path(__file__).parent.parent
MUSTER = str(Path(sys.executable).parent / "muster")


def seconds(stamp: str) -> float:
    return datetime.fromisoformat(stamp).timestamp()


class Bench:
    """One controller on a fresh home."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self.env = {**os.environ, "MUSTER_HOME": str(home)}
        self.env.pop("WARP_CACHE_PATH", None)
        self.server = subprocess.Popen(
            [MUSTER, "serve", "--port", "0", "--cpus", "16"], env=self.env, stdout=subprocess.PIPE, text=True
        )
        assert self.server.stdout is not None
        self.client = Client(self.server.stdout.readline().split()[2])

    def run(self, spec: str, *changes: str) -> dict[str, Any]:
        """Submit, wait for the end; the job's detail with its times."""
        options = [part for change in changes for part in ("--set", change)]
        command = [MUSTER, "submit", spec, "--json", *options]
        submitted = json.loads(
            subprocess.run(command, env=self.env, cwd=REPOSITORY, capture_output=True, check=True).stdout
        )
        while True:
            detail: dict[str, Any] = self.client.get(f"/api/jobs/{submitted['jobId']}")
            if detail["status"] in ("SUCCEEDED", "FAILED"):
                assert detail["status"] == "SUCCEEDED", detail["statusReason"]
                return detail
            time.sleep(0.2)

    def start_up(self, detail: dict[str, Any]) -> tuple[float, float]:
        """Submit → first node process; first node process → end of the first iteration [s]."""
        run = self.home / "store" / "runs" / detail["run"]
        outcomes = [json.loads(path.read_text()) for path in run.glob("outcomes/*/1/*.json")]
        first_process = min(outcome["started"] for outcome in outcomes)
        lines = [
            line for line in self.client.logs(detail["id"]) if " ".join(line["text"].split()).startswith("iteration 1/")
        ]
        return first_process - detail["createdAt"] / 1000, seconds(lines[0]["time"]) - first_process

    def rate(self, detail: dict[str, Any]) -> float:
        """Median steps per second of the gang, without the first two iterations."""
        records = self.client.get(f"/api/runs/{detail['run']}/metrics")[2:]
        median: float = statistics.median(record["steps_per_second"] for record in records)
        return median

    def log_latency(self, lines: int = 50) -> list[float]:
        """Line written by a rank → seen by ``muster logs -f``, one value per line [s]."""
        spec = self.home / "ticker.yaml"
        code = f"import time\\nfor _ in range({lines}): print(time.time(), flush=True); time.sleep(0.1)"
        spec.write_text(f'name: ticker\nresources: {{cpus: 0.1, memory: 16MiB}}\ncommand: [python, -c, "{code}"]\n')
        submit = subprocess.run([MUSTER, "submit", str(spec), "--json"], env=self.env, capture_output=True, check=True)
        follow = [MUSTER, "logs", json.loads(submit.stdout)["jobId"], "-f", "--rank", "0", "--json"]
        seen = []
        with subprocess.Popen(follow, env=self.env, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            for line in process.stdout:
                seen.append(time.time() - float(json.loads(line)["text"]))
        return seen[5:]

    def close(self) -> None:
        self.server.terminate()
        self.server.wait()


def lines_of_code() -> dict[str, int]:
    """Lines of each package that are neither blank nor a comment."""
    counts = {}
    for package in ("orchestrator", "shared_store", "worker", "racer", "tests"):
        text = [path.read_text().splitlines() for path in (REPOSITORY / package).rglob("*.py")]
        counts[package] = sum(
            1 for lines in text for line in lines if line.strip() and not line.strip().startswith("#")
        )
    return counts


def measure(home: Path) -> list[tuple[str, str]]:
    """All rows of the table."""
    bench, rows = Bench(home), []
    cartpole, ant = "job_specs/cartpole.yaml", "job_specs/ant.yaml"
    try:
        for spec, name in ((cartpole, "Cartpole, 3 nodes"), (ant, "Ant, 2 nodes")):
            for state in ("cold", "warm"):
                wait, first = bench.start_up(bench.run(spec, "train.iterations=2"))
                if state == "warm":
                    rows.append((f"submit → first node process, {name}", f"{wait:.2f} s"))
                rows.append((f"first node process → first iteration, {name}, {state} kernels", f"{first:.1f} s"))
        for spec, name in ((cartpole, "Cartpole"), (ant, "Ant")):
            for nodes in (1, 2, 3):
                detail = bench.run(spec, f"nodes={nodes}", "train.iterations=12", "train.worlds=64")
                rows.append(
                    (f"{name}, {nodes} × 64 worlds, steps/s of the gang (median)", f"{bench.rate(detail):,.0f}")
                )
        delays = sorted(bench.log_latency())
        rows.append(
            ("log line written → seen by `muster logs -f`, median", f"{statistics.median(delays) * 1000:.0f} ms")
        )
        rows.append(("the same, 95th percentile", f"{delays[int(len(delays) * 0.95)] * 1000:.0f} ms"))
    finally:
        bench.close()
    return rows + [(f"lines of code, {package}", f"{count:,}") for package, count in lines_of_code().items()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_option(parser)
    watch = Watch(parser.parse_args().loaded_anyway)
    with tempfile.TemporaryDirectory() as directory:
        rows = measure(Path(directory))
    table = ["| what | measured |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)]
    text = "\n".join(
        [
            "# The spine",
            "",
            f"`make bench` on {machine()}; one run. Before it: {reported([watch.start])}",
            "",
            *table,
            "",
        ]
    )
    (REPOSITORY / "benchmarks" / "spine.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
