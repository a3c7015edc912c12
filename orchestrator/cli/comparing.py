"""``muster compare``."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from orchestrator.cli.jobs import JsonOption
from orchestrator.cli.recordings import OverwriteOption, refuse_existing
from orchestrator.cli.terminal import echo, echo_json, print_cut
from orchestrator.client import Client, named
from orchestrator.compared import Group, RunFacts, grouped
from orchestrator.errors import UsageError

_PAGE = 10_000


def register(app: typer.Typer) -> None:
    app.command(epilog="Example:  muster compare 'ant-fast-*' ant-1f2e3d4c -o compare.png")(compare)


def compare(
    runs: Annotated[
        list[str],
        typer.Argument(metavar="RUN…", help="Runs, or patterns of them in quotes: 'ant-*'. Two or more in all."),
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Draw the return against the steps into this PNG file.")
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compare runs, or groups of runs that differ in their seed alone; draw their curves.

    A group has the mean over its runs ± their standard deviation. EVALUATED is the return of each run's best checkpoint in its
    evaluations (its last checkpoint has one); an interval of 95 % where the group is a single run.
    """
    if output is not None:
        refuse_existing(output, overwrite)
    with Client.connect() as client:
        names = _chosen(client, runs)
        groups = grouped([_facts(client, name) for name in names])
    if output is not None:
        _draw(groups, output)
    if as_json:
        echo_json([group.describe() for group in groups], indent=1)
        return
    table = Table(box=None, pad_edge=False)
    for column in ("RUNS", "SEEDS", "TASK", "ITERATION", "STEPS", "REWARD", "LENGTH", "EVALUATED", "SUCCESS"):
        table.add_column(column, no_wrap=True)
    for group in groups:
        table.add_row(*group.cells())
    print_cut(table)
    if output is not None:
        echo(f"drawn: {output}")


def _chosen(client: Client, patterns: Sequence[str]) -> list[str]:
    """The names of the runs that are meant, in the order of the patterns. Raises UsageError, ApiError."""
    known: list[str] | None = None
    chosen: list[str] = []
    for pattern in patterns:
        if not any(sign in pattern for sign in "*?["):
            chosen.append(pattern)
            continue
        known = _all_runs(client) if known is None else known
        fitting = [name for name in known if fnmatchcase(name, pattern)]
        if not fitting:
            raise UsageError(
                f"no run is called like {pattern}; `muster list` shows the jobs, `muster show JOB` a job's run"
            )
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


def _facts(client: Client, name: str) -> RunFacts:
    """What is compared of a run. Raises ApiError where it does not exist."""
    described = client.get(f"/api/runs/{named(name)}")
    records: list[dict[str, Any]] = []
    while page := client.get(f"/api/runs/{named(name)}/metrics", after=records[-1]["iteration"] if records else 0):
        records += page
    listed = client.get(f"/api/runs/{named(name)}/checkpoints")
    best = next((each for each in listed if each["best"] and each["evaluated"]), None)
    judged = best or next((each for each in reversed(listed) if each["evaluated"]), None)
    evaluations = client.get(f"/api/runs/{named(name)}/evaluations")
    called = judged["evaluated"]["name"] if judged else None
    evaluation = next((each for each in evaluations if each["name"] == called), None)
    return RunFacts(name, described["spec"] or {}, records, evaluation)


def _draw(groups: Sequence[Group], output: Path) -> None:
    """Raises UsageError."""
    if not output.parent.is_dir():
        raise UsageError(f"-o {output}: {output.parent} is no directory")
    try:
        from orchestrator.curves import draw
    except ImportError:
        raise UsageError("-o needs matplotlib, which this environment lacks: pip install 'muster[plot]'") from None
    try:
        draw(groups, output)
    except (OSError, ValueError) as error:
        raise UsageError(f"-o {output}: {getattr(error, 'strerror', None) or error}") from None
