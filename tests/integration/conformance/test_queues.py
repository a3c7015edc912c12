"""Compute environments, queues with their time limits, and scheduling policies, from their creation to their end."""

from __future__ import annotations

import sqlite3
from typing import Any

import pytest

from tests.conftest import Serving, wait_for
from tests.support.conformance.aws import NO_ROOM, PREFIX, Batch, refused

INVALID = "ACTION_REQUIRED - CE(s) associated with the job queue are invalid."


# -- compute environments, queues, policies ---------------------------------------------------------------------------


def test_a_compute_environment_from_its_creation_to_its_end(batch: Batch) -> None:
    resources = {
        "type": "EC2",
        "allocationStrategy": "BEST_FIT_PROGRESSIVE",
        "minvCpus": 0,
        "maxvCpus": 256,
        "instanceTypes": ["g6.12xlarge"],
        "subnets": ["subnet-none"],
        "securityGroupIds": ["sg-none"],
        "instanceRole": "none",
    }
    request = {"computeEnvironmentName": "q-ce", "type": "MANAGED", "tags": {"a": "1"}}
    created = batch.api.create_compute_environment(**request, computeResources=resources)
    assert created["computeEnvironmentArn"] == f"{PREFIX}compute-environment/q-ce"
    arn = created["computeEnvironmentArn"]
    [shown] = batch.api.describe_compute_environments(computeEnvironments=[arn])["computeEnvironments"]
    assert shown["computeResources"] == resources and shown["tags"] == {"a": "1"}
    assert (shown["type"], shown["state"], shown["status"]) == ("MANAGED", "ENABLED", "VALID")
    with refused("q-ce exists already"):
        batch.compute_environment("q-ce")
    batch.queue("q-on-ce", "q-ce")
    with refused("q-ce is ENABLED"):
        batch.api.delete_compute_environment(computeEnvironment="q-ce")
    fewer = {"maxvCpus": 4, "desiredvCpus": 2}
    batch.api.update_compute_environment(computeEnvironment=arn, state="DISABLED", computeResources=fewer)
    [shown] = batch.api.describe_compute_environments(computeEnvironments=["q-ce"])["computeEnvironments"]
    assert shown["computeResources"] == {**resources, "maxvCpus": 4, "desiredvCpus": 2}
    assert shown["state"] == "DISABLED"
    with refused("used by job queue q-on-ce"):
        batch.api.delete_compute_environment(computeEnvironment="q-ce")
    batch.remove(["q-on-ce"], ["q-ce"])
    assert batch.api.describe_compute_environments(computeEnvironments=["q-ce"])["computeEnvironments"] == []
    for change, message in [
        ({"type": "OTHER"}, "MANAGED or UNMANAGED"),
        (
            {"computeResources": {**resources, "type": "ECS_MANAGED_INSTANCES"}},
            "'ECS_MANAGED_INSTANCES' is not supported",
        ),
        ({"computeResources": {**resources, "maxvCpus": -1}}, "maxvCpus is -1"),
        ({"computeEnvironmentName": "a b"}, "computeEnvironmentName"),
        ({"state": "ON"}, "ENABLED or DISABLED"),
    ]:
        request = {"computeEnvironmentName": "q-bad", "type": "MANAGED", "computeResources": resources, **change}
        with refused(message):
            batch.api.create_compute_environment(**request)
    with refused("needs computeResources"):
        batch.api.create_compute_environment(computeEnvironmentName="q-bad", type="MANAGED")
    with refused("q-bad does not exist"):
        batch.api.update_compute_environment(computeEnvironment="q-bad", state="DISABLED")


def test_an_update_drops_no_member_of_a_compute_environment(batch: Batch) -> None:
    batch.compute_environment("q-updated")
    changes: dict[str, Any] = {
        "state": "DISABLED",
        "unmanagedvCpus": 4,
        "serviceRole": "arn:aws:iam::000000000000:role/mine",
        "context": "reserved",
        "computeResources": {"maxvCpus": 5},
        "updatePolicy": {"terminateJobsOnUpdate": True},
        "ecsSettings": {"containerInsights": "ENHANCED"},
    }
    known = batch.api.meta.service_model.operation_model("UpdateComputeEnvironment").input_shape.members
    assert {"computeEnvironment", "eksConfiguration", *changes} == set(known)
    batch.api.update_compute_environment(computeEnvironment="q-updated", **changes)
    [shown] = batch.api.describe_compute_environments(computeEnvironments=["q-updated"])["computeEnvironments"]
    assert shown["computeResources"].pop("maxvCpus") == 5
    whole = {"terminateJobsOnUpdate": True, "jobExecutionTimeoutMinutes": 30}
    changes |= {"computeResources": shown["computeResources"], "updatePolicy": whole}
    assert {key: shown[key] for key in changes} == changes
    with refused("containerInsights is 'SOME'; it is ENABLED, ENHANCED or DISABLED"):
        batch.api.update_compute_environment(computeEnvironment="q-updated", ecsSettings={"containerInsights": "SOME"})
    batch.remove([], ["q-updated"])


def test_a_queue_from_its_creation_to_its_end(batch: Batch, parked: str) -> None:
    limit = {"reason": NO_ROOM, "state": "RUNNABLE", "maxTimeSeconds": 600, "action": "CANCEL"}
    arn = batch.api.create_job_queue(
        jobQueueName="q-lives",
        priority=7,
        computeEnvironmentOrder=[{"order": 5, "computeEnvironment": f"{PREFIX}compute-environment/{parked}"}],
        jobStateTimeLimitActions=[limit],
        tags={"a": "1"},
    )["jobQueueArn"]
    assert arn == f"{PREFIX}job-queue/q-lives"
    [shown] = batch.api.describe_job_queues(jobQueues=[arn])["jobQueues"]
    assert (shown["priority"], shown["state"], shown["status"]) == (7, "ENABLED", "VALID")
    assert shown["jobStateTimeLimitActions"] == [limit] and shown["tags"] == {"a": "1"}
    place = {"order": 5, "computeEnvironment": f"{PREFIX}compute-environment/{parked}"}
    assert shown["computeEnvironmentOrder"] == [place]
    definition = batch.single("q-lives", "true")
    waiting = batch.submit(definition, queue=arn)
    with refused("q-lives is ENABLED"):
        batch.api.delete_job_queue(jobQueue="q-lives")
    batch.api.update_job_queue(jobQueue=arn, state="DISABLED", priority=8)
    [shown] = batch.api.describe_job_queues(jobQueues=["q-lives"])["jobQueues"]
    assert (shown["priority"], shown["state"], shown["jobStateTimeLimitActions"]) == (8, "DISABLED", [limit])
    with refused("q-lives is DISABLED"):
        batch.submit(definition, queue="q-lives")
    assert batch.reason(waiting, INVALID) == INVALID, "a disabled queue keeps what it has"
    batch.api.delete_job_queue(jobQueue="q-lives")
    assert "q-lives" in batch.wait(waiting)["statusReason"], "its jobs end with it"
    with refused("q-lives does not exist"):
        batch.submit(definition, queue="q-lives")
    wait_for(lambda: not batch.api.describe_job_queues(jobQueues=["q-lives"])["jobQueues"], what="its end")
    assert batch.describe(waiting)["jobQueue"] == arn, "its history stays"
    batch.api.delete_job_queue(jobQueue="q-lives")


def test_the_order_of_compute_environments_is_described_as_it_was_sent_and_tried_ascending(batch: Batch) -> None:
    """Terraform compares it at each plan, with its sequence: its acceptance test wants (2, 1, 3) back."""
    names = [batch.compute_environment(f"q-order-{letter}", cpus=0 if letter == "a" else 8) for letter in "abc"]
    arns = [f"{PREFIX}compute-environment/{name}" for name in names]
    batch.queue("q-order", names[0])

    def described(*orders: int) -> list[dict[str, Any]]:
        sent = [{"order": order, "computeEnvironment": name} for order, name in zip(orders, names, strict=False)]
        batch.api.update_job_queue(jobQueue="q-order", computeEnvironmentOrder=sent)
        [queue] = batch.api.describe_job_queues(jobQueues=["q-order"])["jobQueues"]
        return list(queue["computeEnvironmentOrder"])

    for orders in ([1], [0], [2**31 - 1], [0, 1], [10, 20], [2, 1, 3], [3, 1, 2]):
        shown = [{"order": order, "computeEnvironment": arn} for order, arn in zip(orders, arns, strict=False)]
        assert described(*orders) == shown
    batch.api.update_job_queue(jobQueue="q-order", priority=2)
    [queue] = batch.api.describe_job_queues(jobQueues=["q-order"])["jobQueues"]
    assert [each["order"] for each in queue["computeEnvironmentOrder"]] == [3, 1, 2], "another change leaves it alone"
    job = batch.submit(batch.single("q-order", 'echo "$AWS_BATCH_CE_NAME"'), queue="q-order")
    batch.wait(job, "SUCCEEDED")
    assert batch.lines(job) == [names[1]]
    batch.remove(["q-order"], names)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"jobQueueName": "a/b"}, "jobQueueName"),
        ({"priority": -1}, "0 to 1000000"),
        ({"state": "ON"}, "ENABLED or DISABLED"),
        ({"computeEnvironmentOrder": []}, "name 1 to 3 compute environments"),
        ({"computeEnvironmentOrder": [{"order": 1, "computeEnvironment": "q-none"}]}, "q-none does not exist"),
        ({"computeEnvironmentOrder": [{"order": i, "computeEnvironment": f"q-{i}"} for i in range(4)]}, "at most 3"),
        ({"computeEnvironmentOrder": [{"order": i, "computeEnvironment": "queues-parked"} for i in range(2)]}, "once"),
        (
            {"computeEnvironmentOrder": [{"order": -1, "computeEnvironment": "queues-parked"}]},
            "order is -1; it must be",
        ),
        ({"computeEnvironmentOrder": [{"order": 2**31, "computeEnvironment": "queues-parked"}]}, "0 to 2147483647"),
        ({"schedulingPolicyArn": f"{PREFIX}scheduling-policy/q-none"}, "q-none does not exist"),
        ({"jobQueueName": "queues-parked"}, "queues-parked exists already"),
        ({"limit": {"maxTimeSeconds": 599}}, "maxTimeSeconds is 599; it must be 600 to 86400"),
        ({"limit": {"maxTimeSeconds": 86401}}, "maxTimeSeconds is 86401; it must be 600 to 86400"),
        ({"limit": {"reason": "CAPACITY:OTHER"}}, "CAPACITY:OTHER"),
        ({"limit": {"state": "RUNNING"}}, "RUNNABLE"),
        ({"limit": {"action": "TERMINATE"}}, "CANCEL"),
    ],
)
def test_bad_queues_are_refused(batch: Batch, parked: str, change: dict[str, Any], message: str) -> None:
    limit = {"reason": NO_ROOM, "state": "RUNNABLE", "maxTimeSeconds": 600, "action": "CANCEL"}
    if "limit" in change:
        change = {"jobStateTimeLimitActions": [{**limit, **change["limit"]}]}
        with refused(message):
            batch.api.update_job_queue(jobQueue=parked, **change)
    order = [{"order": 1, "computeEnvironment": parked}]
    request = {"jobQueueName": "q-bad", "priority": 1, "computeEnvironmentOrder": order, **change}
    with refused(message):
        batch.api.create_job_queue(**request)
    assert batch.api.describe_job_queues(jobQueues=["q-bad"])["jobQueues"] == []


def test_every_reason_of_a_time_limit_is_taken(batch: Batch, parked: str) -> None:
    limits = [
        {"reason": reason, "state": "RUNNABLE", "maxTimeSeconds": seconds, "action": "CANCEL"}
        for reason, seconds in [
            (NO_ROOM, 600),
            ("MISCONFIGURATION:COMPUTE_ENVIRONMENT_MAX_RESOURCE", 601),
            ("MISCONFIGURATION:JOB_RESOURCE_REQUIREMENT", 86400),
        ]
    ]
    for requested in (limits, []):
        batch.api.update_job_queue(jobQueue=parked, jobStateTimeLimitActions=requested)
        shown = batch.api.describe_job_queues(jobQueues=[parked])["jobQueues"][0]
        assert shown["jobStateTimeLimitActions"] == requested


def test_a_job_that_is_stuck_at_the_head_is_cancelled_by_its_queues_limit(server: Serving) -> None:
    """The API takes no limit below ten minutes, so a shorter one is written to the database of a stopped server."""
    batch = Batch(server)
    limit = {"reason": NO_ROOM, "state": "RUNNABLE", "maxTimeSeconds": 600, "action": "CANCEL"}
    batch.queue("q-limited", batch.compute_environment("q-limited", cpus=1), jobStateTimeLimitActions=[limit])
    definition = batch.single("q-stuck", "exec sleep 600", cpus="1")
    running, stuck, behind = (batch.submit(definition, queue="q-limited") for _ in range(3))
    batch.wait(running, "RUNNING")
    batch.reason(stuck, NO_ROOM)
    server.kill()
    with sqlite3.connect(server.home / "muster.db", timeout=30) as database:
        changed = "UPDATE job_queues SET limits = replace(limits, '600', '2') WHERE name = 'q-limited'"
        assert database.execute(changed).rowcount == 1
    server.start()
    batch = Batch(server)
    detail = batch.wait(stuck)
    assert detail["statusReason"] == f"Canceled by JobStateTimeLimit action due to reason: {NO_ROOM}"
    assert (detail["status"], detail["isCancelled"], detail["isTerminated"]) == ("FAILED", True, False)
    assert batch.describe(running)["status"] == "RUNNING"
    assert batch.wait(behind)["stoppedAt"] >= detail["stoppedAt"] + 2000, "its time began when it came to the head"


def test_a_scheduling_policy_can_be_replaced_but_not_taken_away(batch: Batch, parked: str) -> None:
    shares = [{"shareIdentifier": "A*", "weightFactor": 0.5}]
    fair = {"shareDecaySeconds": 3600, "computeReservation": 10, "shareDistribution": shares}
    arn = batch.api.create_scheduling_policy(name="q-fair", fairsharePolicy=fair, tags={"a": "1"})["arn"]
    other = batch.api.create_scheduling_policy(name="q-fair-2", fairsharePolicy={})["arn"]
    assert arn == f"{PREFIX}scheduling-policy/q-fair"
    requested = [arn, f"{PREFIX}scheduling-policy/q-none"]
    [shown] = batch.api.describe_scheduling_policies(arns=requested)["schedulingPolicies"]
    assert shown == {"name": "q-fair", "arn": arn, "fairsharePolicy": fair, "tags": {"a": "1"}}
    with refused("q-fair exists already"):
        batch.api.create_scheduling_policy(name="q-fair", fairsharePolicy={})
    with refused("can't be added"):
        batch.api.update_job_queue(jobQueue=parked, schedulingPolicyArn=arn)
    batch.queue("q-with-policy", parked, schedulingPolicyArn=arn)
    with refused("used by job queue q-with-policy"):
        batch.api.delete_scheduling_policy(arn=arn)
    with refused("does not exist"):
        batch.api.update_job_queue(jobQueue="q-with-policy", schedulingPolicyArn="")
    batch.api.update_job_queue(jobQueue="q-with-policy", schedulingPolicyArn=other)
    shown = batch.api.describe_job_queues(jobQueues=["q-with-policy"])["jobQueues"][0]
    assert shown["schedulingPolicyArn"] == other
    batch.api.update_scheduling_policy(arn=arn, fairsharePolicy={"computeReservation": 99})
    changed = batch.api.describe_scheduling_policies(arns=[arn])["schedulingPolicies"][0]
    assert changed["fairsharePolicy"] == {"computeReservation": 99}
    with refused("its kind can't change"):
        batch.api.update_scheduling_policy(arn=arn, quotaSharePolicy={"idleResourceAssignmentStrategy": "FIFO"})
    listed = batch.api.get_paginator("list_scheduling_policies").paginate(PaginationConfig={"PageSize": 1})
    assert {each["arn"] for page in listed for each in page["schedulingPolicies"]} >= {arn, other}
    batch.api.delete_scheduling_policy(arn=arn)
    batch.remove(["q-with-policy"], [])
    batch.api.delete_scheduling_policy(arn=other)
    assert batch.api.describe_scheduling_policies(arns=[arn, other])["schedulingPolicies"] == []


@pytest.mark.parametrize(
    ("fair", "message"),
    [
        ({"shareDecaySeconds": 604_801}, "0 to 604800"),
        ({"shareDecaySeconds": -1}, "0 to 604800"),
        ({"computeReservation": 100}, "0 to 99"),
        ({"computeReservation": -1}, "0 to 99"),
        ({"shareDistribution": [{"shareIdentifier": "A", "weightFactor": 0.00009}]}, "0.0001 to 999.9999"),
        ({"shareDistribution": [{"shareIdentifier": "A", "weightFactor": 1000}]}, "0.0001 to 999.9999"),
        ({"shareDistribution": [{"shareIdentifier": "UserA*"}, {"shareIdentifier": "UserA1"}]}, "overlap"),
        ({"shareDistribution": [{"shareIdentifier": "A"}, {"shareIdentifier": "A"}]}, "overlap"),
        ({"shareDistribution": [{"shareIdentifier": "a-b"}]}, "letters and digits"),
        ({"shareDistribution": [{"shareIdentifier": "*A"}]}, "letters and digits"),
    ],
)
def test_bad_policies_are_refused(batch: Batch, fair: dict[str, Any], message: str) -> None:
    with refused(message):
        batch.api.create_scheduling_policy(name="q-bad", fairsharePolicy=fair)
    assert batch.api.describe_scheduling_policies(arns=[f"{PREFIX}scheduling-policy/q-bad"])["schedulingPolicies"] == []
