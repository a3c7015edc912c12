"""Commands for runs: ``muster resume`` and ``muster checkpoints``."""

from __future__ import annotations

import os
import time
from functools import partial
from typing import Annotated, Any

import typer
from rich.table import Table

from orchestrator.cli.jobs import AcceptOption, JsonOption, SetOption, engine_queue, on_queue, store_of, tell_note
from orchestrator.cli.progress import await_end, follow
from orchestrator.cli.serving import CpusOption, StoreOption, found_or_own, see_through
from orchestrator.cli.show import scored
from orchestrator.cli.terminal import echo, echo_json, print_cut
from orchestrator.client import Client, named
from orchestrator.spec.kept_files import changes_with_files

RunArgument = Annotated[str, typer.Argument(help="A run; `muster show JOB` prints its name.")]


def register(app: typer.Typer) -> None:
    app.command(epilog="Example:  muster resume ant-1f2e3d4c --set train.iterations=600 -f")(resume)
    app.command(epilog="Example:  muster checkpoints ant-1f2e3d4c --verify")(checkpoints)


def resume(
    run: RunArgument,
    checkpoint: Annotated[int | None, typer.Option(help="Resume from this iteration instead of the newest.")] = None,
    nodes: Annotated[
        int | None, typer.Option(min=1, help="Number of nodes, if it should change; the worlds are resharded.")
    ] = None,
    set_: SetOption = None,
    accept_changed_robot: AcceptOption = False,
    engine: Annotated[str | None, typer.Option(help="Engine that runs the job, one of the controller's.")] = None,
    store: StoreOption = None,
    cpus: CpusOption = None,
    follow_: Annotated[bool, typer.Option("--follow", "-f", help="Show progress until the job ends.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Resume a run from its newest checkpoint, at the next iteration.

    Where no controller is running, this command is one until the job ends, as `muster run` is: it shows the progress, and Ctrl-C stops the
    job after a checkpoint. --store and --cpus are for this case.
    """
    with found_or_own(store, cpus, [engine] if engine else ()) as (client, is_own):
        elsewhere = on_queue(set_, None if engine is None else engine_queue(client, engine))
        accepted = ["train.accept_changed_robot=true"] if accept_changed_robot else []
        body = {
            "checkpoint": checkpoint,
            "nodes": nodes,
            "set": [
                *changes_with_files(
                    lambda: client.get(f"/api/runs/{named(run)}")["spec"],
                    set_,
                    client.keep_text,
                    partial(store_of, client),
                    tell_note,
                    partial(client.run_text, run),
                ),
                *elsewhere,
                *accepted,
            ],
            "directory": os.getcwd(),
        }
        resumed = client.post(f"/api/runs/{named(run)}/resume", body, once=True)
        if as_json:
            echo_json(resumed)
        else:
            at = f" from iteration {resumed['iteration']}" if resumed["kind"] == "train" else ""
            echo(f"resumed {resumed['run']}{at} as job {resumed['jobId']}")
            if not follow_ and not is_own:
                echo(f"follow it with: muster logs {resumed['jobId'][:8]} -f")
        code = None
        if is_own:
            echo("no other controller is running: this command is the controller until the job ends", err=True)
            code = see_through(client, resumed["jobId"], await_end if as_json else follow)
        elif follow_:
            code = (await_end if as_json else follow)(client, resumed["jobId"])
    if code is not None:
        raise typer.Exit(code)


def checkpoints(
    run: RunArgument,
    verify: Annotated[bool, typer.Option("--verify", help="Read every file and check its digest.")] = False,
    as_json: JsonOption = False,
) -> None:
    """List a run's checkpoints; with --verify, exit 1 if one is damaged."""
    with Client.connect() as client:
        found = client.get(f"/api/runs/{named(run)}/checkpoints", verify=verify)
    damaged = [each for each in found if each.get("problem")]
    if as_json:
        echo_json(found, indent=1)
    elif not found:
        echo(f"run {run} has no checkpoint yet")
    else:
        table = Table(box=None, pad_edge=False)
        for column in ("CHECKPOINT", "ITERATION", "REWARD", "SCORE", "EVALUATED", "WORLDS", "SIZE", "CREATED", "STATE"):
            table.add_column(column, no_wrap=True)
        for each in found:
            reward = "-" if each.get("reward") is None else f"{each['reward']:.2f}"
            score = scored(each.get("score"), each.get("scoreError"))
            size = f"{each['size'] / 2**20:.1f} MiB" if "size" in each else "-"
            created = (
                time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(each["created"])) if each.get("created") else "-"
            )
            state = each.get("problem") or ("verified" if each.get("verified") else "committed")
            if each["best"]:
                state += ", the best"
            table.add_row(
                *(each["name"], str(each["iteration"]), reward, score, _evaluated(each["evaluated"])),
                *(str(each.get("worlds", "-")), size, created, state),
            )
        print_cut(table)
    if damaged:
        raise typer.Exit(1)


def _evaluated(told: dict[str, Any] | None) -> str:
    """The mean return of an evaluation, with half of its 95 % interval."""
    if told is None:
        return "-"
    if not isinstance(told["high"], int | float):
        return f"{told['mean']:.2f}"
    return f"{told['mean']:.2f} ± {told['high'] - told['mean']:.2f}"
