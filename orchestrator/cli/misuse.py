"""Misuse of the command line, reported in one line: the input, the mistake, the nearest name, and the help to read."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Sequence
from typing import Any

import typer
from typer.core import TyperGroup

from orchestrator.domain.errors import UsageError
from shared_store.contract.error_text import OF_PLUGIN, explain, nearest

Misuse: type[Exception] = typer.BadParameter.__mro__[2]
"""The parser's exception. Typer takes it from click or has its own, depending on the version."""

_EXPECTED = {
    "int_parsing": "an integer",
    "int_from_float": "an integer",
    "float_parsing": "a number",
    "bool_parsing": "true or false",
}


class CommandGroup(TyperGroup):
    """A group of commands that refuses an unknown one with the nearest name."""

    otherwise = ""
    """The command for an argument that isn't a command's name, as in `muster queues default`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if self.invoke_without_command and args[:1] == ["--json"] and not "".join(args[1:2]).startswith("-"):
            args = [*args[1:], "--json"]  # of the command behind it, as in `muster queues --json default`
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if self.get_command(ctx, args[0]) is None:
            if self.otherwise and not args[0].startswith("-"):
                args = [self.otherwise, *args]
                return super().resolve_command(ctx, args)
            near = nearest(args[0], self.commands, _see(ctx.command_path))
            further = f" ({OF_PLUGIN})" if ctx.parent is None else ""  # a plug-in adds no command to a group
            raise UsageError(f"{args[0]}: unknown command; {near}{further}")
        return super().resolve_command(ctx, args)


def make_group(
    about: str,
    epilog: str,
    default: Callable[..., None] | None = None,
    cls: type[CommandGroup] = CommandGroup,
) -> typer.Typer:
    """A group of commands. Without a subcommand it runs ``default``, with the options of that, or prints its help where there is none."""
    group = typer.Typer(
        cls=cls,
        no_args_is_help=default is None,
        invoke_without_command=default is not None,
        rich_markup_mode="rich",
        help=about,
        epilog=epilog,
    )
    if default is not None:
        group.callback()(_unless_subcommand(default))
    return group


def _unless_subcommand(default: Callable[..., None]) -> Callable[..., None]:
    def callback(ctx: typer.Context, **values: Any) -> None:
        own = {param.name: param.opts[0] for param in ctx.command.params if param.name in values}
        if ctx.invoked_subcommand is None:
            default(**values)
        elif wrong := [opt for name, opt in own.items() if "COMMANDLINE" in str(ctx.get_parameter_source(name))]:
            raise UsageError(f"{wrong[0]}: an option of {ctx.command_path} alone; leave {ctx.invoked_subcommand} out")

    return in_place_of(
        default, callback, inspect.Parameter("ctx", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
    )


def in_place_of(
    function: Callable[..., Any], other: Callable[..., Any], *added: inspect.Parameter
) -> Callable[..., Any]:
    """``other`` as a command with the name, help and options of ``function``, and ``added`` ones."""
    signature = inspect.signature(function, eval_str=True)
    other.__name__, other.__doc__, other.__annotations__ = function.__name__, function.__doc__, {}
    other.__signature__ = signature.replace(parameters=[*signature.parameters.values(), *added])  # type: ignore[attr-defined]
    return other


def describe(error: Any, commands: Sequence[str]) -> str:
    """The mistake in the command line; empty if the command line is empty, since the help is already printed.

    Args:
        error: A :data:`Misuse`.
        commands: Names of all commands, since the parser does not always report the present one.
    """
    message = error.format_message().strip()
    ctx = getattr(error, "ctx", None)
    command = [word for word in sys.argv[1:2] if word in commands]
    see = _see(ctx.command_path if ctx else " ".join(["muster", *command]))
    param, option = getattr(error, "param", None), getattr(error, "option_name", None)
    if option is not None and ctx is not None:
        known = [name for each in ctx.command.get_params(ctx) for name in (*each.opts, *each.secondary_opts)]
        near = nearest(option, [name for name in known if name.startswith("--")], see)
        return f"{option}: unknown option; {near}" + ("" if near == see else f" {see}")
    if option is not None:
        return f"{option} {'needs a' if 'requires' in message else 'takes no'} value; {see}"
    if param is not None:
        if type(error).__name__ == "MissingParameter":
            return f"{_name(param)} is missing; {see}"
        return f"{_name(param)}: {_mismatch(error)}; {see}"
    if message.startswith("Got unexpected extra"):
        return f"{message.partition('(s) (')[2].removesuffix(')')}: more arguments than the command takes; {see}"
    return f"{message[:1].lower()}{message[1:].rstrip('.')}; {see}" if message else ""


def _see(path: str) -> str:
    return f"see: {path} --help"


def _name(param: Any) -> str:
    if param.param_type_name == "option":
        return str(max(param.opts, key=len))
    return str(param.metavar or param.name.upper())


def _mismatch(error: Any) -> str:
    """The expected and the actual value."""
    cause = error.__cause__
    if not hasattr(cause, "errors"):
        return str(error.message).rstrip(".")
    first = cause.errors(include_url=False)[0]
    if (expected := _EXPECTED.get(first["type"])) is not None:
        return f"expected {expected}, found {str(first['input'])[:60]}"
    return explain(first)
