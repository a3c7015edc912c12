"""``muster compare``."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from orchestrator.cli.comparison.curves import ENDINGS, draw
from orchestrator.cli.jobs import JsonOption
from orchestrator.cli.recordings import OverwriteOption, refuse_existing
from orchestrator.cli.terminal import echo, echo_json, print_cut
from orchestrator.client import Client, named
from orchestrator.domain.errors import UsageError
from shared_store.volume.comparison import COLUMNS, ComparedRun, RunGroup, facts_of, grouped, sentence, versus

_PAGE = 10_000


def register(app: typer.Typer) -> None:
    app.command(epilog="Example:  muster compare 'ant-fast-*' ant-1f2e3d4c -o compare.png")(compare)


def compare(
    runs: Annotated[
        list[str],
        typer.Argument(metavar="RUN…", help="Runs, or patterns in quotes such as 'ant-*'; at least two runs in all."),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help=f"Write the return against the steps into this file: {', '.join(ENDINGS)}."
        ),
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compare runs, or groups of runs that differ only in their seed; draw their curves.

    For a group, the table shows the mean over its runs ± their standard deviation. EVALUATED is the return of each run's best checkpoint
    in its evaluations (its last checkpoint has one), for a single run with a 95 % interval. Single runs that `muster evaluate` evaluated
    on the same episodes (the same --seed) are compared with the first one episode by episode.
    """
    _check_output(output)
    if output is not None:
        refuse_existing(output, overwrite)
    with Client.connect() as client:
        names = _chosen(client, runs)
        groups = grouped([_facts(client, name) for name in names])
    if output is not None:
        _draw(groups, output)
    against = [versus(group, groups[0]) for group in groups]
    if as_json:
        echo_json(
            [{**group.describe(), "against": told} for group, told in zip(groups, against, strict=True)], indent=1
        )
        return
    table = Table(box=None, pad_edge=False)
    for column in COLUMNS:
        table.add_column(column, no_wrap=True)
    for group in groups:
        table.add_row(*group.cells())
    print_cut(table)
    for told in filter(None, against):
        echo(sentence(told))
    if output is not None:
        echo(f"written: {output}")


def _chosen(client: Client, patterns: Sequence[str]) -> list[str]:
    """The names of the matching runs, in the order of the patterns. Raises UsageError, ApiError."""
    known: list[str] | None = None
    chosen: list[str] = []
    for pattern in patterns:
        if not any(sign in pattern for sign in "*?["):
            chosen.append(pattern)
            continue
        known = _all_runs(client) if known is None else known
        fitting = [name for name in known if fnmatchcase(name, pattern)]
        if not fitting:
            raise UsageError(f"no run matches {pattern}; `muster list` shows the jobs, `muster show JOB` a job's run")
        chosen += fitting
    different = list(dict.fromkeys(chosen))
    if len(different) < 2:
        raise UsageError(f"{' '.join(patterns)}: that is one run, {different[0]}; name two or more to compare")
    return different


def _all_runs(client: Client) -> list[str]:
    names: list[str] = []
    while page := client.get("/api/runs", after=names[-1] if names else None):
        names += [run["run"] for run in page]
    return names


def _facts(client: Client, name: str) -> ComparedRun:
    """The data of a run to compare. Raises ApiError if it does not exist."""
    described = client.get(f"/api/runs/{named(name)}")
    records: list[dict[str, Any]] = []
    while page := client.get(f"/api/runs/{named(name)}/metrics", after=records[-1]["iteration"] if records else 0):
        records += page
    checkpoints = client.get(f"/api/runs/{named(name)}/checkpoints")
    return facts_of(described, records, checkpoints, client.get(f"/api/runs/{named(name)}/evaluations"))


def _check_output(output: Path | None) -> None:
    """Refuse an output that can't be written before the first request. Raises UsageError."""
    if output is None:
        return
    if output.suffix not in ENDINGS:
        raise UsageError(f"-o {output}: unknown ending; use {', '.join(ENDINGS)}")
    if not output.parent.is_dir():
        raise UsageError(f"-o {output}: {output.parent} is not a directory")


def _draw(groups: Sequence[RunGroup], output: Path) -> None:
    """Raises UsageError."""
    try:
        draw(groups, output)
    except ImportError:
        raise UsageError(
            f"-o {output}: a picture needs matplotlib, which this environment lacks: pip install 'muster[plot]'; "
            ".csv needs nothing"
        ) from None
    except (OSError, ValueError) as error:
        raise UsageError(f"-o {output}: {getattr(error, 'strerror', None) or error}") from None
