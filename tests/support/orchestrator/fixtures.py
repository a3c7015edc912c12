"""Controllers: in the test's own process, where it may look inside; without room for another job; databases of both kinds."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from orchestrator.server import Server
from tests.conftest import Serving
from tests.support.orchestrator import postgres
from tests.support.orchestrator.jobs import FOREVER


@pytest.fixture(scope="session")
def inside(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """One for the tests that neither kill it nor need its hosts."""
    server = Server(tmp_path_factory.mktemp("inside"), cpus=1)
    server.start()
    yield server
    server.close()


@pytest.fixture(scope="session")
def http(inside: Server) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=inside.url, timeout=60) as client:
        yield client


@pytest.fixture(scope="session")
def postgresql() -> Iterator[postgres.Server]:
    binaries = postgres.programs()
    if binaries is None:
        pytest.skip("PostgreSQL is not installed: apt-get install postgresql")
    with postgres.serving(binaries) as running:
        yield running


@pytest.fixture(params=["sqlite", "postgresql"])
def database_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """A database without tables, on each kind of server."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'muster.db'}"
    return str(request.getfixturevalue("postgresql").new_database())


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    """A server whose only CPU is taken: what is submitted waits."""
    with Serving(tmp_path_factory.mktemp("home"), "--cpus", "1") as server:
        server.wait(server.gang(FOREVER, cpus="1", name="blocker"), "RUNNING")
        yield server
