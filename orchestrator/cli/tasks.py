"""``muster tasks``: what can be trained, with what each task sees, does and is rewarded for."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
from typing import Annotated, Any

import typer
from rich.table import Table

from orchestrator.cli.jobs import JsonOption
from orchestrator.cli.terminal import Console, echo, echo_json
from orchestrator.errors import ServerError, SpecError


def register(app: typer.Typer) -> None:
    app.command(epilog="Example:  muster tasks     or, all about one:  muster tasks Ant")(tasks)


def tasks(
    name: Annotated[
        str | None, typer.Argument(help="A task, or module:Class: show its observations, actions and rewards by name.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the tasks that are installed here; of one, the names of its observations and actions.

    The weights of reward terms are changed in a job's YAML: train: {config: {rewards: {forward: 2.0}}}
    """
    if sys.stderr.isatty():
        echo("importing the simulation, some seconds …", err=True)
    found = _ask_worker([name] if name else [])
    if as_json:
        echo_json(found, indent=1)
        return
    console = Console()
    console.print(_table(found))
    if name:
        for kind in ("observations", "actions"):
            console.print(f"\n{kind.upper()}\n{', '.join(found[0][kind])}", highlight=False, markup=False)


def _ask_worker(names: list[str]) -> list[dict[str, Any]]:
    """Ask another process, since tasks import the simulation and this package never does.

    Raises:
        SpecError: There is no such task.
        ServerError: Tasks can't be looked at here.
    """
    if find_spec("newton") is None:
        raise ServerError("tasks can't be listed where no simulation is installed: pip install 'muster[worker]'")
    asked = subprocess.run(
        [sys.executable, "-P", "-m", "worker.tasks", *names], capture_output=True, text=True, check=False
    )
    said = asked.stderr.strip().splitlines() or [f"the listing ended with exit code {asked.returncode}"]
    if asked.returncode == 2:
        raise SpecError(said[-1])
    if asked.returncode:
        raise ServerError(f"tasks can't be listed: {said[-1]}")
    # what a module of the user's prints while it is imported comes before
    found: list[dict[str, Any]] = json.loads(asked.stdout.splitlines()[-1])
    return found


def _table(found: list[dict[str, Any]]) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in ("TASK", "OBSERVATIONS", "ACTIONS", "CONTROL", "EPISODE"):
        table.add_column(column, no_wrap=True)
    table.add_column("REWARDS", overflow="fold")
    for task in found:
        if "error" in task:
            table.add_row(task["name"], "-", "-", "-", "-", f"can't be imported: {task['error']}")
            continue
        table.add_row(
            task["name"],
            str(len(task["observations"])),
            str(len(task["actions"])),
            f"{task['control_hz']:g} Hz",
            f"{task['episode_seconds']:g} s",
            "  ".join(f"{term} {weight:g}" for term, weight in task["rewards"].items()),
        )
    return table
