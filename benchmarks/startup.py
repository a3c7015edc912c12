"""Waiting time of a user for the command: ``python -m benchmarks.startup``; the table goes to ``startup.md``.

CPU time is the user and system time of the process and its children; ready is the time to the line ``Muster serves``.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.load import Watch, add_option, machine, reported

REPOSITORY = Path(__file__).parent.parent
MUSTER = str(Path(sys.executable).parent / "muster")
REPEATS = 7


def cpu_of(command: list[str], env: dict[str, str]) -> tuple[float, float]:
    """CPU time and wall time of a command [s]. Raises CalledProcessError."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    subprocess.run(command, env=env, cwd=REPOSITORY, check=True, capture_output=True)
    took, after = time.monotonic() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, took


def serving(env: dict[str, str]) -> tuple[subprocess.Popen[str], float]:
    """A controller, and the time until it was ready [s]."""
    began = time.monotonic()
    server = subprocess.Popen([MUSTER, "serve", "--port", "0"], env=env, stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None and server.stdout.readline().startswith("Muster serves ")
    return server, time.monotonic() - began


def stop(server: subprocess.Popen[str]) -> None:
    server.terminate()
    server.wait()


def median(measure: Callable[[], float], repeats: int = REPEATS) -> str:
    return f"{statistics.median(measure() for _ in range(repeats)):.2f} s"


def measure(home: Path) -> list[tuple[str, str, str]]:
    """Name, goal and measurement of each row."""
    env = {**os.environ, "MUSTER_HOME": str(home)}

    def ready(home: str) -> float:
        server, seconds = serving({**os.environ, "MUSTER_HOME": home})
        stop(server)
        return seconds

    def ready_in_new_home() -> float:
        with tempfile.TemporaryDirectory() as directory:
            return ready(directory)

    rows = [("`muster --help`, CPU", "< 0.4 s", median(lambda: cpu_of([MUSTER, "--help"], env)[0]))]
    rows.append(("`muster serve`, new home: ready after", "< 2 s", median(ready_in_new_home)))
    ready(str(home))
    rows.append(("`muster serve`, again: ready after", "< 2 s", median(lambda: ready(str(home)))))
    server, _ = serving(env)
    rows.append(("`muster list`, CPU", "< 0.8 s", median(lambda: cpu_of([MUSTER, "list"], env)[0])))
    stop(server)
    training = [MUSTER, "run", "job_specs/cartpole.yaml"]
    cpu_of(training, env)  # compiles the kernels
    rows.append(
        ("`make run`, warm: 60 iterations on three nodes", "< 20 s", median(lambda: cpu_of(training, env)[1], 3))
    )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_option(parser)
    watch = Watch(parser.parse_args().loaded_anyway)
    with tempfile.TemporaryDirectory() as directory:
        rows = measure(Path(directory))
    table = ["| what | goal | median |", "|---|---|---|", *(f"| {' | '.join(row)} |" for row in rows)]
    intro = f"`make bench-startup` on {machine()}; {REPEATS} times each, `make run` 3 times. Before it: {reported([watch.start])}"
    text = "\n".join(["# Start-up", "", intro, "", *table, ""])
    (REPOSITORY / "benchmarks" / "startup.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
