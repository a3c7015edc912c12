"""Clients that mean harm leave a server with few descriptors serving, starting jobs and saying little.

``make test`` sends some of each class, ``make fuzz`` as many as $MUSTER_FUZZ says.
"""

from __future__ import annotations

import os
import random
from collections import Counter
from collections.abc import Iterator

import httpx
import pytest

from tests.conftest import MUSTER
from tests.support.conformance.fuzzed import TOKEN, Fuzzed
from tests.support.conformance.hostile_clients import CLASSES, Target
from tests.support.definitions import container, single

COUNT = int(os.environ.get("MUSTER_FUZZ", "0")) // 10 or 60
DESCRIPTORS = 256
MOST_LOG = 100_000
"""Bytes that the server may log about all of it."""


class FewDescriptors(Fuzzed):
    command = ("prlimit", f"--nofile={DESCRIPTORS}:{DESCRIPTORS}", MUSTER)


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Fuzzed, Target]]:
    """A server that may open few files, and a run of a training that it did not finish."""
    server = FewDescriptors(tmp_path_factory.mktemp("hostile") / "home", "--cpus", "4", "--rate-limit", "0")
    run = server.home / "store" / "runs" / "crafted"
    run.mkdir(parents=True)
    (run / "run.json").write_text(
        '{"run": "crafted", "spec": {"name": "crafted", "train": {"task": "Cartpole", "worlds": 8, "iterations": 9}}}'
    )
    url = httpx.URL(server.url)
    server.client.batch("RegisterJobDefinition", **single("small", container()))
    yield server, Target(url.host, url.port or 0, TOKEN, "crafted", "small")
    server.close()


@pytest.mark.parametrize("name", CLASSES)
def test_others_are_served_during_attacks(target: tuple[Fuzzed, Target], name: str, fuzz_report: Counter[str]) -> None:
    server, victim = target
    before = (server.home.parent / "stderr").stat().st_size
    jobs: list[str] = []

    def meanwhile() -> None:
        assert server.client.get("/healthz") is not None
        jobs.append(server.gang("print('alive')"))
        assert server.wait(jobs[-1])["status"] == "SUCCEEDED"

    rng = random.Random(f"{name} {os.environ.get('MUSTER_FUZZ', '')}")
    count = COUNT if name in ("expansion", "hangs up") else max(COUNT, 2 * DESCRIPTORS)
    sent = CLASSES[name](victim, count, rng, meanwhile)
    assert jobs and server.log(jobs[-1])[0] == "alive"
    output = (server.home.parent / "stderr").stat().st_size - before
    assert output < MOST_LOG, f"the server wrote {output} bytes"
    assert "Traceback" not in server.complaints()
    fuzz_report[f"client: {name}"] += sent
