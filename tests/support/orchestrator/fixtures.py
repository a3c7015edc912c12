"""A controller with its server in the test's own process, where a test may look inside."""

from __future__ import annotations

from collections.abc import Iterator

import httpx
import pytest

from orchestrator.server import Server


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
