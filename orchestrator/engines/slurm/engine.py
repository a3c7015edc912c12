"""The Slurm engine: a gang is one Slurm job with one task a node; queueing, shares, limits and preemption are Slurm's.

Every start of a gang is a submission of its own (``--no-requeue``). ``scontrol requeue`` and ``RequeueExit`` would start the same script
again, with the epoch of an attempt that is over: the fenced nodes would leave at once. So a gang that was preempted or came to its
time limit leaves with 75, and the controller submits a new attempt with a new epoch; ``SLURM_RESTART_COUNT`` stays unset.

One ``srun`` step with ``--kill-on-bad-exit=0``: to Slurm, 75 is a bad exit, and a child's death means nothing with ``on_child_failure:
ignore``. Who judges is the controller, as on every engine, from the outcomes in the store; of a node that left none, from what
``srun`` says of its task in the job's output. Then it stops the gang, as a whole.

A child of a job array is a single-node job here, which the controller starts: dependencies, retries and states are AWS's, which
Slurm's arrays do not have.
"""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any

from orchestrator import machine
from orchestrator.domain.hosts import Host, Queued
from orchestrator.engines.api import (
    Cause,
    EngineError,
    Gang,
    GangStatus,
    Handle,
    NodePhase,
    NodeStatus,
    NotYet,
    Plan,
    StatusOrError,
    node_plans,
)
from orchestrator.engines.slurm import TRAITS
from orchestrator.engines.slurm.script import SlurmSubmission, submission_for
from orchestrator.engines.slurm.slurm_commands import (
    SlurmJob,
    SlurmUnreachable,
    address_of_this_machine,
    call,
    list_hosts,
    list_jobs,
)
from orchestrator.engines.slurm.states import CANCELLED, OVER, QUEUED, ending, waiting
from orchestrator.engines.toolkit.outcomes import all_recorded, store_facts
from orchestrator.engines.toolkit.statuses import ended, one_by_one
from orchestrator.engines.toolkit.view import CachedView
from orchestrator.engines.toolkit.waiting import stop_within
from shared_store.volume.layout import Store
from shared_store.volume.node_outcomes import OUT_OF_MEMORY, Outcome

_FULL = re.compile(r"MaxSubmit|slurm temporarily unable", re.IGNORECASE)
"""Errors of sbatch after which it would accept the job later."""
_LOOK = 0.3
"""Seconds between two steps of a stop."""
_AGAIN = 2.0
"""Seconds after which a job that is still there is cancelled: it may have had no step yet, or Slurm can't reach a node."""
_KILLING = 60.0
"""Seconds beyond the grace time after which a job that is still there is reported; Slurm's KillWait is 30 s by default."""
_SILENCE, _PATIENCE = "slurmctld has not answered yet; see `scontrol ping`", 8.0
"""The trouble once slurmctld has not answered for so many seconds: a loaded machine answers late."""
_HOSTS_AGE = 10.0
"""Seconds for which a view of all hosts holds."""
_OFTEN, _SELDOM, _FEW = 1.0, 30.0, 10
"""Seconds between two calls of squeue while at most so many gangs are in its queue, and while there are more."""
_DOUBT = 5.0
"""The most seconds until another call after one that failed."""
_FORGOTTEN = "0"
"""Number of a job that Slurm does not know any more."""
_TASK_END = re.compile(r"^srun: error: \S+: tasks? ([\d,-]+): (?:Exited with exit code (\d+)|(.+))$", re.MULTILINE)
_STARVED = "Out Of Memory"
_SIGNALS = {"Killed": 137, "Terminated": 143, "Segmentation fault": 139, "Aborted": 134, _STARVED: 137}
_SCRIPT = re.compile(r"^(?:muster: node|slurmstepd\S*: error|srun: error|/\S+: line \d+): .*$", re.MULTILINE)
"""Lines of the script itself when it can't start the nodes."""
_GANG = re.compile(r"[^/]+/\d+/\d+")
"""The comment of a gang's job: the gang's name."""
_MEETING = re.compile(r"^muster: meeting (\{.*\})$", re.MULTILINE)


class SlurmEngine:
    """A Slurm cluster, by the commands of this machine."""

    name = "slurm"
    traits = TRAITS

    def __init__(self, squeue_interval: float | None = None) -> None:
        """``squeue_interval``: seconds; by default by the number of gangs.

        Raises EngineError where Slurm is not installed here, or slurmctld does not answer.
        """
        self._hosts = CachedView[Sequence[Host]]((), list_hosts, name="scontrol", silence=_SILENCE, patience=_PATIENCE)
        self._hosts.read()
        self.address = address_of_this_machine()
        self._jobs = CachedView[Mapping[str, SlurmJob]](
            {}, self._list_jobs, name="squeue", silence=_SILENCE, patience=_PATIENCE
        )
        self._chosen_interval = squeue_interval
        self._interval = squeue_interval or _OFTEN
        """Seconds for which a view of this user's jobs holds."""
        self._submitted: dict[str, float] = {}
        self._cancelled: dict[str, float] = {}
        """Numbers of the jobs that this engine has cancelled, while Slurm knows them, and when (monotonic [s])."""
        self._submitting = threading.Lock()

    def capacity(self) -> Queued:
        """Raises NotYet where slurmctld did not answer the last time: its last answer may be wrong."""
        hosts = self._hosts.get(_HOSTS_AGE)
        if trouble := self._hosts.trouble:
            raise NotYet(f"Slurm: {trouble}")
        return Queued(hosts)

    def plan(self, gang: Gang) -> Plan[SlurmSubmission]:
        """With the whole script; the nodes' addresses are known when Slurm has placed them."""
        request = submission_for(gang)
        document = request.script
        if gang.bus_token:  # not for people
            document = document.replace(json.dumps(gang.bus_token), json.dumps("…"))
        return Plan(gang, node_plans(gang, [""] * len(gang.placements), 0), request, document)

    def launch(self, plan: Plan[SlurmSubmission]) -> Handle:
        gang = plan.gang
        facts = {**store_facts(gang), "main": gang.main, "output": plan.request.output}
        if self._jobs.trouble:
            self._jobs.get(_OFTEN)
        try:
            if trouble := self._jobs.trouble:
                raise SlurmUnreachable(trouble)
            with self._submitting:  # one search and one submission at a time
                number = self._find(gang.name, facts) or self._submit(plan.request)
                self._submitted[number] = machine.monotonic()
        except SlurmUnreachable as error:
            raise NotYet(f"Slurm: {error}", unknown=True) from error
        return Handle(self.name, gang.name, len(plan.nodes), {**facts, "slurm": number})

    def observe(self, handles: Sequence[Handle]) -> Sequence[StatusOrError]:
        return one_by_one(self._observe, handles)

    def _observe(self, handle: Handle) -> GangStatus:
        facts, count = handle.facts, handle.nodes
        try:
            job = self._job(handle)
        except SlurmUnreachable as error:
            trouble = f"Slurm: {error}"
            return [NodeStatus(NodePhase.UNREACHABLE, words=trouble, stale=trouble)] * count
        trouble = f"Slurm: {why}" if (why := self._jobs.trouble) else ""
        is_queued = job is not None and job.state in QUEUED
        # the view may be old: what the job has written shows that Slurm has started it
        output = "" if is_queued and self._interval <= _OFTEN else _output(facts)
        meeting = _MEETING.search(output)
        if job is not None and is_queued and not meeting:
            return [_queued(job, trouble)] * count
        ends = all_recorded(handle)
        names = json.loads(meeting[1])["nodes"] if meeting else []
        nodes = []
        for index in range(count):
            node = _node(facts, job, output, index, ends.get(index))
            if node.running:
                node = replace(node, stale=trouble)
            elif job is not None and job.state == "CANCELLED" and job.number not in self._cancelled:
                node = replace(node, cause=Cause.CANCELLED, words=f"{CANCELLED} (job {job.number})")
            nodes.append(replace(node, host=f"slurm/{names[_task(facts, index)]}") if names else node)
        return nodes

    def stop(self, handle: Handle, grace: float) -> None:
        number = handle.facts["slurm"]
        due, killed = inf if grace > 0 else 0.0, 0.0
        """When the job is killed (monotonic [s]; infinity until the nodes were asked to leave), and when it last was."""

        def step() -> str:
            nonlocal due, killed
            job = self._job(handle, _LOOK if self._interval <= _OFTEN else _AGAIN)
            if job is None or job.state in OVER:
                self._submitted.pop(number, None)
                return ""
            now = machine.monotonic()
            if job.state in QUEUED:
                self._cancel(number)
            elif due == inf:
                # to the script alone, which tells the nodes: it knows whether they have been started yet
                _scancel("--batch", "--signal=USR1", number)
                due = machine.monotonic() + grace  # from now on: slurmctld may have been away
            elif now >= due and not killed:
                # the step at once; to end the job, Slurm asks once more and waits for KillWait
                _scancel("--signal=KILL", f"{number}.0")
                killed = now
            elif now >= due and now - killed > _AGAIN:
                self._cancel(number)
                killed = now
            state = f"job {number} is {job.state}{f' on {job.hosts}' if job.hosts else ''}"
            why = f"although it was killed (`scontrol show job {number}`, and ps on that host, say what is left of it)"
            return f"{state} {why}" if killed else state

        stop_within(grace + _KILLING, step, engine=self.name, gang=handle.gang, pause=_LOOK)

    def close(self) -> None:
        """Slurm's jobs go on."""

    # -- jobs ---------------------------------------------------------------------------------------------------------

    def _list_jobs(self) -> Mapping[str, SlurmJob]:
        jobs = list_jobs()
        gangs = sum(job.state not in OVER and _GANG.fullmatch(job.comment) is not None for job in jobs.values())
        self._interval = self._chosen_interval or (_OFTEN if gangs <= _FEW else _SELDOM)
        return jobs

    def _cancel(self, number: str) -> None:
        """Cancel a job, and remember that it was this controller."""
        taken, known = self._jobs.taken, self._jobs.value
        for each, at in list(self._cancelled.items()):
            if each not in known and at < taken:  # an older view may not have it yet
                self._cancelled.pop(each, None)
        self._cancelled[number] = machine.monotonic()
        _scancel(number)

    def _find(self, gang: str, facts: Mapping[str, Any]) -> str | None:
        """The number of a gang that was submitted before: its controller died, or sbatch's answer was lost. Raises EngineError."""
        for job in self._jobs.read().values():
            if job.comment == gang:
                return job.number
        run = Store(facts["store"]).run(facts["run"])
        if run.outcome(facts["job"], facts["attempt"], facts["main"]).exists():
            return _FORGOTTEN  # it ran and ended long ago: not a second time
        return None

    @staticmethod
    def _submit(request: SlurmSubmission) -> str:
        Path(request.output).parent.mkdir(parents=True, exist_ok=True)
        try:
            return call("sbatch", "--parsable", text=request.script).strip().partition(";")[0]
        except SlurmUnreachable:
            raise
        except EngineError as error:
            if _FULL.search(str(error)):
                raise NotYet(f"Slurm takes no more jobs now: {error}") from error
            where = f" for partition {request.partition}" if request.partition else ""
            raise EngineError(
                f"Slurm refuses the job{where}: {error}; `muster submit --dry-run` shows the request"
            ) from error

    def _job(self, handle: Handle, age: float | None = None) -> SlurmJob | None:
        """None where Slurm has forgotten it. Raises SlurmUnreachable: no view since it was submitted.

        ``age``: for how many seconds a view holds; by default for the interval, or less where none is known to hold.
        """
        number, submitted = handle.facts["slurm"], self._submitted.get(handle.facts["slurm"], 0.0)
        if age is None:
            age = min(self._interval, _DOUBT) if self._jobs.trouble else self._interval
        if self._jobs.taken < submitted:
            age = min(age, _OFTEN)
        job = self._jobs.get(age).get(number)
        if job is None and self._jobs.taken < submitted:
            raise SlurmUnreachable(self._jobs.trouble or _SILENCE)
        return job if job is not None and job.comment == handle.gang else None


def _scancel(*arguments: str) -> None:
    try:
        call("scancel", *arguments)
    except SlurmUnreachable:
        raise
    except EngineError:
        pass  # it ended meanwhile


def _output(facts: Mapping[str, Any]) -> str:
    """The job's output so far. Raises OSError where it can't be read now."""
    try:
        return Path(facts["output"]).read_text(errors="replace")
    except FileNotFoundError:
        return ""


def _queued(job: SlurmJob, trouble: str) -> NodeStatus:
    """A node of a job that Slurm has not started; ``trouble``: why there is no newer status."""
    phase = NodePhase.STARTING if job.state == "CONFIGURING" else NodePhase.QUEUED
    return NodeStatus(phase, words=waiting(job), stale=trouble)


def _node(
    facts: Mapping[str, Any], job: SlurmJob | None, output: str, index: int, outcome: Outcome | None
) -> NodeStatus:
    """The status of one node: by its outcome, else by srun's line about its task, else by its job."""
    task = _task(facts, index)
    meeting = _MEETING.search(output)
    address = json.loads(meeting[1])["addresses"][task] if meeting else ""
    if outcome is not None:
        return ended(address, outcome.exit_code)
    # lines of the node's own processes from before they could write to the store
    own = re.findall(rf"^\s*{'0*' + str(task)}: (muster.*)$", output, re.MULTILINE)
    for tasks, code, how in _TASK_END.findall(output):
        if _among(task, tasks):
            status = int(code) if code else _SIGNALS.get(how.removesuffix(" (core dumped)"), 137)
            if how == _STARVED:
                return NodeStatus(NodePhase.ENDED, address, OUT_OF_MEMORY, Cause.OUT_OF_MEMORY, status)
            return ended(address, status, own[-1] if own else "")
    if job is not None and job.state not in OVER:
        if meeting:
            return NodeStatus(NodePhase.RUNNING, address)
        return NodeStatus(NodePhase.STARTING, address, f"Slurm: starts on {job.hosts} (job {job.number})")
    if not own and (not meeting or (job is not None and job.state == "FAILED")):
        own = _SCRIPT.findall(output)
    if own:
        return ended(address, 2, own[-1])
    if job is None:
        return NodeStatus(NodePhase.ENDED, address, "Slurm has forgotten the job, and the node left no outcome")
    cause, exit_code, words = ending(job, facts["output"])
    return NodeStatus(NodePhase.ENDED, address, words, cause, exit_code)


def _task(facts: Mapping[str, Any], index: int) -> int:
    """Number of a node's task: the main node is the first, the others follow by their index."""
    return 0 if index == facts["main"] else index + (1 if index < facts["main"] else 0)


def _among(task: int, tasks: str) -> bool:
    """Whether srun's ``0-2,5`` names the task."""
    ranges = (part.partition("-") for part in tasks.split(","))
    return any(int(first) <= task <= int(last or first) for first, _, last in ranges)
