"""``muster runs``: the runs of the store."""

from __future__ import annotations

import sys
import time
from typing import Annotated, Any

import typer
from rich.table import Table

from orchestrator.cli.jobs import JsonOption
from orchestrator.cli.misuse import make_group
from orchestrator.cli.terminal import echo, echo_json, print_cut
from orchestrator.client import Client, named
from orchestrator.domain.errors import UsageError
from shared_store.contract.error_text import counted

RunArgument = Annotated[str, typer.Argument(help="A run; `muster runs list` prints the names.")]
_A_PAGE = 100


def register(app: typer.Typer) -> None:
    group = make_group(
        "List, archive and delete the runs of the store.\n\nOld runs that hold nothing but logs go by themselves, as `muster gc --help` says.",
        "Examples:  muster runs list --search ant   then   muster runs archive ant-1f2e3d4c",
    )
    group.command("list", epilog="Example:  muster runs list --search ant")(list_runs)
    group.command(epilog="Examples:  muster runs archive ant-1f2e3d4c   and   muster runs archive ant-1f2e3d4c --undo")(
        archive
    )
    group.command(epilog="Example:  muster runs delete ant-1f2e3d4c --yes")(delete)
    app.add_typer(group, name="runs")


def list_runs(
    search: Annotated[str, typer.Option(help="Part of the name.", show_default=False)] = "",
    archived: Annotated[bool, typer.Option("--archived", help="The archived runs, in place of the others.")] = False,
    as_json: JsonOption = False,
) -> None:
    """List the runs that you may see, by name."""
    found: list[dict[str, Any]] = []
    with Client.connect() as client:
        page = found
        while page is found or len(page) == _A_PAGE:
            after = found[-1]["run"] if found else ""
            query: dict[str, Any] = {
                "after": after,
                "search": search,
                "max": _A_PAGE,
                "archived": str(archived).lower(),
            }
            page = client.get("/api/runs", **query, seconds=610)
            found = [*found, *page]
    if as_json:
        echo_json(found, indent=1)
        return
    if not found:
        echo(
            "no run is archived" if archived else "no run; `muster runs list --archived` shows those that are archived"
        )
        return
    table = Table(box=None, pad_edge=False)
    for column in ("RUN", "CHECKPOINTS", "ITERATION", "JOBS", "OWNER", "QUEUE", "CREATED"):
        table.add_column(column, no_wrap=True)
    for each in found:
        table.add_row(*_cells(each))
    print_cut(table)


def _cells(run: dict[str, Any]) -> list[str]:
    if problem := run.get("problem"):
        return [run["run"], f"can't be read: {problem}"]
    created = run.get("created")
    when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(created / 1000)) if created else "-"
    counts = str(run["checkpoints"]), str(run["iteration"]), str(len(run["jobs"]))
    return [run["run"], *counts, run["owner"] or "-", run["queue"] or "-", when]


def archive(
    run: RunArgument,
    undo: Annotated[bool, typer.Option("--undo", help="Take the run out of the archive.")] = False,
) -> None:
    """Archive a run: it is kept, with its jobs and logs, until it is taken out again.

    Nothing is added to it meanwhile (no job continues or evaluates it), and `muster runs list` shows it with --archived only. Its weights
    can be cloned and imitated as before.
    """
    with Client.connect() as client:
        client.post(f"/api/runs/{named(run)}/archive", {"archived": not undo})
    echo(f"run {run} is {'no longer archived' if undo else 'archived: it is neither taken nor deleted'}")


def delete(
    run: RunArgument,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Delete a run with its checkpoints, logs and results, for good.

    It is refused while something needs the run: an unfinished job, a clone, a pupil, a model, or what a plug-in keeps, such as an entry of
    a league. The jobs of the run stay in the history.
    """
    with Client.connect() as client:
        if not yes:
            _confirm(client, run)
        deleted = client.delete(f"/api/runs/{named(run)}", seconds=610)
    if as_json:
        echo_json(deleted)
    else:
        echo(f"deleted run {run}: {counted(deleted['files'], 'file')}, {deleted['bytes'] / 2**20:.1f} MiB")
        if left := deleted["left"]:
            echo(f"not all of them can be removed; remove the rest by hand: {left}")


def _confirm(client: Client, run: str) -> None:
    """Raises typer.Abort where the user does not want it, UsageError where nobody can be asked."""
    if not sys.stdin.isatty():
        raise UsageError(f"run {run} is not deleted: give --yes where nobody can be asked")
    found = client.get(f"/api/runs/{named(run)}")
    what = f"{counted(found['checkpoints'], 'checkpoint')} and everything else in it"
    typer.confirm(f"delete run {run} with {what} for good?", abort=True)
