"""What the command shows of an array and of its children."""

from __future__ import annotations

import os
import subprocess

import httpx
import pytest

from orchestrator.domain.errors import ApiError
from tests.conftest import MUSTER, PATIENCE, Serving, wait_for
from tests.support.definitions import container, single
from tests.support.orchestrator.jobs import FOREVER, refused


def submit_array(server: Serving, name: str, size: int, script: str, cpus: str = "0.1") -> str:
    """Submit an array of shell scripts; its id."""
    server.client.batch("RegisterJobDefinition", **single(name, container(["sh", "-c", script], cpus)))
    job = {"jobName": name, "jobQueue": "default", "jobDefinition": name, "arrayProperties": {"size": size}}
    return str(server.client.batch("SubmitJob", **job)["jobId"])


def test_show_counts_the_children_of_an_array_and_shows_one_by_its_index(shared_server: Serving) -> None:
    array = submit_array(shared_server, "many", 3, "true")
    shared_server.wait(array)
    shown = shared_server.muster("show", "many").stdout
    assert f"children:     3: 3 SUCCEEDED; muster show {array[:8]}:0" in shown and "run:" not in shown
    for reference in ("many:2", f"{array[:8]}:2", f"{array}:2"):
        assert f"{array}:2" in shared_server.muster("show", reference).stdout
    for missing in ("many:3", "many:x", "nosuch:0", f"{array[:8]}:1:1"):
        refused(["show", missing], shared_server.home, 2, f"job {missing} does not exist")
    children = f"job many:3 does not exist: the children of job many ({array[:8]}) are 0 to 2"
    refused(["show", "many:3"], shared_server.home, 2, children)
    shared_server.wait(shared_server.gang("", name="lone"))
    refused(["show", "lone:0"], shared_server.home, 2, "is not an array")
    runs = f"its children have the runs many-{array[:8]}-0 to many-{array[:8]}-2; name one, such as many-{array[:8]}-0"
    refused(["resume", f"many-{array[:8]}"], shared_server.home, 2, f"run many-{array[:8]} does not exist", runs)
    refused(["resume", "many"], shared_server.home, 2, "many is a job, not a run", runs)
    for follow in ([], ["-f"]):
        assert shared_server.muster("logs", "many", *follow).stderr.endswith("such as: muster logs many:0\n")


def test_an_array_tells_which_of_its_children_failed_and_lists_these_first(shared_server: Serving) -> None:
    fails = "exit $((AWS_BATCH_JOB_ARRAY_INDEX % 2 * AWS_BATCH_JOB_ARRAY_INDEX))"
    array = submit_array(shared_server, "odd", 9, fails)
    found = shared_server.wait(array)
    why = [f"{index} (main node: rank 0 exited with code {index})" for index in (1, 3, 5)]
    reason = f"4 of 9 array jobs failed: {', '.join(why)}, 1 more"
    assert (found["status"], found["statusReason"]) == ("FAILED", reason)
    states = [(each["index"], each["status"]) for each in found["children"]]
    assert states == [*((i, "FAILED") for i in (1, 3, 5, 7)), *((i, "SUCCEEDED") for i in (0, 2, 4, 6, 8))]
    assert all(each["ranSeconds"] >= 0 for each in found["children"])
    failed = f"name one, such as odd-{array[:8]}-1, which failed"
    refused(["resume", f"odd-{array[:8]}"], shared_server.home, 2, failed)
    lines = shared_server.muster("show", array).stdout.splitlines()
    listed = [line.split(maxsplit=3) for line in lines if line.split()[1:2] in (["FAILED"], ["SUCCEEDED"])]
    assert [int(each[0]) for each in listed] == [1, 3, 5, 7, 0, 2, 4, 6, 8]
    assert listed[3][3] == "main node: rank 0 exited with code 7" and listed[0][2].startswith("0:00:0")
    hint = f"odd ({array[:8]}) is an array, whose children have the logs, such as: muster logs odd:1\n"
    done = shared_server.muster("logs", "odd")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", hint)


def test_an_array_that_waits_says_why_its_first_child_does(server: Serving) -> None:
    server.wait(full := server.gang(FOREVER, cpus="4"), "RUNNING")
    waits, short = submit_array(server, "many", 3, "true", cpus="4"), full[:8]
    why = f"3 of 3 wait; child 0: waits for job test ({short}) to end: 4 of 4 CPUs short"
    wait_for(lambda: why in (server.detail(waits)["statusReason"] or ""), 30, "its reason")
    assert why in server.muster("list").stdout and f"why:          {why}" in server.muster("show", "many").stdout
    assert server.client.batch("DescribeJobs", jobs=[waits])["jobs"][0]["statusReason"] == "an array of 3"
    next_ones = [line.split()[1:3] for line in server.muster("queues", "default").stdout.splitlines()[3:]]
    assert next_ones == [[f"{waits[:8]}:{index}", f"many:{index}"] for index in range(3)]
    assert ">many:1</a>" in httpx.get(f"{server.client.url}/queues?queue=default").text
    refused(["checkpoint", "many:1"], server.home, 1, f"job many:1 ({waits[:8]}:1) is RUNNABLE, not RUNNING")
    with pytest.raises(ApiError, match=f"by job many:1 .*; stop it first: muster stop {waits[:8]}:1"):
        server.gang("pass", env={"MUSTER_RUN": server.detail(f"{waits}:1")["run"]})
    env = {**os.environ, "MUSTER_HOME": str(server.home)}
    following = {}
    for job in ("many", "many:1"):
        following[job] = subprocess.Popen([MUSTER, "logs", job, "-f"], stderr=subprocess.PIPE, text=True, env=env)
    first, second = (each.stderr for each in following.values())
    assert first is not None and second is not None
    assert first.readline().startswith(f"many ({waits[:8]}) PENDING: {why}")
    hint = f"many ({waits[:8]}) is an array, whose children have the logs, such as: muster logs many:0\n"
    assert first.readline() == hint
    assert second.readline().startswith(f"many:1 ({waits[:8]}:1) RUNNABLE: ")
    stopped = server.muster("stop", "many:1").stdout
    assert stopped == f"many:1 ({waits[:8]}:1) ended: stopped by the user\n"
    wait_for(lambda: server.detail(waits)["statusReason"].startswith("2 of 3 wait; child 0: "), 30, "the others")
    server.client.batch("TerminateJob", jobId=waits, reason="enough")
    assert [each.wait(60 * PATIENCE) for each in following.values()] == [0, 0]
    server.client.batch("TerminateJob", jobId=full, reason="enough")
