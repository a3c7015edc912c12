"""Who may do what to what, through a real server: every operation, every kind of key, objects of its own and of others."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest
from fastapi.routing import APIRoute

from orchestrator.api.batch import operations as batch
from orchestrator.api.http.app import create_app
from orchestrator.api.logs import operations as logs
from orchestrator.api.native import routes as native
from orchestrator.domain.errors import ApiError
from orchestrator.services.permissions import Operation
from shared_store.contract.plugins import plugins
from tests.support.conformance.fuzz_requests import GROUP_ARN
from tests.support.conformance.permissions_world import (
    MARK,
    NAMED_WRITE,
    OWN_MADE,
    OWN_WRITE,
    SECRET,
    SHARED_READ,
    SHARED_WRITE,
    TOKEN,
    World,
    answers_as,
    definition,
)
from tests.support.conformance.streams import GROUP
from tests.support.definitions import container, multinode

OWN_WRITES = "+ + + e - - -"
"""Several at once: ``e`` is an answer with an error for each that is not its own."""
OWN_READ = "+ + + - h h -"
"""It is read: ``h`` without the values of environment variables."""
NAMED_READ = "+ + + n h h n"
"""It is found by its name: ``n`` answers as if it did not exist."""
OWN_LIST = "+ + + o h h o"
"""It is listed: ``o`` is an answer without it."""
ALL_READ = "+ + - - + - -"
"""It tells of all queues at once."""
DEFINITION_READ = "+ + + h h h h"
"""Names and commands of definitions are everybody's to see, values only to their owner."""

OF = Operation
TABLE = {
    operation: row
    for row, operations in {
        OWN_WRITE: (
            *(OF.DEREGISTER_JOB_DEFINITION, OF.SUBMIT_JOB, OF.TERMINATE_JOB),
            *(OF.CANCEL_JOB, OF.TAG_RESOURCE, OF.UNTAG_RESOURCE, OF.PLAN, OF.FIT, OF.SUBMIT_SPEC),
            *(OF.DELETE_LOG_GROUP, OF.PUT_RETENTION_POLICY, OF.DELETE_RETENTION_POLICY, OF.CREATE_LOG_STREAM),
            OF.DELETE_LOG_STREAM,
        ),
        NAMED_WRITE: (
            *(OF.CHECKPOINT_JOB, OF.RESUME_RUN, OF.CLONE_RUN, OF.REGISTER_MODEL),
            *(OF.ARCHIVE_RUN, OF.DELETE_RUN),
        ),
        DEFINITION_READ: (OF.DESCRIBE_JOB_DEFINITIONS,),
        OWN_LIST: (
            *(OF.DESCRIBE_JOBS, OF.FILTER_LOG_EVENTS, OF.DESCRIBE_LOG_STREAMS, OF.START_LIVE_TAIL, OF.READ_QUEUES),
            *(OF.FIND_JOBS, OF.LIST_RUNS, OF.LIST_MODELS),
        ),
        OWN_READ: (OF.LIST_JOBS, OF.GET_JOB_QUEUE_SNAPSHOT, OF.LIST_TAGS_FOR_RESOURCE, OF.GET_LOG_EVENTS),
        NAMED_READ: (
            *(OF.READ_JOB, OF.READ_JOB_LOGS, OF.READ_JOB_STACKS, OF.READ_RUN, OF.READ_CHECKPOINTS, OF.READ_METRICS),
            *(OF.READ_EVALUATIONS, OF.READ_MODEL, OF.READ_TEXT),
        ),
        OWN_WRITES: (OF.TERMINATE_JOBS, OF.CANCEL_JOBS),
        SHARED_WRITE: (
            *(OF.CREATE_JOB_QUEUE, OF.UPDATE_JOB_QUEUE, OF.DELETE_JOB_QUEUE, OF.CREATE_COMPUTE_ENVIRONMENT),
            *(OF.UPDATE_COMPUTE_ENVIRONMENT, OF.DELETE_COMPUTE_ENVIRONMENT, OF.CREATE_SCHEDULING_POLICY),
            *(OF.UPDATE_SCHEDULING_POLICY, OF.DELETE_SCHEDULING_POLICY, OF.CREATE_KEY, OF.DELETE_KEY),
            OF.TEST_WEBHOOK,
        ),
        SHARED_READ: (
            *(OF.DESCRIBE_JOB_QUEUES, OF.DESCRIBE_COMPUTE_ENVIRONMENTS, OF.DESCRIBE_SCHEDULING_POLICIES),
            *(OF.LIST_SCHEDULING_POLICIES, OF.DESCRIBE_LOG_GROUPS, OF.READ_HEALTH, OF.READ_DOCUMENTATION),
            OF.READ_CAPACITY,
            OF.READ_GARBAGE,
        ),
        ALL_READ: (OF.READ_MONITORING, OF.READ_KEYS, OF.READ_WEBHOOKS),
        OWN_MADE: (OF.REGISTER_JOB_DEFINITION, OF.CREATE_LOG_GROUP, OF.KEEP_TEXT, OF.TAKE_GARBAGE),
    }.items()
    for operation in operations
}
ARN = "arn:aws:batch:us-east-1:000000000000:"


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    world = World(tmp_path_factory.mktemp("home"))
    with world.server:
        yield world
        for each in (*world.clients.values(), world.http):
            each.close()


def requests_of(world: World) -> dict[Operation, Callable[[str], httpx.Response]]:
    """Each operation, on what the key ``robots`` made in the queue ``robots`` (or on what all share), as a key."""

    def aws(operation: Operation, **request: Any) -> Callable[[str], httpx.Response]:
        return lambda key: world.send(key, operation, **{k: v() if callable(v) else v for k, v in request.items()})

    def of_ours(operation: Operation, body: dict[str, Any] | None = None) -> Callable[[str], httpx.Response]:
        return lambda key: world.native_call(key, operation, body)

    def registered() -> str:
        """The name of a new definition of the key ``robots``."""
        return world.register("robots", world.fresh()).rpartition("/")[2].partition(":")[0]

    def policy() -> str:
        return world.made("CreateSchedulingPolicy", "name", fairsharePolicy={})

    def own_group() -> str:
        """A new log group of the key ``robots``."""
        name = f"/{world.fresh()}"
        assert world.send("robots", "CreateLogGroup", logGroupName=name).status_code == 200
        return name

    group = {"logGroupName": GROUP}
    queue = {"priority": 1, "computeEnvironmentOrder": [{"order": 1, "computeEnvironment": "local"}]}
    job = {"jobName": "x", "jobQueue": "robots", "jobDefinition": world.definition}
    disabled = {"type": "UNMANAGED", "state": "DISABLED"}
    of, empty = Operation, {"fairsharePolicy": {}}
    requests: dict[Operation, dict[str, Any]] = {
        of.REGISTER_JOB_DEFINITION: {**definition(""), "jobDefinitionName": registered},
        of.DESCRIBE_JOB_DEFINITIONS: dict(jobDefinitions=[world.definition]),
        of.DEREGISTER_JOB_DEFINITION: dict(jobDefinition=lambda: f"{registered()}:1"),
        of.SUBMIT_JOB: dict(**job),
        of.DESCRIBE_JOBS: dict(jobs=[world.job]),
        of.LIST_JOBS: dict(jobQueue="robots", filters=[{"name": "JOB_NAME", "values": ["theirs"]}]),
        of.TERMINATE_JOB: dict(jobId=world.job, reason="x"),
        of.CANCEL_JOB: dict(jobId=world.job, reason="x"),
        of.TERMINATE_JOBS: dict(jobs=[world.job], reason="x"),
        of.CANCEL_JOBS: dict(jobs=[world.job], reason="x"),
        of.CREATE_JOB_QUEUE: dict(jobQueueName=world.fresh, **queue),
        of.DESCRIBE_JOB_QUEUES: {},
        of.UPDATE_JOB_QUEUE: dict(jobQueue="robots", priority=9),
        of.DELETE_JOB_QUEUE: dict(
            jobQueue=lambda: world.made("CreateJobQueue", "jobQueueName", **queue, state="DISABLED"),
        ),
        of.GET_JOB_QUEUE_SNAPSHOT: dict(jobQueue="robots"),
        of.CREATE_COMPUTE_ENVIRONMENT: dict(computeEnvironmentName=world.fresh, type="UNMANAGED"),
        of.DESCRIBE_COMPUTE_ENVIRONMENTS: {},
        of.UPDATE_COMPUTE_ENVIRONMENT: dict(computeEnvironment="local", state="ENABLED"),
        of.DELETE_COMPUTE_ENVIRONMENT: dict(
            computeEnvironment=lambda: world.made("CreateComputeEnvironment", "computeEnvironmentName", **disabled),
        ),
        of.CREATE_SCHEDULING_POLICY: dict(name=world.fresh, fairsharePolicy={}),
        of.DESCRIBE_SCHEDULING_POLICIES: dict(arns=[]),
        of.LIST_SCHEDULING_POLICIES: {},
        of.UPDATE_SCHEDULING_POLICY: dict(arn=policy, **empty),
        of.DELETE_SCHEDULING_POLICY: dict(arn=policy),
        of.TAG_RESOURCE: dict(resourceArn=f"{ARN}job/{world.job}", tags={"a": "b"}),
        of.UNTAG_RESOURCE: dict(resourceArn=f"{ARN}job/{world.job}", tagKeys=["a"]),
        of.LIST_TAGS_FOR_RESOURCE: dict(resourceArn=f"{ARN}job/{world.job}"),
        of.GET_LOG_EVENTS: dict(**group, logStreamName=world.stream),
        of.FILTER_LOG_EVENTS: dict(**group, filterPattern='"robots line"'),
        of.DESCRIBE_LOG_STREAMS: dict(**group),
        of.DESCRIBE_LOG_GROUPS: {},
        of.CREATE_LOG_GROUP: dict(logGroupName=world.fresh),
        of.DELETE_LOG_GROUP: dict(logGroupName=own_group),
        of.PUT_RETENTION_POLICY: dict(logGroupName=own_group, retentionInDays=7),
        of.DELETE_RETENTION_POLICY: dict(logGroupName=own_group),
        of.CREATE_LOG_STREAM: dict(logGroupName=own_group, logStreamName="made"),
        of.DELETE_LOG_STREAM: dict(logGroupName=own_group, logStreamName="made"),
    }
    others: dict[Operation, Callable[[str], httpx.Response]] = {
        of.START_LIVE_TAIL: lambda key: live_tail(world, key),
        of.CREATE_KEY: lambda key: world.native_call(key, of.CREATE_KEY, {"name": world.fresh()}),
        of.DELETE_KEY: world.delete_key,
        of.KEEP_TEXT: lambda key: world.text_call(key, of.KEEP_TEXT, MARK),
        of.READ_TEXT: lambda key: world.text_call(key, of.READ_TEXT, MARK),
    }
    bodies: dict[Operation, dict[str, Any]] = {
        of.PLAN: {"definition": definition("x"), "queue": "robots"},
        of.FIT: {"definition": definition("x"), "queue": "robots"},
        of.SUBMIT_SPEC: {
            "spec": {"name": "x", "queue": "robots", "command": ["true"], "resources": {"cpus": 0.1, "memory": 16}}
        },
        of.RESUME_RUN: {},
        of.CLONE_RUN: {"name": "x"},
        of.REGISTER_MODEL: {"name": "x"},
        of.TEST_WEBHOOK: {},
        of.ARCHIVE_RUN: {"archived": False},
        of.TAKE_GARBAGE: {},
    }
    others |= {each: aws(each, **request) for each, request in requests.items()}
    return {each: others.get(each) or of_ours(each, bodies.get(each)) for each in TABLE}


def live_tail(world: World, key: str) -> httpx.Response:
    """A session until it has shown some new lines of each queue that the key may see; jobs of both print all the time."""
    headers = {"Authorization": f"Bearer {world.tokens[key]}", "X-Amz-Target": "Logs_20140328.StartLiveTail"}
    own = key.removesuffix("-reader")
    requested = [
        f"{queue} line".encode() for queue in ("robots", "lab") if own not in ("robots", "lab") or own == queue
    ]
    body = b""
    with world.http.stream("POST", world.url, json={"logGroupIdentifiers": [GROUP_ARN]}, headers=headers) as answer:
        for chunk in answer.iter_bytes():
            body += chunk
            if all(body.count(line) >= 3 for line in requested):
                break
    return httpx.Response(answer.status_code, content=body)


@pytest.fixture
def printing(world: World) -> Iterator[None]:
    """A job in each queue prints a line again and again."""
    gate = world.server.home / f"gate-{world.fresh()}"  # another one each time: lines of a second try go on
    ids = []
    for queue in ("robots", "lab"):
        command = ["sh", "-c", f"until [ -e {gate} ]; do echo {queue} line; sleep 0.05; done"]
        ids.append(world.native("admin", queue, name="printing", environment={}, command=command)[0])
        world.server.wait(ids[-1], "RUNNING")
    yield
    gate.touch()
    for job in ids:
        world.server.wait(job)


def test_every_operation_is_allowed_or_refused_as_the_table_says(world: World, printing: None) -> None:
    for operation, call in requests_of(world).items():
        reads = operation.reads and not operation.value.endswith("/stacks")
        answers_as(TABLE[operation], world, operation, call, reads)


def test_every_operation_of_the_product_stands_in_the_table() -> None:
    app = create_app(None)
    routes = {f"{method.upper()} {path}" for path, methods in app.openapi()["paths"].items() for method in methods}
    for route in [*app.routes, *native.router.routes]:
        if isinstance(route, APIRoute) and not route.path.startswith("/v1/") and route.name != "cloudwatch_logs":
            routes |= {f"{method} {route.path}" for method in route.methods}
    offered = {*batch.OPERATIONS, *logs.NAMES, *routes}
    added = {operation for plugin in plugins().values() for operation in plugin.operations}
    assert {operation.value for operation in TABLE} == offered - added
    assert set(TABLE) == {operation for operation in Operation if operation not in added}


def refused(text: str, call: Callable[..., Any], *arguments: Any, status: int = 403, **request: Any) -> None:
    with pytest.raises(ApiError, match=text) as caught:
        call(*arguments, **request)
    assert caught.value.status == status, caught.value


def submission(name: str, queue: str, **environment: str) -> dict[str, Any]:
    pairs = [{"name": key, "value": value} for key, value in environment.items()]
    overrides = [{"targetNodes": "0:", "containerOverrides": {"environment": pairs}}]
    job = {"jobName": "x", "jobQueue": queue, "jobDefinition": name}
    return {**job, "nodeOverrides": {"nodePropertyOverrides": overrides}}


def test_a_run_of_another_queue_is_neither_continued_nor_resumed_nor_used_as_a_source(world: World) -> None:
    lab, epoch = world.clients["lab"], world.server.home / "store" / "runs" / world.run / "EPOCH"
    for each in world.clients["admin"].get(f"/api/runs/{world.run}")["jobs"]:
        world.server.wait(each["id"])
    before = epoch.read_bytes()
    own = world.register("lab", "labs")
    foreign, absent = f"run {world.run} belongs to job queue robots", f"run {world.run} does not exist"
    refused(foreign, lab.batch, "SubmitJob", **submission(own, "lab", MUSTER_RUN=world.run))
    named = definition("named")
    container = named["nodeProperties"]["nodeRangeProperties"][0]["container"]
    container["environment"].append({"name": "MUSTER_RUN", "value": world.run})
    inside = world.register("lab", "named", **named)
    refused(foreign, lab.batch, "SubmitJob", jobName="x", jobQueue="lab", jobDefinition=inside)
    lab.batch("RegisterJobDefinition", jobDefinitionName="single", type="container", containerProperties=container)
    refused(foreign, lab.batch, "SubmitJob", jobName="x", jobQueue="lab", jobDefinition="single")
    for change in ("name=labs2", "queue=lab"):
        refused(absent, lab.post, f"/api/runs/{world.run}/resume", {"set": [change, "queue=lab"]}, status=404)
    waits = lab.batch("SubmitJob", jobName="x", jobQueue="lab", jobDefinition=own)["jobId"]
    clone = {"name": "labs-own", "set": ["queue=lab"]}
    refused(absent, lab.post, f"/api/runs/{world.run}/clone", clone, status=404)
    teacher = {"train": {"task": "Cartpole", "rsl_rl": {"teacher_checkpoint": f"{world.run}@3"}}}
    for section in ({"evaluate": {"run": world.run}}, {"export": {"run": world.run}}, teacher):
        spec = json.dumps({"name": "x", **section})
        refused(absent, lab.batch, "SubmitJob", status=404, **submission(own, "lab", MUSTER_SPEC=spec))
        later = {**submission(own, "lab", MUSTER_SPEC=spec), "dependsOn": [{"jobId": waits}]}
        refused(f"run {world.run} belongs to no known job queue", lab.batch, "SubmitJob", **later)
    train = {"train": {"task": "Cartpole", "worlds": 4, "iterations": 9}, "evaluation": {"every": 1, "queue": "robots"}}
    elsewhere = submission(own, "lab", MUSTER_SPEC=json.dumps({"name": "x", **train}))
    refused("it concerns job queue robots", lab.batch, "SubmitJob", **elsewhere)
    to_come = submission(own, "lab", MUSTER_SPEC='{"evaluate": {"run": "not-yet"}}')
    unknown = "run not-yet belongs to no known job queue"
    refused(unknown, lab.batch, "SubmitJob", **to_come, dependsOn=[{"jobId": waits}])
    waiting = {"jobName": "x", "jobQueue": "lab", "jobDefinition": own, "dependsOn": [{"jobId": world.job}]}
    refused("job theirs .* belongs to job queue robots", lab.batch, "SubmitJob", **waiting)
    assert epoch.read_bytes() == before
    for name in ("robots", "admin"):
        job = world.clients[name].post(f"/api/runs/{world.run}/resume", {"set": [f"name=again-{name}"]})["jobId"]
        world.server.wait(job, "SUCCEEDED")


def test_a_definition_of_another_key_is_used_only_where_its_tag_names_the_queue(world: World) -> None:
    lab, admin = world.clients["lab"], world.clients["admin"]
    arn = world.register("admin", "common")
    request = {"jobName": "x", "jobQueue": "lab", "jobDefinition": "common"}
    refused("job definition common was registered by key admin.*muster:queues", lab.batch, "SubmitJob", **request)
    tags, bearer = {"muster:queues": "other lab"}, {"Authorization": f"Bearer {TOKEN}"}
    httpx.post(f"{world.url}/v1/tags/{arn}", json={"tags": tags}, headers=bearer).raise_for_status()
    lab.batch("SubmitJob", **request)
    refused(
        "key robots is not authorized for SubmitJob",
        world.clients["robots"].batch,
        "SubmitJob",
        **{**request, "jobQueue": "robots"},
    )
    assert SECRET in json.dumps(lab.batch("DescribeJobDefinitions", jobDefinitionName="common"))
    assert admin.batch("DescribeJobDefinitions", jobDefinitionName="common")["jobDefinitions"][0]["revision"] == 1


def test_names_of_others_are_not_leaked_by_errors_and_not_found_by_name(world: World) -> None:
    lab = world.clients["lab"]
    with pytest.raises(ApiError, match="does not exist") as caught:
        lab.get(f"/api/runs/{world.run}x")
    assert world.run not in str(caught.value).replace(f"{world.run}x", ""), caught.value
    with pytest.raises(ApiError, match="does not exist"):
        lab.get("/api/jobs/theirs")
    with pytest.raises(ApiError, match="does not exist"):
        lab.get(f"/api/jobs/{world.job[:8]}")
    assert lab.get("/api/capacity")["queues"] == ["lab"]
    assert world.server.muster("queues").returncode == 1  # without a key
    for key, names in (("lab", {"lab"}), ("admin", {"default", "lab", "robots"})):
        shown = json.loads(world.server.muster("queues", "--json", MUSTER_TOKEN=world.tokens[key]).stdout)
        assert {queue["jobQueueName"] for queue in shown} >= names and ("robots" in str(shown)) is (key == "admin")


def test_a_job_of_another_queue_that_writes_a_run_of_one_s_own_is_not_named(world: World) -> None:
    lab, admin = world.clients["lab"], world.clients["admin"]
    job, run = world.native("lab", "lab")
    world.server.wait(job)
    waits = submission(world.definition, "robots", MUSTER_RUN=run)
    needs = [{"type": "VCPU", "value": "1000"}]
    waits["nodeOverrides"]["nodePropertyOverrides"][0]["containerOverrides"]["resourceRequirements"] = needs
    holder = admin.batch("SubmitJob", **{**waits, "jobName": "secretive"})["jobId"]
    with pytest.raises(ApiError, match=f"run {run} is being written by another job; choose another name") as caught:
        lab.batch("SubmitJob", **submission(world.register("lab", "labs-waiting"), "lab", MUSTER_RUN=run))
    assert "secretive" not in str(caught.value)
    admin.batch("TerminateJob", jobId=holder, reason="x")


@pytest.mark.parametrize("kind", ["models", "runs", "jobs"])
def test_what_a_key_may_not_see_answers_as_what_does_not_exist(world: World, kind: str) -> None:
    """No answer tells which names exist, nor do hints name what is another queue's (T7)."""
    taken = world.job if kind == "jobs" else world.run
    job, _ = world.native("lab", "lab")  # its run has a name that may be near to the one asked for
    world.server.wait(job)
    for key in ("lab", "lab-reader"):
        listed = json.dumps(world.clients[key].get(f"/api/{kind}"))
        answers, others = [], set()
        for name in (taken, "z" + taken[1:]):
            with pytest.raises(ApiError) as caught:
                world.clients[key].get(f"/api/{kind}/{name}")
            assert "robots" not in str(caught.value)
            problem, _, hint = str(caught.value).replace(name, "NAME").partition("; ")
            if near := re.fullmatch(r"did you mean (.+)\?", hint):  # which of both names is near to one is chance
                assert near[1] in listed
            else:
                others.add(hint)
            answers.append((caught.value.status, problem))
        assert answers[0] == answers[1] and len(others) <= 1
    with pytest.raises(ApiError, match="did you mean" if kind != "jobs" else "does not exist"):
        world.clients["robots"].get(f"/api/{kind}/{world.run}x")


def test_a_run_without_a_row_belongs_to_the_owner_in_its_file(world: World) -> None:
    """As after the database was lost, or in a store that came from elsewhere."""
    described = json.loads((world.server.home / "store" / "runs" / world.run / "run.json").read_text())
    assert (described["queue"], described["owner"]) == ("robots", "key robots")
    for name, queue in (("moved", "robots"), ("older", None)):
        path = world.server.home / "store" / "runs" / name
        path.mkdir()
        facts = {**described, "run": name, "queue": queue, "owner": None}
        (path / "run.json").write_text(json.dumps({key: value for key, value in facts.items() if value}))
    assert world.clients["robots"].get("/api/runs/moved")["queue"] == "robots"
    refused("run moved does not exist", world.clients["lab"].get, "/api/runs/moved", status=404)
    own = world.register("robots", "continuing")
    older = submission(own, "robots", MUSTER_RUN="older")
    refused("no known job queue", world.clients["robots"].batch, "SubmitJob", **older)
    job = world.clients["admin"].batch("SubmitJob", **older)["jobId"]
    world.server.wait(job, "SUCCEEDED")
    assert world.clients["robots"].get("/api/runs/older")["queue"] == "robots"


def test_a_group_with_streams_of_another_queue_is_deleted_by_keys_with_all_queues_alone(world: World) -> None:
    group = f"/{world.fresh()}"
    assert world.send("robots", "CreateLogGroup", logGroupName=group).status_code == 200
    logged = container(["echo", "logged"])
    logged["logConfiguration"] = {"logDriver": "awslogs", "options": {"awslogs-group": group}}
    name = world.fresh()
    world.clients["lab"].batch("RegisterJobDefinition", **multinode(name, logged))
    job = world.clients["lab"].batch("SubmitJob", jobName=name, jobQueue="lab", jobDefinition=name)["jobId"]
    world.server.wait(job)
    refused = world.send("robots", "DeleteLogGroup", logGroupName=group)
    assert (
        refused.status_code == 403 and "has streams of jobs in other queues" in refused.text and job not in refused.text
    )
    [stream] = world.send("lab", "DescribeLogStreams", logGroupName=group).json()["logStreams"]
    assert job in stream["logStreamName"]
    assert world.send("admin", "DeleteLogGroup", logGroupName=group).status_code == 200
