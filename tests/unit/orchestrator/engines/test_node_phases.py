"""Phases and causes of nodes: what each engine makes of its own states, and what the controller makes of a cause."""

from __future__ import annotations

import json
from typing import Any

import pytest

from orchestrator.control.node_ends import node_end, seen_end
from orchestrator.engines.api import Cause, NodePhase, NodeStatus
from orchestrator.engines.ray.engine import _status as ray_status
from orchestrator.engines.slurm.engine import _node as slurm_node
from orchestrator.engines.slurm.engine import _queued as slurm_queued
from orchestrator.engines.slurm.slurm_commands import SlurmJob
from orchestrator.engines.toolkit.statuses import ended
from shared_store.contract.faults import Fault
from shared_store.volume.node_outcomes import OUT_OF_MEMORY, FirstError, Outcome

ENDED, QUEUED, RUNNING, STARTING = NodePhase.ENDED, NodePhase.QUEUED, NodePhase.RUNNING, NodePhase.STARTING
MEETING = "muster: meeting " + json.dumps({"addresses": ["10.0.0.1", "10.0.0.2"]}) + "\n"


def test_a_node_that_does_not_run_says_why_and_one_that_runs_has_no_end() -> None:
    for phase in (QUEUED, STARTING, NodePhase.UNREACHABLE):
        with pytest.raises(ValueError, match=f"a node that is {phase} says why"):
            NodeStatus(phase)
    for fields in ({"cause": Cause.EXIT}, {"exit_code": 0}):
        with pytest.raises(ValueError, match="a node that is running has no cause and no exit code"):
            NodeStatus(RUNNING, **fields)


def check_end(node: NodeStatus, cause: Cause | None, code: int | None, words: str) -> None:
    assert (node.phase, node.cause, node.exit_code, node.words) == (ENDED, cause, code, words)


LOCAL = {0: Cause.EXIT, 75: Cause.EXIT, 128: Cause.EXIT, 137: Cause.SIGNAL, 143: Cause.SIGNAL, None: Cause.HOST_LOST}


@pytest.mark.parametrize("code", LOCAL)
def test_an_exit_code_gives_the_cause_of_a_local_process_s_end(code: int | None) -> None:
    check_end(ended("127.64.0.1", code, "words"), LOCAL[code], code, "words")


@pytest.mark.parametrize(
    ("state", "cause", "words"),
    [
        ({"ExitCode": 0}, Cause.EXIT, ""),
        ({"ExitCode": 3, "Error": ""}, Cause.EXIT, ""),
        ({"ExitCode": 127, "Error": "no such file"}, Cause.EXIT, "no such file"),
        ({"ExitCode": 137, "OOMKilled": False}, Cause.SIGNAL, ""),
        ({"ExitCode": 137, "OOMKilled": True}, Cause.OUT_OF_MEMORY, OUT_OF_MEMORY),
    ],
)
def test_docker_s_state_of_a_container_gives_the_cause_of_its_end(
    state: dict[str, Any], cause: Cause, words: str
) -> None:
    pytest.importorskip("docker")
    from orchestrator.engines.docker.engine import _ended

    check_end(_ended(state, "10.192.0.2"), cause, state["ExitCode"], words)


@pytest.mark.parametrize(
    ("node", "phase", "why", "seen"),
    [
        ({"started": False}, "joining", "joining the Ray cluster", (STARTING, None, "joining the Ray cluster")),
        ({"started": False}, "placing", "waits for room", (QUEUED, None, "waits for room")),
        ({"started": False}, "running", "", (RUNNING, None, "")),
        ({"started": True}, "running", "", (RUNNING, None, "")),
        ({"started": True}, "stopping", "node 1: SIGKILL does not end it", (RUNNING, None, "")),
        ({"running": False, "code": 0}, "running", "", (ENDED, Cause.EXIT, "")),
        ({"running": False, "code": 143}, "running", "", (ENDED, Cause.SIGNAL, "")),
        ({"running": False}, "running", "", (ENDED, Cause.HOST_LOST, "")),
        ({"running": False, "detail": "early", "cause": "stopped"}, "stopped", "", (ENDED, Cause.STOPPED, "early")),
    ],
)
def test_a_report_of_ray_s_driver_becomes_the_node_s_phase(
    node: dict[str, Any], phase: str, why: str, seen: tuple[Any, ...]
) -> None:
    reported = {
        "running": True,
        "address": "10.0.0.1",
        "code": None,
        "detail": "",
        "started": True,
        "gpus": "0,1",
        **node,
    }
    status = ray_status(reported, {"phase": phase, "why": why}, True)
    assert (status.phase, status.cause, status.words) == seen and status.gpus == ("0", "1")
    if node.get("running", True):
        orphan = ray_status(reported, {"phase": phase, "why": why}, False)
        assert (orphan.cause, orphan.words) == (Cause.HOST_LOST, "its driver died")


def job(state: str, reason: str = "None") -> SlurmJob:
    return SlurmJob("5", state, reason, "n1", "job/1/1")


@pytest.mark.parametrize(("state", "phase"), [("PENDING", QUEUED), ("REQUEUED", QUEUED), ("CONFIGURING", STARTING)])
def test_a_job_in_slurm_s_queue_is_queued_until_its_nodes_are_made_ready(state: str, phase: NodePhase) -> None:
    status = slurm_queued(job(state), "slurmctld does not answer")
    assert (status.phase, status.stale) == (phase, "slurmctld does not answer") and status.words.startswith("Slurm: ")


@pytest.mark.parametrize(
    ("found", "output", "seen"),
    [
        (job("RUNNING"), "", (STARTING, None, None)),
        (job("RUNNING"), MEETING, (RUNNING, None, None)),
        (job("COMPLETING"), MEETING, (RUNNING, None, None)),
        (job("FAILED"), "srun: error: n1: task 0: Exited with exit code 3", (ENDED, Cause.EXIT, 3)),
        (job("FAILED"), "srun: error: n1: task 0: Killed", (ENDED, Cause.SIGNAL, 137)),
        (job("FAILED"), "srun: error: n1: tasks 0-1: Out Of Memory", (ENDED, Cause.OUT_OF_MEMORY, 137)),
        (job("PREEMPTED"), MEETING, (ENDED, Cause.PREEMPTED, 75)),
        (job("NODE_FAIL"), MEETING, (ENDED, Cause.HOST_LOST, 137)),
        (job("BOOT_FAIL"), MEETING, (ENDED, Cause.HOST_LOST, 137)),
        (job("CANCELLED"), MEETING, (ENDED, Cause.CANCELLED, 137)),
        (job("TIMEOUT"), MEETING, (ENDED, Cause.STOPPED, 137)),
        (job("OUT_OF_MEMORY"), MEETING, (ENDED, Cause.OUT_OF_MEMORY, 137)),
        (None, MEETING, (ENDED, None, None)),
    ],
)
def test_slurm_s_job_and_srun_s_output_become_the_node_s_phase(
    found: SlurmJob | None, output: str, seen: tuple[Any, ...]
) -> None:
    node = slurm_node({"main": 0, "output": "/store/slurm.out"}, found, output, 0, None)
    assert (node.phase, node.cause, node.exit_code) == seen


def test_on_slurm_an_outcome_takes_precedence_over_the_job_s_state() -> None:
    outcome = Outcome(0, 1, 75, None, "left on request", None, 1.0, 1.0)
    node = slurm_node({"main": 0, "output": ""}, job("CANCELLED"), MEETING, 0, outcome)
    assert (node.phase, node.cause, node.exit_code, node.address) == (ENDED, Cause.EXIT, 75, "10.0.0.1")


@pytest.mark.parametrize(
    ("code", "reason", "cause"),
    [
        (0, "", Cause.EXIT),
        (3, "Essential container in task exited", Cause.EXIT),
        (143, "", Cause.SIGNAL),
        (137, OUT_OF_MEMORY, Cause.OUT_OF_MEMORY),
        (None, "Host EC2 (instance i-1) terminated.", Cause.HOST_LOST),
        (None, "", Cause.HOST_LOST),
        (None, "CannotPullContainerError: no such image", None),
    ],
)
def test_aws_s_exit_code_and_reason_give_the_cause_of_a_node_s_end(
    code: int | None, reason: str, cause: Cause | None
) -> None:
    pytest.importorskip("boto3")
    from orchestrator.engines.aws_batch.watched_gang import node_ended

    check_end(node_ended("10.0.0.1", code, reason), cause, code, reason)
    check_end(node_ended("10.0.0.1", None, reason, not_started=True), Cause.CANNOT_START, None, reason)


@pytest.mark.parametrize(
    ("cause", "code", "lost"),
    [
        *((Cause.EXIT, 3, False), (Cause.OUT_OF_MEMORY, 137, False), (Cause.STOPPED, 137, False)),
        *((None, None, False), (Cause.SIGNAL, 137, True), (Cause.HOST_LOST, None, True)),
        *((Cause.PREEMPTED, 75, True), (Cause.CANNOT_START, None, False)),
    ],
)
def test_a_node_without_an_outcome_is_lost_by_its_cause_and_not_by_its_words(
    cause: Cause | None, code: int | None, lost: bool
) -> None:
    for words in ("", "what the engine says"):
        end = seen_end(NodeStatus(ENDED, "", words, cause, code), True, 5.0)
        assert (end.lost, end.exit_code, end.ended) == (lost, code or 137, 5.0)
        assert end.cannot_start is (cause is Cause.CANNOT_START)
        reported = f"exit {code}, outcome not written{words and f' ({words})'}" if cause is Cause.EXIT else words
        assert end.reason == (reported or "the supervisor died without an outcome")
    preempted = seen_end(NodeStatus(ENDED, "", "preempted by Slurm", Cause.PREEMPTED, 75), False, 5.0)
    assert (preempted.lost, preempted.exit_code) == (True, 137), "a job of the Batch API has lost its host"


@pytest.mark.parametrize(
    ("cause", "requested", "is_reported"),
    [
        (Cause.EXIT, False, True),
        (None, False, True),
        (Cause.EXIT, True, False),
        *((each, False, False) for each in Cause if each is not Cause.EXIT),
    ],
)
def test_the_fault_of_an_outcome_counts_unless_the_node_was_ended_from_outside(
    cause: Cause | None, requested: bool, is_reported: bool
) -> None:
    error = FirstError(0, "ValueError: bad", "", 1.0, Fault("ValueError", "reward.py", 3))
    outcome = Outcome(0, 1, 1, None, "rank 0 exited with code 1", error, 1.0, 2.0, requested)
    end, _ = node_end(outcome, NodeStatus(ENDED, cause=cause, exit_code=1), True, 3000)
    assert end.fault == ("ValueError in reward.py, line 3" if is_reported else None)
    assert node_end(Outcome(0, 1, 1, None, "why", None, 1.0, 2.0), NodeStatus(ENDED), True, 3000)[0].fault is None
