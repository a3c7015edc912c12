"""Continuing runs: ``muster resume`` and ``muster clone``."""

from __future__ import annotations

import os
from typing import Annotated, Any

import typer

from orchestrator.cli import command_options as options
from orchestrator.cli.controllers import found_or_own, see_through
from orchestrator.cli.progress import await_end, follow
from orchestrator.cli.runs import chosen
from orchestrator.cli.submitting import changes_of_run, queue_change, report, show_plan
from orchestrator.cli.terminal import echo, echo_json
from orchestrator.client import Client, named

_CLONES = """Examples:  muster clone ant-1f2e3d4c@best --name ant-fast --set train.config.rewards.forward=2.0 -f
muster clone ant-1f2e3d4c@300 --name ant-long --set train.iterations=900 --nodes 2 --dry-run"""
_RESUMES = """Examples:  muster resume ant-1f2e3d4c --set train.iterations=600 -f
muster resume ant-1f2e3d4c@200 --nodes 2 --dry-run"""


def register(app: typer.Typer) -> None:
    app.command(epilog=_RESUMES)(resume)
    app.command(epilog=_CLONES)(clone)


def resume(
    source: options.CheckpointArgument,
    nodes: options.NodesOption = None,
    set_: options.SetOption = None,
    accept_changed_robot: options.AcceptOption = False,
    queue: options.QueueOption = None,
    engine: options.EngineOption = None,
    store: options.StoreOption = None,
    cpus: options.CpusOption = None,
    follow_: options.FollowOption = False,
    dry_run: options.DryRunOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Resume a run from its newest checkpoint, at the next iteration.

    Where no controller is running, this command is one until the job ends, as `muster run` is: it shows the progress, and Ctrl-C stops the
    job after a checkpoint. --store and --cpus are for this case.
    """
    run, reference = options.split_reference(source)
    with found_or_own(store, cpus, [engine] if engine else ()) as (client, is_own):
        body = _body(client, run, set_, queue, engine, nodes, dry_run)
        if accept_changed_robot:
            body["set"].append("train.accept_changed_robot=true")
        checkpoint = None if reference is None else chosen(client, run, reference)["iteration"]
        resumed = client.post(f"/api/runs/{named(run)}/resume", {**body, "checkpoint": checkpoint}, once=not dry_run)
        if dry_run:
            show_plan(client, resumed["definition"], resumed["queue"], as_json)
            return
        at = f" from iteration {resumed['iteration']}" if resumed["kind"] == "train" else ""
        line = f"resumed {resumed['run']}{at} as job {resumed['jobId']}"
        if not is_own:
            report(client, resumed, line, follow_, as_json)
            return
        if as_json:
            echo_json(resumed)
        else:
            echo(line)
        echo("no other controller is running: this command is the controller until the job ends", err=True)
        code = see_through(client, resumed["jobId"], await_end if as_json else follow)
    raise typer.Exit(code)


def clone(
    source: options.CheckpointArgument,
    name: Annotated[str, typer.Option("--name", metavar="NAME", help="Name of the new run and of its job.")],
    set_: options.SetOption = None,
    nodes: options.NodesOption = None,
    queue: options.QueueOption = None,
    engine: options.EngineOption = None,
    follow_: options.FollowOption = False,
    dry_run: options.DryRunOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Start a new run from only the weights of a checkpoint.

    Networks and normalisers are copied. The optimizer, the learning rate, the worlds and the curriculum start over at iteration 0, with
    the settings of RUN and the changes of --set: other rewards, another configuration of the task, another seed.
    """
    run, checkpoint = options.split_reference(source)
    with Client.connect() as client:
        body = {**_body(client, run, set_, queue, engine, nodes, dry_run), "name": name, "checkpoint": checkpoint}
        cloned = client.post(f"/api/runs/{named(run)}/clone", body, seconds=300, once=not dry_run)
        if dry_run:
            show_plan(client, cloned["definition"], cloned["queue"], as_json)
            return
        parent = cloned["parent"]
        line = f"cloned {parent['run']}@{parent['iteration']} as run {cloned['run']}, job {cloned['jobId']}"
        report(client, cloned, line, follow_, as_json)


def _body(
    client: Client,
    run: str,
    changes: list[str] | None,
    queue: str | None,
    engine: str | None,
    nodes: int | None,
    dry_run: bool,
) -> dict[str, Any]:
    """The request for a job that continues or clones a run."""
    elsewhere = queue_change(client, changes, queue, engine)
    keep = (lambda text: None) if dry_run else client.keep_text
    return {
        "nodes": nodes,
        "set": [*changes_of_run(client, run, changes, keep), *elsewhere],
        "directory": os.getcwd(),
        "dry_run": dry_run,
    }
