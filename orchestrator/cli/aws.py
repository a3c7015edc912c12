"""``muster aws``: the CloudFormation stack for jobs on AWS."""

from __future__ import annotations

import os
import time
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated

import typer

from orchestrator.cli.command_options import JsonOption, YesOption
from orchestrator.cli.listings import Resource
from orchestrator.cli.misuse import make_group
from orchestrator.cli.terminal import echo, echo_json
from orchestrator.domain.errors import ServerError
from orchestrator.engines.aws_batch.config import config_path
from orchestrator.home import muster_home
from shared_store.contract.error_text import counted

if TYPE_CHECKING:
    from orchestrator.engines.aws_batch.stack import Stack, StackEvent

_STATUS = Resource({"": lambda row: row[0], " ": lambda row: row[1]}, whole=True)
NameOption = Annotated[str, typer.Option("--stack-name", metavar="NAME", help="Name of the CloudFormation stack.")]
RegionOption = Annotated[
    str | None, typer.Option(metavar="REGION", help="AWS region; by default that of your AWS configuration.")
]
ProfileOption = Annotated[str | None, typer.Option(metavar="PROFILE", help="Profile of your AWS configuration.")]


def register(app: typer.Typer) -> None:
    group = make_group(
        "Manage the CloudFormation stack for jobs on AWS.\n\nIt has the network, the volume, the images and AWS Batch.",
        "Examples:  muster aws up --region eu-west-1   then   muster serve --engine aws-batch",
    )
    group.command(epilog="Example:  muster aws up --region eu-west-1 --parameter InstanceTypes=g6.4xlarge")(up)
    group.command(epilog="Example:  muster aws down")(down)
    group.command(epilog="Example:  muster aws status --json | jq .jobs")(status)
    app.add_typer(group, name="aws")


def up(
    stack_name: NameOption = "muster",
    region: RegionOption = None,
    profile: ProfileOption = None,
    parameter: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="A parameter of the template; repeatable. Others keep their values."),
    ] = None,
    template: Annotated[Path | None, typer.Option(help="A template to use instead of Muster's own.")] = None,
    yes: YesOption = False,
    as_json: JsonOption = False,
) -> None:
    """Create or update the stack, and write $MUSTER_HOME/aws.json for the aws-batch engine."""
    parameters = dict(_pair(each) for each in parameter or [])
    from_template, stack = _stack_module(), _stack(stack_name, region, profile)
    text = from_template.template_text(template)
    stack.parameters(text, parameters, existing=False)  # refuse mistakes before the first question
    if not yes:
        verb = "update" if stack.describe() else "create"
        typer.confirm(
            f"{verb} stack {stack_name} in {stack.region}? It costs money from now on (a NAT gateway by the hour, the volume "
            "by what lies on it; instances only while jobs run)",
            abort=True,
            err=as_json,
        )
    began = time.time() - 1
    made = stack.create(text, parameters)
    if made is None:
        echo(f"stack {stack_name} is up to date", err=as_json)
    else:
        events = _follow(stack, made, began, as_json)
        found = stack.describe()
        state = found["StackStatus"] if found else "DELETE_COMPLETE"
        if state not in ("CREATE_COMPLETE", "UPDATE_COMPLETE"):
            why = from_template.first_failure(events) or (found or {}).get("StackStatusReason", "")
            raise ServerError(f"stack {stack_name} is in {state}: {why}; remove what is left with `muster aws down`")
    path = from_template.write_config(muster_home(), stack, os.environ.get("AWS_ENDPOINT_URL"))
    outputs = stack.outputs()
    if as_json:
        echo_json({"stack": stack_name, "region": stack.region, "config": str(path), "outputs": outputs}, indent=1)
        return
    repository = outputs["RepositoryUri"]
    echo(f"""wrote {path}

push the image, then run jobs:
  aws ecr get-login-password --region {stack.region} | docker login --username AWS --password-stdin {repository.partition("/")[0]}
  docker build -f containers/Dockerfile -t {repository}:latest --build-arg EXTRAS=worker . && docker push {repository}:latest
  muster serve --engine aws-batch""")
    if url := outputs.get("WorkstationUrl"):
        echo(f"  the workstation's desktop, ready in some 15 minutes: {url}")


def down(
    stack_name: NameOption = "muster",
    region: RegionOption = None,
    profile: ProfileOption = None,
    yes: YesOption = False,
    as_json: JsonOption = False,
) -> None:
    """Delete the stack: network, queue, images, logs, workstation. The volume with all runs is kept."""
    from_template, stack = _stack_module(), _stack(stack_name, region, profile)
    outputs = stack.outputs()
    volume = outputs.get("FileSystemId")
    stays = f"file system {volume}, with all runs and checkpoints, stays" if volume else "it has no volume yet"
    if not yes:
        jobs = stack.jobs(outputs["JobQueueArn"]) if "JobQueueArn" in outputs else {}
        ended = (
            f"{counted(sum(jobs.values()), 'job')} in it {'is' if sum(jobs.values()) == 1 else 'are'} ended; "
            if jobs
            else ""
        )
        question = f"delete stack {stack_name} in {stack.region}? {ended}images and logs go; {stays}"
        typer.confirm(question, abort=True, err=as_json)
    began = time.time() - 1
    events = _follow(stack, stack.delete(), began, as_json)
    if stack.describe() is not None:
        raise ServerError(f"stack {stack_name} could not be deleted: {from_template.first_failure(events)}")
    config = config_path(muster_home())
    if config.exists() and f'"stack": "{stack_name}"' in config.read_text():
        config.unlink()
    if as_json:
        echo_json({"stack": stack_name, "region": stack.region, "fileSystem": volume})
        return
    echo(f"stack {stack_name} is deleted; {stays}")
    if volume:
        echo(f"to delete that, too:  aws efs delete-file-system --region {stack.region} --file-system-id {volume}")


def status(
    stack_name: NameOption = "muster",
    region: RegionOption = None,
    profile: ProfileOption = None,
    write: Annotated[
        bool, typer.Option("--write", help="Write $MUSTER_HOME/aws.json, on a machine that did not create the stack.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Show the stack: its status, queue, compute environment, jobs and image."""
    stack = _stack(stack_name, region, profile)
    found = stack.status()
    if write:
        path = _stack_module().write_config(muster_home(), stack, os.environ.get("AWS_ENDPOINT_URL"))
        echo(f"wrote {path}", err=as_json)
    if as_json:
        echo_json(found, indent=1)
        return
    rows = {"stack": f"{stack_name} in {found['region']}: {found['status']} {found['reason']}".strip()}
    for key, label in (("computeEnvironment", "compute environment"), ("queue", "queue")):
        words = found.get(key) or {}
        states = f"{words.get('state', '')} {words.get('status', '')} {words.get('statusReason', '')}".strip()
        rows[label] = states or "missing"
    rows["jobs"] = ", ".join(f"{count} {state}" for state, count in (found.get("jobs") or {}).items()) or "none"
    image = found.get("image")
    rows["image"] = f"pushed {image}" if image else "not pushed yet: see containers/aws/README.md"
    rows |= {name: str(value) for name, value in found["outputs"].items()}
    _STATUS.show([*rows.items()])


def _follow(stack: Stack, made: str, began: float, err: bool) -> list[StackEvent]:
    """Print the stack's events until it is stable, with ``err`` on standard error."""
    events = []
    for event in stack.follow(made, began):
        events.append(event)
        reason = f"  {event.reason}" if event.reason and event.is_failure else ""
        echo(f"{event.time}  {event.status:<22} {event.resource}{reason}", err)
    return events


def _pair(text: str) -> tuple[str, str]:
    key, sign, value = text.partition("=")
    if not sign or not key:
        raise typer.BadParameter(f"--parameter {text}: expected NAME=VALUE, such as MaxvCpus=96")
    return key, value


def _stack_module() -> ModuleType:
    """Import the module that needs boto3. Raises ServerError if it is not installed."""
    try:
        from orchestrator.engines.aws_batch import stack as aws_stack
    except ModuleNotFoundError as error:
        raise ServerError("muster aws is not installed: pip install 'muster[aws]'") from error
    return aws_stack


def _stack(name: str, region: str | None, profile: str | None) -> Stack:
    found: Stack = _stack_module().Stack(name, region, profile)
    return found
