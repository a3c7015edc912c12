"""The scheduler as the API shows it: why jobs wait, who is next, shares, reservations, preemption; real jobs where they run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import wait_for
from tests.support.conformance.aws import NO_ROOM, PREFIX, UNTIL, Batch, aws, gate, refused


@pytest.fixture
def one_cpu(batch: Batch) -> Iterator[str]:
    """A compute environment of one CPU with two queues, ``q-low`` and ``q-high``."""
    compute_environment = batch.compute_environment("q-one-cpu", cpus=1)
    batch.queue("q-low", compute_environment, priority=1)
    batch.queue("q-high", compute_environment, priority=10)
    yield compute_environment
    batch.remove(["q-low", "q-high"], [compute_environment])


def test_a_disabled_queue_finishes_what_it_has(batch: Batch, one_cpu: str, tmp_path: Path) -> None:
    definition = batch.single("q-finished", UNTIL.format("go"), env={"GATE": str(tmp_path)}, cpus="1")
    jobs = [batch.submit(definition, queue="q-low") for _ in range(2)]
    batch.wait(jobs[0], "RUNNING")
    batch.api.update_job_queue(jobQueue="q-low", state="DISABLED")
    gate(tmp_path, "go")
    assert [batch.wait(job)["status"] for job in jobs] == ["SUCCEEDED", "SUCCEEDED"]


def test_a_deleted_queue_ends_its_jobs_and_stays_until_then(batch: Batch, one_cpu: str, tmp_path: Path) -> None:
    script = f"trap 'touch $GATE/asked' TERM; touch $GATE/ready; {UNTIL.format('go')}"
    definition = batch.single("q-ended", script, env={"GATE": str(tmp_path)}, cpus="1", retryStrategy={"attempts": 2})
    batch.queue("q-ended", one_cpu)
    running, waiting = batch.submit(definition, queue="q-ended"), batch.submit(definition, queue="q-ended")
    wait_for((tmp_path / "ready").exists, what="the trap")
    batch.api.update_job_queue(jobQueue="q-ended", state="DISABLED")
    batch.api.delete_job_queue(jobQueue="q-ended")
    wait_for((tmp_path / "asked").exists, what="SIGTERM")
    [shown] = batch.api.describe_job_queues(jobQueues=["q-ended"])["jobQueues"]
    assert (shown["status"], shown["state"]) == ("DELETING", "DISABLED")
    assert batch.wait(waiting)["attempts"] == []
    gate(tmp_path, "go")
    detail = batch.wait(running)
    assert detail["status"] == "FAILED" and "q-ended" in detail["statusReason"] and len(detail["attempts"]) == 1
    wait_for(lambda: not batch.api.describe_job_queues(jobQueues=["q-ended"])["jobQueues"], what="the queue's end")


def test_a_job_that_waits_says_what_it_needs_and_for_whom_it_waits(batch: Batch, one_cpu: str, tmp_path: Path) -> None:
    holds = batch.single("q-holds", UNTIL.format("go"), env={"GATE": str(tmp_path)}, cpus="1")
    plain, wide = batch.single("q-plain", "true", cpus="0.5"), batch.single("q-wide", "true", cpus="2")
    gang = batch.multinode("q-gang", "true", 3, cpus="500")
    first = batch.submit(holds, queue="q-low")
    batch.wait(first, "RUNNING")
    head = batch.submit(plain, queue="q-low")
    second = batch.submit(plain, queue="q-low")
    too_wide = batch.submit(wide, queue="q-low")
    impossible = batch.submit(gang)
    pending = batch.submit(plain, queue="q-low", dependsOn=[{"jobId": head}])
    needs = "needs 1 node with 0.5 CPUs, 0 GPUs, 64 MiB in all"
    waits = f"{NO_ROOM} - waits for job q-holds ({first[:8]}) to end"
    limit = "compute environment q-one-cpu may use 0 CPUs more at this time"
    assert batch.reason(head, NO_ROOM) == f"{waits}: {limit}; {needs}"
    behind = f"2nd in queue q-low, behind job q-plain ({head[:8]}), which {needs}"
    assert batch.reason(second, "2nd") == behind
    assert batch.reason(too_wide, "MISCONFIGURATION") == (
        "MISCONFIGURATION:COMPUTE_ENVIRONMENT_MAX_RESOURCE - compute environment q-one-cpu has at most 1 CPU; "
        "needs 1 node with 2 CPUs, 0 GPUs, 64 MiB in all"
    )
    output = batch.reason(impossible, "MISCONFIGURATION:JOB_RESOURCE_REQUIREMENT - each node needs 500 CPUs, 0 GPUs, ")
    assert "the largest host has 8 CPUs, " in output
    assert f"({head[:8]})" in batch.reason(pending, "waits for the success of job ")
    page = batch.api.list_jobs(jobQueue="q-low", jobStatus="RUNNABLE")
    listed = {each["jobId"]: each["statusReason"] for each in page["jobSummaryList"]}
    assert set(listed) == {head, second, too_wide} and listed[second] == behind
    batch.api.terminate_job(jobId=impossible, reason="over")
    batch.api.terminate_job(jobId=too_wide, reason="over")
    gate(tmp_path, "go")
    assert [batch.wait(job)["status"] for job in (head, second, pending)] == ["SUCCEEDED"] * 3


def test_a_snapshot_shows_the_next_jobs_and_the_resources_in_use(batch: Batch, one_cpu: str, tmp_path: Path) -> None:
    definition = batch.single("q-snapped", UNTIL.format("go"), env={"GATE": str(tmp_path)}, cpus="1")
    running = batch.submit(definition, queue="q-low")
    batch.wait(running, "RUNNING")
    waiting = [batch.submit(definition, queue="q-low") for _ in range(3)]
    wait_for(lambda: batch.front("q-low") == waiting, what="the order of submission")
    snapshot = batch.api.get_job_queue_snapshot(jobQueue=f"{PREFIX}job-queue/q-low")
    times = [each["earliestTimeAtPosition"] for each in snapshot["frontOfQueue"]["jobs"]]
    assert all(time >= batch.describe(job)["createdAt"] for time, job in zip(times, waiting, strict=True))
    usage = snapshot["queueUtilization"]["totalCapacityUsage"]
    assert {"capacityUnit": "VCPU", "quantity": 1.0} in usage
    typed = aws(batch.server.url, "batch", "get-job-queue-snapshot", "--job-queue", "q-low")
    assert [each["jobArn"] for each in typed["frontOfQueue"]["jobs"]] == [f"{PREFIX}job/{job}" for job in waiting]
    gate(tmp_path, "go")
    ended = [batch.wait(job) for job in (running, *waiting)]
    assert [each["startedAt"] for each in ended] == sorted(each["startedAt"] for each in ended)
    assert batch.front("q-low") == []
    with refused("q-none does not exist"):
        batch.api.get_job_queue_snapshot(jobQueue="q-none")


def test_shares_take_turns_by_weight_and_priority_counts_within_one(batch: Batch) -> None:
    """Equal jobs of three shares that used nothing yet: the share with half the weight factor comes twice as often."""
    compute_environment = batch.compute_environment("q-shares", state="DISABLED")
    fair = {"shareDistribution": [{"shareIdentifier": "Heavy*", "weightFactor": 0.5}]}
    policy = batch.api.create_scheduling_policy(name="q-shares", fairsharePolicy=fair)["arn"]
    batch.queue("q-shares", compute_environment, schedulingPolicyArn=policy)
    definition = batch.single("q-share", "true", cpus="1", schedulingPriority=5)
    with refused("give a shareIdentifier"):
        batch.submit(definition, queue="q-shares")
    with refused("1 to 255 letters and digits"):
        batch.submit(definition, queue="q-shares", shareIdentifier="a b")
    for share in ("*", "A**", "A*1", "A" * 256):
        with refused("1 to 255 letters and digits, a * at the end at most"):
            batch.submit(definition, queue="q-shares", shareIdentifier=share)
    with refused("must be 0 to 9999"):
        batch.submit(definition, queue="q-shares", shareIdentifier="A", schedulingPriorityOverride=10000)
    shares: dict[str, str] = {}
    for share in ["Light"] * 4 + ["Heavy1*"] * 8:  # AWS's reference allows an asterisk at the end
        shares[batch.submit(definition, queue="q-shares", shareIdentifier=share)] = share
    urgent = batch.submit(definition, queue="q-shares", shareIdentifier="Light", schedulingPriorityOverride=6)
    shares[urgent] = "Light"
    wait_for(lambda: len(batch.front("q-shares")) == 13, what="all in the order")
    order = batch.front("q-shares")
    for length in (3, 6, 9, 12):
        assert [shares[job] for job in order[:length]].count("Light") == length // 3
    light = [job for job in order if shares[job] == "Light"]
    rest = [job for job in shares if shares[job] == "Light" and job != urgent]
    assert light == [urgent, *rest], "the higher priority first, then the older"
    detail = batch.describe(urgent)
    assert (detail["shareIdentifier"], detail["schedulingPriority"]) == ("Light", 6)
    heavy = next(job for job in order if shares[job] == "Heavy1*")
    assert batch.describe(heavy)["shareIdentifier"] == "Heavy1*"
    assert batch.describe(rest[0])["schedulingPriority"] == 5, "the definition's"
    found = batch.api.list_jobs(jobQueue="q-shares", filters=[{"name": "SHARE_IDENTIFIER", "values": ["Light"]}])
    assert [each["jobId"] for each in found["jobSummaryList"]] == [urgent, *reversed(rest)]
    assert {each["shareIdentifier"] for each in found["jobSummaryList"]} == {"Light"}
    batch.remove(["q-shares"], [compute_environment])
    batch.api.delete_scheduling_policy(arn=policy)


def test_the_share_with_less_use_goes_first_and_a_reservation_is_kept_free(batch: Batch, tmp_path: Path) -> None:
    """Of 4 CPUs a reservation of 50 keeps half for others while one share is active, a quarter while two are."""
    compute_environment = batch.compute_environment("q-used", cpus=4)
    policy = batch.api.create_scheduling_policy(name="q-used", fairsharePolicy={"computeReservation": 50})["arn"]
    batch.queue("q-used", compute_environment, schedulingPolicyArn=policy)
    definition = batch.single("q-user", UNTIL.format("go"), env={"GATE": str(tmp_path)}, cpus="1")
    mine = [batch.submit(definition, queue="q-used", shareIdentifier="mine") for _ in range(4)]
    for job in mine[:2]:
        batch.wait(job, "RUNNING")
    assert "uses 2 of the 2 CPUs that it may use of q-used" in batch.reason(mine[2], "active share")
    yours = [batch.submit(definition, queue="q-used", shareIdentifier="yours") for _ in range(2)]
    batch.wait(
        yours[0], "RUNNING"
    )  # the third of three CPUs goes to the share that has used less, though it came later
    wait_for(lambda: len(batch.front("q-used")) == 3, what="three that wait")
    assert "uses 3 of the 3 CPUs" in batch.reason(mine[2], "2 active shares")
    shown = batch.api.get_job_queue_snapshot(jobQueue="q-used")["queueUtilization"]["fairshareUtilization"]
    used = {each["shareIdentifier"]: each["capacityUsage"] for each in shown["topCapacityUtilization"]}
    held = {share: next(u["quantity"] for u in units if u["capacityUnit"] == "VCPU") for share, units in used.items()}
    assert held == {"mine": 2.0, "yours": 1.0} and shown["activeShareCount"] == 2
    gate(tmp_path, "go")
    assert {batch.wait(job)["status"] for job in (*mine, *yours)} == {"SUCCEEDED"}
    batch.remove(["q-used"], [compute_environment])
    batch.api.delete_scheduling_policy(arn=policy)


def test_a_preemptible_job_makes_way_and_spends_no_attempt(batch: Batch, one_cpu: str, tmp_path: Path) -> None:
    """Two attempts are allowed. The first launch is preempted, the second fails, so that the third is the second that counts."""
    script = f"""
trap 'echo checkpointed; exit 75' TERM
echo attempt $AWS_BATCH_JOB_ATTEMPT
case $AWS_BATCH_JOB_ATTEMPT in 1) {UNTIL.format("never")};; 2) [ $AWS_BATCH_JOB_NODE_INDEX = 0 ] && exit 1; {UNTIL.format("never")};; esac
"""
    native = {"MUSTER_ON_CHILD_FAILURE": "restart", "MUSTER_PREEMPTIBLE": "1", "GATE": str(tmp_path)}
    definition = batch.multinode("q-preempted", script, 2, env=native, cpus="0.5", retryStrategy={"attempts": 2})
    low = batch.submit(definition, queue="q-low")
    wait_for(lambda: all(batch.lines(f"{low}#{node}") == ["attempt 1"] for node in range(2)), what="both traps")
    urgent = batch.single("q-urgent", UNTIL.format("go"), env={"GATE": str(tmp_path)}, cpus="1")
    high = batch.submit(urgent, queue="q-high")
    batch.wait(high, "RUNNING")
    waiting = batch.wait(low, "RUNNABLE")
    [attempt] = waiting["attempts"]
    assert attempt["statusReason"] == f"preempted by job q-urgent ({high[:8]})"
    assert attempt["container"]["exitCode"] == 75
    assert f"waits for job q-urgent ({high[:8]}) to end: " in batch.reason(low, NO_ROOM)
    assert batch.front("q-low") == [low]
    gate(tmp_path, "go")
    assert batch.wait(high)["status"] == "SUCCEEDED"
    detail = batch.wait(low)
    assert detail["status"] == "SUCCEEDED", "the first one did not count"
    assert [each["container"]["exitCode"] for each in detail["attempts"]] == [75, 1, 0]
    first = batch.stream(attempt["container"]["logStreamName"])
    assert "attempt 1" in first and "checkpointed" in first and batch.lines(low) == ["attempt 3"]
