"""``muster clone``."""

from __future__ import annotations

import os
from functools import partial
from typing import Annotated

import typer

from orchestrator.cli.jobs import JsonOption, SetOption, engine_queue, on_queue, store_of, tell_note
from orchestrator.cli.plans import show_plan
from orchestrator.cli.progress import follow
from orchestrator.cli.terminal import echo, echo_json
from orchestrator.client import Client, named
from orchestrator.domain.errors import UsageError
from orchestrator.spec.kept_files import changes_with_files

_EXAMPLES = """Examples:  muster clone ant-1f2e3d4c@best --name ant-fast --set train.config.rewards.forward=2.0 -f
muster clone ant-1f2e3d4c@300 --name ant-long --set train.iterations=900 --nodes 2 --dry-run"""


def register(app: typer.Typer) -> None:
    app.command(epilog=_EXAMPLES)(clone)


def clone(
    source: Annotated[
        str,
        typer.Argument(
            metavar="RUN[@ITERATION|@best|@latest]",
            help="The source of the weights: a run's newest checkpoint, or that of an iteration, or the best one.",
        ),
    ],
    name: Annotated[str, typer.Option(help="Name of the new run and of its job.")],
    set_: SetOption = None,
    nodes: Annotated[int | None, typer.Option(min=1, help="Number of nodes, if it should change.")] = None,
    queue: Annotated[str | None, typer.Option(help="Another queue.")] = None,
    engine: Annotated[str | None, typer.Option(help="Engine that runs the job, one of the controller's.")] = None,
    follow_: Annotated[bool, typer.Option("--follow", "-f", help="Show progress until the job ends.")] = False,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", help="Check it and show what would start where; --json: with all variables. Nothing starts."
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Start a new run from only the weights of a checkpoint.

    Networks and normalisers are copied. The optimizer, the learning rate, the worlds and the curriculum start over at iteration 0, with
    the settings of RUN and the changes of --set: other rewards, another configuration of the task, another seed.
    """
    run, checkpoint = split_reference(source)
    if queue is not None and engine is not None:
        raise UsageError("--queue and --engine: an engine is chosen by its queue; leave one of them out")
    with Client.connect() as client:
        elsewhere = queue if engine is None else engine_queue(client, engine)
        body = {
            "name": name,
            "checkpoint": checkpoint,
            "nodes": nodes,
            "set": [
                *changes_with_files(
                    lambda: client.get(f"/api/runs/{named(run)}")["spec"],
                    set_,
                    (lambda text: None) if dry_run else client.keep_text,
                    partial(store_of, client),
                    tell_note,
                    partial(client.run_text, run),
                ),
                *on_queue(set_, elsewhere),
            ],
            "directory": os.getcwd(),
            "dry_run": dry_run,
        }
        cloned = client.post(f"/api/runs/{named(run)}/clone", body, seconds=300, once=True)
        if dry_run:
            show_plan(client, cloned["definition"], cloned["queue"], as_json)
            return
        if as_json:
            echo_json(cloned)
        else:
            parent = cloned["parent"]
            echo(f"cloned {parent['run']}@{parent['iteration']} as run {cloned['run']}, job {cloned['jobId']}")
            if not follow_:
                echo(f"follow it with: muster logs {cloned['jobId'][:8]} -f")
        if follow_:
            raise typer.Exit(follow(client, cloned["jobId"]))


def split_reference(text: str) -> tuple[str, int | str | None]:
    """Run and checkpoint of ``RUN``, ``RUN@ITERATION`` or ``RUN@best``. Raises UsageError."""
    run, sign, at = text.partition("@")
    if not sign:
        return run, None
    if at in ("best", "latest"):
        return run, at
    if at.isascii() and at.isdecimal() and len(at) < 10:
        return run, int(at)
    raise UsageError(
        f"{text}: expected an iteration, best or latest after @; `muster checkpoints {run}` lists the iterations"
    )
