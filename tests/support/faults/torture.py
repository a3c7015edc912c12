"""Kill anything, at any instant: the run ends with the same bits. ``python -m tests.support.faults.torture --kills 300 --seed 1``

A job is run straight, once for each size of its gang. Then the same job is run again and again while SIGKILL, and now and then
SIGSTOP, hits its ranks, supervisors, writers and the controller at moments drawn from the seed, some of them inside a commit.
Every run must end as the straight one did: tensors bit for bit, metrics iteration by iteration, with every attempt accounted for
and no process or file left. Then come the other classes (:mod:`tests.support.faults.rounds`): hostile jobs, a full disk, a wall clock that
jumps, a second controller. The table goes to ``benchmarks/torture.md``; exit code 1 where anything was wrong.
"""

from __future__ import annotations

import argparse
import shutil
import signal
import sys
import tempfile
import threading
import time
from functools import partial
from pathlib import Path

from tests.conftest import REPOSITORY
from tests.support.faults.checks import Reference
from tests.support.faults.fire import Fire, Result, run_straight
from tests.support.faults.home import Home
from tests.support.faults.report import summary, table
from tests.support.faults.rounds import ROUNDS, Class, class_table
from tests.support.faults.schedule import JOB_NODES, draw_plan
from tests.support.processes import end_all

BLOWS = 12
"""At most so many in one run, besides those that hit a controller while it starts."""


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
        home = Home(self.directory / f"home-{lane}")
        try:
            while name := self._next():
                blows = min(BLOWS, max(1, self.kills - self._total()))
                plan = draw_plan(name, blows)
                fire = Fire(home, plan, self.iterations, partial(self._hit, name))
                result = fire.carry_out(self.references[plan.nodes])
                self.results.append(result)
                self._tell(result)
                if result.verdict.violations:  # its home is kept for whoever looks; the next run gets a new one
                    home.close()
                    home = Home(self.directory / f"home-{lane}-after-{plan.seed}")
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

    def _tell(self, result: Result) -> None:
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


def run_classes(directory: Path, seed: int, rounds: int) -> list[Class]:
    """So many rounds of every class, each in a directory of its own that is kept where something was wrong."""
    classes = [Class(name) for name in ROUNDS]
    for each in classes:
        for number in range(1, rounds + 1):
            place = directory / each.name.replace(" ", "-") / str(number)
            before = len(each.violations)
            each.run(place, 1000 * seed + number)
            print(f"{each.name}, round {number}: {dict(each.done)}, {len(each.violations)} violations", flush=True)
            if len(each.violations) == before:
                shutil.rmtree(place, ignore_errors=True)
    return classes


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
    given = parser.parse_args(arguments)
    directory = given.directory or Path(tempfile.mkdtemp(prefix="muster-torture-"))
    directory.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    torture = Torture(given.kills, given.seed, given.iterations, given.jobs, directory.resolve())
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda _number, _frame: torture.stop())
    results = torture.run()
    seconds = time.monotonic() - started
    classes = run_classes(directory.resolve(), given.seed, given.rounds)
    print("\n" + table(results, seconds) + "\n\n" + class_table(classes))
    given.report.write_text(summary(results, classes, seconds, given.seed, given.iterations, given.jobs))
    wrong = [
        f"in run {result.plan.seed} (--seed {given.seed}): {violation}"
        for result in results
        for violation in result.verdict.violations
    ]
    wrong += [violation for each in classes for violation in each.violations]
    for violation in wrong:
        print(f"VIOLATION {violation}")
    if wrong:
        print(f"homes: {directory}")
    elif given.directory is None:
        shutil.rmtree(directory)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
