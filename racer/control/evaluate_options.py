"""The options of a race for ``muster evaluate``."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.cli.catalogue import FurtherOptions
from orchestrator.cli.evaluations import follow_evaluation
from orchestrator.cli.terminal import echo
from orchestrator.domain.errors import ServerError, UsageError
from racer.store.races import BESIDE, SIM_TRACE

_RACE = "Race"


def race_or_evaluate(
    evaluate: Callable[..., None],
    arguments: dict[str, Any],
    *,
    race: Annotated[
        bool,
        typer.Option("--race", help="Drive race laps from the start line, one world each.", rich_help_panel=_RACE),
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
            metavar="TRACK",
            help="Track to use instead of the training's; laps use several in turn. Repeatable.",
            rich_help_panel=_RACE,
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="DIRECTORY",
            help="Copy the SimTrace files of the race, and those of the training, into this directory, as log tools expect them.",
            rich_help_panel=_RACE,
            show_default=False,
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace existing files of a race.", rich_help_panel=_RACE)
    ] = False,
) -> None:
    """Evaluate a checkpoint, or have it drive a race. Raises what :func:`.follow_evaluation` raises."""
    race_options = {
        "trials": trials,
        "continuous": continuous,
        "penalty": penalty,
        "track": track or None,
        "output": output,
        "overwrite": overwrite or None,
    }
    _refuse_mixed(race, {"episodes": arguments["episodes"], "worlds": arguments["worlds"]}, race_options)
    if not race:
        evaluate(**arguments)
        return
    for existing in () if output is None else (output / each for each in (SIM_TRACE, *BESIDE)):
        if existing.exists() and not overwrite:
            raise UsageError(f"-o {output}: {existing} exists; --overwrite replaces it")
    section = {
        "seed": arguments["seed"],
        "trials": trials,
        "continuous": continuous,
        "track": track or None,
        "off_track_penalty": penalty,
        "crash_penalty": penalty,
        "accept_changed_robot": arguments["accept_changed_robot"] or None,
    }
    submission = {key: arguments[key] for key in ("queue", "engine", "store", "cpus", "follow", "dry_run", "as_json")}

    def copy(run: Path, evaluation: str) -> None:
        if output is not None:
            _copy(run, evaluation, output, arguments["as_json"])

    evaluation = arguments["source"], section, arguments["set_"], arguments["name"]
    raise typer.Exit(follow_evaluation(*evaluation, kind="race", then=copy, **submission))


OPTIONS = FurtherOptions(
    race_or_evaluate, "muster evaluate racer-1f2e3d4c --race --trials 5 --continuous --penalty 5 -o race"
)


def _refuse_mixed(race: bool, episode_options: dict[str, Any], race_options: dict[str, Any]) -> None:
    """Refuse options of races without --race, and other options with it. Raises UsageError."""
    wrong = [name for name, value in (episode_options if race else race_options).items() if value is not None]
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
        shutil.rmtree(output / SIM_TRACE, ignore_errors=True)  # it exists only with --overwrite
        for each in list(hidden.iterdir()):
            target = output / each.name
            if target.is_dir():
                shutil.copytree(each, target, dirs_exist_ok=True)
            else:
                each.rename(target)
        shutil.rmtree(hidden)
    except OSError as error:
        shutil.rmtree(hidden, ignore_errors=True)
        raise ServerError(
            f"-o {output}: it can't be written ({error.strerror or error}); the files are in {made / SIM_TRACE}"
        ) from None
    if not quiet:
        echo(f"copied: {output / SIM_TRACE}")
