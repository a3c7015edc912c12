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
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
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
    Look,
    NodePhase,
    NodeStatus,
    NotYet,
    Plan,
    node_plans,
)
from orchestrator.engines.slurm import TRAITS
from orchestrator.engines.slurm.script import SlurmSubmission, shown, submission_for
from orchestrator.engines.slurm.slurm_commands import (
    SlurmJob,
    SlurmUnreachable,
    address_of_this_machine,
    call,
    list_hosts,
    list_jobs,
)
from orchestrator.engines.slurm.states import CANCELLED, OVER, QUEUED, ending, waiting
from orchestrator.engines.toolkit.endings import ended
from orchestrator.engines.toolkit.looks import one_by_one
from orchestrator.engines.toolkit.outcomes import all_recorded, store_facts
from orchestrator.engines.toolkit.stopping import stop_within
from orchestrator.engines.toolkit.view import CachedView
from shared_store.volume.layout import Store
from shared_store.volume.node_outcomes import OUT_OF_MEMORY, Outcome

_FULL = re.compile(r"MaxSubmit|slurm temporarily unable", re.IGNORECASE)
"""Errors of sbatch after which it would accept the job later."""
_LOOK = 0.3
"""Seconds between two looks at a job that is being stopped."""
_AGAIN = 2.0
"""Seconds after which a job that is still there is cancelled: it may have had no step yet, or Slurm can't reach a node."""
_KILLING = 60.0
"""Seconds beyond the grace time after which a job that is still there is reported; Slurm's KillWait is 30 s by default."""
_SILENCE = "slurmctld has not answered yet; see `scontrol ping`"
_HOSTS_AGE = 10.0
"""Seconds for which a view of all hosts holds."""
_OFTEN, _SELDOM, _FEW = 1.0, 30.0, 10
"""Seconds between two calls of squeue while at most so many gangs are in its queue, and while there are more."""
_DOUBT = 5.0
"""The most seconds until another call after one that failed."""
_ANSWER, _OVERDUE = 2.0, 8.0
"""Seconds that a look at a job waits for squeue, and after which slurmctld does not answer. A look at a job that was never seen waits for
all of them: a loaded machine answers late."""
_PATIENCE = 5.0
"""Seconds for which a launch waits for sbatch, which tries for longer where slurmctld is away: other jobs wait meanwhile."""
_FORGOTTEN = "0"
"""Number of a job that Slurm does not know any more."""
_SAID = re.compile(r"^srun: error: \S+: tasks? ([\d,-]+): (?:Exited with exit code (\d+)|(.+))$", re.MULTILINE)
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
        self._interval_set = squeue_interval
        self._hosts = CachedView[Sequence[Host]]((), list_hosts, name="scontrol", silence=_SILENCE, overdue=_OVERDUE)
        self._hosts.read()
        self.address = address_of_this_machine()
        self._jobs = CachedView[Mapping[str, SlurmJob]](
            {}, list_jobs, name="squeue", silence=_SILENCE, overdue=_OVERDUE
        )
        self._counted = (-inf, 0)
        """When the view was taken in which gangs were counted, and how many they were."""
        self._submitted: dict[str, float] = {}
        self._cancelled: dict[str, float] = {}
        """Numbers of the jobs that this engine has cancelled, while Slurm knows them, and when (monotonic [s])."""
        self._submitting = threading.Lock()
        self._pending: dict[str, Future[str]] = {}
        """Submissions that are not answered, by gang."""

    def capacity(self) -> Queued:
        """Raises NotYet where slurmctld did not answer the last time: what it said before may be wrong."""
        hosts = self._hosts.get(_HOSTS_AGE)
        if trouble := self._hosts.trouble:
            raise NotYet(f"Slurm: {trouble}")
        return Queued(hosts)

    def plan(self, gang: Gang) -> Plan[SlurmSubmission]:
        """With the whole script; the nodes' addresses are known when Slurm has placed them."""
        request = submission_for(gang)
        nodes = node_plans(gang, [""] * len(gang.placements), 0)
        return Plan(gang, nodes, request, shown(request.script, gang.bus_token))

    def launch(self, plan: Plan[SlurmSubmission]) -> Handle:
        gang = plan.gang
        facts = {**store_facts(gang), "main": gang.main, "output": plan.request.output}
        patience = 0.0 if self._pending else _PATIENCE
        if gang.name not in self._pending:
            if trouble := self._jobs.trouble:
                self._jobs.refresh()
                raise NotYet(f"Slurm: {trouble}", unknown=True)
            self._begin(gang.name, facts, plan.request)
        pending = self._pending[gang.name]
        if not wait([pending], patience).done:
            raise NotYet(
                "Slurm: the gang is being handed to slurmctld; if this lasts, see `scontrol ping`", unknown=True
            )
        del self._pending[gang.name]
        try:
            return Handle(self.name, gang.name, len(plan.nodes), {**facts, "slurm": pending.result()})
        except SlurmUnreachable as error:
            raise NotYet(f"Slurm: {error}", unknown=True) from error

    def observe(self, handles: Sequence[Handle]) -> Sequence[Look]:
        return one_by_one(self._observe, handles)

    def _observe(self, handle: Handle) -> GangStatus:
        facts, count = handle.facts, handle.nodes
        try:
            job = self._job(handle)
        except SlurmUnreachable as error:
            said = f"Slurm: {error}"
            return [NodeStatus(NodePhase.UNREACHABLE, words=said, stale=said)] * count
        trouble = f"Slurm: {why}" if (why := self._jobs.trouble) else ""
        queued = job is not None and job.state in QUEUED
        # the view may be old: what the job has written shows that Slurm has started it
        output = "" if queued and self._interval() <= _OFTEN else _output(facts)
        if job is not None and queued and not _MEETING.search(output):
            return [_queued(job, trouble)] * count
        ends = all_recorded(handle)
        nodes = [_node(facts, job, output, index, ends.get(index)) for index in range(count)]
        found = _MEETING.search(output)
        names = json.loads(found[1])["nodes"] if found else []
        hosts = [f"slurm/{names[_task(facts, index)]}" if names else "" for index in range(count)]
        if job is not None and job.state == "CANCELLED" and job.number not in self._cancelled:
            words = f"{CANCELLED} (job {job.number})"
            nodes = [each if each.running else replace(each, cause=Cause.CANCELLED, words=words) for each in nodes]
        return [
            replace(node, host=host, stale=trouble if node.running else "")
            for node, host in zip(nodes, hosts, strict=True)
        ]

    def stop(self, handle: Handle, grace: float) -> None:
        ending = _Cancellation(handle.facts["slurm"], grace, self._cancel)

        def step() -> str:
            job = self._job(handle, _LOOK if self._interval() <= _OFTEN else _AGAIN)
            if job is None or job.state in OVER:
                self._submitted.pop(ending.number, None)
                return ""
            return ending.next(job)

        stop_within(grace + _KILLING, step, engine=self.name, gang=handle.gang, pause=_LOOK)

    def close(self) -> None:
        """Slurm's jobs go on."""

    def _interval(self) -> float:
        """Seconds for which a view of this user's jobs holds."""
        if self._interval_set is not None:
            return self._interval_set
        if (taken := self._jobs.taken) != self._counted[0]:
            jobs = self._jobs.value.values()
            self._counted = (
                taken,
                sum(job.state not in OVER and _GANG.fullmatch(job.comment) is not None for job in jobs),
            )
        return _OFTEN if self._counted[1] <= _FEW else _SELDOM

    def _cancel(self, number: str) -> None:
        """Cancel a job, and remember that it was not somebody else who did."""
        taken, known = self._jobs.taken, self._jobs.value
        for each, at in list(self._cancelled.items()):
            if each not in known and at < taken:  # an older view may not have it yet
                self._cancelled.pop(each, None)
        self._cancelled[number] = machine.monotonic()
        _scancel(number)

    # -- jobs ---------------------------------------------------------------------------------------------------------

    def _begin(self, gang: str, facts: Mapping[str, Any], request: SlurmSubmission) -> None:
        """Submit the gang in the background."""
        pending: Future[str] = Future()

        def submit() -> None:
            try:
                with self._submitting:  # one look and one submission at a time
                    number = self._find(gang, facts) or self._submit(request)
                    self._submitted[number] = machine.monotonic()
                pending.set_result(number)
            except BaseException as error:
                pending.set_exception(error)

        threading.Thread(target=submit, name="sbatch", daemon=True).start()
        self._pending[gang] = pending

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
                f"Slurm refuses the job{where}: {error}; `muster submit --dry-run` shows what it is asked for"
            ) from error

    def _job(self, handle: Handle, age: float | None = None) -> SlurmJob | None:
        """None where Slurm has forgotten it. Raises Unreachable: no view since it was submitted.

        ``age``: for how many seconds a view holds; by default for the interval, or less where none is known to hold.
        """
        number = handle.facts["slurm"]
        submitted = self._submitted.get(number, 0.0)
        if age is None:
            age = min(self._interval(), _DOUBT) if self._jobs.trouble else self._interval()
        if self._jobs.taken <= submitted:
            age = min(age, _OFTEN)
        job = self._jobs.get(age, _ANSWER if self._jobs.taken > submitted else _OVERDUE).get(number)
        if job is None and self._jobs.taken <= submitted:
            raise SlurmUnreachable(self._jobs.trouble or _SILENCE)
        return job if job is not None and job.comment == handle.gang else None


class _Cancellation:
    """The end of one job: asked by a signal, then killed."""

    def __init__(self, number: str, grace: float, cancel: Callable[[str], None]) -> None:
        """``cancel``: cancels a job."""
        self.number, self._grace, self._cancel, self._killed = number, grace, cancel, 0.0
        self._due = inf if grace > 0 else 0.0
        """When it is killed (monotonic [s]); infinity until it was asked."""

    def next(self, job: SlurmJob) -> str:
        """Cancel the job, where that is due; returns its state in words. Raises Unreachable."""
        now, number = machine.monotonic(), self.number
        if job.state in QUEUED:
            self._cancel(number)
        elif self._due == inf:
            # to the script alone, which tells the nodes: it knows whether they have been started yet
            _scancel("--batch", "--signal=USR1", number)
            self._due = machine.monotonic() + self._grace  # from now on: slurmctld may have been away
        elif now >= self._due and not self._killed:
            # the step at once; to end the job, Slurm asks once more and waits for KillWait
            _scancel("--signal=KILL", f"{number}.0")
            self._killed = now
        elif now >= self._due and now - self._killed > _AGAIN:
            self._cancel(number)
            self._killed = now
        state = f"job {number} is {job.state}{f' on {job.hosts}' if job.hosts else ''}"
        if not self._killed:
            return state
        return f"{state} although it was killed (`scontrol show job {number}`, and ps on that host, say what is left of it)"


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
    """A node of a job that Slurm has not started; ``trouble``: why there is no newer picture."""
    phase = NodePhase.STARTING if job.state == "CONFIGURING" else NodePhase.QUEUED
    return NodeStatus(phase, words=waiting(job), stale=trouble)


def _node(facts: Mapping[str, Any], job: SlurmJob | None, said: str, index: int, outcome: Outcome | None) -> NodeStatus:
    """The status of one node: by its outcome, else by what srun says of its task, else by its job."""
    task = _task(facts, index)
    meeting = _MEETING.search(said)
    address = json.loads(meeting[1])["addresses"][task] if meeting else ""
    if outcome is not None:
        return ended(address, outcome.exit_code)
    # what the node's own processes said before they could say it in the store
    own = re.findall(rf"^\s*{'0*' + str(task)}: (muster.*)$", said, re.MULTILINE)
    for tasks, code, how in _SAID.findall(said):
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
        own = _SCRIPT.findall(said)
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
    for part in tasks.split(","):
        first, _, last = part.partition("-")
        if int(first) <= task <= int(last or first):
            return True
    return False
