"""Plans as ``--dry-run`` prints them: the host of each node that a job would start."""

from __future__ import annotations

import shlex
from typing import Any

from rich.markup import escape
from rich.table import Table

from orchestrator.cli.terminal import echo, echo_json, print_rows
from orchestrator.client import Client


def show_plan(client: Client, definition: dict[str, Any], queue: str, as_json: bool) -> None:
    """Print what the controller's engine would start for a job definition, if all hosts were free."""
    plan = client.post("/api/plan", {"definition": definition, "queue": queue})
    if as_json:
        echo_json({**plan, "registerJobDefinition": definition}, indent=1)
        return
    table = Table(box=None, pad_edge=False)
    for column in ("NODE", "RANK", "HOST", "CPUS", "GPUS", "MEMORY", "ADDRESS", "IMAGE"):
        table.add_column(column, no_wrap=True)
    table.add_column("COMMAND", overflow="fold")
    for node in plan["nodes"]:
        image = node["image"] if plan["images"] else "-"
        table.add_row(
            *(str(node["index"]), str(node["rank"]), node["host"], f"{node['cpus']:g}", ",".join(node["gpus"]) or "-"),
            *(f"{node['memory']} MiB", node["address"] or "-", image, escape(shlex.join(node["command"]))),
        )
    echo(f"{definition['jobDefinitionName']} on the {plan['engine']} engine, queue {queue}; nothing was started")
    print_rows(table)  # to be read once, and in full: a narrow terminal breaks the lines
    if plan["document"]:
        echo(f"\n{plan['document']}")
