"""``muster logs``."""

from __future__ import annotations

import os
import re
import sys
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any

import typer

from orchestrator.cli.jobs import JobArgument, JsonOption
from orchestrator.cli.progress import Waits
from orchestrator.cli.terminal import echo, echo_raw, to_json, visible
from orchestrator.client import Client, named
from orchestrator.domain import reasons
from orchestrator.domain.errors import SpecError

_COLOURS = (36, 33, 35, 32, 34, 31)
"""ANSI colours of the node prefixes, by node index."""


def register(app: typer.Typer) -> None:
    app.command(epilog="Examples:  muster logs ant -f    muster logs ant --node 1 --since 10m --grep 'reward|Error'")(
        logs
    )


def logs(
    job: JobArgument,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Follow the log until the job ends.")] = False,
    node: Annotated[int | None, typer.Option(help="Only this node.")] = None,
    rank: Annotated[int | None, typer.Option(help="Only this rank.")] = None,
    attempt: Annotated[int | None, typer.Option(help="Only this attempt.")] = None,
    since: Annotated[str | None, typer.Option(help="Print only lines newer than this: 90s, 10m, 2h or 1d.")] = None,
    grep: Annotated[str | None, typer.Option(help="Print only lines that match this regular expression.")] = None,
    raw: Annotated[
        bool,
        typer.Option("--raw", help="Print lines unchanged; by default only colours stay, and other escapes are shown."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Print a job's log, all nodes and attempts merged by time."""
    oldest = _oldest(since)
    try:
        pattern = re.compile(grep) if grep else None
    except re.error as error:
        raise SpecError(f"--grep {grep}: not a regular expression ({error})") from None
    colour = sys.stdout.isatty()
    came = False
    with Client.connect() as client:
        client.notify = lambda line: echo(line, err=True)
        waits = Waits(client, job)
        waits.tell()
        hint = _of_children(client, job) if follow else ""
        if hint:
            echo(hint, err=True)
        for lines in client.log_batches(job, follow=follow, node=node, rank=rank, attempt=attempt):
            if not lines:
                waits.tell()
                continue
            came = True
            shown = [
                to_json(line) if as_json else _format(line, colour, raw)
                for line in lines
                if not (oldest and line["time"] < oldest) and (not pattern or pattern.search(line["text"]))
            ]
            if shown and not _printed("\n".join(shown)):
                return
        if not came and (found := _of_children(client, job)):
            if found != hint:
                echo(found, err=True)
            return
        if not came and (detail := client.get(f"/api/jobs/{named(job)}"))["runIsGone"]:
            echo(f"run {detail['run']} was deleted, and the log of job {job} with it", err=True)
            return
    if not came:
        asked = {"node": node, "rank": rank, "attempt": attempt}
        of = ", ".join(f"{name} {value}" for name, value in asked.items() if value is not None)
        echo(
            f"job {job} has no log lines{f' of {of}' if of else ''}; muster show {job} has its attempts and nodes",
            err=True,
        )


def _of_children(client: Client, job: str) -> str:
    """Where the log of an array is: with its first child that failed, else with child 0; empty for other jobs. Raises ApiError, Unreachable."""
    found = client.get(f"/api/jobs/{named(job)}", store=False)
    if found["children"] is None:
        return ""
    child = next((each["index"] for each in found["children"] if each["status"] == "FAILED"), 0)
    who = reasons.named(found["name"], found["id"])
    return f"{who} is an array, whose children have the logs, such as: muster logs {job}:{child}"


def _printed(text: str) -> bool:
    """Print a line; False if the reader closed the pipe (``muster logs … | head``)."""
    try:
        echo_raw(text)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # discard buffered output
        return False
    return True


def _format(line: dict[str, Any], colour: bool, raw: bool) -> str:
    who = "node" if line["rank"] is None else f"rank {line['rank']}"
    prefix = f"[{line['time'][11:23]} {line['attempt']}.{line['node']} {who}]"
    if colour:
        prefix = f"\033[{_COLOURS[line['node'] % len(_COLOURS)]}m{prefix}\033[0m"
    return f"{prefix} {line['text'] if raw else visible(line['text'], colours=True)}"


def _oldest(since: str | None) -> str | None:
    if since is None:
        return None
    match = re.fullmatch(r"(\d+)([smhd])", since)
    if not match:
        raise SpecError(f"--since {since}: expected a duration such as 90s, 10m, 2h or 1d")
    seconds = int(match[1]) * {"s": 1, "m": 60, "h": 3600, "d": 86400}[match[2]]
    return (datetime.now(UTC) - timedelta(seconds=seconds)).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
