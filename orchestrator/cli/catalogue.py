"""The catalogue of all commands, with one line each. A command's module is imported on use; `muster --help` imports none."""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.models import CommandInfo, TyperInfo

from orchestrator.cli.help import print_help, set_forms
from orchestrator.cli.misuse import CommandGroup, in_place_of
from orchestrator.cli.terminal import end_at_closed_pipe
from orchestrator.domain.errors import UsageError
from shared_store.contract.error_text import nearest
from shared_store.contract.plugins import Command, PluginError, blamed, plugins
from shared_store.contract.plugins import load as load_part

_LISTED = {
    "Jobs": """
        run            Run a job to its end, with a temporary controller if none is running.
        submit         Submit a job to a running controller.
        list           List jobs, the newest first.
        show           Show a job: why it is in its state, its attempts and nodes, its results.
        logs           Print a job's log, all nodes and attempts merged by time.
        stop           Stop jobs: they checkpoint and exit; `muster resume` continues.
        stacks         Print the Python and native stacks of every rank of a running job.
    """,
    "Runs": """
        runs           List, archive and delete the runs of the store.
        resume         Resume a run from its newest checkpoint, at the next iteration.
        clone          Start a new run from only the weights of a checkpoint.
        evaluate       Evaluate a checkpoint in worlds that its training has not seen.
        compare        Compare runs, or groups of runs that differ only in their seed.
        export         Export a policy as a bundle for a robot, and check it.
        models         Register, list, show, compare and verify exported policies.
        checkpoint     Make a training job save now; return when the checkpoint is durable.
        checkpoints    List a run's checkpoints; with --verify, exit 1 if one is damaged.
        record         Record a policy in action as an MCAP file, for ROS 2's tools and viewers.
        render         Film a checkpoint's policy in action, or draw six moments of it.
        view           View a training, a checkpoint's policy or a recording in a browser.
        verify-resume  Prove bit by bit that a training survives a crash.
    """,
    "Controller": """
        serve          Run the controller as a server. Running jobs outlive it.
        queues         List and create job queues, or show which of a queue's jobs start next.
        gc             Delete old jobs, their logs and their runs, where nothing needs them.
        keys           Manage the access keys of this home directory's server.
        webhooks       List and test the webhooks that report the end of jobs.
        aws            Manage the CloudFormation stack for jobs on AWS.
    """,
    "This machine": """
        tasks          List the installed tasks, or all terms and numbers of one task.
        robot          Show a robot's file as a task would load it, beside MuJoCo's own reading.
        schema         Print the JSON Schema of the job YAML, or of the policy contract.
        doctor         Check whether this machine meets Muster's requirements.
    """,
}
_MODULES = {
    **dict.fromkeys(("run", "serve"), "serving"),
    **dict.fromkeys(("submit", "stop", "stacks", "checkpoint", "schema"), "jobs"),
    **dict.fromkeys(("list", "show"), "shown_jobs"),
    **dict.fromkeys(("resume", "clone"), "continuing"),
    **dict.fromkeys(("runs", "checkpoints"), "runs"),
    **dict.fromkeys(("record", "render", "view"), "recordings"),
    **{"evaluate": "evaluations", "compare": "comparing", "verify-resume": "verify"},
}
"""Modules of this package, of commands that have another name than theirs."""
_LOCAL = frozenset({"serve", "keys", "aws", "tasks", "robot", "schema"})
"""Commands that speak to no controller."""
_SERVER = "muster.server"
"""Key of a parser's context for the URL of `--server`."""
_OWN = tuple(
    Command(name, f"orchestrator.cli.{_MODULES.get(name, name)}", panel, summary)
    for panel, text in _LISTED.items()
    for name, summary in (line.split(maxsplit=1) for line in text.strip().splitlines())
)


def _added() -> Iterator[Command]:
    """The commands of plug-ins. Raises PluginError: one has the name of Muster's, or adds options to an unknown command."""
    own = [entry.name for entry in _OWN]
    for name, plugin in plugins().items():
        for command in plugin.commands:
            if command.name in own:
                raise PluginError(
                    f"plug-in {name}: commands: muster {command.name} is Muster's own; choose another name"
                )
        for extended, _ in plugin.options:
            if extended not in own:
                raise PluginError(f"plug-in {name}: options: unknown command {extended}; {nearest(extended, own)}")
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
        parameters = inspect.signature(function, eval_str=True).parameters.values()
        added = [each for each in parameters if each.kind is inspect.Parameter.KEYWORD_ONLY]

        def both(**values: Any) -> Any:
            further = {each.name: values.pop(each.name) for each in added}
            return function(own, values, **further)

        command.callback, command.epilog = in_place_of(own, both, *added), f"{command.epilog}\n{self.examples}"


def load(name: str) -> Any:
    """The command itself. Imports its module. Raises PluginError where it, or an option of it, is a plug-in's and can't be used."""
    own = typer.Typer(rich_markup_mode="rich")
    module = next(entry.module for entry in ENTRIES if entry.name == name)
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
    if name not in _LOCAL:
        for info in (*own.registered_commands, *(each for group in own.registered_groups for each in _members(group))):
            info.callback = _for_server(info.callback) if info.callback else None
    command: Any = typer.main.get_group(own).commands[name]
    for each in (command, *getattr(command, "commands", {}).values()):
        set_forms(each.params)
        each.format_help = partial(print_help, each)
    return command


def _members(group: TyperInfo) -> Iterator[CommandInfo | TyperInfo]:
    """What of a group takes options."""
    assert group.typer_instance is not None
    yield from group.typer_instance.registered_commands
    if group.typer_instance.registered_callback:
        yield group.typer_instance.registered_callback


def _use_server(ctx: typer.Context, url: str | None) -> str | None:
    if url is not None:
        if not url.startswith(("http://", "https://")):
            near = f"http://{url}" if re.fullmatch(r"[\w.:\[\]-]+", url) else "http://127.0.0.1:8080"
            raise UsageError(f"--server{url and f' {url}'}: expected the URL of a controller, such as {near}")
        os.environ["MUSTER_URL"] = ctx.meta[_SERVER] = url
    return url


ServerOption = Annotated[
    str | None,
    typer.Option(
        "--server",
        metavar="URL",
        callback=_use_server,
        is_eager=True,
        help="URL of the controller; default: $MUSTER_URL, else this home directory's. $MUSTER_TOKEN is its key.",
    ),
]
"""Every command for a controller has it, before and after its name."""


def _for_server(own: Callable[..., Any]) -> Callable[..., Any]:
    """The command with :data:`ServerOption`, whose callback has done its work before the command runs."""

    def without(server: str | None, **values: Any) -> Any:
        return own(**values)

    place = inspect.Parameter("server", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=ServerOption)
    return in_place_of(own, without, place)


class Catalogue(CommandGroup):
    """A group that lists placeholders and runs the real commands."""

    def make_context(self, *args: Any, **options: Any) -> Any:
        with end_at_closed_pipe():  # of --help and --version
            return super().make_context(*args, **options)

    def invoke(self, ctx: Any) -> Any:
        with end_at_closed_pipe():
            return super().invoke(ctx)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name, found, rest = super().resolve_command(ctx, args)  # refuses an unknown name with the nearest known ones
        if name in _LOCAL and _SERVER in ctx.meta:
            raise UsageError(f"--server: muster {name} works on this machine, without a controller; leave --server out")
        return name, load(name) if found is not None and name else None, rest

    def format_help(self, ctx: Any, formatter: Any) -> None:
        print_help(self, ctx)


def add_placeholders(app: typer.Typer) -> None:
    """Add the catalogue's commands to ``app``, by name and summary."""

    def placeholder() -> None:
        """Never called: see :meth:`Catalogue.resolve_command`."""

    for entry in ENTRIES:
        app.command(entry.name, help=entry.summary, rich_help_panel=entry.panel)(placeholder)
