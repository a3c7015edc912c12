"""Kill anything, at any instant: the run ends with the same bits. ``python -m tests.support.faults.torture --kills 300 --seed 1``

A job is run straight, once for each size of its gang. Then the same job is run again and again while SIGKILL, and now and then
SIGSTOP, hits its ranks, supervisors, writers and the controller at moments drawn from the seed, some of them inside a commit.
Every run must end as the straight one did: tensors bit for bit, metrics iteration by iteration, with every attempt accounted for
and no process or file left. Then come the other classes: hostile jobs, a full disk, a wall clock that
jumps, a second controller, outages of the network and the store. The table goes to ``benchmarks/torture.md``; exit code 1 where anything was wrong.
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY
from tests.support.faults.checks import Reference
from tests.support.faults.fire import Fire, Result, run_straight
from tests.support.faults.full_disk import full_disk_round
from tests.support.faults.home import Home
from tests.support.faults.hostile import hostile_round
from tests.support.faults.outages import outage_round
from tests.support.faults.schedule import JOB_NODES, SHARES, draw_plan
from tests.support.faults.second_controller import second_controller_round
from tests.support.faults.wall_clock import wall_clock_round
from tests.support.processes import end_all

BLOWS = 12
"""At most so many in one run, besides those that hit a controller while it starts."""
_SOON = ("--lost-after", "30s")
"""Options of ``muster serve``: a supervisor that is frozen while its ranks train is found by its silence, and runs wait for that."""
ROUNDS: dict[str, Callable[[Path, int], tuple[Counter[str], list[str]]]] = {
    "hostile jobs": hostile_round,
    "full disk": full_disk_round,
    "wall clock": wall_clock_round,
    "second controller": second_controller_round,
    "outages": outage_round,
}
"""What is done besides killing. Each class is a function ``(directory, seed)`` that brings up a real home below the directory and does its
worst as the seed says; it returns what it did, counted by name, and what was wrong afterwards, one line each."""


class Torture:
    """Runs plans on several homes at once until enough blows have landed."""

    def __init__(self, kills: int, seed: int, iterations: int, jobs: int, directory: Path) -> None:
        self.kills, self.seed, self.iterations, self.jobs, self.directory = kills, seed, iterations, jobs, directory
        self.references: dict[int, Reference] = {}
        self.results: list[Result] = []
        self._planned = 0
        self._number = 0
        self._lock = threading.Lock()
        self._landed: dict[str, int] = {}
        self._started = time.monotonic()

    def run(self) -> list[Result]:
        """All of it; raises Broken where even the straight run fails."""
        home = Home(self.directory / "straight")
        try:
            for nodes in sorted(set(JOB_NODES)):
                self.references[nodes] = run_straight(home, nodes, self.iterations)
                kept = len(self.references[nodes].checkpoints)
                self._say("straight", f"{nodes} nodes: {self.iterations} iterations, {kept} checkpoints")
        finally:
            home.close()
            end_all(home.path)
        threads = [threading.Thread(target=self._lane, args=(lane,)) for lane in range(self.jobs)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return self.results

    def stop(self) -> None:
        """Begin no other run; what is known when the present ones have ended is the result."""
        self.kills = self._total()

    def _lane(self, lane: int) -> None:
        home = Home(self.directory / f"home-{lane}", *_SOON)
        try:
            while name := self._next():
                blows = min(BLOWS, max(1, self.kills - self._total()))
                plan = draw_plan(name, blows)
                fire = Fire(home, plan, self.iterations, partial(self._hit, name))
                result = fire.carry_out(self.references[plan.nodes])
                self.results.append(result)
                self._report(result)
                if result.verdict.violations:  # its home is kept for whoever looks; the next run gets a new one
                    home.close()
                    home = Home(self.directory / f"home-{lane}-after-{plan.seed}", *_SOON)
                else:
                    shutil.rmtree(fire.run.path)
        finally:
            home.close()
            end_all(home.path)

    def _next(self) -> str | None:
        with self._lock:
            if self._total() >= self.kills:
                return None
            self._number += 1
            return f"{self.seed}.{self._number}"

    def _total(self) -> int:
        return sum(self._landed.values())

    def _hit(self, name: str, text: str) -> None:
        if text.startswith("SIG"):
            self._landed[name] = self._landed.get(name, 0) + 1
        self._say(name, text)

    def _report(self, result: Result) -> None:
        verdict = result.verdict
        self._say(
            result.plan.seed,
            f"{'WRONG' if verdict.violations else 'the same bits'} after {len(result.hits)} blows: {result.plan.nodes} nodes, "
            f"{verdict.jobs} jobs, {verdict.attempts} attempts, {verdict.repeated} iterations repeated, {result.seconds:.0f} s",
        )
        for violation in verdict.violations:
            self._say(result.plan.seed, f"VIOLATION {violation}")

    def _say(self, name: str, text: str) -> None:
        print(
            f"{time.monotonic() - self._started:6.0f} s  {self._total():4}/{self.kills}  {name:>8}  {text}", flush=True
        )


def run_class(name: str, directory: Path, seed: int, rounds: int) -> tuple[str, list[str]]:
    """So many rounds, each in a directory of its own that is kept where something was wrong; a row of a table, and what was wrong."""
    done, wrong = Counter[str](), list[str]()
    for number in range(1, rounds + 1):
        place = directory / name.replace(" ", "-") / str(number)
        try:
            did, amiss = ROUNDS[name](place, 1000 * seed + number)
        except pytest.skip.Exception as skipped:
            return f"| {name} | 0 | {skipped} | **0** |", []
        except Exception as error:  # a defect of the harness must not pass for a pass
            traceback.print_exc()
            did, amiss = Counter[str](), [f"the harness failed: {error!r}"]
        done += did
        wrong += [f"{name}, round {1000 * seed + number}: {violation}" for violation in amiss]
        print(f"{name}, round {number}: {dict(did)}, {len(amiss)} violations", flush=True)
        if not amiss:
            shutil.rmtree(place, ignore_errors=True)
    counted = ", ".join(f"{count} {what}" for what, count in sorted(done.items()))
    return f"| {name} | {rounds} | {counted} | **{len(wrong)}** |", wrong


def table(results: Sequence[Result], seconds: float) -> str:
    """What was struck and what came of it, as a Markdown table."""
    hits = Counter((hit.target, hit.signal) for result in results for hit in result.hits)
    inside = Counter(hit.target for result in results for hit in result.hits if hit.in_commit)
    lines = ["| struck | SIGKILL | SIGSTOP | of them inside a commit |", "|---|--:|--:|--:|"]
    for target in SHARES:
        lines.append(f"| {target} | {hits[target, 'SIGKILL']} | {hits[target, 'SIGSTOP']} | {inside[target]} |")
    kills, stops = (sum(count for (_, name), count in hits.items() if name == kind) for kind in ("SIGKILL", "SIGSTOP"))
    lines.append(f"| **all** | **{kills}** | **{stops}** | **{sum(inside.values())}** |")
    verdicts = [result.verdict for result in results]
    sizes = ", ".join(str(sum(result.plan.nodes == nodes for result in results)) for nodes in (1, 2, 3))
    skipped = sum(verdict.skipped_epochs for verdict in verdicts)
    facts = {
        "runs (of 1, 2 and 3 nodes)": f"{len(results)} ({sizes})",
        "gang starts after the first of each run": sum(max(0, verdict.attempts - 1) for verdict in verdicts),
        "controller starts": sum(result.controller_starts for result in results),
        "jobs that resumed a run whose attempts were spent": sum(max(0, verdict.jobs - 1) for verdict in verdicts),
        "iterations repeated (lost work)": sum(verdict.repeated for verdict in verdicts),
        "epochs skipped (controller killed before it had recorded the attempt)": skipped,
        "checkpoints compared bit by bit": sum(verdict.checkpoints for verdict in verdicts),
        "**runs that ended differently, or with anything amiss**": f"**{sum(bool(v.violations) for v in verdicts)}**",
        "seconds": f"{seconds:.0f}",
    }
    lines += ["", "| what came of it | |", "|---|--:|", *(f"| {name} | {value} |" for name, value in facts.items())]
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.support.faults.torture", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--kills", type=int, default=300, help="how many signals are to land (default 300)")
    parser.add_argument("--seed", type=int, default=1, help="of targets and moments (default 1)")
    parser.add_argument("--jobs", type=int, default=2, help="homes at once, each with a controller (default 2)")
    parser.add_argument("--iterations", type=int, default=400, help="length of the job (default 400)")
    parser.add_argument("--rounds", type=int, default=10, help="of each class besides killing (default 10)")
    parser.add_argument("--directory", type=Path, help="where the homes go, and stay (default: a temporary directory)")
    parser.add_argument("--report", type=Path, default=REPOSITORY / "benchmarks" / "torture.md", help="the table")
    supplied = parser.parse_args(arguments)
    directory = (supplied.directory or Path(tempfile.mkdtemp(prefix="muster-torture-"))).resolve()
    directory.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    torture = Torture(supplied.kills, supplied.seed, supplied.iterations, supplied.jobs, directory)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda _number, _frame: torture.stop())
    results = torture.run()
    struck = table(results, time.monotonic() - started)
    wrong = [f"run {result.plan.seed}: {each}" for result in results for each in result.verdict.violations]
    rows = ["| class | rounds | what was done | violations |", "|---|--:|---|--:|"]
    for name in ROUNDS:
        row, amiss = run_class(name, directory, supplied.seed, supplied.rounds)
        rows.append(row)
        wrong += amiss
    classes = "\n".join(rows)
    print(f"\n{struck}\n\n{classes}")
    found = "\n".join(["\n## What was wrong\n", *(f"- {each}" for each in wrong), ""]) if wrong else ""
    total = sum(len(result.hits) for result in results)
    supplied.report.write_text(f"""# Kill anything, at any instant

Written by `make torture N={total}` (`python -m tests.support.faults.torture --seed {supplied.seed} --jobs {supplied.jobs}`), {datetime.now(UTC):%Y-%m-%d}, {os.cpu_count()} CPUs, Python {platform.python_version()}.

A Cartpole job of {supplied.iterations} iterations with a checkpoint every 10 is run straight, then again and again through the real command and
controller while signals hit its processes at random moments. Every run must end with the straight run's tensors, bit for bit, in all
checkpoints that it has left; every metrics record that was ever written must be the straight run's (timing apart), none missing or
doubled; attempts, launches and epochs must agree; every attempt must have its reason; no process and no hidden file may be left.

{struck}

## Besides killing

Each round brings up a controller of its own and does its worst: jobs that fork, flood, ignore signals and try to escape; a volume without
a free byte; a wall clock that jumps by up to 90 days; a second controller that takes the same run at the same moment; outages under
which the only attempt of a run must end with the straight run's bits: a network that is cut between controller and nodes, a store that is
frozen, replaced by an empty directory, or full, and a controller that moves to another address.

{classes}
{found}""")
    for violation in wrong:
        print(f"VIOLATION (--seed {supplied.seed}) {violation}")
    if wrong:
        print(f"homes: {directory}")
    elif supplied.directory is None:
        shutil.rmtree(directory)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
