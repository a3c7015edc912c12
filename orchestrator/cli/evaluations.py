"""``muster evaluate``: an evaluation of a checkpoint, as a job that is followed to its end."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.cli.clones import split_reference
from orchestrator.cli.jobs import AcceptOption, JsonOption, engine_queue, on_queue, store_of, submit_spec, tell_note
from orchestrator.cli.progress import await_end, summary
from orchestrator.cli.serving import CpusOption, StoreOption, controller, see_through
from orchestrator.cli.terminal import echo, echo_json
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
    source: Annotated[
        str,
        typer.Argument(
            metavar="RUN[@ITERATION|@best|@latest]",
            help="The policy: of a run's newest checkpoint, unless you name one.",
        ),
    ],
    episodes: Annotated[int | None, typer.Option(help="Episodes in all; 100 by default.", show_default=False)] = None,
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
            help="Change the worlds (config.randomize.friction=[0.4, 0.6]) or a key of the job (resources.cpus=4). Repeatable.",
        ),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the job; evaluate-RUN by default.")] = None,
    accept_changed_robot: AcceptOption = False,
    engine: Annotated[str | None, typer.Option(help="Engine that runs the job, one of the controller's.")] = None,
    store: StoreOption = None,
    cpus: CpusOption = None,
    as_json: JsonOption = False,
) -> None:
    """Evaluate a checkpoint: whole episodes in worlds that its training has not seen.

    This submits a job and follows it to its end, with a temporary controller if none is running. The policy takes its mean action. The
    run's evaluations/ gets a Parquet file with one row per episode, and a summary. The job has one node, with the resources of the run's
    nodes, but at most one GPU.
    """
    section = {
        "episodes": episodes,
        "worlds": worlds,
        "seed": seed,
        "accept_changed_robot": accept_changed_robot or None,
    }
    request = EvaluationRequest(source, section, set_ or (), name, engine, store, cpus, as_json)
    raise typer.Exit(follow_evaluation(request))


@dataclass(frozen=True)
class EvaluationRequest:
    """What a user asks of an evaluation.

    Attributes:
        source: ``RUN[@ITERATION|@best|@latest]``.
        section: What the job's section says beside run and checkpoint; None is left out.
        changes: ``key=value``, of the worlds or of the job.
        name: Of the job; KIND-RUN where None.
        engine: That runs the job.
        store: Of a temporary controller.
        cpus: Of a temporary controller.
        as_json: Whether the summary is printed as JSON.
        kind: Key of the job's section.
    """

    source: str
    section: Mapping[str, Any]
    changes: Sequence[str] = ()
    name: str | None = None
    engine: str | None = None
    store: str | None = None
    cpus: float | None = None
    as_json: bool = False
    kind: str = "evaluate"


def follow_evaluation(request: EvaluationRequest, then: Callable[[Path, str], None] | None = None) -> int:
    """Submit an evaluation and follow it to its end.

    Args:
        request: The evaluation.
        then: Called after success with the run's directory and the evaluation's name.

    Returns:
        The exit code.

    Raises:
        UsageError, SpecError, ApiError, ServerError: One line each.
    """
    run, checkpoint = split_reference(request.source)
    section = {key: value for key, value in {"checkpoint": checkpoint, **request.section}.items() if value is not None}
    with controller(request.store, request.cpus) as connect:
        client = connect()
        elsewhere = on_queue(request.changes, None if request.engine is None else engine_queue(client, request.engine))
        spec = _spec(client, named(run), request.name, section, request.changes, elsewhere, request.kind)
        job = submit_spec(client, spec, f"evaluate {request.source}")["jobId"]
        code = see_through(client, job, await_end if request.as_json else _told)
        if code == 0 and (request.as_json or then):
            found = client.get(f"/api/runs/{named(run)}/evaluations")
            summary = next(each for each in found if each.get("job") == job)
            if then:
                then(Path(client.get(f"/api/runs/{named(run)}")["path"]), summary["name"])
            if request.as_json:
                echo_json(summary, indent=1)
    return code


def _spec(
    client: Client,
    run: str,
    name: str | None,
    section: dict[str, Any],
    changes: Sequence[str] | None,
    elsewhere: Sequence[str],
    kind: str,
) -> Spec:
    """The job, on nodes like the training's. Raises SpecError, and ApiError for an unknown run."""
    trained = client.get(f"/api/runs/{run}")["spec"] or {}
    document = evaluation_document(run, trained, section, name, kind)
    worlds = [f"{kind}.{each}" if each.startswith(("config.", "config=")) else each for each in changes or ()]
    source = f"{'evaluation' if kind == 'evaluate' else kind} of {run}"
    changed = override(document, [*worlds, *elsewhere])
    train = trained.get("train") or {}
    task, base = train.get("task"), train.get("config") or {}
    whole = with_files(
        changed,
        source,
        task=task,
        base=base,
        store=partial(store_of, client),
        note=tell_note,
        text_of=partial(client.run_text, run),
    )
    return validate(whole, source)


def _told(client: Client, job: str) -> int:
    """Print the main rank's output, and how the job ended if it did not succeed. Returns the exit code."""
    for line in client.logs(job, follow=True):
        if line["rank"] == 0:
            echo(line["text"])
    return _ended(client, job)


def _ended(client: Client, job: str) -> int:
    return 0 if client.get(f"/api/jobs/{job}")["status"] == "SUCCEEDED" else summary(client, job)
