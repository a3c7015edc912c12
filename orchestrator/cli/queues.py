"""``muster queues``: the queues, their waiting jobs and their resources in use."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from orchestrator.cli.command_options import JsonOption
from orchestrator.cli.listings import Resource
from orchestrator.cli.misuse import CommandGroup, make_group
from orchestrator.cli.submitting import engine_queue
from orchestrator.cli.terminal import echo, echo_json, one_line
from orchestrator.client import Client
from orchestrator.domain.errors import ApiError, UsageError
from orchestrator.domain.reasons import short_id, title


def _waiting(queue: dict[str, Any]) -> str:
    count = len(queue["snapshot"]["frontOfQueue"]["jobs"])
    return f"{count}{'+' if count == 100 else ''}"


def _in_use(queue: dict[str, Any]) -> str:
    used = queue["snapshot"]["queueUtilization"]["totalCapacityUsage"]
    return ", ".join(f"{each['quantity']:g} {each['capacityUnit']}" for each in used if each["quantity"])


QUEUES = Resource(
    {
        "QUEUE": "jobQueueName",
        "STATE": lambda queue: queue["state"] if queue["status"] == "VALID" else queue["status"],
        "PRIORITY": "priority",
        "ORDER": lambda queue: "fair share" if "schedulingPolicyArn" in queue else "first in, first out",
        "WAITING": _waiting,
        "IN USE": _in_use,
    },
    "no queue; muster queues create NAME",
    folded=("IN USE",),
)
_FRONT = Resource(
    {
        "NEXT": "next",
        "JOB": lambda job: short_id(job["id"]),
        "NAME": lambda job: title(job["name"], job["id"]),
        "WHY IT WAITS": lambda job: one_line(job["reason"] or ""),
    },
    "no job waits",
    folded=("WHY IT WAITS",),
)


class _QueueGroup(CommandGroup):
    otherwise = "show"


def register(app: typer.Typer) -> None:
    group = make_group(
        "List and create job queues, or show which of a queue's jobs start next.\n\nAWS's own commands change and delete queues: aws batch "
        "update-job-queue --endpoint-url …",
        "Example:  muster queues     or, one queue's next jobs and why they wait:  muster queues default",
        list_queues,
        _QueueGroup,
    )
    group.command("list", epilog="Example:  muster queues list --json | jq '.[].priority'")(list_queues)
    group.command(epilog="Example:  muster queues show default     or shorter:  muster queues default")(show)
    group.command(epilog="Example:  muster queues create urgent --priority 10")(create)
    app.add_typer(group, name="queues")


def list_queues(as_json: JsonOption = False) -> None:
    """List the job queues, with their waiting jobs and the resources in use."""
    with Client.connect() as client:
        found = client.batch("DescribeJobQueues")["jobQueues"]
        QUEUES.show([queue for queue in found if _take_snapshot(client, queue, is_named=False)], as_json)


def show(
    name: Annotated[str, typer.Argument(metavar="QUEUE", help="A queue.")],
    as_json: JsonOption = False,
) -> None:
    """Show a queue's waiting jobs in the order in which they will start, and why each waits."""
    with Client.connect() as client:
        queue = _described(client, name)
        _take_snapshot(client, queue, is_named=True)
        front = client.get("/api/queues", queue=name)["queues"][0]["front"]
    QUEUES.show([queue], as_json)
    if not as_json:
        _FRONT.show([{**job, "next": number} for number, job in enumerate(front, 1)])


def create(
    name: Annotated[str, typer.Argument(help="Name of the queue.")],
    priority: Annotated[
        int, typer.Option(min=0, max=1_000_000, help="Jobs of a queue with a higher priority start first.")
    ] = 1,
    like: Annotated[
        str | None,
        typer.Option(metavar="QUEUE", help="Use the compute environments of this queue."),
    ] = None,
    engine: Annotated[
        str | None, typer.Option(metavar="ENGINE", help="Use the compute environments of this engine's queue.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Create a job queue, by default with the compute environments of the queue default."""
    if like and engine:
        raise UsageError("--like and --engine: an engine means its queue; leave one of them out")
    with Client.connect() as client:
        source = like or (engine_queue(client, engine) if engine else "default")
        try:
            order = _described(client, source)["computeEnvironmentOrder"]
            made = client.batch("CreateJobQueue", jobQueueName=name, priority=priority, computeEnvironmentOrder=order)
        except ApiError as error:
            raise ApiError(str(error).replace("jobQueueName", "NAME"), error.status) from None
    if as_json:
        echo_json(made)
    else:
        echo(f"created queue {name} with priority {priority}; use it with: muster submit SPEC --queue {name}")


def _described(client: Client, name: str) -> dict[str, Any]:
    """The description of a queue. Raises ApiError with the existing ones where there is none of this name."""
    found = client.batch("DescribeJobQueues", jobQueues=[name])["jobQueues"]
    if not found:
        client.batch("GetJobQueueSnapshot", jobQueue=name)  # refuses an unknown name
    return dict(found[0])


def _take_snapshot(client: Client, queue: dict[str, Any], is_named: bool) -> bool:
    """Add the queue's snapshot to it; False for a queue in a list of all whose jobs the key may not see."""
    try:
        queue["snapshot"] = client.batch("GetJobQueueSnapshot", jobQueue=queue["jobQueueName"])
    except ApiError as error:
        if error.status != 403 or is_named:
            raise
    return "snapshot" in queue
