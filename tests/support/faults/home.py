"""A home directory with a real ``muster serve`` that is killed and started again, and what its database says."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sqlite3
import subprocess
import time
from pathlib import Path
from typing import Any

from shared_store.volume.layout import Run, Store
from tests.conftest import MUSTER, REPOSITORY, run_muster
from tests.support.waiting import PATIENCE

_START_SECONDS = 60.0
_FRESH_SECONDS = 0.25
"""How long after its last change a hidden directory counts as a commit under way; one takes some 10 ms."""


class Broken(Exception):
    """The product did what it must not do, and the run can't be judged further."""


class Home:
    """``muster serve`` on ``path``, started again whenever it is asked to be there. Not thread-safe: one owner."""

    def __init__(self, path: Path, *options: str, **env: str) -> None:
        """``options`` of ``muster serve``, ``env``: further variables of its environment."""
        self.path, self.options, self.env = path, options, env
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.starts = 0
        self.process: subprocess.Popen[bytes] | None = None

    # -- the controller -----------------------------------------------------------------------------------------------

    @property
    def errors(self) -> Path:
        """What the controllers of this home wrote to stderr, all of them."""
        return self.path / "controllers.err"

    @property
    def _output(self) -> Path:
        return self.path / f"controller-{self.starts}.out"

    @property
    def up(self) -> bool:
        """Whether the controller's process exists, frozen or not."""
        return self.process is not None and self.process.poll() is None

    def start(self) -> None:
        """Start the controller; returns at once."""
        assert not self.up
        self.starts += 1
        with open(self._output, "wb") as message, open(self.errors, "ab") as errors:
            self.process = subprocess.Popen(
                [MUSTER, "serve", "--port", "0", "--cpus", "16", *self.options],
                env={**os.environ, "MUSTER_HOME": str(self.path), **self.env},
                cwd=REPOSITORY,
                stdin=subprocess.DEVNULL,
                stdout=message,
                stderr=errors,
            )

    def serve(self) -> None:
        """Start the controller if need be, and wait until it answers. Raises Broken where it does not."""
        if not self.up:
            self.start()
        deadline = time.monotonic() + _START_SECONDS
        while b"Muster serves " not in self._output.read_bytes():
            if not self.up or time.monotonic() > deadline:
                last = self.errors.read_text(errors="replace").strip().splitlines()[-1:]
                raise Broken(f"`muster serve` did not start again: {last[0] if last else 'it says nothing'}")
            time.sleep(0.02)

    @property
    def url(self) -> str:
        """Where the controller that answered last listens."""
        return self._output.read_text().partition("Muster serves ")[2].split()[0]

    def strike(self, number: int) -> bool:
        """Send signal ``number`` to the controller; after SIGKILL it is gone on return. False where there is none."""
        if not self.up:
            return False
        assert self.process is not None
        self.process.send_signal(number)
        if number == signal.SIGKILL:
            self.process.wait()
        return True

    def close(self) -> None:
        """End the controller in the friendly way."""
        if self.up:
            assert self.process is not None
            self.process.send_signal(signal.SIGCONT)
            self.process.terminate()
            self.process.wait(20 * PATIENCE)

    # -- the command --------------------------------------------------------------------------------------------------

    def command(self, *arguments: str) -> tuple[dict[str, Any] | None, str]:
        """``muster ARGUMENTS --json``: what it printed (None where it refused) and what it wrote to stderr."""
        self.serve()
        done = run_muster(*arguments, "--json", home=self.path, timeout=60)
        return (json.loads(done.stdout) if done.returncode == 0 else None), done.stderr.strip()

    # -- the truths ---------------------------------------------------------------------------------------------------

    def run(self, name: str) -> Run:
        """The run called ``name``."""
        return Store(self.path / "store").run(name)

    def jobs(self, run: str) -> list[dict[str, Any]]:
        """The run's jobs, oldest first, each with its ``attempts``: rows of the database, read without the controller."""
        connection = sqlite3.connect(self.path / "muster.db", timeout=20)
        connection.row_factory = sqlite3.Row
        try:
            jobs = [
                dict(row)
                for row in connection.execute("SELECT * FROM jobs WHERE run = ? ORDER BY created_at, id", (run,))
            ]
            for job in jobs:
                rows = connection.execute("SELECT * FROM attempts WHERE job_id = ? ORDER BY number", (job["id"],))
                job["attempts"] = [dict(row) for row in rows]
            return jobs
        finally:
            connection.close()


def reached(run: Run, epoch: int) -> int:
    """The last iteration that the attempt of ``epoch`` has reported; 0 before its first."""
    try:
        with open(run.metrics / f"metrics-e{epoch}.jsonl", "rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - 4096))
            lines = file.read().split(b"\n")[:-1]
        return int(json.loads(lines[-1]).get("iteration", 0)) if lines else 0
    except (OSError, ValueError):
        return 0


def open_commit(run: Run) -> str | None:
    """Name of a hidden directory of a checkpoint in the making; None where there is none now. One that a killed writer has left
    behind does not count, which its age tells."""
    try:
        for entry in os.listdir(run.checkpoints):
            if entry[1:9].isdigit() and entry.endswith(".tmp"):
                with contextlib.suppress(FileNotFoundError):
                    if time.time() - os.stat(run.checkpoints / entry).st_ctime < _FRESH_SECONDS:
                        return entry
    except FileNotFoundError:
        pass
    return None
