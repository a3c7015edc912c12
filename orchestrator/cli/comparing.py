"""``muster compare``."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.cli.command_options import JsonOption, OverwriteOption
from orchestrator.cli.comparison.curves import ENDINGS, draw
from orchestrator.cli.listings import Resource
from orchestrator.cli.outputs import check_output
from orchestrator.cli.runs import all_runs
from orchestrator.cli.terminal import echo, echo_json
from orchestrator.client import Client, named
from orchestrator.domain.errors import UsageError
from shared_store.volume.comparison import COLUMNS, ComparedRun, RunGroup, facts_of, grouped, sentence, versus


def register(app: typer.Typer) -> None:
    app.command(epilog="Example:  muster compare 'ant-fast-*' ant-1f2e3d4c -o compare.png")(compare)


def compare(
    runs: Annotated[
        list[str],
        typer.Argument(metavar="RUN", help="Runs, or patterns in quotes such as 'ant-*'; at least two runs in all."),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help=f"Draw the return over the steps into this file: {', '.join(ENDINGS)}."),
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compare runs, or groups of runs that differ only in their seed.

    With -o, draw their curves. For a group, the table shows the mean over its runs ± their standard deviation. EVALUATED is the return of
    each run's best checkpoint in its evaluations (its last checkpoint has one), for a single run with a 95 % interval. Single runs that
    `muster evaluate` evaluated on the same episodes (the same --seed) are compared with the first one episode by episode.
    """
    if output is not None:
        check_output(output, overwrite, *ENDINGS)
    with Client.connect() as client:
        names = _chosen(client, runs)
        groups = grouped([_facts(client, name) for name in names])
    if output is not None:
        _draw(groups, output)
    against = [versus(group, groups[0]) for group in groups]
    if as_json:
        compared = zip(groups, against, strict=True)
        echo_json([{**group.describe(), "against": difference} for group, difference in compared], indent=1)
        return
    Resource({name: name for name in COLUMNS}).show(
        [dict(zip(COLUMNS, group.cells(), strict=True)) for group in groups]
    )
    for difference in filter(None, against):
        echo(sentence(difference))
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
        known = [run["run"] for run in all_runs(client)] if known is None else known
        fitting = [name for name in known if fnmatchcase(name, pattern)]
        if not fitting:
            raise UsageError(f"no run matches {pattern}; `muster runs` lists them")
        chosen += fitting
    different = list(dict.fromkeys(chosen))
    if len(different) < 2:
        raise UsageError(f"{' '.join(patterns)}: that is one run, {different[0]}; name two or more to compare")
    return different


def _facts(client: Client, name: str) -> ComparedRun:
    """The data of a run to compare. Raises ApiError if it does not exist."""
    described = client.get(f"/api/runs/{named(name)}")
    records: list[dict[str, Any]] = []
    while page := client.get(f"/api/runs/{named(name)}/metrics", after=records[-1]["iteration"] if records else 0):
        records += page
    checkpoints = client.get(f"/api/runs/{named(name)}/checkpoints")
    return facts_of(described, records, checkpoints, client.get(f"/api/runs/{named(name)}/evaluations"))


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
