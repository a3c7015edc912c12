"""``muster tasks``: the tasks, with their observations, actions and rewards."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Annotated, Any

import typer
from rich.table import Table

from orchestrator.cli.jobs import JsonOption
from orchestrator.cli.terminal import Console, echo, echo_json, print_wrapped
from orchestrator.domain.errors import ServerError, SpecError


def register(app: typer.Typer) -> None:
    app.command(epilog="Example:  muster tasks     or, all about one:  muster tasks Ant")(tasks)


def tasks(
    name: Annotated[
        str | None, typer.Argument(help="A task, or module:Class, whose terms and numbers to show.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the installed tasks, or all terms and numbers of one task.

    Change the weights of reward terms in a job's YAML: train: {config: {rewards: {forward: 2.0}}}
    """
    if sys.stderr.isatty():
        echo("importing the simulation, which takes some seconds …", err=True)
    found = ask_worker("worker.tasks", [name] if name else [], "tasks can't be listed")
    if as_json:
        echo_json(found, indent=1)
        return
    print_wrapped(_table(found))
    if not name:
        return
    console = Console(highlight=False, soft_wrap=not sys.stdout.isatty())
    for kind in ("observations", "actions"):
        console.print(f"\n{kind.upper()}\n{', '.join(found[0][kind])}", markup=False)
    if robots := found[0]["robots"]:
        console.print("\nROBOTS\n" + "\n".join(robots), markup=False)
    for section, rows in found[0].get("tables", {}).items():
        echo("")
        print_wrapped(_terms(section, rows))
    if numbers := found[0].get("numbers"):
        console.print("\nNUMBERS of train.config.numbers and train.config.curriculum", markup=False)
        print_wrapped(_numbers(numbers))


def ask_worker(module: str, arguments: Sequence[str], failure: str) -> Any:
    """Ask a subprocess, since modules of the worker import the simulation and this package never does.

    Args:
        module: Run with ``python -m``; it prints JSON in its last line.
        arguments: Of the module.
        failure: What can't be done if it does not answer, for the error.

    Raises:
        SpecError: The module refuses the arguments.
        ServerError: It can't answer here.
    """
    if find_spec("newton") is None:
        raise ServerError(f"{failure} where no simulation is installed: pip install 'muster[worker]'")
    asked = subprocess.run(
        [sys.executable, "-P", "-m", module, *arguments], capture_output=True, text=True, check=False
    )
    lines = asked.stderr.strip().splitlines() or [f"it ended with exit code {asked.returncode}"]
    if asked.returncode == 2:
        raise SpecError(lines[-1])
    if asked.returncode:
        raise ServerError(f"{failure}: {lines[-1]}")
    # a user's module may print before it while it is imported
    return json.loads(asked.stdout.splitlines()[-1])


def _terms(section: str, rows: list[dict[str, str]]) -> Table:
    """A section of a declaration, without empty columns."""
    table = Table(box=None, pad_edge=False, title=section.upper(), title_justify="left", title_style="")
    columns = [column for column in rows[0] if any(row[column] for row in rows)]
    for column in columns:
        table.add_column(column, overflow="fold", no_wrap=column == "name")
    for row in rows:
        table.add_row(*(row[column] for column in columns))
    return table


def _numbers(numbers: dict[str, list[float]]) -> Table:
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column("place", no_wrap=True)
    table.add_column("value", overflow="fold")
    for place, values in numbers.items():
        table.add_row(place, ", ".join(f"{value:g}" for value in values))
    return table


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
