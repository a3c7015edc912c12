"""``muster list``."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from orchestrator.cli.jobs import JsonOption
from orchestrator.cli.show import COLOURS, took, when
from orchestrator.cli.terminal import echo, echo_json, one_line, print_cut
from orchestrator.client import Client
from orchestrator.spec.evaluations import AUTOMATIC_TAG
from shared_store.wording import counted

_NEWEST = 20
_AT_ONCE = 100
"""Greatest number of jobs in a DescribeJobs request."""
_AUTOMATIC = "automaticEvaluation"
"""Key of a summary for the subject of an automatic evaluation, ``RUN@ITERATION``."""


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
        queues = [queue] if queue else client.get("/api/capacity")["queues"]
        summaries = [summary for name in queues for summary in _list_queue(client, name, all_, not as_json)]
    summaries.sort(key=lambda summary: -summary["createdAt"])
    if as_json:
        echo_json(summaries if all_ else summaries[:_NEWEST], indent=1)
        return
    if not summaries:
        echo("no jobs yet; start one with: muster submit job_specs/cartpole.yaml")
        return
    shown = summaries if all_ else [each for each in summaries if _AUTOMATIC not in each][:_NEWEST]
    if shown:
        print_cut(_table(shown))
    last = shown[-1]["createdAt"] if len(shown) == _NEWEST else 0
    hidden = 0 if all_ else sum(_AUTOMATIC in each and each["createdAt"] >= last for each in summaries)
    if hidden:
        what = counted(hidden, "automatic evaluation")
        echo(f"{what} {'is' if hidden == 1 else 'are'} not shown; --all shows {'it' if hidden == 1 else 'them'}")


def _table(summaries: list[dict[str, Any]]) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in ("JOB", "NAME", "STATUS", "NODES", "CREATED", "TOOK"):
        table.add_column(column, no_wrap=True)
    table.add_column("REASON", no_wrap=True, overflow="ellipsis")
    for summary in summaries:
        colour = COLOURS.get(summary["status"], "white")
        evaluates = f"evaluates {summary[_AUTOMATIC]}" if _AUTOMATIC in summary else ""
        reason = summary.get("statusReason", "") if summary["status"] != "SUCCEEDED" else ""
        table.add_row(
            *(summary["jobId"][:8], summary["jobName"], f"[{colour}]{summary['status']}[/]", _nodes(summary)),
            *(when(summary["createdAt"]), took(summary.get("startedAt"), summary.get("stoppedAt"))),
            # a compiler's message has several lines, and brackets that are not markup
            escape(one_line("; ".join(filter(None, (evaluates, reason))))),
        )
    return table


def _list_queue(client: Client, queue: str, all_: bool, folded: bool) -> list[dict[str, Any]]:
    """The newest 20 jobs of a queue, or all; ``folded``: the newest 20 except automatic evaluations, and the evaluations in between."""
    summaries: list[dict[str, Any]] = []
    more: dict[str, str] = {}
    while True:
        # a filter, because a listing by status shows one status at a time
        everything = [{"name": "AFTER_CREATED_AT", "values": ["0"]}]
        page = client.batch("ListJobs", jobQueue=queue, filters=everything, **more)
        summaries += _with_origins(client, page["jobSummaryList"])
        there = sum(not (folded and _AUTOMATIC in summary) for summary in summaries)
        if not page.get("nextToken") or (not all_ and there >= _NEWEST):
            return summaries
        more = {"nextToken": page["nextToken"]}


def _with_origins(client: Client, summaries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The summaries, with the subjects of automatic evaluations from their tags, which a listing lacks."""
    named = [each["jobId"] for each in summaries if each["jobName"].startswith("evaluate-")]
    found: dict[str, str] = {}
    for start in range(0, len(named), _AT_ONCE):
        for job in client.batch("DescribeJobs", jobs=named[start : start + _AT_ONCE])["jobs"]:
            if told := job.get("tags", {}).get(AUTOMATIC_TAG):
                found[job["jobId"]] = told
    return [{**each, _AUTOMATIC: found[each["jobId"]]} if each["jobId"] in found else each for each in summaries]


def _nodes(summary: dict[str, Any]) -> str:
    if size := summary.get("arrayProperties", {}).get("size"):
        return f"1 × {size}"
    return str(summary.get("nodeProperties", {}).get("numNodes", 1))
