"""A volume that fills up under home, database, store and logs: one class of a torture. Root only: it mounts a small volume."""

from __future__ import annotations

import contextlib
import random
import shutil
import sqlite3
import subprocess
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from orchestrator.client import Client
from orchestrator.domain.errors import ApiError, NotServing
from tests.conftest import submit_gang
from tests.support.faults.home import Home
from tests.support.orchestrator.jobs import await_status, detail
from tests.support.processes import end_all, processes_of_job
from tests.support.waiting import wait_for

OVER = ("SUCCEEDED", "FAILED")
VOLUME = 48 << 20
MOST_LOG = 1 << 20
STEADY = "import time\nfor number in range(6000):\n    print(number, flush=True)\n    time.sleep(0.1)"
FLOOD = "for number in range(20_000):\n    print('y' * 1000)"


@contextlib.contextmanager
def small_volume(directory: Path, size: int = VOLUME) -> Iterator[Path]:
    """A volume of ``size`` bytes at ``directory``; skips where none may be mounted."""
    directory.mkdir(parents=True)
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", directory], capture_output=True, text=True
    )
    if mounted.returncode:
        pytest.skip(f"a volume of its own can't be mounted here: {mounted.stderr.strip()}")
    try:
        yield directory
    finally:
        subprocess.run(["umount", "-l", directory], check=True)


@contextlib.contextmanager
def full_volume(directory: Path) -> Iterator[Path]:
    """A volume at ``directory`` without a free byte, and the file that fills it."""
    with small_volume(directory, 1 << 16):
        yield fill(directory)


def fill(volume: Path) -> Path:
    """Take all the space that is left."""
    filler = volume / "filler"
    with open(filler, "wb", buffering=0) as file:
        for size in (1 << 20, 1 << 12, 1):
            try:
                while True:
                    file.write(b"\0" * size)
            except OSError:
                continue
    return filler


def full_disk_round(directory: Path, seed: int) -> tuple[Counter[str], list[str]]:
    """Fill the volume, ask for everything, make room: a job can always be stopped, and what was taken on ends."""
    rng = random.Random(seed)
    done, wrong = Counter[str](), list[str]()
    with small_volume(directory / "volume") as volume:
        home = Home(volume / "home", "--min-free", "2MiB")
        try:
            home.serve()
            with Client(home.url) as client:
                steady = submit_gang(client, STEADY, name="steady")
                await_status(client, steady, "RUNNING")
                taken = [steady]
                if rng.random() < 0.5:
                    taken.append(submit_gang(client, FLOOD, name="flood"))
                    done["floods"] += 1
                    await_status(client, taken[-1], "STARTING", "RUNNING", *OVER)
                filler = fill(volume)
                done["disks filled"] += 1
                taken += _submit(client, rng.randrange(1, 5), done)
            if rng.random() < 0.4:
                home.strike(9)
                done["controllers killed"] += 1
                with contextlib.suppress(Exception):  # a controller may say that it can't start now
                    home.serve()
            if home.up:
                with Client(home.url) as client:
                    client.batch("TerminateJob", jobId=steady, reason="the disk is full")
                    wait_for(lambda: not processes_of_job(steady), 60, "the steady job has ended")
                    done["jobs stopped"] += 1
            filler.unlink()
            home.serve()
            with Client(home.url) as client:
                if detail(client, steady)["status"] not in OVER:
                    client.batch("TerminateJob", jobId=steady, reason="the disk was full")
                for job in taken:
                    await_status(client, job, *OVER)
                await_status(
                    client, wait_for(lambda: _taken_on(client), 60, "the controller to accept jobs again"), "SUCCEEDED"
                )
                done["jobs"] += len(taken) + 1
            if (output := home.errors.stat().st_size) > MOST_LOG:
                wrong.append(f"the controllers wrote {output} bytes of errors")
            if "Traceback" in home.errors.read_text():
                wrong.append("the controllers wrote a traceback")
            if sqlite3.connect(home.path / "muster.db").execute("PRAGMA integrity_check").fetchone() != ("ok",):
                wrong.append("the database is damaged")
        finally:
            home.close()
            end_all(home.path)
            if wrong:
                shutil.copy(home.errors, directory / "controllers.err")
    return done, wrong


def _taken_on(client: Client) -> str | None:
    """The id of a new job; None while the controller still refuses jobs for lack of space."""
    try:
        return submit_gang(client, "print('again')", name="last")
    except NotServing:
        return None


def _submit(client: Client, count: int, done: Counter[str]) -> list[str]:
    """Jobs that were taken on though there is no room; a refusal has a reason and is not a fault of the server."""
    taken = []
    for _ in range(count):
        try:
            taken.append(submit_gang(client, "print('hello')", name="late"))
        except ApiError as error:
            assert "free" in str(error) or "space" in str(error) or "full" in str(error), error
            assert error.status != 500, error
            done["submissions refused"] += 1
    return taken
