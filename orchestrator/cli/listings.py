"""What commands list and show: of each kind of thing one declaration of its columns, from which its table and its `list` command come.

>>> RUNS = Resource({"RUN": "run", "OWNER": "owner", "CREATED": lambda run: date(run["created"])}, "no run", "/api/runs")
>>> RUNS.show(client.get(RUNS.route), as_json)
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import typer
from rich.table import Table
from rich.text import Text

from orchestrator.cli.command_options import JsonOption, StoreOption
from orchestrator.cli.terminal import echo, echo_json, print_cut, print_rows, print_wrapped, visible

Row = Any
"""A mapping, unless every cell is a function."""
Cell = str | Callable[[Any], object]
"""A key of a row, or a function of it. None and an empty text are shown as ``-``."""


@dataclass(frozen=True)
class Resource:
    """A kind of thing that commands list.

    Attributes:
        columns: By heading the :data:`Cell` of each row.
        empty: Printed where nothing is listed.
        route: Of the native API; its answer is the list of rows.
        optional: Headings of columns that are left out where every cell is empty.
        folded: Headings of columns whose cells may take several lines on a terminal.
        title: A line above the table.
        blank: Shown in an empty cell.
        problem: Key of a row that can't be read for why, and words before that, if any.
        whole: Print each row on a line of its own, whatever the terminal's width.
        width: At which rows wrap for another program than a terminal; 0: nowhere.
    """

    columns: Mapping[str, Cell]
    empty: str = ""
    route: str = ""
    optional: Collection[str] = ()
    folded: Collection[str] = ()
    title: str = ""
    blank: str = "-"
    problem: tuple[str, str] = ("problem", "can't be read")
    whole: bool = False
    width: int = 0

    def table(self, rows: Sequence[Row]) -> Table:
        """The rows as a table. One that lacks what a column needs has its :attr:`problem` in the last column."""
        found = [self._cells(row) for row in rows]
        headings = list(self.columns)
        shown = [i for i, name in enumerate(headings) if name not in self.optional or any(row[i] for row in found)]
        table = Table(box=None, pad_edge=False, show_header=any(map(str.strip, headings)))
        for i in shown:
            folds = headings[i] in self.folded
            cut = "ellipsis" if i == len(headings) - 1 and not folds else "fold"
            table.add_column(Text(headings[i]), no_wrap=not folds, overflow=cut)  # type: ignore[arg-type]
        for row in found:
            table.add_row(*(_text(row[i] or self.blank) for i in shown))
        return table

    def texts(self, row: Row) -> list[str]:
        """The cells of a row as text."""
        return [str(cell) or self.blank for cell in self._cells(row)]

    def _cells(self, row: Row) -> list[Text | str]:
        try:
            values = [row.get(cell) if isinstance(cell, str) else cell(row) for cell in self.columns.values()]
        except (KeyError, TypeError):
            key, words = self.problem
            if not isinstance(row, Mapping) or not row.get(key):
                raise
            first = next(iter(self.columns.values()))
            name = row[first] if isinstance(first, str) else first(row)
            values = [name, *[None] * (len(self.columns) - 2), f"{words}: {row[key]}" if words else row[key]]
        return [value if isinstance(value, Text) else "" if value is None else str(value) for value in values]

    def show(self, rows: Sequence[Row], as_json: bool = False) -> None:
        """Print the rows as JSON, as a table, or :attr:`empty`."""
        if as_json:
            echo_json(rows, indent=1)
        elif rows:
            if self.title:
                echo(f"\n{self.title}")
            if self.folded and not self.whole:
                print_wrapped(self.table(rows), self.width)
            else:
                (print_rows if self.whole else print_cut)(self.table(rows))
        elif self.empty:
            echo(self.empty)

    def lister(self, summary: str) -> Callable[..., None]:
        """A command that lists what :attr:`route` answers, with a temporary controller if none is running."""

        def list_(store: StoreOption = None, as_json: JsonOption = False) -> None:
            from orchestrator.cli.controllers import controller  # which most commands have imported by now

            with controller(store, None) as connect:
                found = connect().get(self.route)
            self.show(found, as_json)

        list_.__doc__ = summary
        return list_

    def add_list(self, group: typer.Typer, summary: str, epilog: str) -> None:
        """Add the command :meth:`lister` to a group, as ``list``."""
        group.command("list", epilog=epilog)(self.lister(summary))


def _text(cell: Text | str) -> Text:
    """A cell as text, never as markup, in which a tab or a line end is a space."""
    return cell if isinstance(cell, Text) else Text(visible(" ".join(cell.splitlines())))


def show_facts(facts: Mapping[str, object], width: int = 13, err: bool = False) -> None:
    """Print facts under their names, a line each, those that are neither None nor empty.

    Args:
        facts: By name.
        width: Of the names.
        err: Print on standard error.
    """
    for name, value in facts.items():
        if value not in (None, ""):
            echo(f"  {name + ':':{width}} {value}", err)


def date(seconds: float | None) -> str:
    """A time [Unix s] in this machine's time zone."""
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(seconds)) if seconds else ""


def date_ms(milliseconds: float | None) -> str:
    """A time [Unix ms] in this machine's time zone."""
    return date(milliseconds / 1000 if milliseconds else None)


def duration(seconds: float | None) -> str:
    """A duration as h:mm:ss."""
    if seconds is None:
        return ""
    whole = int(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02}:{whole % 60:02}"


def number(value: float | None, pattern: str = ".2f") -> str:
    """A number in a format; empty where it is not known."""
    return "" if value is None else format(value, pattern)


def scored(score: float | None, error: float | None = None) -> str:
    """A score with its standard error, if known: ``812.30 ± 4.10``."""
    return number(score) + (f" ± {error:.2f}" if score is not None and error is not None else "")


def mebibytes(size: float | None, digits: int = 1) -> str:
    """Bytes as MiB."""
    return "" if size is None else f"{size / 2**20:.{digits}f} MiB"
