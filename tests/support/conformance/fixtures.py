"""A server as AWS's clients see it; what ``make fuzz`` writes down."""

from __future__ import annotations

import os
import platform
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import pytest

from tests.conftest import REPOSITORY, Serving

if TYPE_CHECKING:
    from tests.support.conformance.aws import Batch


@pytest.fixture(scope="module")
def batch(shared_server: Serving) -> Batch:
    from tests.support.conformance.aws import Batch  # boto3, for those that use it

    return Batch(shared_server)


@pytest.fixture(scope="module")
def parked(batch: Batch, request: pytest.FixtureRequest) -> Iterator[str]:
    """A queue whose jobs never start, so that they can be looked at for as long as it takes; ``queues-parked`` in test_queues.py."""
    name = f"{request.module.__name__.rpartition('test_')[2].replace('_', '-')}-parked"
    yield batch.queue(name, batch.compute_environment(name, state="DISABLED"))
    batch.remove([name], [name])


@pytest.fixture(scope="session")
def fuzz_report(request: pytest.FixtureRequest) -> Iterator[Counter[str]]:
    """How many requests of each class were sent; ``make fuzz`` ends with the table in ``benchmarks/fuzz.md``."""
    sent: Counter[str] = Counter()
    yield sent
    if (requested := os.environ.get("MUSTER_FUZZ")) and not request.session.testsfailed:
        rows = "\n".join(f"| {name} | {count:,} |" for name, count in sent.items())
        (REPOSITORY / "benchmarks" / "fuzz.md").write_text(
            f"""# Malformed requests and hostile clients

Written by `make fuzz N={requested}`, {datetime.now(UTC):%Y-%m-%d}, {os.cpu_count()} CPUs, Python {platform.python_version()}.

Every request goes over HTTP to a real server. None may be answered with a 5xx or leave a traceback in the server's log; while a hostile
client is at work, another client must be answered and a job that it submits must run, with 256 descriptors for all of it.

| class | sent |
|---|--:|
{rows}
| **answered with a 5xx, or with harm to others** | **0** |
"""
        )
