"""``muster gc``: what retention would delete, and deletes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any

import typer

from orchestrator.cli.command_options import JsonOption
from orchestrator.cli.listings import Resource, mebibytes
from orchestrator.cli.terminal import echo, echo_json
from orchestrator.client import Client
from shared_store.contract.error_text import counted

_PATIENCE = 610.0
"""Seconds for a part of a pass: the controller's own limit, and some."""
GONE = Resource(
    {
        "RUN": "run",
        "JOBS": lambda each: len(each["jobs"]),
        "WHAT GOES": lambda each: "the run" if each["whole"] else "logs" if each["files"] else "history",
        "FILES": "files",
        "SIZE": lambda each: mebibytes(each["bytes"], 2),
    }
)


def register(app: typer.Typer) -> None:
    app.command(epilog="Examples:  muster gc --dry-run   then   muster gc --older-than 30d")(gc)


def gc(
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", help="Delete nothing: print what would go, how much, and why other old runs are kept."
        ),
    ] = False,
    older_than: Annotated[
        str | None,
        typer.Option(
            metavar="DURATION",
            help="Delete what ended longer ago, such as 30d, in queues without a rule. By default: as `muster serve --retention` says.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Delete old jobs, their logs and their runs, where nothing needs them.

    A job goes by the rule of its queue (tag muster:retention, such as 30d), else by `muster serve --retention`; of queues without a rule
    only jobs of the Batch API go, 90 days after their end. Never deleted: runs with checkpoints or any other results, parents of clones,
    teachers, runs of models and of what plug-ins keep, runs that an unfinished job uses, and archived runs (`muster runs archive`). Your
    key deletes what is yours; a key with all queues deletes everything.
    """
    with Client.connect() as client:
        found = [each for part in _parts(client, dry_run, older_than or "") for each in part]
    gone, kept = [each for each in found if each["jobs"]], [each for each in found if each["kept"]]
    jobs, runs = sum(len(each["jobs"]) for each in gone), sum(each["whole"] for each in gone)
    size, files = sum(each["bytes"] for each in gone), sum(each["files"] for each in gone)
    if as_json:
        counts = {"jobs": jobs, "runs": runs, "files": files, "bytes": size, "kept": len(kept)}
        echo_json({"taken": not dry_run, "counts": counts, "runs": found}, indent=1)
        return
    if dry_run and gone:
        GONE.show(gone)
    for reasons, runs_kept in _by_reasons(kept).items():
        echo(f"kept: {'run' if len(runs_kept) == 1 else 'runs'} {', '.join(runs_kept)}: {reasons}")
    what = f"{counted(jobs, 'job')} and {counted(runs, 'run')}: {counted(files, 'file')}, {mebibytes(size)}"
    echo(f"would delete {what}" if dry_run else f"deleted {what}")
    if not found:
        echo("no job of yours is old enough by the rule of its queue; `muster gc --help` says which rules there are")


def _parts(client: Client, dry_run: bool, older_than: str) -> Iterator[list[dict[str, Any]]]:
    place: str | None = ""
    while place is not None:
        body = {"after": place, "older_than": older_than}
        part = (
            client.get("/api/gc", **body, seconds=_PATIENCE)
            if dry_run
            else client.post("/api/gc", body, seconds=_PATIENCE)
        )
        yield part["runs"]
        place = part["next"]


def _by_reasons(kept: list[dict[str, Any]]) -> dict[str, list[str]]:
    """The runs that are kept for the same reasons, by these."""
    found: dict[str, list[str]] = {}
    for each in kept:
        names = found.setdefault("; ".join(each["kept"]), [])
        names += [each["run"]] if each["run"] not in names else []
    return found
