"""``muster notes``."""

from typing import Annotated

import typer

from orchestrator.cli.command_options import JsonOption
from orchestrator.cli.listings import Resource
from orchestrator.client import Client, named
from orchestrator.domain.errors import UsageError

NOTES = Resource({"RUN": "run", "NOTES": lambda each: "; ".join(each["notes"])}, "no run has a note", "/api/notes")


def register(app: typer.Typer) -> None:
    app.command(epilog="Example:  muster notes ant-1f2e3d4c 'walks sideways'")(notes)


def notes(
    run: Annotated[str | None, typer.Argument(help="The run of a new note.")] = None,
    text: Annotated[str | None, typer.Argument(help="The note.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Print the notes on all runs or on one, or add one."""
    if text is not None and not text.strip():
        raise UsageError("TEXT: the note is empty; write some words, or leave it out to print the notes")
    with Client.connect() as client:
        if run and text:
            client.post(f"/api/notes/{named(run)}", {"text": text})
        found = client.get(NOTES.route)
    NOTES.show([each for each in found if run in (None, each["run"])], as_json)
