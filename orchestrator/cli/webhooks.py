"""``muster webhooks``: messages to other programs when jobs end."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

import typer

from orchestrator.cli.command_options import JsonOption
from orchestrator.cli.listings import Resource
from orchestrator.cli.misuse import make_group
from orchestrator.cli.terminal import echo, echo_json
from orchestrator.client import Client, named
from shared_store.contract.error_text import counted


def _limits(key: str, webhook: dict[str, Any]) -> str:
    return " ".join(webhook[key] or ["all"])


WEBHOOKS = Resource(
    {
        "NAME": "name",
        "RECEIVER": "receiver",
        **{key.upper(): partial(_limits, key) for key in ("statuses", "queues", "kinds")},
        "WAITING": "waiting",
        "GIVEN UP": lambda hook: len(hook["failed"]),
        "PROBLEM": "problem",
    },
    "no webhooks; name them in a file and start the controller with: muster serve --webhooks FILE",
    "/api/webhooks",
)


def register(app: typer.Typer) -> None:
    group = make_group(
        "List and test the webhooks that report the end of jobs.\n\nConfigure them with `muster serve --webhooks FILE`, a JSON "
        'object by name: {"chat": {"url": "https://chat.example/hooks/muster", "secret": "whsec_…", "statuses": ["FAILED"]}}. The database keeps them, '
        "sealed, for later starts; another file replaces them.",
        "Examples:  muster webhooks test chat   then   muster webhooks",
        list_webhooks,
    )
    group.command("list", epilog="Example:  muster webhooks list --json | jq '.[].failed'")(list_webhooks)
    group.command(epilog="Example:  muster webhooks test chat")(test)
    app.add_typer(group, name="webhooks")


def list_webhooks(as_json: JsonOption = False) -> None:
    """List the webhooks, with their waiting messages and those given up."""
    with Client.connect() as client:
        found = client.get("/api/webhooks")
    WEBHOOKS.show(found, as_json)
    for each in [] if as_json else found:
        for message in each["failed"]:
            tries = counted(message["tries"], "try", "tries")
            echo(f"given up: {each['name']}, job {message['job']}, {tries}: {message['problem']}")


def test(
    name: Annotated[str, typer.Argument(help="Name of the webhook.")],
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
