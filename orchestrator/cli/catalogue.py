"""The catalogue of all commands, with one line each. A command's module is imported on use; `muster --help` imports none."""

from __future__ import annotations

import re
from importlib import import_module
from typing import Any, NamedTuple

import typer

from orchestrator.cli.misuse import Group


class Entry(NamedTuple):
    """A command, or a group of commands, in `muster --help`."""

    name: str
    module: str
    """Module in ``orchestrator.cli``; its function ``register`` adds the command to an application."""
    panel: str
    summary: str
    """The first line of the command's own help."""


_JOBS, _RUNS, _SHARED, _HERE = "Jobs", "Runs", "Controller", "This machine"
ENTRIES = (
    Entry(
        "run",
        "serving",
        _JOBS,
        "Run a job to its end, with a temporary controller if none is running; exit with its result.",
    ),
    Entry("submit", "jobs", _JOBS, "Submit a job to a running controller."),
    Entry("list", "listing", _JOBS, "List jobs, the newest first."),
    Entry("show", "show", _JOBS, "Show a job: its state and the reason, its attempts and nodes, its run and results."),
    Entry("logs", "logs", _JOBS, "Print a job's log, all nodes and attempts merged by time."),
    Entry("stop", "jobs", _JOBS, "Stop a job: it checkpoints and exits; `muster resume` continues from there."),
    Entry("stacks", "jobs", _JOBS, "Print the Python and native stacks of every rank of a running job."),
    Entry("runs", "stored_runs", _RUNS, "List, archive and delete the runs of the store."),
    Entry("resume", "runs", _RUNS, "Resume a run from its newest checkpoint, at the next iteration."),
    Entry("clone", "clones", _RUNS, "Start a new run from only the weights of a checkpoint."),
    Entry(
        "evaluate",
        "evaluations",
        _RUNS,
        "Evaluate a checkpoint: whole episodes in worlds that its training has not seen.",
    ),
    Entry(
        "compare",
        "comparing",
        _RUNS,
        "Compare runs, or groups of runs that differ only in their seed; draw their curves.",
    ),
    Entry(
        "export",
        "export",
        _RUNS,
        "Export a policy as a bundle for a robot (ONNX, contract, self-test), checked against the policy.",
    ),
    Entry(
        "models",
        "models",
        _RUNS,
        "Manage exported policies: register, list, show, diff, verify. Versions are immutable.",
    ),
    Entry("checkpoint", "jobs", _RUNS, "Make a training job save now; return when the checkpoint is durable."),
    Entry("checkpoints", "runs", _RUNS, "List a run's checkpoints; with --verify, exit 1 if one is damaged."),
    Entry("record", "recordings", _RUNS, "Record a policy in action as an MCAP file, for ROS 2's tools and viewers."),
    Entry(
        "render", "recordings", _RUNS, "Film a checkpoint's policy in action, or show six moments of it in a picture."
    ),
    Entry("view", "viewing", _RUNS, "View a running training, a checkpoint's policy or a recording in a browser."),
    Entry(
        "verify-resume",
        "verify",
        _RUNS,
        "Prove that a training survives a crash: train twice, kill one, compare the results bit by bit.",
    ),
    Entry(
        "serve",
        "serving",
        _SHARED,
        "Run the controller as a server. Running jobs outlive it; the next controller finds them.",
    ),
    Entry(
        "queues",
        "queues",
        _SHARED,
        "List job queues, or one queue's waiting jobs in the order in which they will start.",
    ),
    Entry("gc", "gc", _SHARED, "Delete old jobs, their logs and their runs, where nothing needs them any more."),
    Entry("keys", "keys", _SHARED, "Manage the access keys of this home directory's server."),
    Entry("webhooks", "webhooks", _SHARED, "List and test the controller's webhooks, which report the end of jobs."),
    Entry(
        "aws", "aws", _SHARED, "Manage the CloudFormation stack for jobs on AWS (network, volume, images, AWS Batch)."
    ),
    Entry(
        "tasks",
        "tasks",
        _HERE,
        "List the installed tasks, or all terms and numbers of one task.",
    ),
    Entry("robot", "robot", _HERE, "Show a robot's file as a task would load it, beside MuJoCo's own reading."),
    Entry("tracks", "tracks", _SHARED, "Manage the racer's tracks: list, show, make, import. Tracks are immutable."),
    Entry(
        "league",
        "league",
        _SHARED,
        "Manage the racer's leagues: create, submit, table, verify and more. Leagues are append-only.",
    ),
    Entry("schema", "jobs", _HERE, "Print the JSON Schema of the job YAML, for editors, or of the policy contract."),
    Entry(
        "doctor",
        "doctor",
        _HERE,
        "Check whether this machine meets Muster's requirements; exit 1 if a requested part is missing.",
    ),
)
_LINE_END = re.compile(r"(?<!\n)\n(?!\n)")
"""Marks a line that is not the last of its paragraph."""
_MODULES = {entry.name: entry.module for entry in ENTRIES}


def load(name: str) -> Any:
    """The command itself. Imports its module."""
    own = typer.Typer(rich_markup_mode="rich")
    import_module(f"orchestrator.cli.{_MODULES[name]}").register(own)
    command: Any = typer.main.get_group(own).commands[name]
    for each in (command, *getattr(command, "commands", {}).values()):
        # a docstring's line breaks are the source's; the terminal's width decides on its own
        each.help = _LINE_END.sub(" ", each.help or "")
    return command


class Catalogue(Group):
    """A group that lists placeholders and runs the real commands."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name, found, rest = super().resolve_command(ctx, args)  # refuses an unknown name with the nearest known ones
        return name, load(name) if found is not None and name else None, rest


def add_placeholders(app: typer.Typer) -> None:
    """Add the catalogue's commands to ``app``, by name and summary."""

    def placeholder() -> None:
        """Never called: see :meth:`Catalogue.resolve_command`."""

    for entry in ENTRIES:
        app.command(entry.name, help=entry.summary, rich_help_panel=entry.panel)(placeholder)
