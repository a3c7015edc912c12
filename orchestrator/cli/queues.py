"""``muster queues``: the queues, their waiting jobs and their resources in use."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from orchestrator.cli.jobs import JsonOption
from orchestrator.cli.terminal import echo, echo_json, one_line, print_wrapped
from orchestrator.client import Client
from orchestrator.domain.errors import ApiError
from orchestrator.domain.reasons import short_id, title


def register(app: typer.Typer) -> None:
    app.command(
        epilog="Example:  muster queues     or, one queue's next jobs and why they wait:  muster queues default"
    )(queues)


def queues(
    name: Annotated[str | None, typer.Argument(help="A queue, to show its next jobs and why they wait.")] = None,
    as_json: JsonOption = False,
) -> None:
    """List job queues, or one queue's waiting jobs in the order in which they will start.

    Create queues with AWS's own commands: aws batch create-job-queue --endpoint-url …
    """
    with Client.connect() as client:
        found = client.batch("DescribeJobQueues", **({"jobQueues": [name]} if name else {}))["jobQueues"]
        if name and not found:
            client.batch("GetJobQueueSnapshot", jobQueue=name)  # refuse an unknown name with the existing ones
        found = [queue for queue in found if _take_snapshot(client, queue, is_named=name is not None)]
        front = client.get("/api/queues", queue=name)["queues"][0]["front"] if name else []
    if as_json:
        echo_json(found, indent=1)
        return
    print_wrapped(_table(found))
    if front:
        print_wrapped(_waiting(front))
    elif name:
        echo("no job waits")


def _take_snapshot(client: Client, queue: dict[str, Any], is_named: bool) -> bool:
    """Add the queue's snapshot to it; False for a queue in a list of all whose jobs the key may not see."""
    try:
        queue["snapshot"] = client.batch("GetJobQueueSnapshot", jobQueue=queue["jobQueueName"])
    except ApiError as error:
        if error.status != 403 or is_named:
            raise
    return "snapshot" in queue


def _table(queues: list[dict[str, Any]]) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in ("QUEUE", "STATE", "PRIORITY", "ORDER", "WAITING", "IN USE"):
        table.add_column(column, no_wrap=True)
    for queue in queues:
        snapshot = queue["snapshot"]
        waiting = len(snapshot["frontOfQueue"]["jobs"])
        used = snapshot["queueUtilization"]["totalCapacityUsage"]
        table.add_row(
            queue["jobQueueName"],
            queue["state"] if queue["status"] == "VALID" else queue["status"],
            str(queue["priority"]),
            "fair share" if "schedulingPolicyArn" in queue else "first in, first out",
            f"{waiting}{'+' if waiting == 100 else ''}",
            ", ".join(f"{each['quantity']:g} {each['capacityUnit']}" for each in used if each["quantity"]) or "-",
        )
    return table


def _waiting(jobs: list[dict[str, Any]]) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in ("NEXT", "JOB", "NAME"):
        table.add_column(column, no_wrap=True)
    table.add_column("WHY IT WAITS", overflow="fold")
    for number, job in enumerate(jobs, 1):
        table.add_row(
            str(number), short_id(job["id"]), title(job["name"], job["id"]), escape(one_line(job["reason"] or ""))
        )
    return table
