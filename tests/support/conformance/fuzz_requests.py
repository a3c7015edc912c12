"""What the fuzzing is made of: odd values, names that hit something, and requests that work.

Requests hold placeholders (``<gang>``, ``<array>`` …) for the ids that a server gives out, so that the same examples can be drawn
for every server; ``<new>`` is another name each time.
"""

from __future__ import annotations

import math
from typing import Any

from orchestrator.api.batch import paging

PREFIX = "arn:aws:batch:us-east-1:000000000000:"
GROUP_ARN = "arn:aws:logs:us-east-1:000000000000:log-group:/aws/batch/job"
ODD_TEXTS = (
    *("", " ", "\0", "a\0b", "\n", "\r\n", "\x1b[0m", "\u202e", "é", "Ω" * 64, "😀", "\ud800", "a\udfffb", "\ufeff"),
    *("x" * 128, "x" * 129, "x" * 256, "x" * 1025, "x" * 20_000, "../..", "..", "/", "%2F", "%00", "#", "#0", ":"),
    ":0",
    *("*", "a*b", "**", "-x", "_", "null", "true", "NaN", "-1", "0", "1", "1e9", "9" * 30, "9" * 5000, "٣", "0.5"),
    *("Ref::", "Ref::who", "Ref::nobody", "${x}", "$(x)", "%s%n", "{}", "'", '"', "\\", "';--", "AWS_BATCH_X", "aws:x"),
    *("arn:", "arn:aws:batch:::", f"{PREFIX}job/", f"{PREFIX}job-queue/../x"),
    f"{PREFIX}job-definition/fuzz:{'9' * 30}",
    *("MUSTER_SPEC", "MUSTER_RUN", "MUSTER_MIN_NODES", "W10=", "WyJ4Il0=", "f/1", "b/99999999999999999"),
    f"f{'9' * 56}",
)
NUMBERS = (
    *(0, 1, -1, 2, 3, 4, 59, 60, 99, 100, 101, 600, 1001, 9999, 10_001, 86_400, 2**31 - 1, 2**31, 2**53 + 1),
    *(2**63 - 1, 2**63, -(2**63), -(2**63) - 1, 10**30, 10**400, 0.0, -0.0, 0.5, 1e308, 5e-324),
    *(math.nan, math.inf, -math.inf),
)
# what a member of this name may hold so that it hits something; by the end of the member's name, lower case
_JOBS = ("<gang>", "<single>", "<array>", "<waiting>", "<gang>#0", "<gang>#1", "<array>:1", f"{PREFIX}job/<gang>#1")
_QUEUES = ("fuzz", "default", "fair", f"{PREFIX}job-queue/fair", "spare", "made")
_DEFINITIONS = ("gang", "gang:1", "single", f"{PREFIX}job-definition/gang", f"{PREFIX}job-definition/single:1", "made")
_POOLS = ("fuzz", "local", f"{PREFIX}compute-environment/fuzz", "spare", "made")
STREAMS = ("gang/<gang>/1/node-0", "gang/<gang>/1/node-1", "single/<single>/1/node-0", "gang/", "gang/<gang>/2/node-0")
_GROUPS = ("/aws/batch/job", GROUP_ARN, f"{GROUP_ARN}:*", "/aws", "/made")
TARGETS = ("0:", "0", "0:0", "1:", "0:1", ":1", "1", ":", "5:1", "999999", "0:999999")
_POSITIONS: tuple[list[Any], ...] = ([], [0], ["a"], ["a", 1], [1, "a"], ["a", "b"], [2**63, "a"])
_POSITIONS += (["\ud800", 1], ["a\0", 1], ["\ud800"], [-1], [None, {}])
KNOWN = {
    **dict.fromkeys(("jobid", "jobs"), _JOBS),
    **dict.fromkeys(("jobqueue", "jobqueues", "jobqueuename"), _QUEUES),
    **dict.fromkeys(("jobdefinition", "jobdefinitions"), _DEFINITIONS),
    "jobdefinitionname": ("gang", "single", "made"),
    **dict.fromkeys(("computeenvironment", "computeenvironments", "computeenvironmentname"), _POOLS),
    "arn": (f"{PREFIX}scheduling-policy/fuzz", f"{PREFIX}scheduling-policy/made"),
    **dict.fromkeys(("arns", "schedulingpolicyarn"), (f"{PREFIX}scheduling-policy/fuzz",)),
    "shareidentifier": ("blue", "red*", "*"),
    "targetnodes": TARGETS,
    **dict.fromkeys(("logstreamname", "logstreamnames", "logstreamnameprefix", "logstreamnameprefixes"), STREAMS),
    **dict.fromkeys(("loggroupname", "loggroupidentifier", "loggroupidentifiers"), _GROUPS),
    "filterpattern": ("line", '"a line" -x', "%l[ia]ne+$%", "{ $.x = 1 }", "?a ?b", "%(%", "%[%", "%a{1,999}%"),
    "image": ("any",),
    "command": ("true", "Ref::who"),
    "onexitcode": ("0", "1*", "137"),
    "nexttoken": (*map(paging.encode, _POSITIONS), "W10=", f"f{'0' * 56}", "f/0", "b/5", "1/x", "0/gang/"),
    "name": (
        *("GREETING", "MUSTER_SPEC", "MUSTER_STALL_TIMEOUT", "MUSTER_MIN_NODES", "MUSTER_RUN"),
        "MUSTER_ON_CHILD_FAILURE",
    ),
    "value": ("2", "nan", '{"name": "\\ud800"}', '{"name": NaN}', "[]", "null", '"x"', "1e400", "restart"),
}
ARRAYS = (2, 3, 1, 0, -1, 10_001)
"""An array of 10,000 is valid, but takes its time."""


def _container(**changes: Any) -> dict[str, Any]:
    return {
        "image": "any",
        "command": ["echo", "a line", "Ref::who"],
        "environment": [{"name": "GREETING", "value": "hello"}],
        "resourceRequirements": [{"type": "VCPU", "value": "1"}, {"type": "MEMORY", "value": "16"}],
        **changes,
    }


def gang(name: str) -> dict[str, Any]:
    """RegisterJobDefinition of two nodes."""
    ranges = [{"targetNodes": "0:", "container": _container()}]
    properties = {"numNodes": 2, "mainNode": 0, "nodeRangeProperties": ranges}
    definition = {"jobDefinitionName": name, "type": "multinode", "nodeProperties": properties}
    retry = {"attempts": 2, "evaluateOnExit": [{"onExitCode": "1*", "action": "EXIT"}]}
    return {**definition, "parameters": {"who": "all"}, "retryStrategy": retry}


def single(name: str) -> dict[str, Any]:
    """RegisterJobDefinition of one node."""
    definition = {"jobDefinitionName": name, "type": "container", "containerProperties": _container()}
    return {**definition, "parameters": {"who": "you"}, "timeout": {"attemptDurationSeconds": 60}}


def old(name: str) -> dict[str, Any]:
    """The same with the fields that AWS has deprecated."""
    container = {**_container(), "vcpus": 1, "memory": 16, "resourceRequirements": []}
    return {**single(name), "containerProperties": container}


def ecs(name: str) -> dict[str, Any]:
    """One node, the newer way; with what is checked by a rule of its own."""
    log = {"logDriver": "awslogs", "options": {}}
    container = {**_container(), "name": "main", "user": "nobody", "logConfiguration": log}
    volumes = [{"name": "v", "host": {"sourcePath": "/v"}}]
    tasks = [{"containers": [container], "taskRoleArn": "any", "volumes": volumes}]
    return {"jobDefinitionName": name, "type": "container", "ecsProperties": {"taskProperties": tasks}}


def submission(definition: str, queue: str = "fuzz", **more: Any) -> dict[str, Any]:
    return {"jobName": "fuzz", "jobQueue": queue, "jobDefinition": definition, **more}


def environment(name: str) -> dict[str, Any]:
    resources = {"type": "EC2", "maxvCpus": 8, "subnets": ["a"], "instanceRole": "any", "instanceTypes": ["any"]}
    return {"computeEnvironmentName": name, "type": "MANAGED", "state": "DISABLED", "computeResources": resources}


def queue(name: str, **more: Any) -> dict[str, Any]:
    order = [{"order": 1, "computeEnvironment": "fuzz"}]
    return {"jobQueueName": name, "priority": 1, "computeEnvironmentOrder": order, **more}


def policy(name: str) -> dict[str, Any]:
    shares = [{"shareIdentifier": "blue", "weightFactor": 0.5}, {"shareIdentifier": "red*"}]
    return {"name": name, "fairsharePolicy": {"shareDecaySeconds": 60, "shareDistribution": shares}}


_SETTINGS = [{"name": "MUSTER_SPEC", "value": "{}"}, {"name": "MUSTER_MIN_NODES", "value": "1"}, {"name": "A"}]
_OVERRIDE = {"targetNodes": "0:", "containerOverrides": {"command": ["true"], "environment": _SETTINGS}}
_LIMIT = {"reason": "CAPACITY:INSUFFICIENT_INSTANCE_CAPACITY", "state": "RUNNABLE", "maxTimeSeconds": 600}
_FILTERS = {"JOB_NAME": "f*", "JOB_DEFINITION": "gang*", "SHARE_IDENTIFIER": "blue"}
_FILTERS["BEFORE_CREATED_AT"] = "99999999999999"
POLICY = f"{PREFIX}scheduling-policy/fuzz"
GOOD: dict[str, tuple[dict[str, Any], ...]] = {
    "RegisterJobDefinition": (gang("made"), single("made"), old("made"), ecs("made")),
    "DescribeJobDefinitions": (
        {"jobDefinitions": ["gang", "single:1"]},
        {"maxResults": 1, "nextToken": ""},
        {"status": "INACTIVE"},
    ),
    "DeregisterJobDefinition": ({"jobDefinition": "made:1"},),
    "SubmitJob": (
        submission("gang", nodeOverrides={"numNodes": 3, "nodePropertyOverrides": [_OVERRIDE]}, tags={"k": "v"}),
        submission("single", containerOverrides={"command": ["Ref::who"]}, parameters={"who": "x"}),
        submission(
            "single", containerOverrides={"vcpus": 2, "memory": 16, "environment": [{"name": "A", "value": ""}]}
        ),
        submission("single", arrayProperties={"size": 3}, dependsOn=[{"type": "SEQUENTIAL"}]),
        submission("single", arrayProperties={"size": 3}, dependsOn=[{"jobId": "<array>", "type": "N_TO_N"}]),
        submission(
            "gang", "fair", shareIdentifier="blue", schedulingPriorityOverride=5, dependsOn=[{"jobId": "<gang>"}]
        ),
    ),
    "DescribeJobs": ({"jobs": ["<gang>", "<gang>#1", "<array>:1"]}, {"jobs": ["<single>", "<waiting>"]}),
    "ListJobs": (
        *({"jobQueue": "fuzz", "filters": [{"name": name, "values": [value]}]} for name, value in _FILTERS.items()),
        *({"arrayJobId": "<array>"}, {"multiNodeJobId": "<gang>", "nextToken": ""}),
        {"jobQueue": "fuzz", "jobStatus": "RUNNABLE", "maxResults": 1, "nextToken": ""},
    ),
    "TerminateJob": ({"jobId": "<waiting>", "reason": "enough"},),
    "CancelJob": ({"jobId": "<array>", "reason": "enough"},),
    "TerminateJobs": ({"jobs": ["<waiting>", "no-such-job"], "reason": "enough"},),
    "CancelJobs": ({"jobs": ["<array>", "<gang>#1"], "reason": "enough"},),
    "CreateJobQueue": (
        queue("<new>", jobStateTimeLimitActions=[{**_LIMIT, "action": "CANCEL"}]),
        queue("<new>", schedulingPolicyArn=f"{PREFIX}scheduling-policy/fuzz"),
    ),
    "DescribeJobQueues": ({"jobQueues": ["fuzz", "fair"]}, {"maxResults": 1, "nextToken": ""}),
    "UpdateJobQueue": ({"jobQueue": "spare", "priority": 2}, {"jobQueue": "made", "state": "DISABLED"}),
    "DeleteJobQueue": ({"jobQueue": "made"},),
    "GetJobQueueSnapshot": ({"jobQueue": "fuzz"}, {"jobQueue": "fair"}),
    "CreateComputeEnvironment": (environment("<new>"),),
    "DescribeComputeEnvironments": ({"computeEnvironments": ["fuzz"]}, {"maxResults": 1}),
    "UpdateComputeEnvironment": ({"computeEnvironment": "spare", "computeResources": {"maxvCpus": 4}},),
    "DeleteComputeEnvironment": ({"computeEnvironment": "made"},),
    "CreateSchedulingPolicy": (policy("<new>"),),
    "DescribeSchedulingPolicies": ({"arns": [f"{PREFIX}scheduling-policy/fuzz"]},),
    "ListSchedulingPolicies": ({"maxResults": 1},),
    "UpdateSchedulingPolicy": ({**policy("made"), "arn": f"{PREFIX}scheduling-policy/fuzz"},),
    "DeleteSchedulingPolicy": ({"arn": f"{PREFIX}scheduling-policy/made"},),
    "GetLogEvents": tuple(
        {"logGroupName": "/aws/batch/job", "logStreamName": STREAMS[0], **more}
        for more in ({"startFromHead": True, "limit": 1}, {"nextToken": "f/5"}, {"startTime": 1, "endTime": 2**62})
    ),
    "FilterLogEvents": (
        {"logGroupName": "/aws/batch/job", "filterPattern": "line", "limit": 1, "nextToken": f"f{'0' * 56}"},
        {"logGroupIdentifier": GROUP_ARN, "logStreamNamePrefix": "gang/", "interleaved": True},
    ),
    "DescribeLogStreams": tuple(
        {"logGroupName": "/aws/batch/job", **more}
        for more in ({"orderBy": "LastEventTime", "descending": True}, {"logStreamNamePrefix": "gang/", "limit": 1})
    ),
    "DescribeLogGroups": ({"logGroupNamePrefix": "/aws"}, {"logGroupNamePattern": "batch"}),
    "CreateLogGroup": ({"logGroupName": "/made", "tags": {"k": "v"}}, {"logGroupName": "<new>"}),
    "DeleteLogGroup": ({"logGroupName": "/made"},),
    "PutRetentionPolicy": ({"logGroupName": "/made", "retentionInDays": 7},),
    "DeleteRetentionPolicy": ({"logGroupName": "/aws/batch/job"},),
    "CreateLogStream": ({"logGroupName": "/aws/batch/job", "logStreamName": "made"},),
    "DeleteLogStream": ({"logGroupName": "/aws/batch/job", "logStreamName": "made"},),
    "StartLiveTail": ({"logGroupIdentifiers": [GROUP_ARN], "logEventFilterPattern": "line"},),
}
CHANGES = (
    *("name=other", "command=[echo]", "nodes=3", "nodes={min: 1, max: 2}", "train.iterations=5"),
    *("retry.attempts=0", "x=1", "="),
    *("name=2001-99-99", "name=0x_", "name==", "name=[" + "[" * 3000, "nodes=" + "9" * 5000, "nodes=.nan"),
    *("timeout=.inf", "a.b"),
    *('environment.X="\\ud800"', 'environment.X="\\0"', "environment.AWS_BATCH_X=1", 'command=["\\udfff"]'),
    *("name=*x", "a..b=1"),
    *("name=!!python/object:os.system x", "name=&a [*a]", "environment=[]", "environment.1=1"),
    *("name={? {a: b} : c}", "timeout=1e400"),
    *("resources.cpus=1e308", "resources.memory=99999999999999TiB", "checkpoint.every=0"),
    *("stall_timeout=99999999999d", "\0=\0"),
)
"""``set`` of a resume."""
