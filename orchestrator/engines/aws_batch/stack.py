"""The CloudFormation stack in which jobs run on AWS: creating, following, looking at and deleting it through boto3."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import boto3
import yaml
from botocore.exceptions import BotoCoreError, ClientError, NoCredentialsError, NoRegionError
from botocore.parsers import ResponseParserError
from pydantic import ValidationError

from orchestrator.domain.errors import ServerError
from orchestrator.engines.aws_batch.config import AwsConfig, config_path, problem_of, save_config
from shared_store.contract.error_text import nearest

_PLACES = (
    Path(__file__).parents[3] / "containers" / "aws" / "muster.yaml",
    Path(sys.prefix) / "share" / "muster" / "aws" / "muster.yaml",
)
_POLL = 2.0
_CANCELLED = ("cancelled", "The following resource(s) failed")
"""Reasons of events that follow from another one's failure."""


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
        with _said():
            self._session = boto3.Session(region_name=region, profile_name=profile)
            if self._session.get_credentials() is None:
                raise NoCredentialsError
            if not self._session.region_name:
                raise NoRegionError
            self.region = str(self._session.region_name)
            self._api = self._session.client("cloudformation")

    def describe(self) -> dict[str, Any] | None:
        """The stack as CloudFormation has it; None where there is none."""
        with _said():
            try:
                found: dict[str, Any] = self._api.describe_stacks(StackName=self.name)["Stacks"][0]
            except (ClientError, IndexError) as error:
                if isinstance(error, IndexError) or "does not exist" in str(error):
                    return None
                raise
        return None if found["StackStatus"] == "DELETE_COMPLETE" else found

    def parameters(self, template: str, given: Mapping[str, str], existing: bool) -> list[dict[str, Any]]:
        """Those of a request: the given ones, and as they were (or their defaults) all others."""
        known = _parameters(template)
        for key in given:
            if key not in known:
                hint = nearest(key, sorted(known))
                raise ServerError(f"--parameter {key}: the template has no such parameter; {hint}")
        request: list[dict[str, Any]] = [{"ParameterKey": key, "ParameterValue": value} for key, value in given.items()]
        if existing:
            before = {each["ParameterKey"] for each in (self.describe() or {}).get("Parameters", [])}
            request += [{"ParameterKey": key, "UsePreviousValue": True} for key in known if key in before - set(given)]
        return request

    def create(self, template: str, given: Mapping[str, str]) -> str | None:
        """Create the stack or bring it up to date; returns its id, None where nothing has to change."""
        found = self.describe()
        status = found["StackStatus"] if found else ""
        if status in ("ROLLBACK_COMPLETE", "ROLLBACK_FAILED", "CREATE_FAILED", "DELETE_FAILED"):
            raise ServerError(
                f"stack {self.name} is in {status} and can't be updated; remove it with `muster aws down`, then try again"
            )
        if found and status.endswith("_IN_PROGRESS"):
            return str(found["StackId"])  # somebody began already: follow that
        request = {
            "StackName": self.name,
            "TemplateBody": template,
            "Parameters": self.parameters(template, given, bool(found)),
            "Capabilities": ["CAPABILITY_IAM"],
            "Tags": [{"Key": "muster:stack", "Value": self.name}],
        }
        with _said():
            if not found:
                return str(self._api.create_stack(**request)["StackId"])
            try:
                return str(self._api.update_stack(**request)["StackId"])
            except ClientError as error:
                if "No updates are to be performed" in str(error):
                    return None
                raise

    def delete(self) -> str:
        """Ask for the end of the stack; returns its id."""
        found = self.describe()
        if found is None:
            raise ServerError(f"there is no stack {self.name} in {self.region}")
        with _said():
            self._api.delete_stack(StackName=found["StackId"])
        return str(found["StackId"])

    def follow(self, stack: str, since: float) -> Iterator[StackEvent]:
        """Events of the stack (an id) from ``since`` (Unix time [s]) on, until it rests."""
        seen: set[str] = set()
        while True:
            status = self._status(stack)
            for raw in self._events(stack):
                if raw["EventId"] not in seen and raw["Timestamp"].timestamp() >= since:
                    seen.add(raw["EventId"])
                    yield _event(raw)
            if not status.endswith("_IN_PROGRESS"):
                return
            time.sleep(_POLL)

    def outputs(self) -> dict[str, str]:
        """The stack's outputs by name. Raises ServerError where it is not there or not whole."""
        return _outputs(self._found())

    def _found(self) -> dict[str, Any]:
        """The stack as CloudFormation has it. Raises ServerError where there is none."""
        if (found := self.describe()) is None:
            raise ServerError(f"there is no stack {self.name} in {self.region}; create it with `muster aws up`")
        return found

    def status(self) -> dict[str, Any]:
        """The stack, its queue and compute environment with their own words, its jobs by state, and its image."""
        found = self._found()
        outputs = _outputs(found)
        told: dict[str, Any] = {"stack": self.name, "region": self.region, "status": found["StackStatus"]}
        told |= {"reason": found.get("StackStatusReason", ""), "outputs": outputs}
        if "JobQueueArn" not in outputs:
            return told
        with _said():
            batch = self._session.client("batch")
            queues = batch.describe_job_queues(jobQueues=[outputs["JobQueueArn"]])["jobQueues"]
            described = batch.describe_compute_environments(computeEnvironments=[outputs["ComputeEnvironmentArn"]])
            for key, each in (("queue", queues), ("computeEnvironment", described["computeEnvironments"])):
                wanted = ("state", "status", "statusReason")
                told[key] = {name: each[0][name] for name in wanted if each[0].get(name)} if each else {}
            told["jobs"] = self.jobs(outputs["JobQueueArn"])
            told["image"] = self._image(outputs["RepositoryUri"])
        return told

    def jobs(self, queue: str) -> dict[str, int]:
        """Numbers of the queue's jobs by state, of the states in which they use or wait for instances."""
        with _said():
            pages = self._session.client("batch").get_paginator("list_jobs")
            states = ("SUBMITTED", "PENDING", "RUNNABLE", "STARTING", "RUNNING")
            counts = {
                state: sum(len(page["jobSummaryList"]) for page in pages.paginate(jobQueue=queue, jobStatus=state))
                for state in states
            }
        return {state: count for state, count in counts.items() if count}

    def _image(self, repository: str) -> str | None:
        """When the image ``latest`` was pushed; None where it was not yet."""
        try:
            details = self._session.client("ecr").describe_images(
                repositoryName=repository.partition("/")[2], imageIds=[{"imageTag": "latest"}]
            )["imageDetails"]
        except ClientError:
            return None
        return str(details[0]["imagePushedAt"]) if details else None

    def _status(self, stack: str) -> str:
        with _said():
            try:
                return str(self._api.describe_stacks(StackName=stack)["Stacks"][0]["StackStatus"])
            except (ClientError, IndexError) as error:
                if isinstance(error, IndexError) or "does not exist" in str(error):
                    return "DELETE_COMPLETE"
                raise

    def _events(self, stack: str) -> list[dict[str, Any]]:
        """Oldest first."""
        with _said():
            try:
                pages = self._api.get_paginator("describe_stack_events").paginate(StackName=stack)
                return [event for page in pages for event in page["StackEvents"]][::-1]
            except ClientError as error:
                if "does not exist" in str(error):
                    return []
                raise


def _outputs(found: Mapping[str, Any]) -> dict[str, str]:
    return {each["OutputKey"]: each["OutputValue"] for each in found.get("Outputs") or []}


class _Loader(yaml.SafeLoader):
    """YAML with CloudFormation's own tags, whose values do not matter here."""


_Loader.add_multi_constructor("!", lambda _loader, _suffix, _node: None)


def _parameters(template: str) -> list[str]:
    """Names of a template's parameters. Raises ServerError."""
    try:
        return list(yaml.load(template, _Loader).get("Parameters") or {})
    except (yaml.YAMLError, AttributeError, TypeError) as error:
        raise ServerError(f"the template is no CloudFormation template: {error}") from None


def _event(raw: Mapping[str, Any]) -> StackEvent:
    return StackEvent(
        raw["Timestamp"].astimezone().strftime("%H:%M:%S"),
        raw["LogicalResourceId"],
        raw.get("ResourceType", ""),
        raw.get("ResourceStatus", ""),
        raw.get("ResourceStatusReason", ""),
    )


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
def _said() -> Iterator[None]:
    """Report a refusal of AWS or boto3 in one line."""
    try:
        yield
    except NoCredentialsError:
        raise ServerError("AWS: no credentials; run `aws configure`, or set AWS_PROFILE") from None
    except NoRegionError:
        raise ServerError("AWS: no region; give --region, or set AWS_DEFAULT_REGION") from None
    except ClientError as error:
        told = error.response.get("Error", {})
        raise ServerError(f"AWS ({error.operation_name}): {told.get('Message') or told.get('Code')}") from None
    except (BotoCoreError, ResponseParserError) as error:
        raise ServerError(f"AWS: {error}") from None
