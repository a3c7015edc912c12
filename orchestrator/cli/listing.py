"""``muster list``."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from orchestrator.cli.jobs import JsonOption, owner_of
from orchestrator.cli.show import COLOURS, took, when
from orchestrator.cli.terminal import echo, echo_json, one_line, print_cut
from orchestrator.client import Client
from shared_store.contract.error_text import counted

_NEWEST = 20
_AT_ONCE = 100
"""Greatest number of jobs in an answer."""
_AUTOMATIC = "automaticEvaluation"
"""Key of a job for the subject of an automatic evaluation, ``RUN@ITERATION``."""


def register(app: typer.Typer) -> None:
    app.command("list", epilog="Examples:  muster list --all     muster list --json | jq '.[].jobId'")(list_jobs)


def list_jobs(
    all_: Annotated[
        bool, typer.Option("--all", "-a", help="List all jobs, not just the newest 20 without automatic evaluations.")
    ] = False,
    queue: Annotated[str | None, typer.Option(help="List only this queue's jobs.")] = None,
    as_json: JsonOption = False,
) -> None:
    """List jobs, the newest first.

    Evaluations that a controller submits beside a training are only counted; --all and --json list them.
    """
    with Client.connect() as client:
        jobs = _newest(client, queue, all_, automatic=as_json)
    if as_json:
        echo_json(jobs if all_ else jobs[:_NEWEST], indent=1)
        return
    if not jobs:
        echo("no jobs yet; start one with: muster submit job_specs/cartpole.yaml")
        return
    shown = jobs if all_ else [each for each in jobs if not each[_AUTOMATIC]][:_NEWEST]
    if shown:
        print_cut(_table(shown))
    last = shown[-1]["createdAt"] if len(shown) == _NEWEST else 0
    hidden = 0 if all_ else sum(bool(each[_AUTOMATIC]) and each["createdAt"] >= last for each in jobs)
    if hidden:
        what = counted(hidden, "automatic evaluation")
        echo(f"{what} {'is' if hidden == 1 else 'are'} not shown; --all shows {'it' if hidden == 1 else 'them'}")


def _newest(client: Client, queue: str | None, all_: bool, automatic: bool) -> list[dict[str, Any]]:
    """The newest jobs, at least 20 if there are so many, or all. Unless ``automatic``, automatic evaluations do not count."""
    found: list[dict[str, Any]] = []
    after = ""
    while True:
        page = client.get("/api/jobs", queue=queue, after=after, max=_AT_ONCE, progress=False)
        # the ids and names as the AWS Batch API has them, too: scripts use both
        found += [{"jobId": each["id"], "jobName": each["name"], **each} for each in page["jobs"]]
        if (after := page["next"]) is None:
            return found
        if not all_ and sum(automatic or not each[_AUTOMATIC] for each in found) >= _NEWEST:
            return found


def _table(jobs: list[dict[str, Any]]) -> Table:
    table = Table(box=None, pad_edge=False)
    owners = ("OWNER",) if any(map(owner_of, jobs)) else ()
    for column in ("JOB", "NAME", *owners, "STATUS", "NODES", "CREATED", "TOOK"):
        table.add_column(column, no_wrap=True)
    table.add_column("REASON", no_wrap=True, overflow="ellipsis")
    for job in jobs:
        colour = COLOURS.get(job["status"], "white")
        evaluates = f"evaluates {job[_AUTOMATIC]}" if job[_AUTOMATIC] else ""
        reason = job["statusReason"] or "" if job["status"] != "SUCCEEDED" else ""
        nodes = f"1 × {job['arraySize']}" if job["arraySize"] else str(job["nodes"])
        table.add_row(
            *(job["id"][:8], job["name"], *((job["owner"] or "").removeprefix("key ") for _ in owners)),
            *(f"[{colour}]{job['status']}[/]", nodes),
            *(when(job["createdAt"]), took(job["ranSeconds"])),
            # a compiler's message has several lines, and brackets that are not markup
            escape(one_line("; ".join(filter(None, (evaluates, reason))))),
        )
    return table
