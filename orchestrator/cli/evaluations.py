"""``muster evaluate``: an evaluation of a checkpoint, as a job that is followed to its end."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.cli import command_options as options
from orchestrator.cli.controllers import controller
from orchestrator.cli.progress import follow_main
from orchestrator.cli.submitting import carry_out, note, queue_change, store_of
from orchestrator.cli.terminal import echo_json
from orchestrator.client import Client, named
from orchestrator.spec.changes import override
from orchestrator.spec.evaluations import evaluation_document
from orchestrator.spec.kept_files import with_files
from orchestrator.spec.model import Spec, validate

_EXAMPLES = """Examples:  muster evaluate ant-1f2e3d4c@best --episodes 500
muster evaluate ant-1f2e3d4c@300 --set 'config.randomize.friction=[0.4, 0.6]' --name ant-on-ice"""


def register(app: typer.Typer) -> None:
    app.command(epilog=_EXAMPLES)(evaluate)


def evaluate(
    source: options.CheckpointArgument,
    episodes: Annotated[int | None, typer.Option(help="Episodes in all; 100 by default.")] = None,
    worlds: Annotated[
        int | None,
        typer.Option(help="Worlds that each rank simulates at once; 1024 by default, at most one for each episode."),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(help="Seed of the worlds; by default derived from the training's seed, and different from it."),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Change the worlds (config.randomize.friction=[0.4, 0.6]) or a key of the job (resources.cpus=4). Repeatable.",
        ),
    ] = None,
    name: Annotated[
        str | None, typer.Option("--name", metavar="NAME", help="Name of the job; default: evaluate-RUN.")
    ] = None,
    accept_changed_robot: options.AcceptOption = False,
    queue: options.QueueOption = None,
    engine: options.EngineOption = None,
    store: options.StoreOption = None,
    cpus: options.CpusOption = None,
    follow: options.FollowOption = True,
    dry_run: options.DryRunOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Evaluate a checkpoint in worlds that its training has not seen.

    This submits a job of whole episodes and follows it to its end, with a temporary controller if none is running. The policy takes its mean action. The
    run's evaluations/ gets a Parquet file with one row per episode, and a summary. The job has one node, with the resources of the run's
    nodes, but at most one GPU.
    """
    section = {
        "episodes": episodes,
        "worlds": worlds,
        "seed": seed,
        "accept_changed_robot": accept_changed_robot or None,
    }
    code = follow_evaluation(
        source,
        section,
        set_,
        name,
        queue=queue,
        engine=engine,
        store=store,
        cpus=cpus,
        follow=follow,
        dry_run=dry_run,
        as_json=as_json,
    )
    raise typer.Exit(code)


def follow_evaluation(
    source: str,
    section: Mapping[str, Any],
    changes: Sequence[str] | None,
    name: str | None,
    *,
    queue: str | None,
    engine: str | None,
    store: str | None,
    cpus: float | None,
    follow: bool,
    dry_run: bool,
    as_json: bool,
    kind: str = "evaluate",
    then: Callable[[Path, str], None] | None = None,
) -> int:
    """Submit an evaluation and follow it to its end.

    Args:
        source: ``RUN[@ITERATION|@best|@latest]``.
        section: Of the job, beside run and checkpoint; None is left out.
        changes: ``key=value``, of the worlds or of the job.
        name: Of the job; KIND-RUN where None.
        queue: Of the job; that of its training where None.
        engine: That runs the job.
        store: Of a temporary controller.
        cpus: Of a temporary controller.
        follow: Whether the command waits for the end of the job.
        dry_run: Whether nothing is submitted.
        as_json: Whether the summary is printed as JSON.
        kind: Key of the job's section.
        then: Called after success with the run's directory and the evaluation's name.

    Returns:
        The exit code.

    Raises:
        UsageError, SpecError, ApiError, ServerError: One line each.
    """
    run, checkpoint = options.split_reference(source)
    section = {key: value for key, value in {"checkpoint": checkpoint, **section}.items() if value is not None}
    worlds = [f"{kind}.{each}" if each.startswith(("config.", "config=")) else each for each in changes or ()]
    with controller(store, cpus) as connect:
        client = connect()
        elsewhere = queue_change(client, changes, queue, engine)
        spec = _spec(client, named(run), kind, name, section, [*worlds, *elsewhere])
        modes = {"follows": follow, "dry_run": dry_run, "as_json": as_json}
        code, job = carry_out(client, spec, f"evaluate {source}", follow_main, **modes)
        if job and code == 0 and (as_json or then):
            found = client.get(f"/api/runs/{named(run)}/evaluations")
            result = next(each for each in found if each.get("job") == job)
            if then:
                then(Path(client.get(f"/api/runs/{named(run)}")["path"]), result["name"])
            if as_json:
                echo_json(result, indent=1)
    return code


def _spec(
    client: Client, run: str, kind: str, name: str | None, section: Mapping[str, Any], changes: Sequence[str]
) -> Spec:
    """The job, on nodes like the training's. Raises SpecError, and ApiError for an unknown run."""
    trained = client.get(f"/api/runs/{run}")["spec"] or {}
    source = f"{'evaluation' if kind == 'evaluate' else kind} of {run}"
    train = trained.get("train") or {}
    whole = with_files(
        override(evaluation_document(run, trained, section, name, kind), changes),
        source,
        task=train.get("task"),
        base=train.get("config") or {},
        store=partial(store_of, client),
        note=note,
        text_of=partial(client.run_text, run),
    )
    return validate(whole, source)
