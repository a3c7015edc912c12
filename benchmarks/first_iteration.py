"""From a command to the end of its first iteration, part by part: ``python -m benchmarks.first_iteration TASK:WORLDS[:NODES] …``.

Every measurement is a ``muster run`` in a new process. Each job has three iterations and no picture. The parts are

- controller: from the command to the attempt, placed by the controller of the command's own;
- node: to the first instruction of the main node's rank; where ranks are forked, it waits for their imports;
- those that the rank itself reports: torch, gang, task and simulator, worlds and learner, first iteration.

Sum: to the end of the first iteration; end: until the command is over. All in seconds, medians.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

MUSTER = str(Path(sys.executable).parent / "muster")
_STARTED = re.compile(r"started in ([\d.]+) s: (.*)")
_JOB = re.compile(r"(.+?):(\d+)(?::(\d+))?")
_PART = re.compile(r"(.*) ([\d.]+) s")


def spec(task: str, worlds: int, nodes: int, gpus: int) -> dict[str, Any]:
    """The job."""
    cpus = max(0.5, (os.cpu_count() or 1) / 4 if gpus else (os.cpu_count() or 1) / nodes / 2)
    train = {"task": task, "worlds": worlds, "iterations": 3, "seed": 1}
    resources = {"cpus": cpus, "gpus": gpus, "memory": "4GiB" if gpus else "1GiB"}
    return {"name": "start", "nodes": nodes, "resources": resources, "train": train}


def measured(home: Path, job: dict[str, Any], picture: bool) -> dict[str, float]:
    """One run. Raises CalledProcessError where it fails."""
    file = home / "job.json"
    file.write_text(json.dumps(job))
    before = {*(home / "store" / "runs").glob("*")}
    environment = {**os.environ, "MUSTER_HOME": str(home), "MUSTER_PICTURE": "1" if picture else "0"}
    began = time.time()
    subprocess.run([MUSTER, "run", str(file)], env=environment, check=True, capture_output=True)
    ended = time.time()
    (run,) = {*(home / "store" / "runs").glob("*")} - before
    return {**dict(_parts(run, began)), "end": ended - began}


def _parts(run: Path, began: float) -> Iterator[tuple[str, float]]:
    (log,) = run.glob("logs/*/1/node-0.log")
    for line in log.read_text().splitlines():
        if found := _STARTED.search(line):
            over = datetime.fromisoformat(line.split()[0]).timestamp()
            rank = over - float(found[1])
            epoch = (run / "EPOCH").stat().st_mtime
            yield "controller", epoch - began
            yield "node", rank - epoch
            for part in found[2].split(", "):
                match = _PART.fullmatch(part)
                assert match is not None, line
                yield match[1], float(match[2])
            yield "sum", over - began
            return
    raise AssertionError(f"{log}: no start")


def table(rows: Sequence[tuple[str, dict[str, float]]]) -> list[str]:
    """A Markdown table."""
    columns = list(rows[0][1])
    lines = [f"| | {' | '.join(columns)} |", f"|---|{'--:|' * len(columns)}"]
    return [*lines, *(f"| {name} | {' | '.join(f'{row[each]:.2f}' for each in columns)} |" for name, row in rows)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("jobs", nargs="+", metavar="TASK:WORLDS[:NODES]")
    parser.add_argument("--gpus", type=int, default=0, help="of each node")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument(
        "--picture", action="store_true", help="draw the policy at the end, as `muster run` does by itself"
    )
    parser.add_argument("--cold", action="store_true", help="measure the first run, which compiles, apart")
    options = parser.parse_args()
    rows: list[tuple[str, dict[str, float]]] = []
    with tempfile.TemporaryDirectory() as directory:
        home = Path(directory)
        for each in options.jobs:
            task, worlds, nodes = _JOB.fullmatch(each).groups()  # type: ignore[union-attr]
            count = int(nodes or 1)
            job = spec(task, int(worlds), count, options.gpus)
            name = f"{task}, {int(worlds):,} worlds" + (f" on each of {count} nodes" if count > 1 else "")
            first = measured(home, job, options.picture)
            if options.cold:
                rows.append((f"{name}, first", first))
            found = [measured(home, job, options.picture) for _ in range(options.repeats)]
            rows.append((name, {part: statistics.median(run[part] for run in found) for part in first}))
            print(name, *(json.dumps(run) for run in found), sep="\n", file=sys.stderr, flush=True)
    print("\n".join(table(rows)))


if __name__ == "__main__":
    main()
