"""The AWS Batch engine: a gang is a multi-node parallel job of AWS's, in the account that ``muster aws up`` made ready.

AWS queues, finds instances and starts containers; retries, epochs and the judgement of an end stay here: each attempt is a job of
its own on AWS, never retried there. Whether the controller's store is the nodes' volume (a workstation that mounts it) or not
(a laptop) is all the same to a job: on a laptop its log and its outcomes come over CloudWatch Logs (:mod:`.logs`), while
checkpoints stay on the volume.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

from botocore.config import Config

from orchestrator.domain.hosts import Limit, Queued
from orchestrator.domain.resources import Resources
from orchestrator.engines.api import EngineError, Gang, Handle, NotYet, Plan, StatusOrError, node_plans
from orchestrator.engines.aws_batch import TRAITS
from orchestrator.engines.aws_batch.config import is_mounted_from, load_config
from orchestrator.engines.aws_batch.errors import FAILURES, answered, session_for, words_of
from orchestrator.engines.aws_batch.logs import CopiedLog, GangLogs
from orchestrator.engines.aws_batch.requests import DIGEST, Requests, requests_for
from orchestrator.engines.aws_batch.watched_gang import STRAGGLE, WatchedGang
from orchestrator.engines.toolkit.outcomes import log_of, store_facts
from orchestrator.engines.toolkit.view import CachedView
from orchestrator.engines.toolkit.waiting import stop_within
from shared_store.contract.error_text import counted

_PORT = 29500
_GRACE = 25.0
"""Grace time [s] of a supervisor: AWS kills containers after 30, and it has to record what did not leave in time before that."""
_CAPACITY_AGE = 60.0
"""Seconds for which AWS's answer about its size is kept."""
_ENDING = STRAGGLE + 60.0
"""Seconds that AWS may take to end a job before its controller learns that it does not."""
_REMEMBERED = 256
"""Gangs whose end is kept: the controller asks once more after it, and after a restart it asks anew."""
_MEMORY = 32 * 1024
"""MiB a vCPU at most, of all of EC2's instance types."""
_DESCRIBED = 100
"""Jobs and nodes that AWS describes in one request, at most."""
_UNREACHABLE = 15.0
"""Seconds for which an AWS that did not answer is left alone."""


class AwsBatchEngine:
    """One account's AWS Batch, as ``$MUSTER_HOME/aws.json`` describes it."""

    name = "aws-batch"
    traits = TRAITS
    address: str | None = None  # nodes on AWS do not reach this machine

    def __init__(self, home: Path) -> None:
        """Raises EngineError: there is no configuration, AWS does not answer, or it does not know the credentials or the queue."""
        self.config = load_config(home)
        try:
            session = session_for(self.config.region, self.config.profile)
            url = self.config.endpoint_url
            # a SubmitJob whose answer was lost must not be sent again unseen: AWS has no key to make it harmless
            once = Config(connect_timeout=5, read_timeout=30, retries={"total_max_attempts": 1})
            # the controller's own loop asks: an AWS that is away must not hold up everything else for long
            twice = Config(connect_timeout=5, read_timeout=30, retries={"mode": "standard", "total_max_attempts": 2})
            self._batch = session.client("batch", endpoint_url=url, config=twice)
            self._submitting = session.client("batch", endpoint_url=url, config=once)
            self._logs = session.client("logs", endpoint_url=url, config=twice)
        except FAILURES as error:
            raise EngineError(f"AWS: {words_of(error)}; see `aws configure`") from None
        silence = "AWS Batch has not answered yet"
        self._vcpus = CachedView(
            self.config.max_vcpus, self._max_vcpus, name="aws capacity", silence=silence, patience=10.0
        )
        self._gangs: dict[str, WatchedGang] = {}
        self._lock = threading.Lock()
        self._defining = WeakValueDictionary[str, threading.Lock]()
        """By name of a definition: held where a revision is looked for and registered."""
        self._check_queue()

    def capacity(self) -> Queued:
        """The limits of the queue's compute environments.

        AWS tells vCPUs only. No type of instance has more than a GPU for every four of them, or more than 32 GiB for each: that
        is taken as their number, and what does not exist waits there with AWS's own reason. Until AWS has reported them, for which it
        may lack a permission, ``max_vcpus`` of the configuration counts.

        Raises NotYet where AWS did not answer the last time: its last answer may be wrong.
        """
        vcpus = self._vcpus.get(_CAPACITY_AGE)
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
        with answered():
            job = self._find(queue, str(requests.submission["jobName"])) or self._submit(requests)
        facts = {"main": gang.main, "aws": job, "queue": queue, "supervised": list(requests.supervised)}
        return Handle(self.name, gang.name, len(plan.nodes), {**store_facts(gang), **facts})

    def observe(self, handles: Sequence[Handle]) -> Sequence[StatusOrError]:
        """AWS is asked for up to 100 jobs and nodes in a request, and for no gang twice within the interval of the configuration."""
        watched = [self._watched(handle) for handle in handles]
        self._update([each for each in watched if each.is_due])
        return [each.observed for each in watched]

    def stop(self, handle: Handle, grace: float) -> None:
        """AWS's own grace is 30 s, whatever ``grace`` says."""
        watched, is_requested = self._watched(handle), False

        def step() -> str:
            nonlocal is_requested
            problem: EngineError | None = None
            try:
                if not is_requested:
                    with answered():
                        self._batch.terminate_job(jobId=handle.facts["aws"], reason="ended by Muster")
                    is_requested = True
            except EngineError as error:
                problem = error
            self._update([watched])
            if isinstance(watched.observed, BaseException):
                raise watched.observed
            running = sum(node.running for node in watched.observed)
            if problem is not None and running:  # else AWS has forgotten the job
                raise problem
            words = f"{counted(running, 'node')} of job {handle.facts['aws']} running"
            return (watched.trouble or words) if running else ""

        stop_within(_ENDING, step, engine=self.name, gang=handle.gang, pause=self.config.poll)
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
        queue = self.config.job_queue
        where = f"AWS Batch ({self.config.endpoint_url or self.config.region})"
        try:
            with answered():
                found = self._batch.describe_job_queues(jobQueues=[queue])["jobQueues"]
        except EngineError as error:
            hint = "region and endpoint_url in aws.json" if isinstance(error, NotYet) else "`aws configure`"
            words = str(error).removesuffix("; trying again").replace("AWS Batch", where, 1)
            raise EngineError(f"{words}; see {hint}") from None
        if not found:
            raise EngineError(
                f"{where} has no job queue {queue}; see `muster aws status`, or make it with `muster aws up`"
            )

    # -- starting -----------------------------------------------------------------------------------------------------

    def _find(self, queue: str, name: str) -> str | None:
        """The job of that name: a controller may have been killed after it submitted it."""
        filters = [{"name": "JOB_NAME", "values": [name]}]
        pages = self._batch.get_paginator("list_jobs").paginate(jobQueue=queue, filters=filters)
        return next((str(job["jobId"]) for page in pages for job in page["jobSummaryList"]), None)

    def _submit(self, requests: Requests) -> str:
        request = {**requests.submission, "jobDefinition": self._definition(requests)}
        return str(self._submitting.submit_job(**request)["jobId"])

    def _definition(self, requests: Requests) -> str:
        """The ARN of an active definition of the same content; a new revision where there is none."""
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

    def _watched(self, handle: Handle) -> WatchedGang:
        with self._lock:  # a gang that is being stopped is watched by two threads
            if (found := self._gangs.get(handle.gang)) is None:
                found = self._gangs[handle.gang] = WatchedGang(handle, self._copies(handle))
            return found

    def _update(self, gangs: Sequence[WatchedGang]) -> None:
        """Ask AWS for these gangs."""
        trouble, pause, described = "", self.config.poll, dict[str, Mapping[str, Any]]()
        ids = [name for each in gangs for name in each.ids]
        try:
            for start in range(0, len(ids), _DESCRIBED):
                for job in self._batch.describe_jobs(jobs=ids[start : start + _DESCRIBED])["jobs"]:
                    described[job["jobId"]] = job
        except FAILURES as error:
            trouble, pause = f"AWS Batch does not answer: {words_of(error)}", _UNREACHABLE
        for each in gangs:
            each.update(described, trouble, pause)

    def _copies(self, handle: Handle) -> GangLogs:
        """The copies of a gang's logs: of supervised nodes only where their volume is not the store that is here."""
        store, shared = handle.facts["store"], self.config.store_is_shared
        if shared is None:
            mounts = Path("/proc/self/mountinfo").read_text()
            shared = is_mounted_from(Path(store).resolve(), self.config.file_system, mounts)
        nodes = {
            index: CopiedLog(*log_of(handle, index), supervised)
            for index, supervised in enumerate(handle.facts["supervised"])
            if not (supervised and shared)
        }
        return GangLogs(self._logs, nodes, self.config.poll, self.config.quiet, handle.gang)

    def _max_vcpus(self) -> int:
        """The vCPUs of the queue's largest compute environment: a gang is in one of them. Raises NotYet."""
        try:
            found = self._batch.describe_job_queues(jobQueues=[self.config.job_queue])["jobQueues"]
            order = [each["computeEnvironment"] for each in found[0]["computeEnvironmentOrder"]] if found else []
            described = self._batch.describe_compute_environments(computeEnvironments=order) if order else {}
        except FAILURES as error:
            raise NotYet(f"AWS Batch does not tell its capacity: {words_of(error)}") from None
        environments = described.get("computeEnvironments", [])
        sizes = [int((each.get("computeResources") or {}).get("maxvCpus", 0)) for each in environments]
        return max([*sizes, 0]) or self.config.max_vcpus
