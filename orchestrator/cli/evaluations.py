"""``muster evaluate``, including races."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
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
from orchestrator.domain.errors import ServerError, UsageError
from orchestrator.spec.changes import override
from orchestrator.spec.evaluations import evaluation_document
from orchestrator.spec.kept_files import with_files
from orchestrator.spec.model import Spec, validate
from shared_store.races import BESIDE, SIM_TRACE

_EXAMPLES = """Examples:  muster evaluate ant-1f2e3d4c@best --episodes 500
muster evaluate ant-1f2e3d4c@300 --set 'config.randomize.friction=[0.4, 0.6]' --name ant-on-ice
muster evaluate racer-1f2e3d4c --race --trials 5 --continuous --penalty 5 -o race"""

_RACE = "Race"


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
    race: Annotated[
        bool, typer.Option("--race", help="Drive race laps from the start line.", rich_help_panel=_RACE)
    ] = False,
    trials: Annotated[
        int | None, typer.Option(help="Number of laps; 3 by default.", rich_help_panel=_RACE, show_default=False)
    ] = None,
    continuous: Annotated[
        bool | None,
        typer.Option(
            "--continuous/--no-continuous",
            help="Put back a car that left the road or crashed; by default its lap ends.",
            rich_help_panel=_RACE,
        ),
    ] = None,
    penalty: Annotated[
        float | None,
        typer.Option(
            help="Penalty in seconds for leaving the track and for each crash; 1 by default.",
            rich_help_panel=_RACE,
            show_default=False,
        ),
    ] = None,
    track: Annotated[
        list[str] | None,
        typer.Option(
            help="Track to use instead of the training's; laps use several in turn. Repeatable.", rich_help_panel=_RACE
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Copy the SimTrace files of the race, and those of the training, into this directory, as log tools expect them.",
            rich_help_panel=_RACE,
            show_default=False,
        ),
    ] = None,
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

    With --race the episodes are timed laps of a racer from the start line, one world each, with a file of all steps.
    """
    run, checkpoint = split_reference(source)
    rules = {"trials": trials, "continuous": continuous, "penalty": penalty, "track": track or None}
    _refuse_mixed(race, {"episodes": episodes, "worlds": worlds}, {**rules, "output": output})
    for there in () if output is None else (output / each for each in (SIM_TRACE, *BESIDE)):
        if there.exists():
            raise UsageError(f"-o {output}: {there} exists; name another directory")
    asked = {"checkpoint": checkpoint, "episodes": episodes, "worlds": worlds, "seed": seed, **rules}
    asked |= {"accept_changed_robot": accept_changed_robot or None}
    if (seconds := asked.pop("penalty")) is not None:
        asked |= {"off_track_penalty": seconds, "crash_penalty": seconds}
    with controller(store, cpus) as connect:
        client = connect()
        elsewhere = on_queue(set_, None if engine is None else engine_queue(client, engine))
        spec = _spec(
            client,
            named(run),
            name,
            {key: value for key, value in asked.items() if value is not None},
            set_,
            elsewhere,
            "race" if race else "evaluate",
        )
        job = submit_spec(client, spec, f"evaluate {source}")["jobId"]
        code = see_through(client, job, await_end if as_json else _told)
        if code == 0 and (as_json or output is not None):
            found = client.get(f"/api/runs/{named(run)}/evaluations")
            summary = next(each for each in found if each.get("job") == job)
            if output is not None:
                _copy(Path(client.get(f"/api/runs/{named(run)}")["path"]), summary["name"], output, as_json)
            if as_json:
                echo_json(summary, indent=1)
    raise typer.Exit(code)


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
    document = evaluation_document(run, {**trained, **({"share": None} if client.has_key else {})}, section, name, kind)
    worlds = [f"{kind}.{each}" if each.startswith(("config.", "config=")) else each for each in changes or ()]
    source = f"{'race' if kind == 'race' else 'evaluation'} of {run}"
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


def _refuse_mixed(race: bool, episodes: dict[str, Any], rules: dict[str, Any]) -> None:
    """Refuse options of races without --race, and other options with it. Raises UsageError."""
    wrong = [name for name, value in (episodes if race else rules).items() if value is not None]
    if wrong:
        instead = "a race takes --trials instead, one world each" if race else "only races take it; add --race"
        raise UsageError(f"--{wrong[0]}: {instead}")


def _copy(run: Path, evaluation: str, output: Path, quiet: bool) -> None:
    """Copy the SimTrace files of a race, those of its training, if there are any, and what is beside them. Raises ServerError."""
    made, trained = run / "evaluations" / evaluation, Path(SIM_TRACE) / "training"
    if not (made / SIM_TRACE).is_dir():
        raise ServerError(
            f"-o {output}: the run's directory {run} is not visible from this machine; the files are in {made / SIM_TRACE}"
        )
    hidden = output / f".{SIM_TRACE}.{evaluation}.tmp"
    try:
        output.mkdir(parents=True, exist_ok=True)
        shutil.copytree(made, hidden)
        if (run / trained).is_dir():
            shutil.copytree(run / trained, hidden / trained)
        for each in list(hidden.iterdir()):
            each.rename(output / each.name)
        hidden.rmdir()
    except OSError as error:
        shutil.rmtree(hidden, ignore_errors=True)
        raise ServerError(
            f"-o {output}: it can't be written ({error.strerror or error}); the files are in {made / SIM_TRACE}"
        ) from None
    if not quiet:
        echo(f"copied: {output / SIM_TRACE}")


def _told(client: Client, job: str) -> int:
    """Print the main rank's output, and how the job ended if it did not succeed. Returns the exit code."""
    for line in client.logs(job, follow=True):
        if line["rank"] == 0:
            echo(line["text"])
    return _ended(client, job)


def _ended(client: Client, job: str) -> int:
    return 0 if client.get(f"/api/jobs/{job}")["status"] == "SUCCEEDED" else summary(client, job)
