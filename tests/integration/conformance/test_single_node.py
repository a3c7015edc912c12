"""Single-node jobs: shape, parameters, arrays, dependencies, retries by evaluateOnExit, and submissions sent twice."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import wait_for
from tests.support.conformance.aws import EXITED, OVER, UNTIL, Batch, aws, container, gate, pairs, refused

ATTEMPT, INDEX = "$AWS_BATCH_JOB_ATTEMPT", "$AWS_BATCH_JOB_ARRAY_INDEX"


# -- shape and parameters ---------------------------------------------------------------------------------------------


def test_a_container_job_has_a_container_and_knows_nothing_of_nodes(batch: Batch) -> None:
    script = "env | grep -E '^AWS_(BATCH|EXECUTION)'; echo $WHO $WHAT; exit 4"
    definition = batch.single("one-shape", script, env={"WHO": "nobody", "WHAT": "works"})
    override = {"environment": pairs({"WHO": "I"}), "resourceRequirements": [{"type": "VCPU", "value": "0.2"}]}
    job = batch.submit(definition, containerOverrides=override, parameters={"unused": "1"}, propagateTags=True)
    detail = batch.wait(job)
    output = batch.lines(job)
    variables = dict(line.split("=", 1) for line in output if line.startswith("AWS_"))
    assert variables.pop("AWS_EXECUTION_ENV")
    place = {"AWS_BATCH_CE_NAME": "local", "AWS_BATCH_JQ_NAME": "default"}
    assert variables == {"AWS_BATCH_JOB_ID": job, "AWS_BATCH_JOB_ATTEMPT": "1", **place}
    assert "I works" in output
    assert not {"nodeProperties", "nodeDetails", "arrayProperties"} & detail.keys()
    assert detail["container"]["exitCode"] == detail["attempts"][0]["container"]["exitCode"] == 4
    assert detail["container"]["environment"] == pairs({"WHO": "I", "WHAT": "works"})
    needs = [{"type": "VCPU", "value": "0.2"}, {"type": "MEMORY", "value": "64"}]
    assert detail["container"]["resourceRequirements"] == needs
    assert (detail["status"], detail["statusReason"]) == ("FAILED", EXITED)
    assert detail["parameters"] == {"unused": "1"} and detail["propagateTags"] is True
    assert batch.api.describe_jobs(jobs=[f"{job}#0", f"{job}:0"])["jobs"] == []
    listed = batch.api.list_jobs(jobQueue="default", jobStatus="FAILED")["jobSummaryList"]
    [summary] = [each for each in listed if each["jobId"] == job]
    assert "nodeProperties" not in summary and summary["container"] == {"exitCode": 4}, "no reason: an ordinary exit"
    assert "reason" not in detail["container"] and "reason" not in detail["attempts"][0]["container"]
    [node] = batch.server.client.get(f"/api/jobs/{job}")["attempts"][0]["nodes"]
    assert node["reason"].startswith("rank 0 exited with code 4"), "Muster's own words"
    assert "rank 0 exited with code 4" in batch.server.muster("show", job, MUSTER_URL=batch.server.url).stdout


def test_parameters_replace_references_the_submissions_before_the_definitions(batch: Batch, parked: str) -> None:
    words = ["echo", "Ref::task", "Ref::seed", "Ref::task"]
    supplied = {"task": "Cartpole", "seed": "1"}
    definition = batch.single("one-refers", "", container={"command": words}, parameters=supplied)

    def command(**request: Any) -> list[str]:
        return list(batch.describe(batch.submit(definition, queue=parked, **request))["container"]["command"])

    assert command() == ["echo", "Cartpole", "1", "Cartpole"]
    assert command(parameters={"task": "Ant"}) == ["echo", "Ant", "1", "Ant"]
    over = {"command": ["run", "Ref::seed", "Ref::more"]}
    assert command(containerOverrides=over, parameters={"more": "Ref::task"}) == ["run", "1", "Ref::task"]
    with refused("Unable to substitute value. No parameter found for reference more"):
        command(containerOverrides=over)


def test_empty_structures_count_as_absent(batch: Batch, parked: str) -> None:
    """Luigi sends them all."""
    names = ("arrayProperties", "retryStrategy", "timeout", "containerOverrides", "nodeOverrides", "parameters")
    limits = {"retryStrategy": {"attempts": 2}, "timeout": {"attemptDurationSeconds": 90}}
    definition = batch.single("one-luigi", "true", **limits)
    detail = batch.describe(batch.submit(definition, queue=parked, dependsOn=[], **{name: {} for name in names}))
    assert detail["retryStrategy"]["attempts"] == 2 and detail["timeout"] == {"attemptDurationSeconds": 90}
    limits = {"retryStrategy": {"attempts": 3}, "timeout": {"attemptDurationSeconds": 60}}
    changed = batch.submit(definition, queue=parked, **limits)
    detail = batch.describe(changed)
    assert detail["retryStrategy"]["attempts"] == 3 and detail["timeout"] == {"attemptDurationSeconds": 60}


def test_the_aws_command_submits_a_job_with_the_older_fields(batch: Batch) -> None:
    old = {"image": "any", "command": ["echo", "Ref::word"], "vcpus": 1, "memory": 16}
    batch.register("one-typed", "container", containerProperties=old)
    submitted = aws(
        *(batch.server.url, "batch", "submit-job", "--job-name", "one-typed", "--job-queue", "default"),
        *("--job-definition", "one-typed", "--parameters", "word=typed"),
        *("--container-overrides", '{"environment": [{"name": "A", "value": "1"}]}'),
    )
    batch.wait(submitted["jobId"])
    [job] = aws(batch.server.url, "batch", "describe-jobs", "--jobs", submitted["jobArn"])["jobs"]
    assert (job["status"], job["jobName"], job["container"]["exitCode"]) == ("SUCCEEDED", "one-typed", 0)
    assert job["container"]["environment"] == pairs({"A": "1"}) and "typed" in batch.lines(job["jobId"])


# -- arrays -----------------------------------------------------------------------------------------------------------


def summary(batch: Batch, job: str) -> dict[str, int]:
    """How many children of an array there are by state; those without any left out."""
    counts = batch.describe(job)["arrayProperties"]["statusSummary"]
    return {status: count for status, count in counts.items() if count}


def test_an_arrays_children_know_their_index_and_decide_its_end(batch: Batch, tmp_path: Path) -> None:
    script = f"env | grep -E '^AWS_BATCH_JOB_(ARRAY|ID|NODE)'; [ {INDEX} != 1 ] || exit 5; {UNTIL.format('go')}"
    definition = batch.single("one-array", script, env={"GATE": str(tmp_path)})
    job = batch.submit(definition, arrayProperties={"size": 3}, tags={"of": "array"})
    wait_for(lambda: summary(batch, job) == {"RUNNING": 2, "FAILED": 1}, what="two that run and one that failed")
    parent = batch.describe(job)
    assert parent["status"] == "PENDING" and parent["arrayProperties"]["size"] == 3
    assert parent["startedAt"] == min(batch.describe(f"{job}:{index}")["startedAt"] for index in range(3))
    states = ("SUBMITTED", "PENDING", "RUNNABLE", "STARTING", "RUNNING", "SUCCEEDED", "FAILED")
    assert set(parent["arrayProperties"]["statusSummary"]) == set(states)
    gate(tmp_path, "go")
    parent = batch.wait(job)
    assert (parent["status"], parent["statusReason"]) == ("FAILED", "Array Child Job failed")
    own = batch.server.client.get(f"/api/jobs/{job}")["statusReason"]
    assert own.startswith("1 of 3 array jobs failed: "), "Muster's own words"
    assert summary(batch, job) == {"SUCCEEDED": 2, "FAILED": 1}
    assert batch.api.list_jobs(arrayJobId=job)["jobSummaryList"] == [], "without a status: those that run"
    over = [batch.api.list_jobs(arrayJobId=job, jobStatus=each)["jobSummaryList"] for each in ("SUCCEEDED", "FAILED")]
    listed = sorted((each for some in over for each in some), key=lambda each: each["arrayProperties"]["index"])
    assert [each["jobId"] for each in listed] == [f"{job}:{index}" for index in range(3)]
    assert [each["arrayProperties"] for each in listed] == [{"index": index, "size": 3} for index in range(3)]
    assert [each["status"] for each in listed] == ["SUCCEEDED", "FAILED", "SUCCEEDED"]
    failed = batch.api.list_jobs(arrayJobId=job, jobStatus="FAILED")["jobSummaryList"]
    assert [each["jobId"] for each in failed] == [f"{job}:1"]
    for index in range(3):
        child = batch.describe(f"{job}:{index}")
        assert child["arrayProperties"]["index"] == index and child["jobArn"].endswith(f":job/{job}:{index}")
        assert child["container"]["exitCode"] == (5 if index == 1 else 0) and child["tags"] == {"of": "array"}
        variables = {line for line in batch.lines(f"{job}:{index}") if line.startswith("AWS_")}
        own = {"ID": f"{job}:{index}", "ARRAY_INDEX": index, "ARRAY_SIZE": 3}
        assert variables == {f"AWS_BATCH_JOB_{name}={value}" for name, value in own.items()}
    by_name = batch.api.list_jobs(jobQueue="default", filters=[{"name": "JOB_NAME", "values": ["one-array"]}])
    assert [each["jobId"] for each in by_name["jobSummaryList"]] == [job], "a queue shows the array, not its children"
    assert by_name["jobSummaryList"][0]["arrayProperties"]["size"] == 3


def test_an_array_is_ended_with_its_children_and_of_two_reasons_it_has_the_one_that_ended_it(
    batch: Batch, tmp_path: Path
) -> None:
    definition = batch.single("one-array-ended", UNTIL.format("never"), env={"GATE": str(tmp_path)})
    job = batch.submit(definition, arrayProperties={"size": 2})
    wait_for(lambda: summary(batch, job) == {"RUNNING": 2}, what="both children")
    batch.api.cancel_job(jobId=job, reason="too late")
    batch.api.terminate_job(jobId=f"{job}:1", reason="this one")
    assert batch.wait(f"{job}:1")["statusReason"] == "this one"
    detail = batch.describe(job)
    assert (detail["status"], detail["isCancelled"], detail["isTerminated"]) == ("PENDING", False, False)
    batch.api.terminate_job(jobId=job, reason="enough of it")
    for each in (job, f"{job}:0"):
        detail = batch.wait(each)
        assert (detail["status"], detail["statusReason"]) == ("FAILED", "enough of it")
        assert (detail["isCancelled"], detail["isTerminated"]) == (False, True)


def test_children_come_one_by_one_in_a_sequential_array(batch: Batch, tmp_path: Path) -> None:
    script = f"echo begin {INDEX} >> $GATE/log; {UNTIL.format('go')}; echo end {INDEX} >> $GATE/log"
    definition = batch.single("one-sequential", script, env={"GATE": str(tmp_path)})
    job = batch.submit(definition, arrayProperties={"size": 3}, dependsOn=[{"type": "SEQUENTIAL"}])
    batch.wait(f"{job}:0", "RUNNING")
    for index in (1, 2):
        held = batch.describe(f"{job}:{index}")
        assert (
            held["status"] == "PENDING"
            and f"one-sequential:{index - 1} ({job[:8]}:{index - 1})" in held["statusReason"]
        )
    gate(tmp_path, "go")
    assert batch.wait(job)["status"] == "SUCCEEDED"
    order = (tmp_path / "log").read_text().splitlines()
    assert order == ["begin 0", "end 0", "begin 1", "end 1", "begin 2", "end 2"]


def test_child_i_waits_for_child_i(batch: Batch, tmp_path: Path) -> None:
    before = batch.single("one-before", f"[ {INDEX} = 0 ] || {UNTIL.format('go')}", env={"GATE": str(tmp_path)})
    first = batch.submit(before, arrayProperties={"size": 2})
    waits = {"dependsOn": [{"jobId": first, "type": "N_TO_N"}]}
    second = batch.submit(batch.single("one-after", "true"), arrayProperties={"size": 2}, **waits)
    last = batch.submit(batch.single("one-last", "true"), dependsOn=[{"jobId": second}])
    assert batch.wait(f"{second}:0")["status"] == "SUCCEEDED"
    held = batch.describe(f"{second}:1")
    assert held["status"] == "PENDING" and f"one-before:1 ({first[:8]}:1)" in held["statusReason"]
    assert held["dependsOn"] == [{"jobId": f"{first}:1", "type": "N_TO_N"}]
    assert batch.describe(last)["status"] == "PENDING" and second[:8] in batch.describe(last)["statusReason"]
    gate(tmp_path, "go")
    assert batch.wait(last)["status"] == "SUCCEEDED"
    times = [batch.describe(each) for each in (f"{first}:1", f"{second}:1", last)]
    assert times[0]["stoppedAt"] <= times[1]["startedAt"] <= times[1]["stoppedAt"] <= times[2]["startedAt"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"arrayProperties": {"size": 1}}, "2 to 10000"),
        ({"arrayProperties": {"size": 10001}}, "2 to 10000"),
        ({"arrayProperties": {"size": 3}, "dependsOn": [{"jobId": "ARRAY", "type": "N_TO_N"}]}, "same size"),
        ({"arrayProperties": {"size": 2}, "dependsOn": [{"jobId": "JOB", "type": "N_TO_N"}]}, "same size"),
        ({"dependsOn": [{"jobId": "ARRAY", "type": "N_TO_N"}]}, "for array jobs"),
        ({"dependsOn": [{}]}, "needs a jobId"),
        (
            {"arrayProperties": {"size": 2}, "dependsOn": [{"jobId": "ARRAY", "type": "SEQUENTIAL"}]},
            "SEQUENTIAL is among the children of the array itself and takes no jobId",
        ),
        ({"nodeOverrides": {"numNodes": 2}}, "use containerOverrides"),
    ],
)
def test_impossible_arrays_are_refused(batch: Batch, parked: str, change: dict[str, Any], message: str) -> None:
    definition = batch.single("one-refused", "true")
    array = batch.submit(definition, queue=parked, arrayProperties={"size": 2})
    known = {"ARRAY": array, "JOB": batch.submit(definition, queue=parked)}
    if "dependsOn" in change:
        names = [{**each, "jobId": known[each["jobId"]]} if each else each for each in change["dependsOn"]]
        change = {**change, "dependsOn": names}
    with refused(message):
        batch.submit(definition, queue=parked, **change)


# -- dependencies -----------------------------------------------------------------------------------------------------


def test_a_dependency_waits_for_success_and_failure_propagates(batch: Batch, tmp_path: Path) -> None:
    definition = batch.single("one-decides", f"{UNTIL.format('go')}; exit $CODE", env={"GATE": str(tmp_path)})

    def ends_with(code: int) -> str:
        return batch.submit(definition, containerOverrides={"environment": pairs({"CODE": str(code)})})

    well, badly, plain = ends_with(0), ends_with(1), batch.single("one-depends", "true")
    arn = f"arn:aws:batch:us-east-1:000000000000:job/{well}"
    after_well = batch.submit(plain, dependsOn=[{"jobId": arn}])
    after_both = batch.submit(plain, dependsOn=[{"jobId": well}, {"jobId": badly}])
    below = batch.submit(plain, dependsOn=[{"jobId": after_both}])
    assert batch.wait(after_well, "PENDING")["dependsOn"] == [{"jobId": well}]
    assert (
        batch.wait(below, "PENDING")["statusReason"] == f"waits for the success of job one-depends ({after_both[:8]})"
    )
    gate(tmp_path, "go")
    assert batch.wait(after_well)["status"] == "SUCCEEDED"
    for job, failed in ((after_both, badly), (below, after_both)):
        detail = batch.wait(job)
        assert (detail["status"], detail["statusReason"]) == ("FAILED", f"Dependent Job failed: {failed}")
        assert detail["attempts"] == [] and not detail["isCancelled"] and not detail["isTerminated"]
    assert batch.wait(well)["stoppedAt"] <= batch.describe(after_well)["startedAt"]
    # what is over already decides at once
    assert batch.wait(batch.submit(plain, dependsOn=[{"jobId": well}]))["status"] == "SUCCEEDED"
    assert batch.wait(batch.submit(plain, dependsOn=[{"jobId": badly}]))["status"] == "FAILED"


# -- retries ----------------------------------------------------------------------------------------------------------

AGAIN, END = {"action": "RETRY"}, {"action": "EXIT"}


def test_the_first_condition_that_matches_decides_whether_to_try_again(batch: Batch) -> None:
    """Each job exits with 12 and says "no licence"; three attempts are allowed."""
    definition = batch.single("one-evaluated", "echo no licence >&2; exit 12")
    cases: list[tuple[list[dict[str, str]], int]] = [
        ([], 3),
        ([{"onExitCode": "1*", **AGAIN}, {"onExitCode": "12", **END}], 3),
        ([{"onExitCode": "12", **END}, {"onExitCode": "1*", **AGAIN}], 1),
        ([{"onExitCode": "1", **END}, {"onExitCode": "2*", **END}], 3),  # none matches: tried again
        ([{"onReason": "rank 0 exited with code 12*", **END}], 3),  # an ordinary exit has no reason
        ([{"onStatusReason": f"{EXITED[1:9]}*", **END}], 3),  # only the end may be left open
        ([{"onExitCode": "12", "onReason": "CannotPull*", **END}], 3),  # all of an entry must match
        ([{"onStatusReason": f"{EXITED[:9]}*", "onExitCode": "12", "action": "exit"}], 1),
        ([{"onExitCode": "0", **END}, {"onReason": "*", **END}], 1),  # the documentation's catch-all
        ([{"onExitCode": "0", **END}], 3),  # what TorchX sends
    ]
    evaluated = [{"evaluateOnExit": conditions} if conditions else {} for conditions, _ in cases]
    jobs = [batch.submit(definition, retryStrategy={"attempts": 3, **each}) for each in evaluated]
    for job, (conditions, attempts) in zip(jobs, cases, strict=True):
        detail = batch.wait(job)
        codes = [attempt["container"]["exitCode"] for attempt in detail["attempts"]]
        assert (detail["status"], codes) == ("FAILED", [12] * attempts), conditions
        shown = [{**each, "action": each["action"].upper()} for each in conditions]
        assert detail["retryStrategy"] == {"attempts": 3, "evaluateOnExit": shown}, "in the model's case"


@pytest.mark.parametrize(
    ("rules", "attempts"),
    [
        ([{"onReason": "CannotStartContainerError*", **END}], 1),
        ([{"onStatusReason": "Task failed to start", **AGAIN}, {"onReason": "*", **END}], 3),
        ([{"onStatusReason": EXITED, **END}, {"onExitCode": "127", **END}], 3),
    ],
)
def test_a_program_that_does_not_exist_has_aws_s_reasons_and_rules_match_them(
    batch: Batch, rules: list[dict[str, str]], attempts: int
) -> None:
    job = batch.submit(
        batch.single("one-missing", "true"),
        containerOverrides={"command": ["no-such-program"]},
        retryStrategy={"attempts": 3, "evaluateOnExit": rules},
    )
    detail = batch.wait(job)
    assert len(detail["attempts"]) == attempts
    listed = batch.api.list_jobs(jobQueue="default", jobStatus="FAILED")["jobSummaryList"]
    [summary] = [each for each in listed if each["jobId"] == job]
    for each in (detail, *detail["attempts"], summary):
        own = "CannotStartContainerError: can't start 'no-such-program': "
        assert each["statusReason"] == "Task failed to start" and each["container"]["reason"].startswith(own)
        assert "exitCode" not in each["container"], "no container ran"
    shown = batch.server.muster("show", job, MUSTER_URL=batch.server.url).stdout
    assert "why:" in shown and "main node: can't start 'no-such-program': " in " ".join(shown.split())


def test_a_gang_that_the_engine_refuses_has_aws_s_reasons(batch: Batch) -> None:
    job = batch.submit(batch.single("one-nowhere", "true", env={"MUSTER_DIRECTORY": "/nowhere"}))
    detail, own = batch.wait(job), "working directory /nowhere is not on this machine"
    listed = batch.api.list_jobs(jobQueue="default", jobStatus="FAILED")["jobSummaryList"]
    [summary] = [each for each in listed if each["jobId"] == job]
    for each in (detail, *detail["attempts"], summary):
        assert each["statusReason"] == "Task failed to start"
        assert each["container"]["reason"] == f"CannotStartContainerError: {own}"
        assert "exitCode" not in each["container"]
    assert batch.server.client.get(f"/api/jobs/{job}")["statusReason"] == f"can't start the gang: {own}"


def test_a_host_that_is_lost_differs_from_a_program_that_failed(batch: Batch, tmp_path: Path) -> None:
    """The pattern that many clients use: again where the host went away, not where the program failed."""
    script = f"[ {ATTEMPT} = 1 ] || exit 3; echo $PPID > $GATE/pid.new; mv $GATE/pid.new $GATE/pid; exec sleep 600"
    conditions = [
        {"onExitCode": "137", **END},
        {"onStatusReason": "Host EC2*", **AGAIN},
        {"onReason": "*", **END},
    ]
    definition = batch.single("one-lost", script, env={"GATE": str(tmp_path)})
    job = batch.submit(definition, retryStrategy={"attempts": 3, "evaluateOnExit": conditions})
    wait_for((tmp_path / "pid").exists, what="the supervisor's pid")
    batch.wait(job, "RUNNING")
    os.kill(int((tmp_path / "pid").read_text()), signal.SIGKILL)
    detail = batch.wait(job)
    lost, failed = detail["attempts"]
    assert lost["statusReason"].startswith("Host EC2 (instance ") and lost["statusReason"].endswith(") terminated.")
    assert lost["container"]["reason"] == lost["statusReason"]
    assert "exitCode" not in lost["container"], "a lost host reports no exit code, and no rule matches one"
    assert (failed["container"]["exitCode"], failed["statusReason"]) == (3, EXITED)
    assert "reason" not in failed["container"]
    assert detail["status"] == "FAILED"


# -- the same submission twice ----------------------------------------------------------------------------------------


@contextmanager
def keyed(batch: Batch, key: str) -> Iterator[None]:
    """SubmitJob of this client carries the idempotency key, which is signed like every header that boto3 sends."""

    def add(request: Any, **_: Any) -> None:
        request.headers["X-Muster-Idempotency-Key"] = key

    batch.api.meta.events.register("before-sign.batch.SubmitJob", add, unique_id="key")
    try:
        yield
    finally:
        batch.api.meta.events.unregister("before-sign.batch.SubmitJob", unique_id="key")


def test_a_submission_with_a_key_may_be_sent_twice(batch: Batch, parked: str) -> None:
    definition = batch.single("one-keyed", "true")
    request = {"jobName": "one-keyed", "jobQueue": parked, "jobDefinition": definition}

    def send(**change: Any) -> dict[str, Any]:
        answer = batch.api.submit_job(**{**request, **change})
        return {key: value for key, value in answer.items() if key != "ResponseMetadata"}

    with keyed(batch, "lost-reply-1"):
        first = send()
        assert send() == first and set(first) == {"jobArn", "jobName", "jobId"}
        with refused("lost-reply-1", first["jobId"], status=409):
            send(jobName="one-other")
        with refused("lost-reply-1", status=409):
            send(timeout={"attemptDurationSeconds": 60})
        batch.api.terminate_job(jobId=first["jobId"], reason="over")
        assert batch.wait(first["jobId"], *OVER)["status"] == "FAILED"
        assert send() == first, "also when that job is over"
    with keyed(batch, "lost-reply-2"):
        second = send()
    assert len({first["jobId"], second["jobId"], send()["jobId"], send()["jobId"]}) == 4, "another key, and none"
    with keyed(batch, "not a key"), refused("idempotency key"):
        send()
    found = batch.api.list_jobs(jobQueue=parked, filters=[{"name": "JOB_NAME", "values": ["one-keyed"]}])
    other = batch.api.list_jobs(jobQueue=parked, filters=[{"name": "JOB_NAME", "values": ["one-other"]}])
    assert len(found["jobSummaryList"]) == 4 and not other["jobSummaryList"]


def test_the_command_may_come_with_the_submission(batch: Batch) -> None:
    properties = {key: value for key, value in container("true", {}).items() if key != "command"}
    definition = batch.register("one-open", "container", containerProperties=properties)
    job = batch.submit(definition, containerOverrides={"command": ["echo", "from the submission"]})
    assert batch.wait(job)["status"] == "SUCCEEDED" and batch.lines(job) == ["from the submission"]
    empty = batch.register("one-empty", "container", containerProperties={**properties, "command": []})
    for each, name in ((definition, "one-open"), (empty, "one-empty")):
        why = f"job definition {name} has no command, and engine local of job queue default runs no image"
        with refused(why, "give a command in the definition or in the overrides", "docker"):
            batch.submit(each)
    ranges = [
        {"targetNodes": "0:0", "container": container("true", {})},
        {"targetNodes": "1:", "container": properties},
    ]
    with refused("node range 1: of job definition one-part has no command, and engine local"):
        batch.submit(batch.multinode("one-part", "", ranges=ranges))


def test_a_container_definition_needs_no_image_of_ours_and_refuses_what_is_not_run(batch: Batch) -> None:
    for properties, message in [
        ({**container("true", {}), "vcpus": 0}, "vcpus is 0"),
        ({**container("true", {}), "memory": 3}, "memory is 3"),
        (container("true", {"env": {"AWS_BATCH_JOB_ID": "x"}}), "are reserved"),
    ]:
        with refused(message):
            batch.register("one-bad", "container", containerProperties=properties)
