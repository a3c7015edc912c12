"""A small training of the cart-pole through the real command."""

from __future__ import annotations

import json
from typing import Any

from shared_store.volume.layout import Store
from tests.conftest import Serving
from tests.support.waiting import wait_for

SMALL = ["train.worlds=16", "nodes=2", "checkpoint.every=5"]


def changes(*assignments: str) -> list[str]:
    return [part for assignment in (*SMALL, *assignments) for part in ("--set", assignment)]


def submit(server: Serving, *assignments: str) -> dict[str, Any]:
    done = server.muster("submit", "job_specs/cartpole.yaml", "--json", *changes(*assignments))
    assert done.returncode == 0, done.stderr
    return server.detail(json.loads(done.stdout)["jobId"])


def wait_for_iteration(server: Serving, run: str, iteration: int) -> None:
    wait_for(lambda: (raw_iterations(server, run) or [0])[-1] >= iteration, 300, f"iteration {iteration}")


def raw_iterations(server: Serving, run: str) -> list[int]:
    """Every iteration number in every epoch's file, as written."""
    found = []
    for path in sorted(Store(server.home / "store").run(run).metrics.glob("metrics-e*.jsonl")):
        records = [json.loads(line) for line in path.read_text().splitlines()]
        found += [record["iteration"] for record in records if "iteration" in record]
    return found
