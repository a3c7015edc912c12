"""Lists, filters and pages; tags by percent-encoded ARN; and what every other operation of AWS answers."""

from __future__ import annotations

from typing import Any

import botocore.session
import httpx

from tests.conftest import wait_for
from tests.support.conformance.aws import PREFIX, Batch, aws, refused

HERE = {
    *("RegisterJobDefinition", "DescribeJobDefinitions", "DeregisterJobDefinition"),
    *("SubmitJob", "DescribeJobs", "ListJobs", "TerminateJob", "CancelJob", "TerminateJobs", "CancelJobs"),
    *("CreateJobQueue", "DescribeJobQueues", "UpdateJobQueue", "DeleteJobQueue", "GetJobQueueSnapshot"),
    *("CreateComputeEnvironment", "DescribeComputeEnvironments"),
    *("UpdateComputeEnvironment", "DeleteComputeEnvironment"),
    *("CreateSchedulingPolicy", "DescribeSchedulingPolicies", "ListSchedulingPolicies"),
    *("UpdateSchedulingPolicy", "DeleteSchedulingPolicy"),
    *("TagResource", "UntagResource", "ListTagsForResource"),
}
"""What is carried out; the others are refused."""


# -- lists and filters ------------------------------------------------------------------------------------------------


def test_filters_see_all_states_newest_first(batch: Batch, parked: str) -> None:
    names = ["Q-Train", "q-train2", "q-trainer", "q-other"]
    definitions = [batch.single(name, "true") for name in ("q-jd1", "Q-jd1", "q-jd1A")]
    definitions.append(batch.single("q-jd1", "true"))
    jobs = [batch.submit(each, name, parked) for each, name in zip(definitions, names, strict=True)]
    batch.api.terminate_job(jobId=jobs[1], reason="over")
    batch.wait(jobs[1])
    created = [batch.describe(job)["createdAt"] for job in jobs]

    def found(name: str, value: str, **query: Any) -> list[int]:
        page = batch.api.list_jobs(jobQueue=parked, filters=[{"name": name, "values": [value]}], **query)
        return [jobs.index(each["jobId"]) for each in page["jobSummaryList"] if each["jobId"] in jobs]

    assert found("JOB_NAME", "q-train") == [0], "the case does not matter, the end does"
    assert found("JOB_NAME", "Q-TRAIN*") == [2, 1, 0]
    assert found("JOB_NAME", "q-train*", jobStatus="SUCCEEDED") == [2, 1, 0], "a filter ignores the state"
    assert found("JOB_NAME", "q_train*") == found("JOB_NAME", "%") == []
    assert found("JOB_DEFINITION", "q-jd1") == [3, 0], "any revision, and the case matters"
    assert found("JOB_DEFINITION", "q-jd1*") == [3, 2, 0]
    assert found("JOB_DEFINITION", "Q-jd*") == [1]
    assert found("JOB_DEFINITION", definitions[3]) == [3]
    assert found("JOB_DEFINITION", f"{definitions[0][:-1]}*") == [], "no asterisk in an ARN"
    assert found("AFTER_CREATED_AT", str(created[0] - 1)) == [3, 2, 1, 0]
    assert found("AFTER_CREATED_AT", str(created[3])) == []
    before = found("BEFORE_CREATED_AT", str(created[3]))
    assert before == sorted((i for i in range(4) if created[i] < created[3]), reverse=True) and 0 in before
    assert found("SHARE_IDENTIFIER", "none") == []
    listed = batch.api.list_jobs(jobQueue=parked)["jobSummaryList"]
    assert listed == [], "without state and filter: those that run"
    ended = batch.api.list_jobs(jobQueue=parked, jobStatus="FAILED")["jobSummaryList"]
    assert [each["jobName"] for each in ended if each["jobId"] in jobs] == ["q-train2"]
    name = {"name": "JOB_NAME", "values": ["x"]}
    for filters, message in [
        ([name, name], "one filter at a time"),
        ([{"name": "JOB_NAME", "values": ["a", "b"]}], "takes one"),
        ([{"name": "STATUS", "values": ["a"]}], "is not known"),
        ([{"name": "AFTER_CREATED_AT", "values": ["today"]}], "in milliseconds"),
    ]:
        with refused(message):
            batch.api.list_jobs(jobQueue=parked, filters=filters)
    filters = ("--filters", "name=JOB_NAME,values=q-train*")
    typed = aws(batch.server.url, "batch", "list-jobs", "--job-queue", parked, *filters)
    assert [each["jobName"] for each in typed["jobSummaryList"]] == ["q-trainer", "q-train2", "Q-Train"]


def test_pages_follow_each_other_without_gap_or_repeat(batch: Batch, parked: str) -> None:
    definition = batch.single("q-paged", "true")
    jobs = [batch.submit(definition, queue=parked) for _ in range(101)]
    by_name: dict[str, Any] = {"jobQueue": parked, "filters": [{"name": "JOB_NAME", "values": ["q-paged"]}]}
    whole = batch.api.list_jobs(**by_name, maxResults=1000)
    assert len(whole["jobSummaryList"]) == 100 and whole["nextToken"], "at most 100 with a filter"
    last = batch.api.list_jobs(**by_name, nextToken=whole["nextToken"])
    assert "nextToken" not in last and [each["jobId"] for each in last["jobSummaryList"]] == [jobs[0]]
    pages = batch.api.get_paginator("list_jobs").paginate(**by_name, PaginationConfig={"PageSize": 30})
    assert [each["jobId"] for page in pages for each in page["jobSummaryList"]] == jobs[::-1]
    runnable = lambda: batch.api.list_jobs(jobQueue=parked, jobStatus="RUNNABLE")["jobSummaryList"]  # noqa: E731
    on_one_page = "all of them RUNNABLE, on one page"
    by_status = wait_for(lambda: len(found := runnable()) >= 101 and found, what=on_one_page)
    assert {each["jobId"] for each in by_status} >= set(jobs)
    # what comes between two pages moves nothing
    first = batch.api.list_jobs(**by_name, maxResults=50)
    newer = batch.submit(definition, queue=parked)
    second = batch.api.list_jobs(**by_name, maxResults=50, nextToken=first["nextToken"])
    assert [each["jobId"] for each in second["jobSummaryList"]] == jobs[1:51][::-1]
    assert batch.api.list_jobs(**by_name, maxResults=1)["jobSummaryList"][0]["jobId"] == newer
    for call in (batch.api.list_jobs, batch.api.describe_job_queues):
        with refused("is not one that was given out"):
            call(**({"jobQueue": parked} if call == batch.api.list_jobs else {}), nextToken="x")
    queues = batch.api.get_paginator("describe_job_queues").paginate(PaginationConfig={"PageSize": 1})
    names = [each["jobQueueName"] for page in queues for each in page["jobQueues"]]
    assert names == sorted(set(names)) and {"default", parked} <= set(names)
    paginator = batch.api.get_paginator("describe_compute_environments")
    compute_environments = paginator.paginate(PaginationConfig={"PageSize": 1})
    names = [each["computeEnvironmentName"] for page in compute_environments for each in page["computeEnvironments"]]
    assert names == sorted(set(names)) and parked in names
    front_of_queue = wait_for(lambda: len(found := batch.front(parked)) == 100 and found, what="a whole snapshot")
    assert [job for job in front_of_queue if job in jobs] == [job for job in jobs if job in front_of_queue]


# -- tags -------------------------------------------------------------------------------------------------------------


def test_everything_with_an_arn_has_tags(batch: Batch, parked: str) -> None:
    definition = batch.single("q-tagged", "true", tags={"from": "definition"}, propagateTags=True)
    job = batch.submit(definition, queue=parked, tags={"from": "job"})
    assert batch.describe(job)["tags"] == {"from": "job"}
    untagged = batch.submit(definition, queue=parked)
    assert batch.describe(untagged)["tags"] == {}, "what is propagated goes to the task, not to the job"
    policy = batch.api.create_scheduling_policy(name="q-tagged", fairsharePolicy={}, tags={"from": "policy"})["arn"]
    requests: list[str] = []
    batch.api.meta.events.register("before-send.batch.*", lambda request, **_: requests.append(request.url))
    for arn, before in [
        (f"{PREFIX}job/{job}", {"from": "job"}),
        (definition, {"from": "definition"}),
        (f"{PREFIX}job-queue/{parked}", {}),
        (f"{PREFIX}compute-environment/{parked}", {}),
        (policy, {"from": "policy"}),
    ]:
        assert batch.api.list_tags_for_resource(resourceArn=arn)["tags"] == before
        batch.api.tag_resource(resourceArn=arn, tags={"from": "test", "a/b:c": "ü 1", "gone": ""})
        batch.api.untag_resource(resourceArn=arn, tagKeys=["gone", "never there"])
        assert batch.api.list_tags_for_resource(resourceArn=arn)["tags"] == {"from": "test", "a/b:c": "ü 1"}
    assert any("/v1/tags/arn%3Aaws%3Abatch%3A" in url and "%2F" in url for url in requests), "one segment of the path"
    assert batch.describe(job)["tags"] == {"from": "test", "a/b:c": "ü 1"}
    shown = batch.api.describe_job_definitions(jobDefinitions=[definition])["jobDefinitions"][0]
    assert shown["tags"]["from"] == "test"
    array = batch.submit(definition, queue=parked, arrayProperties={"size": 2})
    gang = batch.submit(batch.multinode("q-tagged-gang", "true"), queue=parked)
    for arn, message in [
        (f"{PREFIX}job/{gang}#0", "nodes and children have no tags"),
        (f"{PREFIX}job/{array}:0", "nodes and children have no tags"),
        (f"{PREFIX}job/none", "does not exist"),
        (f"{PREFIX}job-queue/none", "does not exist"),
        (f"{PREFIX}job-definition/q-tagged:99", "does not exist"),
        (f"{PREFIX}job-definition/q-tagged", "does not exist"),
        (f"{PREFIX}consumable-resource/x", "does not exist"),
        ("no-arn", "is not an ARN"),
    ]:
        with refused(message):
            batch.api.tag_resource(resourceArn=arn, tags={"a": "1"})
        with refused(message):
            batch.api.list_tags_for_resource(resourceArn=arn)
    arn = f"{PREFIX}job/{job}"
    with refused("at most 50"):
        batch.api.tag_resource(resourceArn=arn, tags={f"key-{i}": "" for i in range(49)})
    for tags in ({"aws:x": "1"}, {"x" * 129: "1"}, {"x": "y" * 257}):
        with refused("keys have 1 to 128 characters"):
            batch.api.tag_resource(resourceArn=arn, tags=tags)
    aws(batch.server.url, "batch", "tag-resource", "--resource-arn", arn, "--tags", "typed=yes")
    aws(batch.server.url, "batch", "untag-resource", "--resource-arn", arn, "--tag-keys", "from", "a/b:c")
    typed = aws(batch.server.url, "batch", "list-tags-for-resource", "--resource-arn", arn)
    assert typed == {"tags": {"typed": "yes"}}
    batch.api.delete_scheduling_policy(arn=policy)


# -- what is not here -------------------------------------------------------------------------------------------------


def test_every_other_operation_of_aws_is_refused_by_name_with_what_to_use(batch: Batch) -> None:
    others = set(botocore.session.Session().get_service_model("batch").operation_names) - HERE
    assert len(others) >= 20
    for name in sorted(others):
        answer = httpx.post(f"{batch.server.url}/v1/{name.lower()}", content=b"{}")
        assert answer.status_code == 400 and answer.headers["x-amzn-errortype"] == "ClientException", name
        message = answer.json()["message"]
        assert message.startswith(f"{name} is not supported here; ")
        assert "use " in message or "supported are " in message
    for part, instead in [
        ("SubmitServiceJob", "SubmitJob"),
        ("CreateServiceEnvironment", "CreateComputeEnvironment"),
        ("CreateQuotaShare", "CreateSchedulingPolicy"),
        ("CreateConsumableResource", "job queue"),
    ]:
        assert instead in httpx.post(f"{batch.server.url}/v1/{part.lower()}", content=b"{}").json()["message"]
    with refused("ListServiceJobs is not supported here; use SubmitJob"):
        batch.api.list_service_jobs(jobQueue="default")
    output = aws(batch.server.url, "batch", "list-consumable-resources", fails=True)
    assert "(ClientException) when calling the ListConsumableResources operation: ListConsumableResources" in output
    unknown = httpx.post(f"{batch.server.url}/v1/makecoffee", content=b"{}")
    assert unknown.status_code == 400 and "makecoffee is not an operation" in unknown.json()["message"]
