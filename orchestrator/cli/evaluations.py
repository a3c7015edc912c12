"""``muster evaluate``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import typer

from orchestrator.cli.clones import split_reference
from orchestrator.cli.jobs import JsonOption, engine_queue, on_queue, submit_spec
from orchestrator.cli.progress import summary
from orchestrator.cli.serving import CpusOption, StoreOption, controller, see_through
from orchestrator.cli.terminal import echo, echo_json
from orchestrator.client import Client, named
from orchestrator.evaluating import evaluation_document
from orchestrator.kept_files import with_files
from orchestrator.spec import Spec, override, validate

_EXAMPLES = """Examples:  muster evaluate ant-1f2e3d4c@best --episodes 500
muster evaluate ant-1f2e3d4c@300 --set 'config.randomize.friction=[0.4, 0.6]' --name ant-on-ice"""


def register(app: typer.Typer) -> None:
    app.command(epilog=_EXAMPLES)(evaluate)


def evaluate(
    source: Annotated[
        str,
        typer.Argument(
            metavar="RUN[@ITERATION|@best|@latest]", help="Whose policy: of its newest checkpoint, unless one is named."
        ),
    ],
    episodes: Annotated[int | None, typer.Option(help="Episodes in all; 100 by default.", show_default=False)] = None,
    worlds: Annotated[
        int | None,
        typer.Option(help="Worlds that each rank simulates at once; 1024 by default, at most one for each episode."),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(help="Of the worlds; by default one that follows from the training's, and is none of it."),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="Change the worlds (config.randomize.friction=[0.4, 0.6]) or a key of the job (resources.cpus=4). Repeatable.",
        ),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Of the job; evaluate-RUN by default.")] = None,
    engine: Annotated[str | None, typer.Option(help="What runs it, of the engines that the controller has.")] = None,
    store: StoreOption = None,
    cpus: CpusOption = None,
    as_json: JsonOption = False,
) -> None:
    """Evaluate a checkpoint: whole episodes on worlds that its training has not seen.

    A job like any other, followed to its end, with a controller of its own where none is running. The policy takes its mean action.
    Every episode becomes a row of a Parquet file beside a summary in the run's evaluations/. The job has one node, with the resources
    that the run's nodes have, and at most one GPU.
    """
    run, checkpoint = split_reference(source)
    asked = {"checkpoint": checkpoint, "episodes": episodes, "worlds": worlds, "seed": seed}
    with controller(store, cpus) as connect:
        client = connect()
        elsewhere = on_queue(set_, None if engine is None else engine_queue(client, engine))
        spec = _spec(
            client, named(run), name, {key: value for key, value in asked.items() if value is not None}, set_, elsewhere
        )
        job = submit_spec(client, spec, f"evaluate {source}")["jobId"]
        code = see_through(client, job, _only_errors if as_json else _told)
        if as_json and code == 0:
            found = client.get(f"/api/runs/{named(run)}/evaluations")
            echo_json(next(each for each in found if each.get("job") == job), indent=1)
    raise typer.Exit(code)


def _spec(
    client: Client,
    run: str,
    name: str | None,
    section: dict[str, Any],
    changes: Sequence[str] | None,
    elsewhere: Sequence[str],
) -> Spec:
    """The job, on nodes like those of the training. Raises SpecError, ApiError for a run that does not exist."""
    trained = client.get(f"/api/runs/{run}")["spec"] or {}
    document = evaluation_document(run, trained, section, name)
    worlds = [f"evaluate.{each}" if each.startswith(("config.", "config=")) else each for each in changes or ()]
    source = f"evaluation of {run}"
    changed = override(document, [*worlds, *elsewhere])
    return validate(with_files(changed, source, task=(trained.get("train") or {}).get("task")), source)


def _told(client: Client, job: str) -> int:
    """Print what the main rank says; how the job ended where it did not succeed. Returns the exit code."""
    for line in client.logs(job, follow=True):
        if line["rank"] == 0:
            echo(line["text"])
    return _ended(client, job)


def _only_errors(client: Client, job: str) -> int:
    for _ in client.logs(job, follow=True):
        pass
    return _ended(client, job)


def _ended(client: Client, job: str) -> int:
    return 0 if client.get(f"/api/jobs/{job}")["status"] == "SUCCEEDED" else summary(client, job)
