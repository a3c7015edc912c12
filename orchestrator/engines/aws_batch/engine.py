"""The AWS Batch engine: a gang is a multi-node parallel job of AWS's, in the account that ``muster aws up`` made ready.

AWS queues, finds instances and starts containers; retries, epochs and the judgement of an end stay here: each attempt is a job of
its own on AWS, never retried there. Whether the controller's store is the nodes' volume (a workstation that mounts it) or not
(a laptop) is all the same to a job: on a laptop its log and its outcomes come over CloudWatch Logs (:mod:`.aws_logs`), while
checkpoints stay on the volume.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import boto3
from botocore.config import Config
from botocore.exceptions import BotoCoreError, ClientError, NoCredentialsError, NoRegionError
from botocore.parsers import ResponseParserError

from orchestrator.domain.gang import LOG_GROUP
from orchestrator.domain.hosts import Limit, Queued
from orchestrator.domain.job import AWS_NOT_STARTED, TERMINAL
from orchestrator.domain.resources import Resources
from orchestrator.engines.api import (
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
from orchestrator.engines.aws_batch import TRAITS
from orchestrator.engines.aws_batch.config import is_mounted_from, load_config
from orchestrator.engines.aws_batch.logs import CopiedLog, GangLogs
from orchestrator.engines.aws_batch.node_status import node_ended, waiting, waits
from orchestrator.engines.aws_batch.requests import DIGEST, Requests, requests_for
from orchestrator.engines.toolkit.looks import one_by_one
from orchestrator.engines.toolkit.outcomes import log_of, record, recorded, seen, store_facts
from orchestrator.engines.toolkit.stopping import stop_within
from orchestrator.engines.toolkit.view import CachedView
from shared_store.contract.error_text import counted
from shared_store.volume.node_outcomes import EX_TEMPFAIL, Outcome

_PORT = 29500
_GRACE = 25.0
"""Grace time [s] of a supervisor: AWS kills containers after 30, and it has to record what did not leave in time before that."""
_CAPACITY_AGE = 60.0
"""Seconds for which AWS's answer about its size is kept."""
_ANSWER = 10.0
"""Seconds that a caller waits for that answer."""
_STRAGGLE = 180.0
"""Seconds after a job's end within which AWS says of every node that it ended, too."""
_ENDING = _STRAGGLE + 60.0
"""Seconds that AWS may take to end a job before its controller is told that it does not."""
_BLAME = 60.0
"""Seconds that a failed main node waits for its children's ends: AWS ends them now, and one may have been the cause."""
_FIXED = 6.0
"""Seconds that an outcome on a shared volume may take to be seen."""
_REMEMBERED = 256
"""Gangs whose end is kept: the controller asks once more after it, and after a restart it asks anew."""
_MEMORY = 32 * 1024
"""MiB a vCPU at most, of all of EC2's instance types."""
_TRANSIENT = (
    *("TooManyRequestsException", "ThrottlingException", "RequestLimitExceeded", "ServerException"),
    *("ExpiredToken", "ExpiredTokenException"),  # a person logs in again
)
_FAILURES = (ClientError, BotoCoreError, ResponseParserError)
"""Exceptions of boto3: AWS refuses, is not reached, or answers nonsense."""
_DESCRIBED = 100
"""Jobs and nodes that AWS describes in one request, at most."""
_AWAY = 15.0
"""Seconds for which an AWS that did not answer is left alone."""


@dataclass
class _Watched:
    """The known state of a gang between two looks."""

    next: float = 0.0
    """When AWS is asked again (monotonic [s])."""
    look: Look = ()
    """The last status, empty before the first; or the error in its place."""
    trouble: str = ""
    """Why AWS could not be asked the last time."""
    over_since: float | None = None
    """When AWS first said that the job is over (monotonic [s])."""
    main_stopped: int | None = None
    """When the main node stopped, as AWS says (Unix time [ms]): AWS ends the others then."""
    ended: dict[int, float] = field(default_factory=dict)
    """By node: when it was first seen to have ended (monotonic [s])."""
    logs: GangLogs | None = None
    stopped: bool = False
    """It was stopped: nothing of it runs, and nothing copies its logs."""

    @property
    def is_due(self) -> bool:
        """Whether AWS is to be asked now: a gang of which nothing runs does not change any more."""
        if isinstance(self.look, BaseException) or not self.look:
            return True
        return time.monotonic() >= self.next and any(node.running for node in self.look)

    @property
    def straggled(self) -> bool:
        """Whether the job is over for so long that none of its nodes can run."""
        return self.over_since is not None and time.monotonic() - self.over_since > _STRAGGLE


class AwsBatchEngine:
    """One account's AWS Batch, as ``$MUSTER_HOME/aws.json`` describes it."""

    name = "aws-batch"
    traits = TRAITS
    address: str | None = None  # nodes on AWS do not reach this machine

    def __init__(self, home: Path) -> None:
        """Raises EngineError: there is no configuration, AWS does not answer, or it does not know the credentials or the queue."""
        self.config = load_config(home)
        try:
            session = boto3.Session(region_name=self.config.region, profile_name=self.config.profile)
            if session.get_credentials() is None:
                raise NoCredentialsError
            url = self.config.endpoint_url
            # a SubmitJob whose answer was lost must not be sent again unseen: AWS has no key to make it harmless
            once = Config(connect_timeout=5, read_timeout=30, retries={"total_max_attempts": 1})
            # the controller's own loop asks: an AWS that is away must not hold up everything else for long
            twice = Config(connect_timeout=5, read_timeout=30, retries={"mode": "standard", "total_max_attempts": 2})
            self._batch = session.client("batch", endpoint_url=url, config=twice)
            self._submitting = session.client("batch", endpoint_url=url, config=once)
            self._logs = session.client("logs", endpoint_url=url, config=twice)
        except (BotoCoreError, NoRegionError) as error:
            raise EngineError(f"AWS: {error}; see `aws configure`") from None
        self._vcpus = CachedView(
            self.config.max_vcpus, self._max_vcpus, name="aws capacity", silence="AWS Batch has not answered yet"
        )
        self._gangs: dict[str, _Watched] = {}
        self._lock = threading.Lock()
        self._defining = WeakValueDictionary[str, threading.Lock]()
        """By name of a definition: held where a revision is looked for and registered."""
        self._check_queue()

    def capacity(self) -> Queued:
        """The limits of the queue's compute environments.

        AWS tells vCPUs only. No type of instance has more than a GPU for every four of them, or more than 32 GiB for each: that
        is taken as their number, and what does not exist waits there with AWS's own reason. Until AWS has told them, for which it
        may lack a permission, ``max_vcpus`` of the configuration counts.

        Raises NotYet where AWS did not answer the last time: what it told before may be wrong.
        """
        vcpus = self._vcpus.get(_CAPACITY_AGE, _ANSWER)
        if (trouble := self._vcpus.trouble) and self._vcpus.taken > -inf:
            raise NotYet(trouble)
        name = f"{self.name}/{self.config.job_queue.rpartition('/')[2]}"
        return Queued(Limit(name, Resources(float(vcpus), vcpus // 4, vcpus * _MEMORY)))

    def plan(self, gang: Gang) -> Plan[Requests]:
        """The requests; nodes' addresses are AWS's to give."""
        gang = dataclasses.replace(gang, grace=min(gang.grace, _GRACE))
        nodes = node_plans(gang, ["given by AWS"] * len(gang.placements), _PORT)
        requests = requests_for(gang, nodes, self.config.with_options(gang.options))
        return Plan(gang, nodes, requests, requests.document())

    def launch(self, plan: Plan[Requests]) -> Handle:
        gang, requests = plan.gang, plan.request
        queue = str(requests.submission["jobQueue"])
        try:
            job = self._find(queue, str(requests.submission["jobName"])) or self._submit(requests)
        except ClientError as error:
            if _is_transient(error):
                raise NotYet(f"AWS Batch: {_words(error)}; trying again") from None
            raise EngineError(f"AWS Batch: {_words(error)}") from None
        except (BotoCoreError, ResponseParserError) as error:
            raise NotYet(f"AWS Batch does not answer: {error}; trying again") from None
        facts = {
            **store_facts(gang),
            "main": gang.main,
            "aws": job,
            "queue": queue,
            "supervised": list(requests.supervised),
        }
        return Handle(self.name, gang.name, len(plan.nodes), facts)

    def observe(self, handles: Sequence[Handle]) -> Sequence[Look]:
        """AWS is asked for up to 100 jobs and nodes in a request, and for no gang twice within the interval of the configuration."""
        watched = {handle: self._watched(handle) for handle in handles}
        self._look_again([handle for handle in handles if watched[handle].is_due])
        return [watched[handle].look for handle in handles]

    def stop(self, handle: Handle, grace: float) -> None:
        """AWS's own grace is 30 s, whatever ``grace`` says."""
        watched = self._watched(handle)
        job, asked = f"job {handle.facts['aws']}", False

        def step() -> str:
            nonlocal asked
            problem: EngineError | None = None
            try:
                if not asked:
                    self._terminate(handle)
                    asked = True
            except EngineError as error:
                problem = error
            self._look_again([handle])
            if isinstance(watched.look, BaseException):
                raise watched.look
            running = sum(node.running for node in watched.look)
            if problem is not None and running:  # else AWS has forgotten the job
                raise problem
            return (watched.trouble or f"{counted(running, 'node')} of {job} running") if running else ""

        stop_within(_ENDING, step, engine=self.name, gang=handle.gang, pause=self.config.poll)
        if watched.logs is not None:
            watched.logs.finish()
        with self._lock:
            watched.stopped = True
            over = [name for name, each in self._gangs.items() if each.stopped]
            for name in over[: max(0, len(over) - _REMEMBERED)]:
                del self._gangs[name]

    def close(self) -> None:
        """Jobs on AWS go on."""
        for client in (self._batch, self._submitting, self._logs):
            client.close()

    def _check_queue(self) -> None:
        """Later AWS may be away for a while, and a gang waits for it; what is wrong from the start would wait for ever."""
        queue, where = self.config.job_queue, self.config.endpoint_url or self.config.region
        try:
            found = self._batch.describe_job_queues(jobQueues=[queue])["jobQueues"]
        except ClientError as error:
            raise EngineError(f"AWS Batch ({where}) refuses: {_words(error)}; see `aws configure`") from None
        except (BotoCoreError, ResponseParserError) as error:
            raise EngineError(
                f"AWS Batch ({where}) does not answer: {error}; see region and endpoint_url in aws.json"
            ) from None
        if not found:
            raise EngineError(
                f"AWS Batch ({where}) has no job queue {queue}; see `muster aws status`, or make it with `muster aws up`"
            )

    def _terminate(self, handle: Handle) -> None:
        """Ask AWS to end the job. Raises NotYet where it does not answer, EngineError where it refuses."""
        try:
            self._batch.terminate_job(jobId=handle.facts["aws"], reason="ended by Muster")
        except _FAILURES as error:
            if isinstance(error, ClientError) and not _is_transient(error):
                raise EngineError(f"AWS Batch does not end job {handle.facts['aws']}: {_words(error)}") from None
            raise NotYet(f"AWS Batch does not answer: {_words(error)}") from None

    # -- starting -----------------------------------------------------------------------------------------------------

    def _find(self, queue: str, name: str) -> str | None:
        """The job of that name: a controller may have been killed after it submitted it."""
        filters = [{"name": "JOB_NAME", "values": [name]}]
        for page in self._batch.get_paginator("list_jobs").paginate(jobQueue=queue, filters=filters):
            for job in page["jobSummaryList"]:
                return str(job["jobId"])
        return None

    def _submit(self, requests: Requests) -> str:
        request = {**requests.submission, "jobDefinition": self._definition(requests)}
        return str(self._submitting.submit_job(**request)["jobId"])

    def _definition(self, requests: Requests) -> str:
        """The ARN of an active definition that says just that; a new revision where there is none."""
        name = requests.definition["jobDefinitionName"]
        with self._lock:
            alone = self._defining.setdefault(name, threading.Lock())
        with alone:  # several gangs of one definition may be launched at once
            pages = self._batch.get_paginator("describe_job_definitions")
            for page in pages.paginate(jobDefinitionName=name, status="ACTIVE"):
                for each in page["jobDefinitions"]:
                    if (each.get("tags") or {}).get(DIGEST) == requests.digest:
                        return str(each["jobDefinitionArn"])
            return str(self._batch.register_job_definition(**requests.definition)["jobDefinitionArn"])

    # -- watching -----------------------------------------------------------------------------------------------------

    def _watched(self, handle: Handle) -> _Watched:
        with self._lock:
            return self._gangs.setdefault(handle.gang, _Watched())

    def _look_again(self, handles: Sequence[Handle]) -> None:
        """Ask AWS; where it does not answer, the last status stays, and says that it is an old one."""
        trouble, pause, described = "", self.config.poll, dict[str, Mapping[str, Any]]()
        try:
            described = self._describe([name for handle in handles for name in _ids(handle)])
        except _FAILURES as error:
            trouble, pause = f"AWS Batch does not answer: {_words(error)}", _AWAY
        for handle in handles:
            watched = self._watched(handle)
            watched.trouble, watched.next = trouble, time.monotonic() + pause
            if trouble:
                unknown = [NodeStatus(NodePhase.UNREACHABLE, words=trouble)] * handle.nodes
                known = unknown if isinstance(watched.look, BaseException) else watched.look or unknown
                watched.look = [dataclasses.replace(node, stale=trouble) if node.running else node for node in known]
            else:
                [watched.look] = one_by_one(lambda handle: self._look(handle, described), [handle])

    def _look(self, handle: Handle, described: Mapping[str, Mapping[str, Any]]) -> GangStatus:
        """The status of every node, by what AWS has described."""
        job, *nodes = [described.get(name) for name in _ids(handle)]
        watched, main = self._watched(handle), handle.facts["main"]
        if job is None:
            gone = NodeStatus(NodePhase.ENDED, words=f"AWS Batch has no job {handle.facts['aws']} any more")
            return [gone] * handle.nodes
        if job["status"] in TERMINAL and watched.over_since is None:
            watched.over_since = time.monotonic()
        watched.main_stopped = (nodes[main] or {}).get("stoppedAt")
        status = [self._node(handle, watched, index, node or job, job) for index, node in enumerate(nodes)]
        failed = not status[main].running and status[main].exit_code not in (0, EX_TEMPFAIL)
        if failed and any(node.running for node in status) and time.monotonic() - watched.ended[main] < _BLAME:
            status[main] = NodeStatus(NodePhase.RUNNING, status[main].address)
        return status

    def _describe(self, ids: Sequence[str]) -> dict[str, Mapping[str, Any]]:
        """What AWS tells of these jobs and nodes, by id; nothing of those that it does not have."""
        found: dict[str, Mapping[str, Any]] = {}
        for start in range(0, len(ids), _DESCRIBED):
            for job in self._batch.describe_jobs(jobs=ids[start : start + _DESCRIBED])["jobs"]:
                found[job["jobId"]] = job
        return found

    def _node(
        self,
        handle: Handle,
        watched: _Watched,
        index: int,
        detail: Mapping[str, Any],
        parent: Mapping[str, Any],
    ) -> NodeStatus:
        status, container = detail["status"], detail.get("container") or {}
        address = next((each.get("privateIpv4Address", "") for each in container.get("networkInterfaces") or []), "")
        over = status in TERMINAL or watched.straggled
        log = self._follow(handle, watched, index, container, over)
        if not over:
            if status == "RUNNING":
                return NodeStatus(NodePhase.RUNNING, address)
            return waits(status, address, waiting(handle, index, status, detail, parent))
        watched.ended.setdefault(index, time.monotonic())
        code = container.get("exitCode")
        code = 0 if code is None and status == "SUCCEEDED" else code
        reason = container.get("reason") or ("" if code == 0 else detail.get("statusReason") or "")
        stopped = float(detail.get("stoppedAt") or time.time() * 1000) / 1000
        asked = bool(watched.main_stopped) and detail.get("stoppedAt", 0) > (watched.main_stopped or 0)
        outcome = seen(handle, index, code or 0, str(reason), stopped, asked)
        if code is not None and not self._settled(handle, watched, log, outcome):
            return NodeStatus(NodePhase.RUNNING, address)  # it has ended, but how is still on its way
        return node_ended(address, code, str(reason), code is None and detail.get("statusReason") == AWS_NOT_STARTED)

    def _settled(self, handle: Handle, watched: _Watched, log: CopiedLog | None, outcome: Outcome) -> bool:
        """Whether the store has the node's outcome; it is written here if it was missing."""
        if recorded(handle, outcome.node) is not None:
            return True
        since = time.monotonic() - watched.ended[outcome.node]
        if not (log.whole if log is not None else since > _FIXED):
            return False
        record(handle, (log.outcome if log else None) or outcome)
        return True

    def _follow(
        self, handle: Handle, watched: _Watched, index: int, container: Mapping[str, Any], over: bool
    ) -> CopiedLog | None:
        """The copy of a node's log; None where the supervisor writes it to the store that is here, too."""
        with self._lock:  # a gang that is being stopped is looked at by two threads
            logs = watched.logs = watched.logs or self._copies(handle)
        options = (container.get("logConfiguration") or {}).get("options") or {}
        node = logs.saw(index, options.get("awslogs-group", LOG_GROUP), container.get("logStreamName"), over)
        return node if node.copied else None

    def _copies(self, handle: Handle) -> GangLogs:
        """The copies of a gang's logs, begun."""
        shared = self._is_shared(handle.facts["store"])
        nodes = [
            CopiedLog(*log_of(handle, index), supervised, copied=not (supervised and shared))
            for index, supervised in enumerate(handle.facts["supervised"])
        ]
        logs = GangLogs(self._logs, nodes, self.config.poll, self.config.quiet)
        logs.start(handle.gang)
        return logs

    def _is_shared(self, store: str) -> bool:
        if self.config.store_is_shared is not None:
            return self.config.store_is_shared
        return is_mounted_from(Path(store).resolve(), self.config.file_system, Path("/proc/self/mountinfo").read_text())

    # -- capacity -----------------------------------------------------------------------------------------------------

    def _max_vcpus(self) -> int:
        """The vCPUs of the queue's largest compute environment: a gang is in one of them. Raises NotYet."""
        try:
            found = self._batch.describe_job_queues(jobQueues=[self.config.job_queue])["jobQueues"]
            order = [each["computeEnvironment"] for each in found[0]["computeEnvironmentOrder"]] if found else []
            described = self._batch.describe_compute_environments(computeEnvironments=order) if order else {}
        except _FAILURES as error:
            raise NotYet(f"AWS Batch does not tell its capacity: {_words(error)}") from None
        sizes = [
            int((each.get("computeResources") or {}).get("maxvCpus", 0))
            for each in described.get("computeEnvironments", [])
        ]
        return max([*sizes, 0]) or self.config.max_vcpus


def _is_transient(error: ClientError) -> bool:
    answer = error.response
    status = int(answer.get("ResponseMetadata", {}).get("HTTPStatusCode", 0))
    return answer.get("Error", {}).get("Code") in _TRANSIENT or status >= 500 or status == 429


def _ids(handle: Handle) -> Sequence[str]:
    """AWS's ids of the job and of each of its nodes."""
    return [handle.facts["aws"], *(f"{handle.facts['aws']}#{index}" for index in range(handle.nodes))]


def _words(error: Exception) -> str:
    told = error.response.get("Error", {}) if isinstance(error, ClientError) else {}
    return f"{told.get('Message') or told.get('Code') or error}"
