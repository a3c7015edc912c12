"""The catalogue of all commands, with one line each. A command's module is imported on use; `muster --help` imports none."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import typer
from typer.models import CommandInfo

from orchestrator.cli.misuse import CommandGroup
from shared_store.contract.error_text import nearest
from shared_store.contract.plugins import Command, PluginError, blamed, plugins
from shared_store.contract.plugins import load as load_part


def _own(name: str, module: str, panel: str, summary: str) -> Command:
    """A command of Muster; ``module``: in ``orchestrator.cli``."""
    return Command(name, f"orchestrator.cli.{module}", panel, summary)


_JOBS, _RUNS, _SHARED, _HERE = "Jobs", "Runs", "Controller", "This machine"
_OWN = (
    _own(
        "run",
        "serving",
        _JOBS,
        "Run a job to its end, with a temporary controller if none is running; exit with its result.",
    ),
    _own("submit", "jobs", _JOBS, "Submit a job to a running controller."),
    _own("list", "listing", _JOBS, "List jobs, the newest first."),
    _own("show", "show", _JOBS, "Show a job: its state and the reason, its attempts and nodes, its run and results."),
    _own("logs", "logs", _JOBS, "Print a job's log, all nodes and attempts merged by time."),
    _own("stop", "jobs", _JOBS, "Stop a job: it checkpoints and exits; `muster resume` continues from there."),
    _own("stacks", "jobs", _JOBS, "Print the Python and native stacks of every rank of a running job."),
    _own("runs", "stored_runs", _RUNS, "List, archive and delete the runs of the store."),
    _own("resume", "runs", _RUNS, "Resume a run from its newest checkpoint, at the next iteration."),
    _own("clone", "clones", _RUNS, "Start a new run from only the weights of a checkpoint."),
    _own(
        "evaluate",
        "evaluations",
        _RUNS,
        "Evaluate a checkpoint: whole episodes in worlds that its training has not seen.",
    ),
    _own(
        "compare",
        "comparing",
        _RUNS,
        "Compare runs, or groups of runs that differ only in their seed; draw their curves.",
    ),
    _own(
        "export",
        "export",
        _RUNS,
        "Export a policy as a bundle for a robot (ONNX, contract, self-test), checked against the policy.",
    ),
    _own(
        "models",
        "models",
        _RUNS,
        "Manage exported policies: register, list, show, diff, verify. Versions are immutable.",
    ),
    _own("checkpoint", "jobs", _RUNS, "Make a training job save now; return when the checkpoint is durable."),
    _own("checkpoints", "runs", _RUNS, "List a run's checkpoints; with --verify, exit 1 if one is damaged."),
    _own("record", "recordings", _RUNS, "Record a policy in action as an MCAP file, for ROS 2's tools and viewers."),
    _own(
        "render", "recordings", _RUNS, "Film a checkpoint's policy in action, or show six moments of it in a picture."
    ),
    _own("view", "viewing", _RUNS, "View a running training, a checkpoint's policy or a recording in a browser."),
    _own(
        "verify-resume",
        "verify",
        _RUNS,
        "Prove that a training survives a crash: train twice, kill one, compare the results bit by bit.",
    ),
    _own(
        "serve",
        "serving",
        _SHARED,
        "Run the controller as a server. Running jobs outlive it; the next controller finds them.",
    ),
    _own(
        "queues",
        "queues",
        _SHARED,
        "List job queues, or one queue's waiting jobs in the order in which they will start.",
    ),
    _own("gc", "gc", _SHARED, "Delete old jobs, their logs and their runs, where nothing needs them any more."),
    _own("keys", "keys", _SHARED, "Manage the access keys of this home directory's server."),
    _own("webhooks", "webhooks", _SHARED, "List and test the controller's webhooks, which report the end of jobs."),
    _own(
        "aws", "aws", _SHARED, "Manage the CloudFormation stack for jobs on AWS (network, volume, images, AWS Batch)."
    ),
    _own(
        "tasks",
        "tasks",
        _HERE,
        "List the installed tasks, or all terms and numbers of one task.",
    ),
    _own("robot", "robot", _HERE, "Show a robot's file as a task would load it, beside MuJoCo's own reading."),
    _own("schema", "jobs", _HERE, "Print the JSON Schema of the job YAML, for editors, or of the policy contract."),
    _own(
        "doctor",
        "doctor",
        _HERE,
        "Check whether this machine meets Muster's requirements; exit 1 if a requested part is missing.",
    ),
)


def _added() -> Iterator[Command]:
    """The commands of plug-ins. Raises PluginError: one takes the name of Muster's, or adds options to a command that is not there."""
    own = [entry.name for entry in _OWN]
    for name, plugin in plugins().items():
        for command in plugin.commands:
            if command.name in own:
                raise PluginError(
                    f"plug-in {name}: commands: muster {command.name} is Muster's own; choose another name"
                )
        for extended, _ in plugin.options:
            if extended not in own:
                raise PluginError(f"plug-in {name}: options: there is no command {extended}; {nearest(extended, own)}")
        yield from plugin.commands


ENTRIES = (*_OWN, *_added())


@dataclass(frozen=True)
class FurtherOptions:
    """Options that a plug-in adds to a command.

    Attributes:
        function: Called in the command's place with its function, its values by their names, and the values of the further options,
            which are the keyword-only parameters of ``function``.
        examples: Lines for the end of the command's help.
    """

    function: Callable[..., Any]
    examples: str

    def extend(self, command: CommandInfo) -> None:
        """Add the options to a command. Raises ValueError where the command has one of this name."""
        own, function = command.callback, self.function
        assert own is not None
        first, second = (inspect.signature(each, eval_str=True) for each in (own, function))
        added = [each for each in second.parameters.values() if each.kind is inspect.Parameter.KEYWORD_ONLY]

        def both(**given: Any) -> Any:
            further = {each.name: given.pop(each.name) for each in added}
            return function(own, given, **further)

        both.__name__, both.__doc__, both.__annotations__ = own.__name__, own.__doc__, {}
        both.__signature__ = first.replace(parameters=[*first.parameters.values(), *added])  # type: ignore[attr-defined]
        command.callback, command.epilog = both, f"{command.epilog}\n{self.examples}"


_LINE_END = re.compile(r"(?<!\n)\n(?!\n)")
"""Marks a line that is not the last of its paragraph."""
_MODULES = {entry.name: entry.module for entry in ENTRIES}


def load(name: str) -> Any:
    """The command itself. Imports its module. Raises PluginError where it, or an option of it, is a plug-in's and can't be used."""
    own, module = typer.Typer(rich_markup_mode="rich"), _MODULES[name]
    if any(entry.name == name for entry in _OWN):
        import_module(module).register(own)
    else:
        register = load_part(f"{module}:register", Callable)
        with blamed(module):
            register(own)
            if name not in (made := typer.main.get_group(own).commands):
                raise ValueError(f"it registers {', '.join(made) or 'no command'}, and not {name}")
    for place in (place for plugin in plugins().values() for extended, place in plugin.options if extended == name):
        further = load_part(place, FurtherOptions)
        with blamed(place):
            further.extend(own.registered_commands[0])
            typer.main.get_group(own)
    command: Any = typer.main.get_group(own).commands[name]
    for each in (command, *getattr(command, "commands", {}).values()):
        # a docstring's line breaks are the source's; the terminal's width decides on its own
        each.help = _LINE_END.sub(" ", each.help or "")
    return command


class Catalogue(CommandGroup):
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
