"""A real PostgreSQL server of the test session's own, from the distribution's packages."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psycopg

from tests.support.hosts import free_ports
from tests.support.waiting import PATIENCE

_SECONDS = 60 * PATIENCE
"""In which the server starts or stops."""


def programs() -> Path | None:
    """Directory of ``initdb`` and ``pg_ctl``; None where PostgreSQL is not installed."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/pg_ctl"))
    on_path = shutil.which("pg_ctl")
    return found[-1].parent if found else Path(on_path).parent if on_path else None


@contextmanager
def serving(binaries: Path) -> Iterator[Server]:
    """Start a server; stopped and deleted at the end."""
    directory = Path(tempfile.mkdtemp(prefix="muster-postgres-"))
    if os.geteuid() == 0:  # it refuses to run as root
        shutil.chown(directory, "postgres", "postgres")
    [port] = free_ports(1)
    # Without fsync a start after a crash does not write all of its files to the disk first, which takes minutes on a busy one.
    data, options = directory / "data", f"-p {port} -k {directory} -c listen_addresses=127.0.0.1 -c fsync=off"
    _as_postgres(str(binaries / "initdb"), "-D", str(data), "-A", "trust", "-U", "muster", "--no-sync")
    control = [str(binaries / "pg_ctl"), "-D", str(data), "-w", "-t", str(_SECONDS)]
    start = [*control, "-l", str(directory / "log"), "-o", options, "start"]
    _as_postgres(*start)
    try:
        yield Server(port, start, [*control, "-m", "immediate", "stop"])
    finally:
        _as_postgres(*control, "-m", "immediate", "stop")
        shutil.rmtree(directory, ignore_errors=True)


class Server:
    """A server that listens on loopback, and lets in anybody."""

    def __init__(self, port: int, start: list[str], stop: list[str]) -> None:
        self.port, self._start, self._stop = port, start, stop

    @contextmanager
    def absent(self) -> Iterator[None]:
        """It crashes, and is started again at the end."""
        _as_postgres(*self._stop)
        try:
            yield
        finally:
            _as_postgres(*self._start)

    def new_database(self) -> str:
        """SQLAlchemy URL of an empty database."""
        name = f"muster_{uuid.uuid4().hex[:12]}"
        with psycopg.connect(host="127.0.0.1", port=self.port, user="muster", dbname="postgres", autocommit=True) as c:
            c.execute(f'CREATE DATABASE "{name}"')
        return f"postgresql+psycopg://muster@127.0.0.1:{self.port}/{name}"


def _as_postgres(*command: str) -> None:
    prefix = ["runuser", "-u", "postgres", "--"] if os.geteuid() == 0 else []
    done = subprocess.run([*prefix, *command], cwd="/", capture_output=True, text=True, timeout=2 * _SECONDS)
    assert done.returncode == 0, done.stdout + done.stderr
