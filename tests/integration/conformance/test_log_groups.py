"""Log groups of users: jobs that log there, and what scripts, covalent and Terraform call before and after a job."""

from __future__ import annotations

import itertools
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from botocore.exceptions import ParamValidationError

from tests.conftest import Serving, run_muster, wait_for
from tests.support.conformance.aws import Batch, aws, container, refused
from tests.support.conformance.streams import ARN, GROUP, client_of, messages

ARNS = ARN.removesuffix(GROUP)
_numbers = itertools.count()


@pytest.fixture(scope="module")
def logs(shared_server: Serving) -> Any:
    return client_of(shared_server.url)


@pytest.fixture
def own() -> str:
    """Name of a group that does not exist yet."""
    return f"/fleet/{next(_numbers)}"


def logging_to(group: str | None, prefix: str | None = None, **more: str) -> dict[str, Any]:
    options = {"awslogs-group": group, "awslogs-stream-prefix": prefix, **more}
    return {"logDriver": "awslogs", "options": {key: value for key, value in options.items() if value is not None}}


def names_in(logs: Any, group: str, **query: Any) -> list[str]:
    return [each["logStreamName"] for each in logs.describe_log_streams(logGroupName=group, **query)["logStreams"]]


def groups_of(logs: Any, prefix: str) -> list[dict[str, Any]]:
    return list(logs.describe_log_groups(logGroupNamePrefix=prefix)["logGroups"])


# -- jobs -------------------------------------------------------------------------------------------------------------


def test_a_job_logs_to_the_group_of_its_definition_and_nowhere_else(batch: Batch, logs: Any, own: str) -> None:
    definition = batch.single(
        "fleet", "echo to the fleet", container={"logConfiguration": logging_to(own, "x", **{"mode": "non-blocking"})}
    )
    job = batch.submit(definition)
    batch.server.wait(job)
    name = batch.describe(job)["container"]["logStreamName"]
    assert name == f"x/{job}/1/node-0"
    for reference in ({"logGroupName": own}, {"logGroupIdentifier": own}, {"logGroupIdentifier": f"{ARNS}{own}"}):
        assert messages(logs.get_log_events(**reference, logStreamName=name)) == ["to the fleet"]
        assert messages(logs.filter_log_events(**reference, filterPattern="fleet")) == ["to the fleet"]
        [stream] = logs.describe_log_streams(**reference)["logStreams"]
        assert stream["arn"] == f"{ARNS}{own}:log-stream:{name}" and stream["storedBytes"] > 0
    for prefix, found in (("x", 1), ("x/", 1), (f"x/{job}/1/n", 1), ("fleet", 0), ("X/", 0), (f"x/{job[:9]}0", 0)):
        assert len(names_in(logs, own, logStreamNamePrefix=prefix)) == found, prefix
    with pytest.raises(logs.exceptions.ResourceNotFoundException, match="log stream does not exist"):
        logs.get_log_events(logGroupName=GROUP, logStreamName=name)
    assert names_in(logs, GROUP, logStreamNamePrefix="x/") == []
    with pytest.raises(logs.exceptions.ResourceNotFoundException, match="log group does not exist"):
        logs.get_log_events(logGroupName=f"{own}x", logStreamName=name)
    [group] = groups_of(logs, own)
    assert group["storedBytes"] == stream["storedBytes"] and group["arn"] == f"{ARNS}{own}:*"
    assert "to the fleet" in batch.server.log(job), "`muster logs` needs no group"


def test_a_prefix_without_a_group_stays_in_the_usual_one(batch: Batch, logs: Any) -> None:
    definition = batch.single("prefixed", "echo here", container={"logConfiguration": logging_to(None, "a/b")})
    job = batch.submit(definition)
    batch.server.wait(job)
    name = batch.describe(job)["container"]["logStreamName"]
    assert name == f"a/b/{job}/1/node-0" and names_in(logs, GROUP, logStreamNamePrefix="a/b/") == [name]
    assert messages(logs.get_log_events(logGroupName=GROUP, logStreamName=name)) == ["here"]


def test_nodes_of_different_groups_and_a_job_grown_by_an_override(
    batch: Batch, logs: Any, own: str, tmp_path: Path
) -> None:
    output = "echo node $AWS_BATCH_JOB_NODE_INDEX"
    last = f"until [ -e {tmp_path}/1 ] && [ -e {tmp_path}/2 ]; do sleep 0.1; done; {output}"  # its end ends the others

    def part(target: str, group: str | None) -> dict[str, Any]:
        changes = {"container": {"logConfiguration": logging_to(group)} if group else {}}
        command = f"{output}; touch {tmp_path}/$AWS_BATCH_JOB_NODE_INDEX" if group else last
        return {"targetNodes": target, "container": container(command, changes)}

    definition = batch.multinode("split", "", nodes=2, ranges=[part("0", None), part("1:", own)])
    job = batch.submit(definition, nodeOverrides={"numNodes": 3})
    batch.server.wait(job)
    assert names_in(logs, own) == [f"split/{job}/1/node-1", f"split/{job}/1/node-2"]
    assert names_in(logs, GROUP, logStreamNamePrefix=f"split/{job}") == [f"split/{job}/1/node-0"]
    shown = batch.describe(f"{job}#2")["container"]
    assert messages(logs.get_log_events(logGroupName=own, logStreamName=shown["logStreamName"])) == ["node 2"]
    assert shown["logConfiguration"]["options"] == {"awslogs-group": own}


def test_children_of_an_array_from_ecs_properties(batch: Batch, logs: Any, own: str) -> None:
    inside = {**container("echo $AWS_BATCH_JOB_ARRAY_INDEX", {}), "logConfiguration": logging_to(own, "arr")}
    properties = {"taskProperties": [{"containers": [{**inside, "name": "main", "essential": True}]}]}
    definition = batch.register("ecs-fleet", "container", ecsProperties=properties)
    job = batch.submit(definition, arrayProperties={"size": 2})
    for child in (0, 1):
        batch.server.wait(f"{job}:{child}")
        page = logs.get_log_events(logGroupName=own, logStreamName=f"arr/{job}.{child}/1/node-0")
        assert messages(page) == [str(child)]
    assert len(names_in(logs, own, logStreamNamePrefix=f"arr/{job}")) == 2


def test_a_live_tail_of_two_groups_names_the_group_of_each_line(
    batch: Batch, logs: Any, own: str, tmp_path: Path
) -> None:
    logs.create_log_group(logGroupName=own)
    lines: list[dict[str, Any]] = []
    started = threading.Event()
    tail = logs.start_live_tail(logGroupIdentifiers=[f"{ARNS}{own}", ARN])["responseStream"]

    def read() -> None:
        try:
            for message in tail:
                started.set()
                lines.extend(message.get("sessionUpdate", {}).get("sessionResults", []))
        except Exception:  # closed under it
            pass

    threading.Thread(target=read, daemon=True).start()
    wait_for(started.is_set)
    script = f'until [ -e "{tmp_path}/go" ]; do echo tailed {own}; sleep 0.1; done'
    jobs = [
        batch.submit(batch.single("tailed-own", script, container={"logConfiguration": logging_to(own)})),
        batch.submit(batch.single("tailed-usual", script)),
    ]
    requested = {f"000000000000:{own}", f"000000000000:{GROUP}"}
    wait_for(lambda: {line["logGroupIdentifier"] for line in lines if own in line["message"]} == requested)
    (tmp_path / "go").touch()
    for job in jobs:
        batch.server.wait(job)
    tail.close()
    assert all(
        ("own" in line["logStreamName"]) == (own in line["logGroupIdentifier"])
        for line in lines
        if own in line["message"]
    )
    with pytest.raises(logs.exceptions.InvalidParameterException, match="exactly one log group"):
        logs.start_live_tail(logGroupIdentifiers=[own, GROUP], logStreamNames=["a"])


@pytest.mark.parametrize("name", ["", "a b", "a:b", "aws/mine", "é", "x" * 513, "*"])
def test_a_name_that_no_group_can_have_is_refused_where_it_is_given(batch: Batch, logs: Any, name: str) -> None:
    with refused("awslogs-group", "1 to 512 letters"):
        batch.single("misnamed", "true", container={"logConfiguration": logging_to(name)})
    with pytest.raises((logs.exceptions.InvalidParameterException, ParamValidationError)):
        logs.create_log_group(logGroupName=name)


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("awslogs-stream-prefix", "a:b", "awslogs-stream-prefix 'a:b'"),
        ("mode", "weird", "logConfiguration mode is 'weird'; it is blocking or non-blocking"),
        ("awslogs-create-group", "maybe", "logConfiguration awslogs-create-group is 'maybe'; it is true or false"),
    ],
)
def test_a_value_that_an_option_can_t_have_is_refused(batch: Batch, option: str, value: str, words: str) -> None:
    with refused(words):
        batch.single("misset", "true", container={"logConfiguration": logging_to(None, **{option: value})})


@pytest.mark.parametrize("value", ["true", "True", "0", ""])
def test_every_option_of_the_driver_is_taken_and_a_truth_value_as_docker_s_takes_it(batch: Batch, value: str) -> None:
    options = {"awslogs-region": "us-west-2", "awslogs-create-group": value, "mode": "blocking" if value else ""}
    options |= {"awslogs-datetime-format": "%Y", "awslogs-multiline-pattern": "^a", "max-buffer-size": "4m"}
    batch.single("options", "true", container={"logConfiguration": logging_to("/options", "p", **options)})


# -- the groups -------------------------------------------------------------------------------------------------------


def test_what_exists_already_is_refused_as_on_aws(logs: Any, own: str) -> None:
    for name in (GROUP, own):
        if name == own:
            logs.create_log_group(logGroupName=own)
        with pytest.raises(logs.exceptions.ResourceAlreadyExistsException, match="log group already exists"):
            logs.create_log_group(logGroupName=name)
    logs.create_log_stream(logGroupName=own, logStreamName="mine")
    with pytest.raises(logs.exceptions.ResourceAlreadyExistsException, match="log stream already exists"):
        logs.create_log_stream(logGroupName=own, logStreamName="mine")
    for call, request in (
        (logs.create_log_stream, {"logStreamName": "x"}),
        (logs.put_retention_policy, {"retentionInDays": 7}),
        (logs.delete_retention_policy, {}),
        (logs.delete_log_group, {}),
        (logs.describe_log_streams, {}),
    ):
        with pytest.raises(logs.exceptions.ResourceNotFoundException, match="log group does not exist"):
            call(logGroupName=f"{own}/other", **request)


def test_a_stream_of_a_client_is_empty_and_a_job_s_can_neither_be_made_nor_deleted(
    batch: Batch, logs: Any, own: str
) -> None:
    definition = batch.single("streams", "echo x", container={"logConfiguration": logging_to(own)})
    job = batch.submit(definition)
    batch.server.wait(job)
    of_job = batch.describe(job)["container"]["logStreamName"]
    logs.create_log_stream(logGroupName=own, logStreamName="mine")
    assert names_in(logs, own) == sorted(["mine", of_job])
    page = logs.get_log_events(logGroupName=own, logStreamName="mine", startFromHead=True)
    assert page["events"] == []
    again = logs.get_log_events(logGroupName=own, logStreamName="mine", nextToken=page["nextForwardToken"])
    assert again["nextForwardToken"] == page["nextForwardToken"]
    assert messages(logs.filter_log_events(logGroupName=own, logStreamNames=["mine", of_job])) == ["x"]
    with pytest.raises(logs.exceptions.ResourceAlreadyExistsException):
        logs.create_log_stream(logGroupName=own, logStreamName=of_job)
    with pytest.raises(logs.exceptions.InvalidParameterException, match="is a job's"):
        logs.delete_log_stream(logGroupName=own, logStreamName=of_job)
    logs.delete_log_stream(logGroupName=own, logStreamName="mine")
    with pytest.raises(logs.exceptions.ResourceNotFoundException, match="log stream does not exist"):
        logs.delete_log_stream(logGroupName=own, logStreamName="mine")
    with pytest.raises(logs.exceptions.InvalidParameterException, match="without ':'"):
        logs.create_log_stream(logGroupName=own, logStreamName="a:b")


def test_a_retention_is_shown_and_only_aws_s_values_are_taken(logs: Any, own: str) -> None:
    logs.create_log_group(logGroupName=own)
    for group in (own, GROUP):
        logs.put_retention_policy(logGroupName=group, retentionInDays=14)
        assert groups_of(logs, group)[0]["retentionInDays"] == 14
        for days in (0, 2, 366, 10**9):
            with pytest.raises(logs.exceptions.InvalidParameterException, match=f"is {days}; it is one of 1, 3, 5"):
                logs.put_retention_policy(logGroupName=group, retentionInDays=days)
        logs.delete_retention_policy(logGroupName=group)
        assert "retentionInDays" not in groups_of(logs, group)[0]


def test_groups_are_listed_by_prefix_by_pattern_by_arn_and_in_pages(logs: Any, own: str) -> None:
    names = [f"{own}/Page{number}" for number in range(5)]
    for name in names:
        logs.create_log_group(logGroupName=name)
    pages = list(
        logs.get_paginator("describe_log_groups").paginate(logGroupNamePrefix=own, PaginationConfig={"PageSize": 2})
    )
    assert [[group["logGroupName"] for group in page["logGroups"]] for page in pages] == [
        names[:2],
        names[2:4],
        names[4:],
    ]
    brief = logs.describe_log_groups(logGroupNamePattern=f"{own}/Page3")["logGroups"]
    assert [set(group) for group in brief] == [{"logGroupName", "creationTime", "arn"}]
    assert logs.describe_log_groups(logGroupNamePattern=f"{own}/page3")["logGroups"] == []
    requested = [names[1], f"{ARNS}{names[2]}", f"{ARNS}{names[4]}:*", "/no/such"]
    found = logs.describe_log_groups(logGroupIdentifiers=requested)["logGroups"]
    assert [group["logGroupName"] for group in found] == [names[1], names[2], names[4]]
    with pytest.raises(logs.exceptions.InvalidParameterException, match="nextToken"):
        logs.describe_log_groups(nextToken="x")


def test_the_usual_group_stays_and_a_deleted_one_takes_its_streams_from_view(batch: Batch, logs: Any, own: str) -> None:
    with pytest.raises(logs.exceptions.InvalidParameterException, match="can't be deleted"):
        logs.delete_log_group(logGroupName=GROUP)
    definition = batch.single("gone", "echo kept", container={"logConfiguration": logging_to(own)})
    job = batch.submit(definition)
    batch.server.wait(job)
    logs.create_log_stream(logGroupName=own, logStreamName="mine")
    logs.delete_log_group(logGroupName=own)
    assert groups_of(logs, own) == [] and names_in(logs, GROUP, logStreamNamePrefix=f"gone/{job}") == []
    logs.create_log_group(logGroupName=own)
    assert names_in(logs, own) == []
    assert "kept" in batch.server.log(job), "the log itself is the run's"
    second = batch.submit(definition)
    batch.server.wait(second)
    assert names_in(logs, own) == [f"gone/{second}/1/node-0"]


@pytest.mark.parametrize(
    ("operation", "request_", "instead"),
    [
        ("start_query", {"logGroupName": GROUP, "startTime": 1, "endTime": 2, "queryString": "x"}, "FilterLogEvents"),
        ("get_query_results", {"queryId": "x"}, "FilterLogEvents"),
        ("put_log_events", {"logGroupName": GROUP, "logStreamName": "x", "logEvents": [{"timestamp": 1, "message": "x"}]}, "what jobs print"),
        ("put_metric_filter", {"logGroupName": GROUP, "filterName": "a", "filterPattern": "b", "metricTransformations": [{"metricName": "a", "metricNamespace": "b", "metricValue": "1"}]}, "/metrics"),
        ("list_tags_log_group", {"logGroupName": GROUP}, "ListTagsForResource"),
        ("create_log_group", {"logGroupName": "/k", "kmsKeyId": "k"}, "kmsKeyId is not supported"),
        ("create_log_group", {"logGroupName": "/k", "logGroupClass": "DELIVERY"}, "use STANDARD"),
    ],
)  # fmt: skip
def test_what_is_not_here_is_refused_by_its_name(logs: Any, operation: str, request_: Any, instead: str) -> None:
    with pytest.raises(logs.exceptions.InvalidParameterException, match=instead):
        getattr(logs, operation)(**request_)


# -- clients ----------------------------------------------------------------------------------------------------------


def test_as_terraform_manages_a_log_group(logs: Any, own: str) -> None:
    """``aws_cloudwatch_log_group``: create, read, update and destroy, as its provider calls them."""
    logs.create_log_group(logGroupName=own, logGroupClass="STANDARD", tags={"team": "fleet"})
    logs.put_retention_policy(logGroupName=own, retentionInDays=30)
    [group] = [each for each in groups_of(logs, own) if each["logGroupName"] == own]
    assert (group["retentionInDays"], group["logGroupClass"]) == (30, "STANDARD")
    arn = group["arn"].removesuffix(":*")
    assert arn == group["logGroupArn"]
    assert logs.list_tags_for_resource(resourceArn=arn)["tags"] == {"team": "fleet"}
    logs.tag_resource(resourceArn=arn, tags={"team": "lab", "cost": "1"})
    logs.untag_resource(resourceArn=arn, tagKeys=["cost", "none"])
    assert logs.list_tags_for_resource(resourceArn=arn)["tags"] == {"team": "lab"}
    logs.delete_retention_policy(logGroupName=own)
    logs.delete_log_group(logGroupName=own)
    assert groups_of(logs, own) == []
    with pytest.raises(logs.exceptions.ResourceNotFoundException):
        logs.list_tags_for_resource(resourceArn=arn)


def test_as_covalent_runs_a_task(batch: Batch, logs: Any) -> None:
    """covalent-awsbatch-plugin: a definition with a log group of its own, its stream by the name that DescribeJobs tells."""
    options = {"awslogs-region": "us-east-1", "awslogs-group": "covalent-batch-job-logs"}
    options |= {"awslogs-create-group": "true", "awslogs-stream-prefix": "covalent-batch"}
    roles = {"jobRoleArn": "arn:aws:iam::000000000000:role/a", "executionRoleArn": "arn:aws:iam::000000000000:role/b"}
    definition = batch.single(
        "dispatch-0",
        "echo result",
        container={**roles, "logConfiguration": {"logDriver": "awslogs", "options": options}},
        retryStrategy={"attempts": 3},
        timeout={"attemptDurationSeconds": 300},
        platformCapabilities=["EC2"],
    )
    job = batch.submit(definition, "covalent-batch-dispatch-0")
    batch.server.wait(job)
    stream = batch.describe(job)["container"]["logStreamName"]
    page = logs.get_log_events(logGroupName="covalent-batch-job-logs", logStreamName=stream)
    assert messages(page) == ["result"] and stream.startswith("covalent-batch/")


def test_as_a_shell_script_prepares_and_reads_a_group(batch: Batch, own: str) -> None:
    """The real ``aws`` command."""
    url = batch.server.url
    reported = aws(url, "logs", "create-log-group", "--log-group-name", GROUP, fails=True)
    assert "(ResourceAlreadyExistsException)" in reported
    aws(url, "logs", "put-retention-policy", "--log-group-name", GROUP, "--retention-in-days", "7")
    aws(url, "logs", "create-log-group", "--log-group-name", own, "--tags", "a=b")
    aws(url, "logs", "create-log-stream", "--log-group-name", own, "--log-stream-name", "s")
    [group] = aws(url, "logs", "describe-log-groups", "--log-group-name-prefix", own)["logGroups"]
    assert aws(url, "logs", "list-tags-for-resource", "--resource-arn", group["logGroupArn"])["tags"] == {"a": "b"}
    assert aws(url, "logs", "describe-log-streams", "--log-group-name", own)["logStreams"][0]["logStreamName"] == "s"
    aws(url, "logs", "delete-log-group", "--log-group-name", own)
    aws(url, "logs", "delete-retention-policy", "--log-group-name", GROUP)
    query = ["--start-time", "1", "--end-time", "2", "--query-string", "x"]
    assert "StartQuery is not supported; search with FilterLogEvents" in aws(
        url, "logs", "start-query", "--log-group-name", GROUP, *query, fails=True
    )


# -- the account and the region ---------------------------------------------------------------------------------------


@pytest.fixture
def abroad(tmp_path: Path) -> Iterator[Serving]:
    options = ("--account-id", "123456789012", "--region", "eu-central-1", "--cpus", "4")
    with Serving(tmp_path / "home", *options) as server:
        yield server


def test_a_controller_of_another_account_and_region(abroad: Serving, tmp_path: Path) -> None:
    """Every ARN that it gives out or takes; the first start settles them."""
    batch, logs = Batch(abroad), client_of(abroad.url)
    prefix = "arn:aws:batch:eu-central-1:123456789012:"
    definition = batch.single("abroad", "echo hello", container={"logConfiguration": logging_to("/abroad")})
    assert definition == f"{prefix}job-definition/abroad:1"
    job = batch.submit(definition, queue=f"{prefix}job-queue/default")
    abroad.wait(job)
    detail = batch.describe(f"{prefix}job/{job}")
    assert (detail["jobArn"], detail["jobDefinition"]) == (f"{prefix}job/{job}", definition)
    assert detail["jobQueue"] == f"{prefix}job-queue/default"
    assert detail["container"]["taskArn"].startswith("arn:aws:ecs:eu-central-1:123456789012:task/")
    listed = batch.api.list_jobs(jobQueue="default", filters=[{"name": "JOB_DEFINITION", "values": ["abroad"]}])
    assert [each["jobId"] for each in listed["jobSummaryList"]] == [job]
    arn = "arn:aws:logs:eu-central-1:123456789012:log-group:/abroad"
    assert groups_of(logs, "/abroad")[0]["logGroupArn"] == arn
    assert messages(logs.filter_log_events(logGroupIdentifier=arn)) == ["hello"]
    described = [batch.api.describe_job_queues(), batch.api.describe_compute_environments(), detail]
    described.append(batch.api.describe_job_definitions())
    assert "000000000000" not in json.dumps(described, default=str) and "us-east-1" not in json.dumps(
        described, default=str
    )
    with refused("is not an ARN of this controller", prefix):
        batch.api.describe_jobs(jobs=[f"arn:aws:batch:us-east-1:000000000000:job/{job}"])
    assert "region eu-central-1 --profile" in abroad.muster("keys", "create", "someone").stdout


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--account-id", "123"), "expected 12 digits"),
        (("--region", "nowhere"), "expected a region of AWS"),
    ],
)
def test_a_malformed_account_or_region_is_refused(tmp_path: Path, options: tuple[str, ...], words: str) -> None:
    done = serve(tmp_path / "home", *options)
    assert words in done and "Traceback" not in done
    with Serving(tmp_path / "home", "--account-id", "123456789012") as server:  # nothing was settled by the refusal
        assert ":123456789012:" in Batch(server).api.describe_job_queues()["jobQueues"][0]["jobQueueArn"]


def serve(home: Path, *options: str) -> str:
    """What ``muster serve`` says that does not start."""
    done = run_muster("serve", "--port", "0", *options, home=home)
    assert done.returncode != 0
    return done.stderr


def test_another_account_later_is_refused_with_the_way_to_have_it(tmp_path: Path) -> None:
    home = tmp_path / "home"
    with Serving(home, "--region", "cn-north-1") as server:
        arn = Batch(server).api.describe_job_queues()["jobQueues"][0]["jobQueueArn"]
        assert arn == "arn:aws-cn:batch:cn-north-1:000000000000:job-queue/default"
    for options in (("--region", "us-east-1"), ("--account-id", "123456789012")):
        output = serve(home, *options)
        assert "account 000000000000 in cn-north-1 since its first start" in output and "another MUSTER_HOME" in output
    with Serving(home) as server, Serving(home / "other", "--region", "us-east-1"):
        assert Batch(server).api.describe_job_queues()["jobQueues"][0]["jobQueueArn"] == arn
