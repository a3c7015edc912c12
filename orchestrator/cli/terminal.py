"""Printing: foreign text (names, reasons, log lines, errors) reaches the terminal as text, never as control sequences.

Every command prints through :func:`echo` and :class:`Console`. Control characters, escape sequences, and characters that reverse or hide
text are shown escaped (``\\x1b``, ``\\u202e``); newlines and tabs stay.
"""

from __future__ import annotations

import json
import logging
import os
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import rich.console
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

_UNSAFE = re.compile(
    "(?P<colour>\x1b\\[[0-9;]*m)|"
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # control characters of ASCII and Latin-1 (C0, C1)
    "\u061c\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb"  # direction, line ends, invisible
    "\ud800-\udfff\U000e0000-\U000e007f]"  # halves of characters, tags
)
_NO_COLOUR = "\x1b[0m"
_WIDEST = 100_000
"""Width at which nothing is cut."""


def visible(text: str, colours: bool = False) -> str:
    """``text`` with all control sequences escaped; with ``colours``, colour sequences stay and are reset at the end."""
    if _UNSAFE.search(text) is None:
        return text

    def escaped(found: re.Match[str]) -> str:
        if found["colour"]:
            return found[0] if colours else "\\x1b" + found[0][1:]
        return found[0].encode("unicode_escape").decode()

    shown = _UNSAFE.sub(escaped, text)
    return shown + _NO_COLOUR if "\x1b" in shown else shown


def one_line(text: str) -> str:
    """A reason or an error as one line, since further lines could pass for Muster's own."""
    return visible(" ".join(text.split()))


def echo(text: str, err: bool = False) -> None:
    """Print ``text`` and a newline, with ``err`` on standard error."""
    echo_raw(visible(text), err)


def echo_raw(text: str, err: bool = False) -> None:
    """:func:`echo` without escaping, in one write, so that lines of concurrent writers don't mix."""
    print(f"{text}\n", end="", file=sys.stderr if err else sys.stdout, flush=True)


def to_json(value: Any, indent: int | None = None) -> str:
    """JSON in printable ASCII."""
    return json.dumps(value, indent=indent).replace("\x7f", "\\u007f")


def echo_json(value: Any, indent: int | None = None) -> None:
    """Print :func:`to_json`."""
    echo_raw(to_json(value, indent))


class Console(rich.console.Console):
    """Rich's console with rendered text made :func:`visible`; its own styles and cursor movements are unchanged."""

    def on_broken_pipe(self) -> None:
        raise  # to end_at_closed_pipe; rich would exit with 1

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(visible(text), **options)  # before it is measured

    def render(self, renderable: Any, options: rich.console.ConsoleOptions | None = None) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(visible(segment.text), segment.style)


def print_rows(table: Table) -> None:
    """Print each row of a table as one line, with nothing cut and no spaces at its end: to be read whole, or by another program."""
    _print_lines(Console(width=_WIDEST), table)


def _print_lines(console: Console, table: Table) -> None:
    with console.capture() as captured:
        console.print(table, soft_wrap=True)
    echo_raw("\n".join(line.rstrip() for line in captured.get().splitlines()))


def print_cut(table: Table) -> None:
    """One line per row: on a terminal the last column is cut to the remaining width; for another program nothing is cut."""
    if not sys.stdout.isatty():
        print_rows(table)
        return
    console, wide = Console(), Console(width=_WIDEST)
    widths = [max(wide.measure(cell).maximum for cell in (each.header, *each.cells)) for each in table.columns]
    for column, width in zip(table.columns[:-1], widths, strict=False):  # rich would shrink all columns equally
        column.min_width = width
    taken = sum(2 + width for width in widths[:-1])
    table.columns[-1].max_width = max(len("REASON"), console.width - taken)
    Console(width=max(console.width, taken + len("REASON"))).print(table, soft_wrap=True)


def print_wrapped(table: Table, width: int = 0) -> None:
    """On a terminal, wrap cells between words but never within a name; for another program wrap at ``width``, or print one line per row."""
    if not sys.stdout.isatty() and not width:
        print_rows(table)
        return
    terminal, wide = Console(width=None if sys.stdout.isatty() else width), Console(width=_WIDEST)
    least = 2 * len(table.columns)
    for column in table.columns:
        sizes = [wide.measure(cell) for cell in (column.header, *column.cells)]
        column.min_width = max(size.maximum if column.no_wrap else size.minimum for size in sizes)
        least += column.min_width
    _print_lines(Console(width=max(terminal.width, least)), table)


@contextmanager
def end_at_closed_pipe() -> Iterator[None]:
    """Exit with 0 and without a message where the reader of the output has closed the pipe (``muster … | head``)."""
    try:
        yield
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # discard buffered output
        sys.exit(0)


class _Formatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return visible(super().format(record))


def log_visibly() -> None:
    """Escape the controller's warnings too, since they name jobs and repeat errors."""
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(_Formatter())
