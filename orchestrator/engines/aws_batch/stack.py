"""The CloudFormation stack in which jobs run on AWS: creating, following, looking at and deleting it through boto3."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from botocore.exceptions import ClientError
from pydantic import ValidationError

from orchestrator.domain.errors import ServerError
from orchestrator.engines.aws_batch.config import AwsConfig, config_path, problem_of, save_config
from orchestrator.engines.aws_batch.errors import FAILURES, session_for, words_of
from shared_store.contract.error_text import nearest

_PLACES = (
    Path(__file__).parents[3] / "containers" / "aws" / "muster.yaml",
    Path(sys.prefix) / "share" / "muster" / "aws" / "muster.yaml",
)
_POLL = 2.0
_CANCELLED = ("cancelled", "The following resource(s) failed")
"""Reasons of events that follow from another one's failure."""

T = TypeVar("T")


@dataclass(frozen=True)
class StackEvent:
    """One thing that happened to a resource of the stack."""

    time: str
    resource: str
    kind: str
    status: str
    reason: str

    @property
    def is_failure(self) -> bool:
        return self.status.endswith("_FAILED") and not any(each in self.reason for each in _CANCELLED)


class Stack:
    """A stack by its name. Every method raises ServerError, in one line, where AWS refuses or can't be reached."""

    def __init__(self, name: str, region: str | None, profile: str | None = None) -> None:
        self.name, self.profile = name, profile
        with _reported():
            self._session = session_for(region, profile)
            self.region = str(self._session.region_name)
            self._api = self._session.client("cloudformation")

    def describe(self, stack: str | None = None) -> dict[str, Any] | None:
        """The stack, or that of an id, as CloudFormation has it; None where there is none."""
        with _reported():
            found = _existing(lambda: self._api.describe_stacks(StackName=stack or self.name)["Stacks"])
        return found[0] if found and found[0]["StackStatus"] != "DELETE_COMPLETE" else None

    def parameters(self, template: str, chosen: Mapping[str, str], existing: bool) -> list[dict[str, Any]]:
        """Those of a request: the chosen ones, and as they were (or their defaults) all others."""
        with _reported():
            summary = self._api.get_template_summary(TemplateBody=template)
        known = [each["ParameterKey"] for each in summary.get("Parameters", [])]
        for key in chosen:
            if key not in known:
                hint = nearest(key, sorted(known))
                raise ServerError(f"--parameter {key}: the template has no such parameter; {hint}")
        request: list[dict[str, Any]] = [{"ParameterKey": key, "ParameterValue": chosen[key]} for key in chosen]
        if existing:
            before = {each["ParameterKey"] for each in (self.describe() or {}).get("Parameters", [])} - set(chosen)
            request += [{"ParameterKey": key, "UsePreviousValue": True} for key in known if key in before]
        return request

    def create(self, template: str, chosen: Mapping[str, str]) -> str | None:
        """Create the stack or bring it up to date; returns its id, None where nothing has to change."""
        found = self.describe()
        status = found["StackStatus"] if found else ""
        if status in ("ROLLBACK_COMPLETE", "ROLLBACK_FAILED", "CREATE_FAILED", "DELETE_FAILED"):
            raise ServerError(
                f"stack {self.name} is in {status} and can't be updated; remove it with `muster aws down`, then try again"
            )
        if found and status.endswith("_IN_PROGRESS"):
            return str(found["StackId"])  # another caller began already: follow that
        request = {
            "StackName": self.name,
            "TemplateBody": template,
            "Parameters": self.parameters(template, chosen, bool(found)),
            "Capabilities": ["CAPABILITY_IAM"],
            "Tags": [{"Key": "muster:stack", "Value": self.name}],
        }
        with _reported():
            try:
                return str((self._api.update_stack if found else self._api.create_stack)(**request)["StackId"])
            except ClientError as error:
                if "No updates are to be performed" in str(error):
                    return None
                raise

    def delete(self) -> str:
        """Ask for the end of the stack; returns its id."""
        found = self.describe()
        if found is None:
            raise ServerError(f"there is no stack {self.name} in {self.region}")
        with _reported():
            self._api.delete_stack(StackName=found["StackId"])
        return str(found["StackId"])

    def follow(self, stack: str, since: float) -> Iterator[StackEvent]:
        """Events of the stack (an id) from ``since`` (Unix time [s]) on, until it rests."""
        seen: set[str] = set()
        pages = self._api.get_paginator("describe_stack_events")
        while True:
            found = self.describe(stack)
            with _reported():
                events = _existing(lambda: list(pages.paginate(StackName=stack).search("StackEvents[]"))) or []
            for raw in reversed(events):  # the newest comes first
                if raw["EventId"] not in seen and raw["Timestamp"].timestamp() >= since:
                    seen.add(raw["EventId"])
                    yield StackEvent(
                        raw["Timestamp"].astimezone().strftime("%H:%M:%S"),
                        raw["LogicalResourceId"],
                        raw.get("ResourceType", ""),
                        raw.get("ResourceStatus", ""),
                        raw.get("ResourceStatusReason", ""),
                    )
            if found is None or not found["StackStatus"].endswith("_IN_PROGRESS"):
                return
            time.sleep(_POLL)

    def outputs(self) -> dict[str, str]:
        """The stack's outputs by name. Raises ServerError where it does not exist."""
        return {each["OutputKey"]: each["OutputValue"] for each in self._found().get("Outputs") or []}

    def _found(self) -> dict[str, Any]:
        """The stack as CloudFormation has it. Raises ServerError where there is none."""
        if (found := self.describe()) is None:
            raise ServerError(f"there is no stack {self.name} in {self.region}; create it with `muster aws up`")
        return found

    def status(self) -> dict[str, Any]:
        """The stack, its queue and compute environment with their own words, its jobs by state, and its image."""
        found, outputs = self._found(), self.outputs()
        status: dict[str, Any] = {"stack": self.name, "region": self.region, "status": found["StackStatus"]}
        status |= {"reason": found.get("StackStatusReason", ""), "outputs": outputs}
        if "JobQueueArn" not in outputs:
            return status
        with _reported():
            batch = self._session.client("batch")
            queues = batch.describe_job_queues(jobQueues=[outputs["JobQueueArn"]])["jobQueues"]
            described = batch.describe_compute_environments(computeEnvironments=[outputs["ComputeEnvironmentArn"]])
            for key, each in (("queue", queues), ("computeEnvironment", described["computeEnvironments"])):
                names = ("state", "status", "statusReason")
                status[key] = {name: each[0][name] for name in names if each[0].get(name)} if each else {}
            return status | {"jobs": self.jobs(outputs["JobQueueArn"]), "image": self._image(outputs["RepositoryUri"])}

    def jobs(self, queue: str) -> dict[str, int]:
        """Numbers of the queue's jobs by state, of the states in which they use or wait for instances."""
        counts = {}
        with _reported():
            pages = self._session.client("batch").get_paginator("list_jobs")
            for state in ("SUBMITTED", "PENDING", "RUNNABLE", "STARTING", "RUNNING"):
                jobs = pages.paginate(jobQueue=queue, jobStatus=state).search("jobSummaryList[]")
                if count := sum(1 for _ in jobs):
                    counts[state] = count
        return counts

    def _image(self, repository: str) -> str | None:
        """When the image ``latest`` was pushed; None where it was not yet."""
        try:
            details = self._session.client("ecr").describe_images(
                repositoryName=repository.partition("/")[2], imageIds=[{"imageTag": "latest"}]
            )["imageDetails"]
        except ClientError:
            return None
        return str(details[0]["imagePushedAt"]) if details else None


def _existing(call: Callable[[], T]) -> T | None:
    """The result of a call of CloudFormation; None where the stack does not exist."""
    try:
        return call()
    except ClientError as error:
        if "does not exist" in str(error):
            return None
        raise


def first_failure(events: Sequence[StackEvent]) -> str:
    """The first resource that failed, and why; empty where none did."""
    failed = next((event for event in events if event.is_failure), None)
    return f"{failed.resource} ({failed.kind}): {failed.reason or failed.status}" if failed else ""


def template_text(path: Path | None = None) -> str:
    """The template. Raises ServerError where it can't be found or read."""
    for place in [path] if path else _PLACES:
        try:
            return place.read_text()
        except FileNotFoundError:
            continue
        except OSError as error:
            raise ServerError(f"template {place}: {error.strerror}") from None
    raise ServerError(f"template {path or _PLACES[0]} is missing; give one with --template")


def write_config(home: Path, stack: Stack, endpoint_url: str | None) -> Path:
    """``aws.json`` of the stack's outputs; what a person has added to it stays."""
    outputs = stack.outputs()
    if "JobQueue" not in outputs:
        raise ServerError(f"stack {stack.name} is not whole: it has no outputs; see `muster aws status`")
    kept: dict[str, Any] = {}
    try:
        before = json.loads(config_path(home).read_text())
        kept = {
            key: before[key] for key in ("poll", "quiet", "instance_type", "share", "store_is_shared") if key in before
        }
    except (OSError, ValueError, TypeError):
        pass
    try:
        config = AwsConfig(
            region=stack.region,
            job_queue=outputs["JobQueue"],
            image=f"{outputs['RepositoryUri']}:latest",
            log_group=outputs["LogGroupName"],
            file_system=outputs["FileSystemId"],
            access_point=outputs["AccessPointId"],
            job_role=outputs["JobRoleArn"],
            efa=outputs.get("UseEfa") == "true",
            max_vcpus=int(float(outputs["MaxvCpus"])),
            endpoint_url=endpoint_url,
            stack=stack.name,
            profile=stack.profile,
            **kept,
        )
        return save_config(home, config)
    except ValidationError as error:  # in what a person has added
        raise ServerError(f"{config_path(home)}: {problem_of(error)}") from None
    except OSError as error:
        raise ServerError(f"{config_path(home)}: {error.strerror}") from None


@contextmanager
def _reported() -> Iterator[None]:
    """Report a refusal of AWS or boto3 in one line."""
    try:
        yield
    except FAILURES as error:
        operation = f" ({error.operation_name})" if isinstance(error, ClientError) else ""
        raise ServerError(f"AWS{operation}: {words_of(error)}") from None
