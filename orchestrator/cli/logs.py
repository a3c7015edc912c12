"""``muster logs``."""

from __future__ import annotations

import re
import sys
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any

import typer

from orchestrator.cli.command_options import JobArgument, JsonOption, SinceOption, seconds_since
from orchestrator.cli.progress import log_lines
from orchestrator.cli.terminal import echo, echo_raw, to_json, visible
from orchestrator.client import Client, named
from orchestrator.domain import reasons
from orchestrator.domain.errors import SpecError, UsageError
from shared_store.contract.error_text import counted

_COLOURS = (36, 33, 35, 32, 34, 31)
"""ANSI colours of the node prefixes, by node index."""


def register(app: typer.Typer) -> None:
    app.command(epilog="Examples:  muster logs ant -f    muster logs ant --node 1 --since 10m --grep 'reward|Error'")(
        logs
    )


def logs(
    job: JobArgument,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Follow the log until the job ends.")] = False,
    node: Annotated[int | None, typer.Option(min=0, help="Only this node.")] = None,
    rank: Annotated[int | None, typer.Option(min=0, help="Only this rank.")] = None,
    attempt: Annotated[int | None, typer.Option(min=1, help="Only this attempt.")] = None,
    since: SinceOption = None,
    grep: Annotated[
        str | None, typer.Option(metavar="REGEX", help="Print only lines that match this regular expression.")
    ] = None,
    raw: Annotated[
        bool,
        typer.Option("--raw", help="Print lines unchanged; by default only colours stay, and other escapes are shown."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Print a job's log, all nodes and attempts merged by time."""
    age = seconds_since(since)
    oldest = "" if age is None else (datetime.now(UTC) - timedelta(seconds=age)).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    try:
        pattern = re.compile(grep or "")
    except re.error as error:
        raise SpecError(f"--grep {grep}: not a regular expression ({error})") from None
    colour, is_empty = sys.stdout.isatty(), True
    with Client.connect() as client:
        if node:
            _check_node(client, job, node)
        batches = log_lines(client, job, follow=follow, node=node, rank=rank, attempt=attempt)
        hint = _children_hint(client, job) if follow else ""
        if hint:
            echo(hint, err=True)
        for lines in batches:
            is_empty = False
            shown = [
                to_json(line) if as_json else _format(line, colour, raw)
                for line in lines
                if line["time"] >= oldest and pattern.search(line["text"])
            ]
            if shown:
                echo_raw("\n".join(shown))
        if is_empty:
            options = {"node": node, "rank": rank, "attempt": attempt}
            part = ", ".join(f"{name} {value}" for name, value in options.items() if value is not None)
            reason = _why_empty(client, job, part)
            if reason != hint:
                echo(reason, err=True)


def _check_node(client: Client, job: str, node: int) -> None:
    """Raises UsageError where the job has no such node, ApiError, Unreachable."""
    detail = client.get(f"/api/jobs/{named(job)}", store=False)
    nodes = max([1, int(detail["nodes"]), *(len(attempt["nodes"]) for attempt in detail["attempts"])])
    if node >= nodes:
        raise UsageError(f"--node {node}: job {job} has {counted(nodes, 'node')}, numbered from 0")


def _why_empty(client: Client, job: str, part: str) -> str:
    """Why a job has no lines, of a ``part`` such as ``node 1``. Raises ApiError, Unreachable."""
    if hint := _children_hint(client, job):
        return hint
    detail = client.get(f"/api/jobs/{named(job)}")
    if detail["runIsGone"]:
        return f"run {detail['run']} was deleted, and the log of job {job} with it"
    selected = f" of {part}" if part else ""
    return f"job {job} has no log lines{selected}; muster show {job} has its attempts and nodes"


def _children_hint(client: Client, job: str) -> str:
    """Where the log of an array is: with its first child that failed, else with child 0; empty for other jobs. Raises ApiError, Unreachable."""
    found = client.get(f"/api/jobs/{named(job)}", store=False)
    if found["children"] is None:
        return ""
    child = next((each["index"] for each in found["children"] if each["status"] == "FAILED"), 0)
    title = reasons.named(found["name"], found["id"])
    return f"{title} is an array, whose children have the logs, such as: muster logs {job}:{child}"


def _format(line: dict[str, Any], colour: bool, raw: bool) -> str:
    origin = "node" if line["rank"] is None else f"rank {line['rank']}"
    prefix = f"[{line['time'][11:23]} {line['attempt']}.{line['node']} {origin}]"
    if colour:
        prefix = f"\033[{_COLOURS[line['node'] % len(_COLOURS)]}m{prefix}\033[0m"
    return f"{prefix} {line['text'] if raw else visible(line['text'], colours=True)}"
