"""All commands with a line each. The module of a command is imported when the command is used: `muster --help` needs none of them."""

from __future__ import annotations

import re
from importlib import import_module
from typing import Any, NamedTuple

import typer

from orchestrator.cli.misuse import Group


class Entry(NamedTuple):
    """A command, or a group of commands, as `muster --help` shows it."""

    name: str
    module: str
    """In ``orchestrator.cli``; its function ``register`` adds the command to an application."""
    panel: str
    summary: str
    """The first line of the command's own help."""


_JOBS, _RUNS, _SHARED, _HERE = "Jobs", "Runs", "Controller", "This machine"
ENTRIES = (
    Entry(
        "run",
        "serving",
        _JOBS,
        "Run a job to its end, with a controller of its own where none is running; exit with its result.",
    ),
    Entry("submit", "jobs", _JOBS, "Submit a job to a running controller."),
    Entry("list", "listing", _JOBS, "List jobs, the newest first."),
    Entry("show", "jobs", _JOBS, "Show a job: its state and why, its attempts and nodes, its run and results."),
    Entry("logs", "logs", _JOBS, "Print a job's log, all nodes and attempts merged by time."),
    Entry("stop", "jobs", _JOBS, "Stop a job: it checkpoints and leaves; `muster resume` goes on from there."),
    Entry("stacks", "jobs", _JOBS, "Print the Python and native stacks of every rank of a running job."),
    Entry("resume", "runs", _RUNS, "Go on with a run from its newest checkpoint, at the next iteration."),
    Entry("clone", "clones", _RUNS, "Start a new run with the weights of a checkpoint, and with nothing else of it."),
    Entry(
        "evaluate",
        "evaluations",
        _RUNS,
        "Evaluate a checkpoint: whole episodes on worlds that its training has not seen.",
    ),
    Entry(
        "compare",
        "comparing",
        _RUNS,
        "Compare runs, or groups of runs that differ in their seed alone; draw their curves.",
    ),
    Entry(
        "export",
        "export",
        _RUNS,
        "Export a policy as a bundle for a robot: ONNX, contract and self-test, compared with the policy.",
    ),
    Entry(
        "models",
        "models",
        _RUNS,
        "Keep exported policies: register, list, show, diff, verify. A version is never changed.",
    ),
    Entry("checkpoint", "jobs", _RUNS, "Have a training job save now; returns when the checkpoint is durable."),
    Entry("checkpoints", "runs", _RUNS, "List a run's checkpoints; with --verify exit 1 where one is damaged."),
    Entry("record", "recordings", _RUNS, "Record what a policy does as an MCAP file, for ROS 2's tools and viewers."),
    Entry(
        "render", "recordings", _RUNS, "Film what a checkpoint's policy does, or show six moments of it in a picture."
    ),
    Entry("view", "viewing", _RUNS, "See a training as it runs, a checkpoint's policy or a recording in a browser."),
    Entry(
        "verify-resume",
        "verify",
        _RUNS,
        "Prove that a training survives a crash: train it twice, kill one, compare all that they end with.",
    ),
    Entry(
        "serve", "serving", _SHARED, "Run the controller as a server. Running jobs outlive it; the next one finds them."
    ),
    Entry(
        "queues",
        "queues",
        _SHARED,
        "List job queues; of one, the waiting jobs in the order in which they will start.",
    ),
    Entry("keys", "keys", _SHARED, "Access keys of this home directory's server: who may call it."),
    Entry("webhooks", "webhooks", _SHARED, "Webhooks of a controller: who is told when jobs end."),
    Entry(
        "aws", "aws", _SHARED, "The CloudFormation stack in which jobs run on AWS (network, volume, images, AWS Batch)."
    ),
    Entry(
        "tasks",
        "tasks",
        _HERE,
        "List the tasks that are installed here; of one, all its terms and numbers.",
    ),
    Entry("tracks", "tracks", _SHARED, "Tracks of the racer: list, show, make, import. A track is never changed."),
    Entry(
        "league",
        "league",
        _SHARED,
        "Leagues of the racer: create, submit, table, verify and more. Nothing of one is ever changed.",
    ),
    Entry(
        "schema", "jobs", _HERE, "Print the JSON Schema of the job YAML, for editors; or that of the policy contract."
    ),
    Entry(
        "doctor",
        "doctor",
        _HERE,
        "Look whether this machine has what Muster needs; exit 1 where what was asked for is missing.",
    ),
)
_LINE_END = re.compile(r"(?<!\n)\n(?!\n)")
"""Of a line that is not the last one of its paragraph."""
_MODULES = {entry.name: entry.module for entry in ENTRIES}


def load(name: str) -> Any:
    """The command itself. Imports its module."""
    own = typer.Typer(rich_markup_mode="rich")
    import_module(f"orchestrator.cli.{_MODULES[name]}").register(own)
    command: Any = typer.main.get_group(own).commands[name]
    for each in (command, *getattr(command, "commands", {}).values()):
        # the lines of a docstring are as long as the source's; where they are broken is for the terminal to say
        each.help = _LINE_END.sub(" ", each.help or "")
    return command


class Catalogue(Group):
    """The group that lists placeholders and runs the commands themselves."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name, found, rest = super().resolve_command(ctx, args)  # an unknown name ends here, with the nearest known ones
        return name, load(name) if found is not None and name else None, rest


def add_placeholders(app: typer.Typer) -> None:
    """Add the catalogue's commands to ``app``, by name and summary."""

    def placeholder() -> None:
        """Is never called: see :meth:`Catalogue.resolve_command`."""

    for entry in ENTRIES:
        app.command(entry.name, help=entry.summary, rich_help_panel=entry.panel)(placeholder)
