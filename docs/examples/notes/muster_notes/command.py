"""``muster notes``."""

from typing import Annotated

import typer

from orchestrator.cli.terminal import echo
from orchestrator.client import Client, named


def register(app: typer.Typer) -> None:
    app.command(epilog="Example:  muster notes ant-1f2e3d4c 'walks sideways'")(notes)


def notes(
    run: Annotated[str | None, typer.Argument(help="The run of a new note.")] = None,
    text: Annotated[str | None, typer.Argument(help="The note.")] = None,
) -> None:
    """Print the notes on runs, or add one."""
    with Client.connect() as client:
        if run and text:
            client.post(f"/api/notes/{named(run)}", {"text": text})
        for each in client.get("/api/notes"):
            echo(f"{each['run']}: {'; '.join(each['notes'])}")
