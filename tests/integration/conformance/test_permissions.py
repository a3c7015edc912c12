"""Who may do what to what, through a real server: every operation, every kind of key, objects of its own and of others."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest
from fastapi.routing import APIRoute

from orchestrator.api.batch import members
from orchestrator.api.batch import operations as batch
from orchestrator.api.http.app import create_app
from orchestrator.api.logs import operations as logs
from orchestrator.api.native import routes as native
from orchestrator.api.permissions import HIDDEN, Operation
from orchestrator.domain.errors import ApiError
from tests.support.conformance.permissions_world import KEYS, MARK, SECRET, TOKEN, World, definition

OWN_WRITE = "+ + + - - - -"
"""What belongs to the queue robots is changed: ``+`` is carried out, ``-`` is refused."""
OWN_WRITES = "+ + + e - - -"
"""Several at once: ``e`` is an answer with an error for each that is not its own."""
OWN_READ = "+ + + - h h -"
"""It is read: ``h`` without the values of environment variables."""
OWN_LIST = "+ + + o h h o"
"""It is listed: ``o`` is an answer without it."""
SHARED_WRITE = "+ + - - - - -"
SHARED_READ = "+ + + + + + +"
ALL_READ = "+ + - - + - -"
"""It tells of all queues at once."""
OWN_LEAGUE = "+ + + + - - -"
"""A league of one's own is created."""
DEFINITION_READ = "+ + + h h h h"
"""Names and commands of definitions are everybody's to see, values only of one's own."""

TABLE = {
    Operation.REGISTER_JOB_DEFINITION: OWN_WRITE,
    Operation.DESCRIBE_JOB_DEFINITIONS: DEFINITION_READ,
    Operation.DEREGISTER_JOB_DEFINITION: OWN_WRITE,
    Operation.SUBMIT_JOB: OWN_WRITE,
    Operation.DESCRIBE_JOBS: OWN_LIST,
    Operation.LIST_JOBS: OWN_READ,
    Operation.TERMINATE_JOB: OWN_WRITE,
    Operation.CANCEL_JOB: OWN_WRITE,
    Operation.TERMINATE_JOBS: OWN_WRITES,
    Operation.CANCEL_JOBS: OWN_WRITES,
    Operation.CREATE_JOB_QUEUE: SHARED_WRITE,
    Operation.DESCRIBE_JOB_QUEUES: SHARED_READ,
    Operation.UPDATE_JOB_QUEUE: SHARED_WRITE,
    Operation.DELETE_JOB_QUEUE: SHARED_WRITE,
    Operation.GET_JOB_QUEUE_SNAPSHOT: OWN_READ,
    Operation.CREATE_COMPUTE_ENVIRONMENT: SHARED_WRITE,
    Operation.DESCRIBE_COMPUTE_ENVIRONMENTS: SHARED_READ,
    Operation.UPDATE_COMPUTE_ENVIRONMENT: SHARED_WRITE,
    Operation.DELETE_COMPUTE_ENVIRONMENT: SHARED_WRITE,
    Operation.CREATE_SCHEDULING_POLICY: SHARED_WRITE,
    Operation.DESCRIBE_SCHEDULING_POLICIES: SHARED_READ,
    Operation.LIST_SCHEDULING_POLICIES: SHARED_READ,
    Operation.UPDATE_SCHEDULING_POLICY: SHARED_WRITE,
    Operation.DELETE_SCHEDULING_POLICY: SHARED_WRITE,
    Operation.TAG_RESOURCE: OWN_WRITE,
    Operation.UNTAG_RESOURCE: OWN_WRITE,
    Operation.LIST_TAGS_FOR_RESOURCE: OWN_READ,
    Operation.GET_LOG_EVENTS: OWN_READ,
    Operation.FILTER_LOG_EVENTS: OWN_LIST,
    Operation.DESCRIBE_LOG_STREAMS: OWN_LIST,
    Operation.DESCRIBE_LOG_GROUPS: SHARED_READ,
    Operation.START_LIVE_TAIL: OWN_LIST,
    Operation.READ_HEALTH: SHARED_READ,
    Operation.READ_DOCUMENTATION: SHARED_READ,
    Operation.READ_MONITORING: ALL_READ,
    Operation.READ_CAPACITY: SHARED_READ,
    Operation.READ_QUEUES: OWN_LIST,
    Operation.PLAN: OWN_WRITE,
    Operation.FIT: OWN_WRITE,
    Operation.FIND_JOBS: OWN_LIST,
    Operation.READ_JOB: OWN_READ,
    Operation.READ_JOB_LOGS: OWN_READ,
    Operation.CHECKPOINT_JOB: OWN_WRITE,
    Operation.READ_JOB_STACKS: OWN_READ,
    Operation.LIST_RUNS: OWN_LIST,
    Operation.READ_RUN: OWN_READ,
    Operation.READ_CHECKPOINTS: OWN_READ,
    Operation.READ_METRICS: OWN_READ,
    Operation.READ_EVALUATIONS: OWN_READ,
    Operation.RESUME_RUN: OWN_WRITE,
    Operation.CLONE_RUN: OWN_WRITE,
    Operation.REGISTER_MODEL: OWN_WRITE,
    Operation.LIST_MODELS: OWN_LIST,
    Operation.READ_MODEL: OWN_READ,
    Operation.LIST_LEAGUES: SHARED_READ,
    Operation.CREATE_LEAGUE: OWN_LEAGUE,
    Operation.READ_LEAGUE: SHARED_READ,
    Operation.READ_LEAGUE_TABLE: SHARED_READ,
    Operation.READ_ENTRY: SHARED_READ,
    Operation.RACE: OWN_WRITE,
    Operation.RERUN_ENTRY: OWN_WRITE,
    Operation.ENTER_LEAGUE: OWN_WRITE,
    Operation.DISQUALIFY: OWN_WRITE,
    Operation.READ_KEYS: ALL_READ,
    Operation.CREATE_KEY: SHARED_WRITE,
    Operation.DELETE_KEY: SHARED_WRITE,
    Operation.LIST_TRACKS: SHARED_READ,
    Operation.MAKE_TRACK: SHARED_WRITE,
    Operation.READ_WEBHOOKS: ALL_READ,
    Operation.TEST_WEBHOOK: SHARED_WRITE,
}
ARN = "arn:aws:batch:us-east-1:000000000000:"


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    world = World(tmp_path_factory.mktemp("home"))
    yield world
    for each in (*world.clients.values(), world.http):
        each.close()
    world.server.close()


def requests_of(world: World) -> dict[Operation, Callable[[str], httpx.Response]]:
    """Each operation, on what the key ``robots`` made in the queue ``robots`` (or on what all share), as a key."""

    def aws(operation: Operation, **request: Any) -> Callable[[str], httpx.Response]:
        return lambda key: world.send(key, operation, **{k: v() if callable(v) else v for k, v in request.items()})

    def of_ours(operation: Operation, body: dict[str, Any] | None = None) -> Callable[[str], httpx.Response]:
        return lambda key: world.native_call(key, operation, body)

    def registered() -> str:
        """The name of a new definition of the key ``robots``."""
        return world.register("robots", world.fresh()).rpartition("/")[2].partition(":")[0]

    group, order = {"logGroupName": members.LOG_GROUP}, [{"order": 1, "computeEnvironment": "local"}]
    job = {"jobName": "x", "jobQueue": "robots", "jobDefinition": world.definition}
    disabled = {"type": "UNMANAGED", "state": "DISABLED"}
    of = Operation
    found = [
        aws(of.REGISTER_JOB_DEFINITION, **{**definition(""), "jobDefinitionName": registered}),
        aws(of.DESCRIBE_JOB_DEFINITIONS, jobDefinitions=[world.definition]),
        aws(of.DEREGISTER_JOB_DEFINITION, jobDefinition=lambda: f"{registered()}:1"),
        aws(of.SUBMIT_JOB, **job),
        aws(of.DESCRIBE_JOBS, jobs=[world.job]),
        aws(of.LIST_JOBS, jobQueue="robots", filters=[{"name": "JOB_NAME", "values": ["theirs"]}]),
        aws(of.TERMINATE_JOB, jobId=world.job, reason="x"),
        aws(of.CANCEL_JOB, jobId=world.job, reason="x"),
        aws(of.TERMINATE_JOBS, jobs=[world.job], reason="x"),
        aws(of.CANCEL_JOBS, jobs=[world.job], reason="x"),
        aws(of.CREATE_JOB_QUEUE, jobQueueName=world.fresh, priority=1, computeEnvironmentOrder=order),
        aws(of.DESCRIBE_JOB_QUEUES),
        aws(of.UPDATE_JOB_QUEUE, jobQueue="robots", priority=9),
        aws(
            of.DELETE_JOB_QUEUE,
            jobQueue=lambda: world.made(
                "CreateJobQueue", "jobQueueName", priority=1, computeEnvironmentOrder=order, state="DISABLED"
            ),
        ),
        aws(of.GET_JOB_QUEUE_SNAPSHOT, jobQueue="robots"),
        aws(of.CREATE_COMPUTE_ENVIRONMENT, computeEnvironmentName=world.fresh, type="UNMANAGED"),
        aws(of.DESCRIBE_COMPUTE_ENVIRONMENTS),
        aws(of.UPDATE_COMPUTE_ENVIRONMENT, computeEnvironment="local", state="ENABLED"),
        aws(
            of.DELETE_COMPUTE_ENVIRONMENT,
            computeEnvironment=lambda: world.made("CreateComputeEnvironment", "computeEnvironmentName", **disabled),
        ),
        aws(of.CREATE_SCHEDULING_POLICY, name=world.fresh, fairsharePolicy={}),
        aws(of.DESCRIBE_SCHEDULING_POLICIES, arns=[]),
        aws(of.LIST_SCHEDULING_POLICIES),
        aws(
            of.UPDATE_SCHEDULING_POLICY,
            arn=lambda: world.made("CreateSchedulingPolicy", "name", fairsharePolicy={}),
            fairsharePolicy={},
        ),
        aws(of.DELETE_SCHEDULING_POLICY, arn=lambda: world.made("CreateSchedulingPolicy", "name", fairsharePolicy={})),
        aws(of.TAG_RESOURCE, resourceArn=f"{ARN}job/{world.job}", tags={"a": "b"}),
        aws(of.UNTAG_RESOURCE, resourceArn=f"{ARN}job/{world.job}", tagKeys=["a"]),
        aws(of.LIST_TAGS_FOR_RESOURCE, resourceArn=f"{ARN}job/{world.job}"),
        aws(of.GET_LOG_EVENTS, **group, logStreamName=world.stream),
        aws(of.FILTER_LOG_EVENTS, **group, filterPattern='"robots line"'),
        aws(of.DESCRIBE_LOG_STREAMS, **group),
        aws(of.DESCRIBE_LOG_GROUPS),
        lambda key: live_tail(world, key),
        of_ours(of.READ_HEALTH),
        of_ours(of.READ_DOCUMENTATION),
        of_ours(of.READ_MONITORING),
        of_ours(of.READ_CAPACITY),
        of_ours(of.READ_QUEUES),
        of_ours(of.PLAN, {"definition": definition("x"), "queue": "robots"}),
        of_ours(of.FIT, {"definition": definition("x"), "queue": "robots"}),
        of_ours(of.FIND_JOBS),
        of_ours(of.READ_JOB),
        of_ours(of.READ_JOB_LOGS),
        of_ours(of.CHECKPOINT_JOB),
        of_ours(of.READ_JOB_STACKS),
        of_ours(of.LIST_RUNS),
        of_ours(of.READ_RUN),
        of_ours(of.READ_CHECKPOINTS),
        of_ours(of.READ_METRICS),
        of_ours(of.READ_EVALUATIONS),
        of_ours(of.RESUME_RUN, {}),
        of_ours(of.CLONE_RUN, {"name": "x"}),
        of_ours(of.REGISTER_MODEL, {"name": "x"}),
        of_ours(of.LIST_MODELS),
        of_ours(of.READ_MODEL),
        of_ours(of.LIST_LEAGUES),
        lambda key: world.native_call(key, of.CREATE_LEAGUE, {"name": world.fresh(), "track": ["oval"]}),
        of_ours(of.READ_LEAGUE),
        of_ours(of.READ_LEAGUE_TABLE),
        of_ours(of.READ_ENTRY),
        of_ours(of.RACE, {"model": world.run}),
        of_ours(of.RERUN_ENTRY, {}),
        of_ours(of.ENTER_LEAGUE, {"model": world.run, "job": world.job}),
        of_ours(of.DISQUALIFY, {"reason": "x"}),
        of_ours(of.READ_KEYS),
        lambda key: world.native_call(key, of.CREATE_KEY, {"name": world.fresh()}),
        lambda key: world.delete_key(key),
        of_ours(of.LIST_TRACKS),
        lambda key: world.native_call(key, of.MAKE_TRACK, {"name": world.fresh(), "seed": 7}),
        of_ours(of.READ_WEBHOOKS),
        of_ours(of.TEST_WEBHOOK, {}),
    ]
    return dict(zip(Operation, found, strict=True))


def live_tail(world: World, key: str) -> httpx.Response:
    """A session until it has shown some new lines of each queue that the key may see; jobs of both print all the time."""
    headers = {"Authorization": f"Bearer {world.tokens[key]}", "X-Amz-Target": "Logs_20140328.StartLiveTail"}
    own = key.removesuffix("-reader")
    wanted = [f"{queue} line".encode() for queue in ("robots", "lab") if own not in ("robots", "lab") or own == queue]
    body = b""
    with world.http.stream(
        "POST", world.url, json={"logGroupIdentifiers": [logs.GROUP_ARN]}, headers=headers
    ) as answer:
        for chunk in answer.iter_bytes():
            body += chunk
            if all(body.count(line) >= 3 for line in wanted):
                break
    return httpx.Response(answer.status_code, content=body)


@pytest.fixture
def printing(world: World) -> Iterator[None]:
    """A job in each queue prints a line again and again."""
    gate = world.server.home / "gate"
    ids = []
    for queue in ("robots", "lab"):
        changes = {
            "name": "printing",
            "environment": {},
            "command": ["sh", "-c", f"until [ -e {gate} ]; do echo {queue} line; sleep 0.05; done"],
        }
        ids.append(world.native("admin", queue, **changes)[0])
        world.server.wait(ids[-1], "RUNNING")
    yield
    gate.touch()
    for job in ids:
        world.server.wait(job)


def refusal_of(answer: httpx.Response, key: str) -> None:
    told = answer.json()
    assert (answer.status_code, told["__type"]) == (403, "AccessDeniedException"), (key, answer.text)
    assert f"key {key} " in told["message"] and "\n" not in told["message"], told


def test_every_operation_is_allowed_or_refused_as_the_table_says(world: World, printing: None) -> None:
    for operation, call in requests_of(world).items():
        row = TABLE[operation].split()
        for key, expected in zip(KEYS, row, strict=True):
            answer = call(key)
            if key == "admin":
                full = MARK if operation is Operation.START_LIVE_TAIL else answer.text
            if expected == "-":
                refusal_of(answer, key)
                continue
            assert answer.status_code in (200, 307, 400, 409), (operation, key, answer.text)  # 400, 409: of its state
            assert ('"AccessDenied"' in answer.text) is (expected == "e"), (operation, key, answer.text)
            if not operation.reads or operation.value.endswith("/stacks"):
                continue
            text = answer.text
            for mark in (MARK, world.job):
                if "o" in row and mark in full:
                    assert (mark in text) is (expected != "o"), (operation, key, mark, text)
            if SECRET in full:
                assert expected in ("+", "h", "o"), (operation, key)
                assert (SECRET in text) is (expected == "+"), (operation, key, text)
                assert (HIDDEN in text) is (expected == "h"), (operation, key, text)


def test_every_operation_of_the_product_stands_in_the_table() -> None:
    app = create_app(None)  # type: ignore[arg-type]
    routes = {f"{method.upper()} {path}" for path, methods in app.openapi()["paths"].items() for method in methods}
    for route in [*app.routes, *native.router.routes]:
        if isinstance(route, APIRoute) and not route.path.startswith("/v1/") and route.name != "cloudwatch_logs":
            routes |= {f"{method} {route.path}" for method in route.methods}
    offered = {*batch.OPERATIONS, *logs.OPERATIONS, "StartLiveTail", *routes}
    assert {operation.value for operation in Operation} == offered
    assert set(TABLE) == set(Operation)


def refused(text: str, call: Callable[..., Any], *arguments: Any, **request: Any) -> None:
    with pytest.raises(ApiError, match=text) as caught:
        call(*arguments, **request)
    assert caught.value.status == 403, caught.value


def submission(name: str, queue: str, **environment: str) -> dict[str, Any]:
    pairs = [{"name": key, "value": value} for key, value in environment.items()]
    overrides = [{"targetNodes": "0:", "containerOverrides": {"environment": pairs}}]
    return {
        "jobName": "x",
        "jobQueue": queue,
        "jobDefinition": name,
        "nodeOverrides": {"nodePropertyOverrides": overrides},
    }


def test_a_run_of_another_queue_is_neither_continued_nor_resumed_nor_used_as_a_source(world: World) -> None:
    lab, epoch = world.clients["lab"], world.server.home / "store" / "runs" / world.run / "EPOCH"
    for each in world.clients["admin"].get(f"/api/runs/{world.run}")["jobs"]:
        world.server.wait(each["id"])
    before = epoch.read_bytes()
    own = world.register("lab", "labs")
    foreign = f"run {world.run} belongs to job queue robots"
    refused(foreign, lab.batch, "SubmitJob", **submission(own, "lab", MUSTER_RUN=world.run))
    named = definition("named")
    named["nodeProperties"]["nodeRangeProperties"][0]["container"]["environment"].append(
        {"name": "MUSTER_RUN", "value": world.run}
    )
    inside = world.register("lab", "named", **named)
    refused(foreign, lab.batch, "SubmitJob", jobName="x", jobQueue="lab", jobDefinition=inside)
    container = named["nodeProperties"]["nodeRangeProperties"][0]["container"]
    lab.batch("RegisterJobDefinition", jobDefinitionName="single", type="container", containerProperties=container)
    refused(foreign, lab.batch, "SubmitJob", jobName="x", jobQueue="lab", jobDefinition="single")
    for change in ("name=labs2", "queue=lab"):
        refused(foreign, lab.post, f"/api/runs/{world.run}/resume", {"set": [change, "queue=lab"]})
    waits = lab.batch("SubmitJob", jobName="x", jobQueue="lab", jobDefinition=own)["jobId"]
    refused(foreign, lab.post, f"/api/runs/{world.run}/clone", {"name": "labs-own", "set": ["queue=lab"]})
    teacher = {"train": {"task": "Cartpole", "rsl_rl": {"teacher_checkpoint": f"{world.run}@3"}}}
    for section in ({"evaluate": {"run": world.run}}, {"export": {"run": world.run}}, teacher):
        spec = json.dumps({"name": "x", **section})
        refused(foreign, lab.batch, "SubmitJob", **submission(own, "lab", MUSTER_SPEC=spec))
        later = {**submission(own, "lab", MUSTER_SPEC=spec), "dependsOn": [{"jobId": waits}]}
        refused(foreign, lab.batch, "SubmitJob", **later)
    train = {"train": {"task": "Cartpole", "worlds": 4, "iterations": 9}, "evaluation": {"every": 1, "queue": "robots"}}
    elsewhere = submission(own, "lab", MUSTER_SPEC=json.dumps({"name": "x", **train}))
    refused("it concerns job queue robots", lab.batch, "SubmitJob", **elsewhere)
    to_come = {
        **submission(own, "lab", MUSTER_SPEC='{"evaluate": {"run": "not-yet"}}'),
        "dependsOn": [{"jobId": waits}],
    }
    refused("run not-yet belongs to no known job queue", lab.batch, "SubmitJob", **to_come)
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
    httpx.post(
        f"{world.url}/v1/tags/{arn}",
        json={"tags": {"muster:queues": "other lab"}},
        headers={"Authorization": f"Bearer {TOKEN}"},
    ).raise_for_status()
    lab.batch("SubmitJob", **request)
    refused("key lab may use", lab.batch, "RegisterJobDefinition", **definition("common"))
    refused("key robots may use", world.clients["robots"].batch, "SubmitJob", **{**request, "jobQueue": "robots"})
    assert SECRET in json.dumps(lab.batch("DescribeJobDefinitions", jobDefinitionName="common"))
    assert admin.batch("DescribeJobDefinitions", jobDefinitionName="common")["jobDefinitions"][0]["revision"] == 1


def test_names_of_others_are_not_told_by_errors_and_not_found_by_name(world: World) -> None:
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
        os.environ["MUSTER_TOKEN"] = world.tokens[key]
        try:
            shown = json.loads(world.server.muster("queues", "--json").stdout)
        finally:
            del os.environ["MUSTER_TOKEN"]
        assert {queue["jobQueueName"] for queue in shown} >= names and ("robots" in str(shown)) is (key == "admin")


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
    refused("run moved belongs to job queue robots", world.clients["lab"].get, "/api/runs/moved")
    own = world.register("robots", "continuing")
    refused(
        "no known job queue",
        world.clients["robots"].batch,
        "SubmitJob",
        **submission(own, "robots", MUSTER_RUN="older"),
    )
    job = world.clients["admin"].batch("SubmitJob", **submission(own, "robots", MUSTER_RUN="older"))["jobId"]
    world.server.wait(job, "SUCCEEDED")
    assert world.clients["robots"].get("/api/runs/older")["queue"] == "robots"
