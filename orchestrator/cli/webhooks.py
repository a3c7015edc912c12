"""``muster webhooks``: messages to other programs when jobs end."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from orchestrator.cli.jobs import JsonOption
from orchestrator.cli.misuse import make_group
from orchestrator.cli.terminal import echo, echo_json, print_cut
from orchestrator.client import Client, named
from shared_store.contract.error_text import counted


def register(app: typer.Typer) -> None:
    group = make_group(
        "List and test the controller's webhooks, which report the end of jobs.\n\nConfigure them with `muster serve --webhooks FILE`, a JSON "
        'object by name: {"chat": {"url": "https://chat.example/hooks/muster", "secret": "whsec_…", "statuses": ["FAILED"]}}. The database keeps them, '
        "sealed, for later starts; another file replaces them.",
        "Examples:  muster webhooks test chat   then   muster webhooks list",
    )
    group.command("list", epilog="Example:  muster webhooks list --json | jq '.[].failed'")(list_webhooks)
    group.command(epilog="Example:  muster webhooks test chat")(test)
    app.add_typer(group, name="webhooks")


def list_webhooks(as_json: JsonOption = False) -> None:
    """List the webhooks, with their waiting messages and those given up."""
    with Client.connect() as client:
        found = client.get("/api/webhooks")
    if as_json:
        echo_json(found, indent=1)
        return
    if not found:
        echo("no webhooks; name them in a file and start the controller with: muster serve --webhooks FILE")
        return
    table = Table(box=None, pad_edge=False)
    for column in ("NAME", "RECEIVER", "STATUSES", "QUEUES", "KINDS", "WAITING", "GIVEN UP", "PROBLEM"):
        table.add_column(column, no_wrap=True)
    for each in found:
        limits = [" ".join(each[key] or ["all"]) for key in ("statuses", "queues", "kinds")]
        counts = str(each["waiting"]), str(len(each["failed"]))
        table.add_row(each["name"], each["receiver"], *limits, *counts, each["problem"] or "")
    print_cut(table)
    for each in found:
        for message in each["failed"]:
            echo(
                f"given up: {each['name']}, job {message['job']}, {counted(message['tries'], 'try', 'tries')}: {message['problem']}"
            )


def test(
    name: Annotated[str, typer.Argument(help="Of the webhook.")],
    as_json: JsonOption = False,
) -> None:
    """Send a sample once; exit 1 if the receiver does not accept it.

    It is signed like any message, but `muster webhooks list` does not count it.
    """
    with Client.connect() as client:
        sent = client.post(f"/api/webhooks/{named(name)}/test", {}, seconds=60)
    if as_json:
        echo_json(sent)
    else:
        echo(f"{name}: {sent['receiver']} {sent['problem'] or 'accepted the sample'} (webhook-id {sent['id']})")
        echo("this sample belongs to no job; muster webhooks list does not count it")
    if sent["problem"]:
        raise typer.Exit(1)
