"""However large a request, what it makes and what it is answered stay within limits, and others are served meanwhile."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import event, func, select

from orchestrator.api.http.limits import LARGEST_COMMANDS
from orchestrator.api.logs.streams import newest_streams
from orchestrator.domain.errors import ClientError
from orchestrator.persistence.batch_models import Attempt, Job, Node
from orchestrator.persistence.session import Database
from orchestrator.server import Server
from orchestrator.services.context import Context
from orchestrator.services.permissions import CONTROLLER, Actor
from shared_store.volume.layout import Store
from tests.conftest import wait_for
from tests.support.definitions import container, multinode, single
from tests.support.orchestrator.rows import job

OVERSIZED = {
    "takes at most 100 jobs, not 400000": ("describejobs", '{"jobs": [%s1]}' % ("1," * 399_999)),
    "takes at most 50 tagKeys": ("untagresource", '{"resourceArn": "a", "tagKeys": [%s"a"]}' % ('"a",' * 50)),
    "more than 10000 values": ("listjobs", '{"jobQueue": [%s1]}' % ("1," * 400_000)),
    "nested deeper than 50 levels": ("listjobs", '{"jobQueue": ' + "[" * 60 + "]" * 60 + "}"),
    "is nested deeper than 50": ("listjobs", "[" * 100_000),
    f"({'9' * 30}…) is larger than {2**63 - 1}": ("createjobqueue", '{"priority": %s}' % ("9" * 100_000)),
    f"is larger than {2**63 - 1}": ("createjobqueue", '{"priority": -9223372036854775809}'),
    "a number of the request is too large": ("createschedulingpolicy", '{"name": "a", "fairsharePolicy": 1e999}'),
}
"""Operation and body, by the words of the refusal."""
LARGE = [{"name": f"A{number}", "value": "x" * 200} for number in range(90)]


@pytest.fixture(scope="module")
def waiting(http: httpx.Client) -> str:
    """A queue whose jobs don't start."""
    resources = {"type": "EC2", "maxvCpus": 1, "subnets": ["none"]}
    environment = {"computeEnvironmentName": "off", "type": "MANAGED", "state": "DISABLED"}
    call(http, "CreateComputeEnvironment", **environment, computeResources=resources)
    order = [{"order": 1, "computeEnvironment": "off"}]
    call(http, "CreateJobQueue", jobQueueName="waiting", priority=1, computeEnvironmentOrder=order)
    return "waiting"


def call(http: httpx.Client, operation: str, **request: Any) -> dict[str, Any]:
    answer = http.post(f"/v1/{operation.lower()}", json=request)
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def large_array(http: httpx.Client, queue: str, size: int, **request: Any) -> str:
    call(http, "RegisterJobDefinition", **single("large", container(environment=LARGE)))
    submission = {"jobName": "large", "jobQueue": queue, "jobDefinition": "large", "arrayProperties": {"size": size}}
    return str(call(http, "SubmitJob", **submission, **request)["jobId"])


def test_an_array_stores_its_definition_once_for_all_children(inside: Server, http: httpx.Client, waiting: str) -> None:
    array = large_array(http, waiting, 3_000, parameters={"a": "b"}, tags={"c": "d"})
    with inside.controller.database.session() as session:
        copies = select(func.count(Job.own_node_properties), func.count()).where(Job.parent == array)
        assert session.execute(copies).one() == (0, 3_000)
    parent, first, last = call(http, "DescribeJobs", jobs=[array, f"{array}:0", f"{array}:2999"])["jobs"]
    assert first["container"]["environment"] == last["container"]["environment"] == LARGE
    assert (last["parameters"], last["tags"]) == (parent["parameters"], parent["tags"]) == ({"a": "b"}, {"c": "d"})
    assert last["arrayProperties"] == {"index": 2999, "size": 3_000}
    call(http, "TerminateJob", jobId=array, reason="enough")
    call(http, "CancelJob", jobId=array, reason="too late")
    with inside.controller.database.session() as session:
        reasons = select(Job.stop_reason, Job.cancelled).where(Job.parent == array).distinct()
        assert [tuple(row) for row in session.execute(reasons)] == [("enough", False)]
    states = lambda: {each["status"] for each in call(http, "DescribeJobs", jobs=[array])["jobs"]}  # noqa: E731
    wait_for(lambda: states() == {"FAILED"}, 60, "the end")
    ended = call(http, "DescribeJobs", jobs=[array, f"{array}:77"])["jobs"]
    assert [(each["status"], each["statusReason"]) for each in ended] == [("FAILED", "enough")] * 2


@pytest.mark.parametrize("output", OVERSIZED)
def test_a_request_beyond_a_limit_is_refused_by_the_limits_name(http: httpx.Client, output: str) -> None:
    operation, body = OVERSIZED[output]
    answer = http.post(f"/v1/{operation}", content=body)
    assert answer.status_code == 400 and output in answer.json()["message"] and len(answer.text) < 500
    if operation == "listjobs":
        target = {"X-Amz-Target": "Logs_20140328.GetLogEvents", "Content-Type": "application/x-amz-json-1.1"}
        answer = http.post("/", content=body, headers=target)
        assert answer.status_code == 400 and output in answer.json()["message"] and len(answer.text) < 500


def test_metrics_come_in_pages_and_no_plan_is_longer_than_a_limit(inside: Server, http: httpx.Client) -> None:
    run = inside.store.run("long")
    run.create({"run": "long"})
    run.metrics.mkdir(exist_ok=True)
    records = "".join(f'{{"iteration": {number}, "time": 1.0}}\n' for number in range(1, 10_003))
    (run.metrics / "metrics-e1.jsonl").write_text(records)
    answer = http.get("/api/runs/long/metrics")
    page = answer.json()
    assert (len(page), page[-1]["iteration"]) == (10_000, 10_000)
    answer = http.get(answer.links["next"]["url"])
    assert [each["iteration"] for each in answer.json()] == [10_001, 10_002] and "next" not in answer.links
    assert [each["iteration"] for each in http.get("/api/runs/long/metrics?max=2").json()] == [1, 2]
    assert http.get("/api/runs/long/metrics?max=20000").status_code == 400

    resources = [{"type": "VCPU", "value": "0.001"}, {"type": "MEMORY", "value": "4"}]
    definition = multinode("wide", container(environment=LARGE, resourceRequirements=resources), 1000)
    answer = http.post("/api/plan", json={"queue": "default", "definition": definition})
    assert answer.status_code == 400 and "MiB of variables, more than 4" in answer.json()["message"]


def test_references_to_a_parameter_can_t_make_a_command_larger_than_the_limit(http: httpx.Client, waiting: str) -> None:
    call(http, "RegisterJobDefinition", **single("refs", container(["echo", "Ref::a " * 3_200])))
    submission = {"jobName": "refs", "jobQueue": waiting, "jobDefinition": "refs"}
    refused = http.post("/v1/submitjob", json={**submission, "parameters": {"a": "x" * 28_000}})
    assert refused.status_code == 400 and len(refused.content) < 1_000
    assert "the commands exceed 65536 bytes with their parameters substituted" in refused.json()["message"]
    most = (LARGEST_COMMANDS - len("echo") - 3_200) // 3_200
    job = call(http, "SubmitJob", **submission, parameters={"a": "x" * most})["jobId"]
    [detail] = call(http, "DescribeJobs", jobs=[job])["jobs"]
    assert detail["container"]["command"][1] == ("x" * most + " ") * 3_200
    refused = http.post("/v1/submitjob", json={**submission, "parameters": {"a": "x" * (most + 1)}})
    assert refused.status_code == 400, refused.text
    call(http, "TerminateJob", jobId=job, reason="enough")


def test_the_newest_streams_cost_one_statement_however_many_jobs_are_children_of_arrays(tmp_path: Path) -> None:
    database = Database.at(tmp_path)
    with database.session() as session:
        session.add(job("array", kind="array"))
        for index in range(3):
            attempt = Attempt(number=1, epoch=1, nodes=[Node(index=0, host="h")])
            child = {"parent": "array", "node_properties": None, "attempts": [attempt]}
            session.add(job(f"array:{index}", run=f"array-{index}", **child))
    statements: list[str] = []
    event.listen(database.engine, "before_cursor_execute", lambda *supplied: statements.append(supplied[2]))
    with database.session() as session:
        assert len(newest_streams(session, CONTROLLER, Store(tmp_path / "store"))) == 3
    assert len(statements) == 1, statements
    database.close()


def test_an_unknown_queue_is_refused_with_the_names_that_the_caller_may_see(inside: Server) -> None:
    actor = Actor("robots", frozenset({"robots"}))
    with inside.controller.database.session() as session, pytest.raises(ClientError) as refused:
        Context(session, inside.controller, actor).queue("nosuch")
    assert str(refused.value) == "Job queue nosuch does not exist; available: none"
