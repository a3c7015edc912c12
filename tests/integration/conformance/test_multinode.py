"""Multi-node parallel jobs to the letter (reference §3.2, §3.3, §3.5, §8.3 to §8.7): real gangs, seen through boto3."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import wait_for
from tests.support.conformance.aws import EXITED, UNTIL, Batch, aws, gate, pairs, refused
from tests.support.processes import processes_of_job

NODE = "$AWS_BATCH_JOB_NODE_INDEX"
ADDRESS = "AWS_BATCH_JOB_MAIN_NODE_PRIVATE_IPV4_ADDRESS"
STAY = "while :; do sleep 0.05; done"


@pytest.fixture
def queue(batch: Batch) -> Iterator[str]:
    """A queue whose compute environment a test may disable, so that nothing new starts while it looks."""
    yield batch.queue("mnp-held", batch.compute_environment("mnp-held"))
    batch.remove(["mnp-held"], ["mnp-held"])


@pytest.fixture(scope="module", autouse=True)
def overdue(batch: Batch) -> Iterator[str]:
    """A job past its timeout whose main node does not heed SIGTERM: killed 30 s later, while the other tests run.

    The API takes no timeout below 60 s, so the start of its attempt is set back in the database instead of waiting.
    """
    script = f'trap "echo asked to leave" TERM; echo ready; [ {NODE} = 0 ] || exec sleep 600; {STAY}'
    limits = {"timeout": {"attemptDurationSeconds": 60}, "retryStrategy": {"attempts": 3}}
    definition = batch.multinode("mnp-overdue", script, **limits)
    job = batch.submit(definition)
    batch.wait(job, "RUNNING")
    wait_for(lambda: "ready" in batch.lines(job), what="the trap")
    age(batch, job, 60)
    yield job
    batch.wait(job)


def age(batch: Batch, job: str, seconds: int) -> None:
    """Make a running attempt so much older: its start is set back in the database."""
    with sqlite3.connect(batch.server.home / "muster.db", timeout=30) as database:
        older = "UPDATE attempts SET running_since = running_since - ? WHERE job_id = ? AND running_since IS NOT NULL"
        assert database.execute(older, [seconds * 1000, job]).rowcount == 1


def children(batch: Batch, job: str, **query: Any) -> dict[int, dict[str, Any]]:
    """The nodes of a job as ListJobs shows them, by index."""
    listed = batch.api.list_jobs(multiNodeJobId=job, **query)["jobSummaryList"]
    return {each["nodeProperties"]["nodeIndex"]: each for each in listed}


# -- the environment --------------------------------------------------------------------------------------------------


def test_every_node_has_the_variables_of_aws_and_no_other(batch: Batch, tmp_path: Path) -> None:
    """Three nodes by an override of two; node 1 is the main node, and leaves when the others are done."""
    script = f"""
env | grep -E '^AWS_(BATCH|EXECUTION)' | sort
read -r _ _ _ shim _ < /proc/$PPID/stat
read -r _ _ _ _ _ _ _ _ _ _ _ _ _ _ _ _ _ _ _ _ _ started _ < /proc/$shim/stat; echo started $started $shim
touch "$GATE/{NODE}"
[ {NODE} = 1 ] || exit 0
{UNTIL.format(0)}; {UNTIL.format(2)}; exit 3
"""
    definition = batch.multinode("mnp-variables", script, 2, main=1, env={"GATE": str(tmp_path)})
    job = batch.submit(definition, nodeOverrides={"numNodes": 3})
    parent = batch.wait(job)
    [attempt] = parent["attempts"]
    address = attempt["container"]["networkInterfaces"][0]["privateIpv4Address"]
    output = [batch.lines(f"{job}#{node}") for node in range(3)]
    for node in range(3):
        variables = dict(line.split("=", 1) for line in output[node] if line.startswith("AWS_"))
        expected = {
            "AWS_BATCH_JOB_ID": f"{job}#{node}",
            "AWS_BATCH_JOB_ATTEMPT": "1",
            "AWS_BATCH_CE_NAME": "local",
            "AWS_BATCH_JQ_NAME": "default",
            "AWS_BATCH_JOB_NODE_INDEX": str(node),
            "AWS_BATCH_JOB_NUM_NODES": "3",
            "AWS_BATCH_JOB_MAIN_NODE_INDEX": "1",
            ADDRESS: address,
        }
        if node == 1:
            del expected[ADDRESS]  # clients tell by its absence that they are the main node
        assert variables.pop("AWS_EXECUTION_ENV"), "Metaflow reads it unguarded"
        assert variables == expected
    # the main node is started first, whatever its index: ticks since boot, then process ids where they are equal
    starts = [tuple(map(int, line.split()[1:])) for lines in output for line in lines if line.startswith("started")]
    assert len(starts) == 3 and min(starts) == starts[1]
    # the parent shows the main node's end, which is not node 0 here
    assert (parent["status"], parent["statusReason"]) == ("FAILED", EXITED)
    assert attempt["container"]["exitCode"] == 3 and attempt["statusReason"] == EXITED
    assert attempt["startedAt"] == parent["startedAt"] <= attempt["stoppedAt"] <= parent["stoppedAt"]
    assert parent["nodeProperties"]["numNodes"] == 3 and parent["nodeProperties"]["mainNode"] == 1
    by_name = batch.api.list_jobs(jobQueue="default", filters=[{"name": "JOB_NAME", "values": ["mnp-variables"]}])
    assert by_name["jobSummaryList"][0]["container"]["exitCode"] == 3
    assert [batch.describe(f"{job}#{node}")["container"]["exitCode"] for node in range(3)] == [0, 3, 0]


# -- addresses and shapes ---------------------------------------------------------------------------------------------


def test_a_parent_has_no_container_and_its_nodes_have_one(batch: Batch) -> None:
    job = batch.submit(batch.multinode("mnp-shapes", "echo here", 2, env={"A": "1"}), tags={"who": "me"})
    arn = f"arn:aws:batch:us-east-1:000000000000:job/{job}"
    parent = batch.wait(job)
    assert "container" not in parent and "nodeDetails" not in parent, "Metaflow and redun branch on this"
    assert (parent["jobId"], parent["jobArn"], parent["jobName"]) == (job, arn, "mnp-shapes")
    assert parent["jobQueue"].endswith(":job-queue/default") and parent["tags"] == {"who": "me"}
    assert parent["createdAt"] <= parent["startedAt"] <= parent["stoppedAt"]
    assert (parent["isCancelled"], parent["isTerminated"]) == (False, False)
    main = batch.describe(f"{job}#0")
    assert main == batch.describe(f"{arn}#0"), "TorchX asks by ARN"
    assert (main["jobId"], main["jobArn"]) == (f"{job}#0", f"{arn}#0") and "nodeProperties" not in main
    assert main["nodeDetails"] == {"nodeIndex": 0, "isMainNode": True} and main["status"] == "SUCCEEDED"
    expected = {"image": "any", "command": ["sh", "-c", "echo here"], "environment": pairs({"A": "1"}), "exitCode": 0}
    assert {key: main["container"][key] for key in expected} == expected
    for key in ("logStreamName", "taskArn", "containerInstanceArn", "networkInterfaces"):
        assert main["container"][key], key
    assert main["attempts"][0]["container"]["logStreamName"] == main["container"]["logStreamName"]
    assert batch.describe(f"{arn}#1")["nodeDetails"] == {"nodeIndex": 1, "isMainNode": False}
    streams = {batch.describe(each)["container"]["logStreamName"] for each in (f"{job}#0", f"{job}#1")}
    assert len(streams) == 2
    assert batch.describe(arn) == batch.describe(job)
    # unknown ones are passed over, the others stay in the order in which they were asked for
    requested = ["no-such-job", f"{job}#1", f"{job}#2", f"{job}#x", f"{job}:0", job, f"{arn}#99999999999", f"{job}#"]
    assert [each["jobId"] for each in batch.api.describe_jobs(jobs=requested)["jobs"]] == [f"{job}#1", job]
    assert batch.api.describe_jobs(jobs=["no-such-job"])["jobs"] == []
    assert len(batch.api.describe_jobs(jobs=[job] * 100)["jobs"]) == 100
    with refused("at most 100"):
        batch.api.describe_jobs(jobs=[job] * 101)


def test_nodes_are_listed_with_their_index(batch: Batch, tmp_path: Path) -> None:
    script = f"[ {NODE} != 0 ] || {UNTIL.format('go')}"
    job = batch.submit(batch.multinode("mnp-listed", script, 3, env={"GATE": str(tmp_path)}))
    for node in (1, 2):
        assert batch.wait(f"{job}#{node}")["status"] == "SUCCEEDED"
    gate(tmp_path, "go")
    batch.wait(job)
    assert batch.api.list_jobs(multiNodeJobId=job)["jobSummaryList"] == [], "without a status: those that run"
    listed = batch.api.list_jobs(multiNodeJobId=job, jobStatus="SUCCEEDED")["jobSummaryList"]
    assert [each["jobId"] for each in listed] == [f"{job}#{node}" for node in range(3)]
    shown = [{"isMainNode": node == 0, "numNodes": 3, "nodeIndex": node} for node in range(3)]
    assert [each["nodeProperties"] for each in listed] == shown
    query = {"multiNodeJobId": job, "jobStatus": "SUCCEEDED", "PaginationConfig": {"PageSize": 2}}
    pages = batch.api.get_paginator("list_jobs").paginate(**query)
    sizes = [[each["nodeProperties"]["nodeIndex"] for each in page["jobSummaryList"]] for page in pages]
    assert sizes == [[0, 1], [2]]
    for query in ({}, {"jobQueue": "default", "multiNodeJobId": job}, {"arrayJobId": job, "multiNodeJobId": job}):
        with refused("exactly one of"):
            batch.api.list_jobs(**query)


# -- lives and deaths -------------------------------------------------------------------------------------------------


def test_the_main_nodes_end_ends_the_job_and_stops_its_children(batch: Batch, tmp_path: Path) -> None:
    script = f"""
if [ {NODE} = 0 ]; then {UNTIL.format("go")}; exit 0; fi
trap 'echo asked to stop; exit 0' TERM; touch "$GATE/child"; {STAY}
"""
    job = batch.submit(batch.multinode("mnp-main-ends", script, env={"GATE": str(tmp_path)}))
    wait_for((tmp_path / "child").exists, what="the child's trap")
    gate(tmp_path, "go")
    detail = batch.wait(job)
    assert (detail["status"], detail["statusReason"]) == ("SUCCEEDED", EXITED)
    assert detail["attempts"][0]["container"]["exitCode"] == 0
    assert "asked to stop" in batch.lines(f"{job}#1") and not processes_of_job(job)


def test_a_childs_death_changes_nothing(batch: Batch, tmp_path: Path) -> None:
    script = f"[ {NODE} = 0 ] || exit 1; {UNTIL.format('go')}"
    definition = batch.multinode("mnp-child-dies", script, 3, env={"GATE": str(tmp_path)})
    job = batch.submit(definition, retryStrategy={"attempts": 3})
    for node in (1, 2):
        assert batch.wait(f"{job}#{node}")["container"]["exitCode"] == 1
    assert list(children(batch, job)) == [0] and list(children(batch, job, jobStatus="FAILED")) == [1, 2]
    parent, ended, other = batch.describe(job), batch.describe(f"{job}#1"), batch.describe(f"{job}#0")
    assert parent["status"] == "RUNNING" and parent["attempts"] == other["attempts"] == [] and "stoppedAt" not in other
    [attempt] = ended["attempts"]
    assert (ended["status"], ended["statusReason"]) == ("FAILED", EXITED), "what it has of its own while others run"
    assert ended["startedAt"] <= ended["stoppedAt"] == attempt["stoppedAt"] and attempt["statusReason"] == EXITED
    assert attempt["container"]["exitCode"] == 1 and attempt["container"]["logStreamName"]
    running = batch.api.list_jobs(jobQueue="default")["jobSummaryList"]
    assert job in [each["jobId"] for each in running], "without a status: what runs"
    gate(tmp_path, "go")
    detail = batch.wait(job)
    assert detail["status"] == "SUCCEEDED" and len(detail["attempts"]) == 1
    assert job not in [each["jobId"] for each in batch.api.list_jobs(jobQueue="default")["jobSummaryList"]]


def test_a_failure_of_the_main_node_starts_the_whole_gang_again(batch: Batch, queue: str, tmp_path: Path) -> None:
    script = f"""
echo attempt $AWS_BATCH_JOB_ATTEMPT
[ {NODE} = 0 ] || exec sleep 600
{UNTIL.format("go")}
[ $AWS_BATCH_JOB_ATTEMPT = 2 ] && {UNTIL.format("done")}
[ $AWS_BATCH_JOB_ATTEMPT = 2 ]
"""
    definition = batch.multinode("mnp-retried", script, env={"GATE": str(tmp_path)}, retryStrategy={"attempts": 2})
    job = batch.submit(definition, queue=queue)
    wait_for(lambda: batch.wait(job, "RUNNING") and "attempt 1" in batch.lines(f"{job}#1"), what="the first attempt")
    batch.api.update_compute_environment(computeEnvironment=queue, state="DISABLED")
    gate(tmp_path, "go")
    batch.wait(job, "RUNNABLE")
    batch.reason(job, "ACTION_REQUIRED - CE(s) associated with the job queue are invalid.")
    between = batch.describe(job)
    assert [attempt["container"]["exitCode"] for attempt in between["attempts"]] == [1]
    assert list(children(batch, job, jobStatus="RUNNABLE")) == [0, 1], "no node of it runs or has ended"
    batch.api.update_compute_environment(computeEnvironment=queue, state="ENABLED")
    wait_for(lambda: batch.wait(job, "RUNNING") and "attempt 2" in batch.lines(f"{job}#1"), what="the second attempt")
    gate(tmp_path, "done")
    detail = batch.wait(job)
    first, second = detail["attempts"]
    assert detail["status"] == "SUCCEEDED"
    assert (first["container"]["exitCode"], second["container"]["exitCode"]) == (1, 0)
    assert first["startedAt"] <= first["stoppedAt"] <= second["startedAt"] <= second["stoppedAt"]
    assert first["statusReason"] == EXITED
    for node in range(2):
        attempts = batch.describe(f"{job}#{node}")["attempts"]
        output = [batch.stream(attempt["container"]["logStreamName"])[0] for attempt in attempts]
        assert output == ["attempt 1", "attempt 2"]
    assert not processes_of_job(job)


@pytest.mark.parametrize("code", [1, 75])
def test_without_attempts_left_any_code_of_the_main_node_is_a_failure(batch: Batch, code: int, tmp_path: Path) -> None:
    """75 means "requeue me" in our own jobs only (there after 10 s at the soonest, and this one is older)."""
    script = f"{UNTIL.format('go')}; exit {code}"
    job = batch.submit(batch.multinode(f"mnp-exits-{code}", script, 1, env={"GATE": str(tmp_path)}))
    batch.wait(job, "RUNNING")
    age(batch, job, 20)
    gate(tmp_path, "go")
    detail = batch.wait(job)
    assert (detail["status"], detail["statusReason"]) == ("FAILED", EXITED)
    assert [attempt["container"]["exitCode"] for attempt in detail["attempts"]] == [code]


# -- stopping ---------------------------------------------------------------------------------------------------------


def test_terminate_ends_a_running_job_for_good(batch: Batch) -> None:
    script = f"trap 'echo asked to stop; exit 0' TERM; echo ready; {STAY}"
    job = batch.submit(batch.multinode("mnp-terminated", script, retryStrategy={"attempts": 3}))
    batch.wait(job, "RUNNING")
    wait_for(lambda: all("ready" in batch.lines(f"{job}#{node}") for node in range(2)), what="both traps")
    arn = f"arn:aws:batch:us-east-1:000000000000:job/{job}"
    with refused("single node"):
        batch.api.terminate_job(jobId=f"{job}#1", reason="x")
    aws(batch.server.url, "batch", "terminate-job", "--job-id", arn, "--reason", "enough of it")
    detail = batch.wait(job)
    assert (detail["status"], detail["statusReason"]) == ("FAILED", "enough of it")
    assert (detail["isTerminated"], detail["isCancelled"]) == (True, False)
    assert len(detail["attempts"]) == 1, "no retry"
    assert all("asked to stop" in batch.lines(f"{job}#{node}") for node in range(2)) and not processes_of_job(job)
    batch.api.terminate_job(jobId=arn, reason="again")  # over is over
    assert batch.describe(job)["statusReason"] == "enough of it"


def test_cancel_leaves_a_running_job_alone(batch: Batch, tmp_path: Path) -> None:
    job = batch.submit(batch.multinode("mnp-not-cancelled", UNTIL.format("go"), env={"GATE": str(tmp_path)}))
    batch.wait(job, "RUNNING")
    answer = batch.api.cancel_job(jobId=job, reason="too late")
    assert answer["ResponseMetadata"]["HTTPStatusCode"] == 200
    gate(tmp_path, "go")
    detail = batch.wait(job)
    assert (detail["status"], detail["isCancelled"], detail["isTerminated"]) == ("SUCCEEDED", False, False)
    assert detail["statusReason"] == EXITED


def test_a_job_that_has_not_started_is_cancelled_by_either_operation(batch: Batch, queue: str) -> None:
    batch.api.update_compute_environment(computeEnvironment=queue, state="DISABLED")
    definition = batch.multinode("mnp-cancelled", "true", retryStrategy={"attempts": 3})
    runnable, other = batch.submit(definition, queue=queue), batch.submit(definition, queue=queue)
    pending = batch.submit(definition, queue=queue, dependsOn=[{"jobId": other}])
    after = batch.submit(definition, queue=queue, dependsOn=[{"jobId": pending}])
    batch.wait(runnable, "RUNNABLE")
    assert batch.wait(pending, "PENDING")["statusReason"] == f"waits for the success of job mnp-cancelled ({other[:8]})"
    for job in (runnable, pending):
        batch.api.cancel_job(jobId=job, reason="changed my mind")
    for job in (runnable, pending):
        detail = batch.wait(job)
        assert (detail["status"], detail["statusReason"]) == ("FAILED", "changed my mind")
        assert detail["isCancelled"] is True and detail["attempts"] == []
        assert "startedAt" not in detail and detail["stoppedAt"] >= detail["createdAt"]
    assert batch.wait(after)["statusReason"] == f"Dependent Job failed: {pending}"
    batch.api.terminate_job(jobId=other, reason="and this one")
    detail = batch.wait(other)
    assert (detail["status"], detail["statusReason"], detail["attempts"]) == ("FAILED", "and this one", [])


def test_many_jobs_are_ended_at_once_each_with_its_own_result(batch: Batch, queue: str, tmp_path: Path) -> None:
    batch.api.update_compute_environment(computeEnvironment=queue, state="DISABLED")
    definition = batch.multinode("mnp-bulk", UNTIL.format("go"), 1, env={"GATE": str(tmp_path)})
    waiting = [batch.submit(definition, queue=queue) for _ in range(3)]
    running = batch.submit(definition)
    batch.wait(running, "RUNNING")
    foreign = "arn:aws:batch:eu-west-1:123456789012:job/6c4a7d0e-0000-4000-8000-000000000000"
    answer = batch.api.cancel_jobs(jobs=[*waiting[:2], running, "no-such-job", foreign, f"{running}#0"], reason="bulk")
    assert answer["successful"] == [*waiting[:2], running, "no-such-job"], "AWS counts unknown jobs as done"
    assert [(each["job"], each["code"]) for each in answer["errors"]] == [
        (foreign, "ValidationException"),
        (f"{running}#0", "ValidationException"),
    ]
    assert "not an ARN of this controller" in answer["errors"][0]["message"]
    assert [batch.wait(job)["statusReason"] for job in waiting[:2]] == ["bulk"] * 2
    assert batch.describe(running)["status"] == "RUNNING" and not batch.describe(running)["isCancelled"]
    answer = batch.api.terminate_jobs(jobs=[waiting[2], running], reason="all of it")
    assert answer["successful"] == [waiting[2], running] and answer["errors"] == []
    for job in (waiting[2], running):
        detail = batch.wait(job)
        assert (detail["status"], detail["statusReason"], detail["isTerminated"]) == ("FAILED", "all of it", True)
    for jobs, output in (([], "takes at least one job"), ([running] * 51, "takes at most 50 jobs, not 51")):
        with refused(output):
            batch.api.terminate_jobs(jobs=jobs, reason="x")


@pytest.mark.parametrize("operation", ["cancel_job", "terminate_job"])
def test_ending_an_impossible_job_is_refused(batch: Batch, operation: str) -> None:
    call: Callable[..., Any] = getattr(batch.api, operation)
    with refused("Job no-such-job does not exist"):
        call(jobId="no-such-job", reason="x")
    with refused("longer than 1024"):
        call(jobId="no-such-job", reason="x" * 1025)


def test_a_timeout_is_sigterm_then_thirty_seconds_then_sigkill_and_no_retry(batch: Batch, overdue: str) -> None:
    detail = batch.wait(overdue)
    assert (detail["status"], detail["statusReason"]) == ("FAILED", "Job attempt duration exceeded timeout")
    assert (detail["isTerminated"], detail["isCancelled"]) == (False, False)
    [attempt] = detail["attempts"]
    assert attempt["container"]["exitCode"] == 137 and detail["timeout"] == {"attemptDurationSeconds": 60}
    stream = {"logGroupName": "/aws/batch/job", "logStreamName": attempt["container"]["logStreamName"]}
    events = batch.logs.get_log_events(**stream, startFromHead=True)["events"]
    [requested] = [event["timestamp"] for event in events if event["message"] == "asked to leave"]
    assert attempt["stoppedAt"] - requested >= 29_000, "it had 30 s to leave"
    assert batch.describe(f"{overdue}#1")["container"]["exitCode"] == 143, "the child left when it was asked"
    assert not processes_of_job(overdue)
