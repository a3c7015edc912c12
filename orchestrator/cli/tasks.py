"""``muster tasks``: the tasks, with their observations, actions and rewards."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec
from typing import Annotated, Any

import typer

from orchestrator.cli.command_options import JsonOption
from orchestrator.cli.listings import Resource
from orchestrator.cli.terminal import Console, echo
from orchestrator.domain.errors import ServerError, SpecError

_WIDTH = 120
"""Columns of all about one task, where the output is not a terminal."""
TASKS = Resource(
    {
        "TASK": "name",
        "OBSERVATIONS": lambda task: len(task["observations"]),
        "ACTIONS": lambda task: len(task["actions"]),
        "CONTROL": lambda task: f"{task['control_hz']:g} Hz",
        "EPISODE": lambda task: f"{task['episode_seconds']:g} s",
        "REWARDS": lambda task: "  ".join(f"{term} {weight:g}" for term, weight in task["rewards"].items()),
    },
    problem=("error", "can't be imported"),
    folded=("REWARDS",),
)
NUMBERS = Resource(
    {"": lambda row: row[0], " ": lambda row: ", ".join(f"{value:g}" for value in row[1])},
    folded=(" ",),
    width=_WIDTH,
    title="NUMBERS of train.config.numbers and train.config.curriculum",
)


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
    found = ask_worker("worker.tasks", [name] if name else [], "tasks can't be listed")
    replace(TASKS, width=_WIDTH if name else 0).show(found, as_json)
    if not name or as_json:
        return
    names = ", ".join(found[0]["actions"])
    console = Console(highlight=False, width=None if sys.stdout.isatty() else _WIDTH)
    for title, lines in {
        "NAMES OF OBSERVATIONS": [", ".join(found[0]["observations"])],
        "NAMES OF ACTIONS": [names],
        "ROBOTS": found[0]["robots"],
    }.items():
        if lines:
            console.print("\n".join([f"\n{title}", *lines]), markup=False)
    for section, rows in found[0].get("tables", {}).items():
        terms(section, rows).show([row | {"joints": ""} if row.get("joints") in ("", names) else row for row in rows])
    NUMBERS.show([*(found[0].get("numbers") or {}).items()])


def terms(section: str, rows: Sequence[dict[str, str]]) -> Resource:
    """A section of a declaration, without empty columns."""
    columns = list(rows[0])
    return Resource(
        {column: column for column in columns},
        optional=columns,
        folded=[column for column in columns if column != "name"],
        title=section.upper(),
        width=_WIDTH,
        blank="",
    )


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
    if sys.stderr.isatty():
        echo("importing the simulation, which takes some seconds …", err=True)
    done = subprocess.run([sys.executable, "-P", "-m", module, *arguments], capture_output=True, text=True, check=False)
    lines = done.stderr.strip().splitlines() or [f"it ended with exit code {done.returncode}"]
    if done.returncode == 2:
        raise SpecError(lines[-1])
    if done.returncode:
        raise ServerError(f"{failure}: {lines[-1]}")
    # a user's module may print before it while it is imported
    return json.loads(done.stdout.splitlines()[-1])
