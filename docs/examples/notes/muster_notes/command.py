"""``muster notes``."""

from typing import Annotated

import typer

from orchestrator.cli.terminal import echo
from orchestrator.client import Client, named
from orchestrator.domain.errors import UsageError


def register(app: typer.Typer) -> None:
    app.command(epilog="Example:  muster notes ant-1f2e3d4c 'walks sideways'")(notes)


def notes(
    run: Annotated[str | None, typer.Argument(help="The run of a new note.")] = None,
    text: Annotated[str | None, typer.Argument(help="The note.")] = None,
) -> None:
    """Print the notes on all runs or on one, or add one."""
    if text is not None and not text.strip():
        raise UsageError("TEXT: the note is empty; write some words, or leave it out to print the notes")
    with Client.connect() as client:
        if run and text:
            client.post(f"/api/notes/{named(run)}", {"text": text})
        for each in client.get("/api/notes"):
            if run in (None, each["run"]):
                echo(f"{each['run']}: {'; '.join(each['notes'])}")
