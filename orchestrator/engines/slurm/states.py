"""Slurm's states and reasons in words that a person can act on."""

from __future__ import annotations

from orchestrator.engines.api import Cause
from orchestrator.engines.slurm.slurm_commands import SlurmJob
from shared_store.volume.node_outcomes import OUT_OF_MEMORY

QUEUED = frozenset(
    {"PENDING", "CONFIGURING", "REQUEUED", "REQUEUE_FED", "REQUEUE_HOLD", "SPECIAL_EXIT", "RESV_DEL_HOLD"}
)
OVER = frozenset(
    {"BOOT_FAIL", "CANCELLED", "COMPLETED", "DEADLINE", "FAILED", "LAUNCH_FAILED", "NODE_FAIL", "OUT_OF_MEMORY"}
    | {"PREEMPTED", "RECONFIG_FAIL", "REVOKED", "TIMEOUT"}
)
"""States after which no process of a job is left. COMPLETING is none: its processes are being ended."""

_WAITS = {
    "None": "it has not looked at the job yet",
    "Resources": "waits for nodes to become free",
    "Priority": "other jobs have a higher priority",
    "BeginTime": "its start time has not come",
    "Dependency": "waits for another Slurm job",
    "Licenses": "waits for a license",
    "Reservation": "waits for its reservation (muster:reservation)",
    "PartitionDown": "the partition is down; name another one (muster:partition), or wait",
    "PartitionInactive": "the partition is inactive; name another one (muster:partition), or wait",
    "PartitionNodeLimit": "it asks for more nodes than the partition has; lower `nodes`, or name another partition",
    "PartitionTimeLimit": "it asks for more time than the partition allows; lower `timeout` (or muster:time)",
    "PartitionConfig": "the partition can't satisfy the request; name another one (muster:partition)",
    "BadConstraints": "no node has the requested resources; check `resources`, muster:constraint and muster:gpu",
    "NodeDown": "a node that it needs is down",
    "ReqNodeNotAvail": "nodes that it needs are down, drained or reserved",
    "Nodes required for job are DOWN": "nodes that it needs are down, drained or reserved",
    "JobHeldUser": "it is held; release it with scontrol release",
    "JobHeldAdmin": "an administrator holds it; ask them",
    "InvalidAccount": "the account is not valid; look at muster:account",
    "InvalidQOS": "the QOS is not valid; look at muster:qos",
    "Prolog": "its prolog runs",
    "Cleaning": "what ran before it is being cleaned up",
    "launch failed requeued held": "it could not be launched and is held; look at slurmd's log, then `muster stop` it",
}


def waiting(job: SlurmJob) -> str:
    """Why a job has not started."""
    if job.state == "CONFIGURING":
        return f"Slurm: {job.hosts} is being made ready (job {job.number})"
    reason = job.reason.partition(",")[0]
    words = _WAITS.get(reason)
    if words is None and (reason.startswith(("QOS", "Assoc", "MaxJobs", "QOSJob"))):
        words = "a limit of the account or QOS is reached"
    named = "" if reason == "None" else f"{job.reason}; "
    return f"Slurm: {words or 'waits'} ({named}job {job.number})"


CANCELLED = "cancelled in Slurm (scancel), not by Muster"

_ENDS = {
    "COMPLETED": (Cause.EXIT, 0, "Slurm says COMPLETED"),
    "PREEMPTED": (Cause.PREEMPTED, 75, "preempted by Slurm, and did not leave in time"),
    "TIMEOUT": (Cause.STOPPED, 137, "Slurm ended it at its time limit; ask for more (timeout, or muster:time)"),
    "DEADLINE": (Cause.STOPPED, 137, "Slurm ended it at its deadline"),
    "OUT_OF_MEMORY": (Cause.OUT_OF_MEMORY, 137, OUT_OF_MEMORY),
    "NODE_FAIL": (Cause.HOST_LOST, 137, "Slurm lost a node of {hosts}"),
    "BOOT_FAIL": (Cause.HOST_LOST, 137, "Slurm could not boot a node"),
    "CANCELLED": (Cause.CANCELLED, 137, CANCELLED),
}
"""By the state in which a job ended: the cause of its nodes' ends, their exit code (75: to be started again for nothing), and words."""


def ending(job: SlurmJob, output: str) -> tuple[Cause | None, int, str]:
    """Cause (None: Slurm does not say), exit code and reason of a node that left no outcome, by how its job ended."""
    cause, code, words = _ENDS.get(job.state, (None, 137, f"Slurm says {job.state}, {job.reason}"))
    words = words.replace("{hosts}", job.hosts or "the job")
    if job.state == "FAILED" and job.reason in ("RaisedSignal:53(Real-time_signal_19)", "JobLaunchFailure"):
        words = f"Slurm could not start it on {job.hosts}: is {output} on a file system that all nodes share?"
    return cause, code, f"{words} (job {job.number})"
