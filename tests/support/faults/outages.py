"""What a job must survive: a cut network, a volume that freezes, vanishes or fills up, a controller that moves. One class of a torture.

Root only: it mounts a volume and sets rules of the firewall.
"""

from __future__ import annotations

import contextlib
import random
import shutil
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

import pytest

from orchestrator.persistence.own_secrets import BUS_PORT
from shared_store.volume.layout import Run
from tests.support.faults.checks import Reference, Verdict, judge
from tests.support.faults.fire import run_straight, write_spec
from tests.support.faults.full_disk import fill
from tests.support.faults.home import Broken, Home, reached
from tests.support.keys import put_secret, secret_of_home
from tests.support.processes import end_all
from tests.support.waiting import wait_for

VOLUME = "192M"
LOST_AFTER = 10.0
"""``serve --lost-after``: the shortest, so that an outage outlasts it [s]."""
LONGEST = 2 * LOST_AFTER
"""Seconds of the longest outage."""
ITERATIONS, STEPS = 800, 128
"""Long iterations, so that no outage lasts until the end, whose checkpoint must be saved."""
BLOWS = 3
"""In one run."""


def root(*command: object) -> None:
    """Run a command that needs privileges; skips the test where they are missing."""
    done = subprocess.run([str(each) for each in command], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"not allowed here: {' '.join(map(str, command))}: {done.stderr.strip()}")


@contextlib.contextmanager
def loop_volume(directory: Path) -> Iterator[Path]:
    """A volume with a file system of its own at ``directory``, which can be frozen."""
    directory.mkdir(parents=True)
    image = directory.with_suffix(".img")
    root("truncate", "-s", VOLUME, image)
    root("mkfs.ext4", "-q", image)
    root("mount", "-o", "loop,noatime", image, directory)
    try:
        yield directory
    finally:
        root("umount", "-l", directory)
        image.unlink()


def partition(home: Home) -> AbstractContextManager[None]:
    """No packet passes between the controller's bus and its nodes."""
    return cut(secret_of_home(home.path, BUS_PORT))


@contextlib.contextmanager
def cut(port: str | None) -> Iterator[None]:
    """No packet passes to or from this port of loopback."""
    rules = [(chain, "-i" if chain == "INPUT" else "-o", way) for chain in ("INPUT", "OUTPUT") for way in ("s", "d")]
    for chain, side, way in rules:
        root("iptables", "-I", chain, side, "lo", "-p", "tcp", f"--{way}port", port, "-j", "DROP")
    try:
        yield
    finally:
        for chain, side, way in rules:
            root("iptables", "-D", chain, side, "lo", "-p", "tcp", f"--{way}port", port, "-j", "DROP")


@contextlib.contextmanager
def frozen(home: Home) -> Iterator[None]:
    """Nobody can write to the store: calls do not return."""
    root("fsfreeze", "-f", home.path / "store")
    try:
        yield
    finally:
        root("fsfreeze", "-u", home.path / "store")


@contextlib.contextmanager
def vanished(home: Home) -> Iterator[None]:
    """An empty directory is in the place of the store."""
    root("mount", "-t", "tmpfs", "tmpfs", home.path / "store")
    try:
        yield
    finally:
        root("umount", "-l", home.path / "store")


@contextlib.contextmanager
def full(home: Home) -> Iterator[None]:
    """The store has no free byte."""
    filler = fill(home.path / "store")
    try:
        yield
    finally:
        filler.unlink()


@contextlib.contextmanager
def moved(home: Home) -> Iterator[None]:
    """The controller ends, and another one begins at another address, which nodes do not know."""
    home.close()
    yield
    put_secret(home.path, BUS_PORT, "0")
    home.serve()


OUTAGES: Mapping[str, Callable[[Home], AbstractContextManager[None]]] = {
    "partition": partition,
    "frozen": frozen,
    "vanished": vanished,
    "full": full,
    "moved": moved,
}


def outage_round(
    directory: Path, seed: int, sizes: Sequence[int] = (1, 3), blows: Sequence[str] = (), longest: float = LONGEST
) -> tuple[Counter[str], list[str]]:
    """One run of each size of gang under these blows, drawn ones by default: its only attempt must end as that of the straight run."""
    rng = random.Random(seed)
    done, wrong = Counter[str](), list[str]()
    with loop_volume(directory / "home" / "store"):
        home = Home(directory / "home", "--lost-after", f"{LOST_AFTER:.0f}s", "--min-free", "1MiB")
        try:
            home.serve()
            for nodes in sizes:
                reference = run_straight(home, nodes, ITERATIONS, STEPS)
                verdict = _run(home, nodes, reference, blows or rng.choices(list(OUTAGES), k=BLOWS), rng, done, longest)
                wrong += verdict.violations
                wrong += [f"{nodes} nodes: {verdict.attempts} attempts"] * (verdict.attempts != 1)
        finally:
            home.close()
            end_all(home.path)
    return done, wrong


def _run(
    home: Home,
    nodes: int,
    reference: Reference,
    blows: Sequence[str],
    rng: random.Random,
    done: Counter[str],
    longest: float,
) -> Verdict:
    """A run with one attempt under these blows, to its end."""
    spec = write_spec(home.path / "spec.yaml", nodes, 1, ITERATIONS, 3, STEPS)
    submitted, output = home.command("submit", str(spec))
    if submitted is None:
        raise Broken(f"submit: {output}")
    run = home.run(f"torture-{submitted['jobId'][:8]}")
    for name in blows:
        before = reached(run, 1)
        wait_for(partial(_went_on, home, run, before), 60, "the run goes on")
        if _is_over(home, run):
            break
        with OUTAGES[name](home):
            time.sleep(rng.uniform(0.5, longest))
        done[name] += 1
        print(f"{nodes} nodes: {name} at iteration {before} of {ITERATIONS}", flush=True)
    wait_for(lambda: _is_over(home, run), 240, "the end")
    verdict = Verdict()
    judge(verdict, home, run, reference, controller_kills=0)
    done["runs"] += 1
    if verdict.violations:  # the volume goes: its logs are kept for whoever looks
        shutil.copytree(run.path / "logs", home.path / f"logs-of-{run.name}")
    return verdict


def _went_on(home: Home, run: Run, before: int) -> bool:
    return reached(run, 1) > before or _is_over(home, run)


def _is_over(home: Home, run: Run) -> bool:
    return home.jobs(run.name)[-1]["status"] in ("SUCCEEDED", "FAILED")
