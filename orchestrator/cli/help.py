"""The help of commands: like Typer's, whose own printing takes longer to import than all else that `muster --help` needs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from orchestrator.cli.terminal import Console

_FORMS = {int: "N", float: "NUMBER", Path: "FILE"}
_WIDEST = 36
"""Columns for the names of options."""
_LINE_END = re.compile(r"(?<!\n)\n(?!\n)")
"""Marks a line that is not the last of its paragraph: a docstring's line breaks are the source's, not the terminal's."""


def set_forms(params: list[Any]) -> None:
    """Name the form of each parameter's value: ``N``, ``FILE``, ``TEXT``; nothing of a flag."""
    for param in params:
        if param.param_type_name == "argument":
            param.metavar = param.metavar or param.name.upper()
            param.display_type_rich = lambda ctx: ""
        elif param.metavar is None:
            param.metavar = "" if param.is_flag else _FORMS.get(param.type_descriptor.annotation, "TEXT")


def print_help(command: Any, ctx: Any, _formatter: object = None) -> None:
    """Print the help of a command or a group, in the place of its ``format_help``."""
    console = Console(highlight=False)
    usage = re.sub(r"[{}]", "", ctx.get_usage())
    console.print(Text(f"\n {usage}\n", "bold"))
    for paragraph in (command.help or "").split("\n\n"):
        console.print(Text(_LINE_END.sub(" ", paragraph.strip()) + "\n"))
    params = command.get_params(ctx)
    set_forms(params)
    panels: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
    for param in params:
        if record := param.get_help_record(ctx):
            panel = "Arguments" if param.param_type_name == "argument" else "Options"
            panels.setdefault(getattr(param, "rich_help_panel", None) or panel, []).append(record)
    for name, each in getattr(command, "commands", {}).items():
        summary = _LINE_END.sub(" ", (each.help or "").partition("\n\n")[0])
        panels.setdefault(getattr(each, "rich_help_panel", None) or "Commands", []).append((name, summary))
    for panel, rows in panels.items():
        if rows:
            table = Table.grid(padding=(0, 2))
            widest = max(len(name) for name, _ in rows)
            table.add_column(style="bold cyan", width=min(widest, _WIDEST))
            for name, text in rows:
                table.add_row(Text(name), Text(text))
            console.print(Panel(table, title=panel, title_align="left", border_style="dim"))
    console.print(Text(f"\n{command.epilog or ''}\n"))
