"""Memory beyond a job's limit on the engine local: as on AWS, for each node by itself."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from shared_store.process.cgroups import own_group
from shared_store.process.memory_groups import memory_home
from tests.support.conformance.aws import EXITED, Batch
from tests.support.waiting import wait_for

pytestmark = pytest.mark.skipif(
    not memory_home(own_group(), arrange=True), reason="memory can't be limited here: run the tests as root"
)
NEEDED, REASON = "64", "OutOfMemoryError: Container killed due to memory usage"
NEEDS = [{"type": "VCPU", "value": "0.1"}, {"type": "MEMORY", "value": NEEDED}]
GROW = f"{sys.executable} -c 'x = bytearray(300 << 20); print(len(x))'"
PART = f"{sys.executable} -c 'import time; x = bytearray(30 << 20); time.sleep(600)'"


def end_of(container: dict[str, Any]) -> tuple[Any, Any]:
    return container.get("exitCode"), container.get("reason")


@pytest.fixture(autouse=True)
def nothing_is_left(batch: Batch) -> Iterator[None]:
    """No memory group of a job of these tests."""
    yield
    home, named = memory_home(own_group()), [{"name": "JOB_NAME", "values": ["mem-*"]}]
    jobs = [each["jobId"] for each in batch.api.list_jobs(jobQueue="default", filters=named)["jobSummaryList"]]
    assert jobs
    wait_for(lambda: not [name for name in os.listdir(home) if any(job in name for job in jobs)], 30, "no group")


@pytest.mark.parametrize(
    "script",
    [
        f"exec {GROW}",
        f"{GROW}; echo no matter what comes after; exit 0",
        f"for i in 1 2 3 4; do {PART} & done; wait; exit 0",
        f"setsid {GROW} & sleep 600",
    ],
    ids=["the program", "a child", "all together", "a process that left the session"],
)
def test_a_job_that_uses_more_than_its_memory_fails_as_on_aws(batch: Batch, script: str) -> None:
    job = batch.submit(batch.single("mem-more", script, container={"resourceRequirements": NEEDS}))
    detail = batch.wait(job)
    assert (detail["status"], detail["statusReason"]) == ("FAILED", EXITED)
    assert end_of(detail["container"]) == end_of(detail["attempts"][0]["container"]) == (137, REASON)


def test_a_job_within_its_memory_is_left_alone_whatever_it_reads(batch: Batch) -> None:
    script = f"head -c 300000000 /dev/zero > big; cat big > /dev/null; {GROW.replace('300', '20')}"
    job = batch.submit(batch.single("mem-less", script, container={"resourceRequirements": NEEDS}))
    detail = batch.wait(job)
    assert (detail["status"], end_of(detail["container"])) == ("SUCCEEDED", (0, None))


def test_out_of_memory_can_be_retried_by_its_reason(batch: Batch) -> None:
    rules = [{"onReason": "OutOfMemoryError*", "action": "RETRY"}, {"onReason": "*", "action": "EXIT"}]
    script = f'[ "$AWS_BATCH_JOB_ATTEMPT" = 1 ] && exec {GROW}; exit 5'
    definition = batch.single("mem-retry", script, container={"resourceRequirements": NEEDS})
    detail = batch.wait(batch.submit(definition, retryStrategy={"attempts": 3, "evaluateOnExit": rules}))
    assert [end_of(each["container"]) for each in detail["attempts"]] == [(137, REASON), (5, None)]


def test_each_node_of_a_gang_has_its_own_limit(batch: Batch, tmp_path: Path) -> None:
    script = (
        f'[ "$AWS_BATCH_JOB_NODE_INDEX" = 1 ] && exec {GROW}; '
        f"{GROW.replace('300', '20')}; until [ -e $GATE/go ]; do sleep 0.05; done"
    )
    container = {"resourceRequirements": NEEDS}
    job = batch.submit(batch.multinode("mem-gang", script, env={"GATE": str(tmp_path)}, container=container))
    child = batch.wait(f"{job}#1", "FAILED")
    assert end_of(child["container"]) == (137, REASON)
    assert batch.describe(job)["status"] == "RUNNING", "a child's end changes nothing"
    (tmp_path / "go").touch()
    assert batch.wait(job)["status"] == "SUCCEEDED"
    assert end_of(batch.describe(f"{job}#0")["container"]) == (0, None)


def test_a_job_of_muster_s_own_is_not_limited(batch: Batch) -> None:
    ours = {"MUSTER_ON_CHILD_FAILURE": "restart"}
    job = batch.submit(batch.single("mem-ours", GROW, env=ours, container={"resourceRequirements": NEEDS}))
    assert batch.wait(job)["status"] == "SUCCEEDED"
