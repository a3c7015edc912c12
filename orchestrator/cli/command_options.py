"""Options and arguments that several commands have: each is declared once, with its spelling, the form of its value and its help."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from orchestrator.domain.errors import SpecError, UsageError
from orchestrator.engines.installed import ENGINES
from orchestrator.spec.values import seconds_of
from shared_store.contract.error_text import nearest

_JOB = "Job id or its first letters (4 or more), or a job name (your newest job of it, else the newest); with :INDEX, an array's child."
_REFERENCE = "RUN[@ITERATION|@best|@latest]"

SpecArgument = Annotated[str, typer.Argument(metavar="SPEC", help="A job YAML, such as job_specs/cartpole.yaml.")]
JobArgument = Annotated[str, typer.Argument(metavar="JOB", help=_JOB)]
JobsArgument = Annotated[list[str], typer.Argument(metavar="JOB", help=_JOB)]
RunArgument = Annotated[str, typer.Argument(metavar="RUN", help="A run; `muster runs` lists them.")]
CheckpointArgument = Annotated[
    str,
    typer.Argument(
        metavar=_REFERENCE,
        help="A run's newest checkpoint (the default), that of an iteration, or the one with the best score.",
    ),
]
SourceArgument = Annotated[
    str | None,
    typer.Argument(
        metavar=f"{_REFERENCE} | JOB", help="A checkpoint, the newest by default, or a job that trains now."
    ),
]
ModelArgument = Annotated[str, typer.Argument(metavar="NAME[@VERSION]", help="A model; its newest version by default.")]

JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for scripts.")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a key of the spec: train.iterations=600. Repeatable."),
]
NameOption = Annotated[
    str | None,
    typer.Option("--name", metavar="NAME", help="Name of the job and of its run; default: that of the spec."),
]
QueueOption = Annotated[
    str | None, typer.Option("--queue", metavar="QUEUE", help="Job queue; default: that of the spec or of the run.")
]
EngineOption = Annotated[
    str | None,
    typer.Option(
        metavar="ENGINE",
        help=f"Engine that runs the job, one of the controller's: {', '.join(ENGINES)}. It means that engine's queue.",
    ),
]
NodesOption = Annotated[
    int | None,
    typer.Option(
        min=1, help="Number of nodes, among which the worlds are divided; default: that of the spec or of the run."
    ),
]
FollowOption = Annotated[
    bool,
    typer.Option(
        "--follow/--no-follow", "-f", help="Show progress until the job ends, or return once it is submitted."
    ),
]
DryRunOption = Annotated[
    bool,
    typer.Option(
        "--dry-run", help="Check the job and show what would start where; --json adds all variables. Nothing starts."
    ),
]
OutputOption = Annotated[Path | None, typer.Option("--output", "-o", help="The file to write.")]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")]
YesOption = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")]
AcceptOption = Annotated[
    bool,
    typer.Option(
        "--accept-changed-robot",
        help="Continue although the robot's file loads differently from the policy's training.",
    ),
]
StoreOption = Annotated[
    str | None,
    typer.Option(metavar="DIRECTORY", help="Directory of the shared store; $MUSTER_HOME/store by default."),
]
CpusOption = Annotated[
    float | None, typer.Option(min=0.1, help="CPU cores to allocate; by default all of the machine's.")
]
NamesOption = Annotated[
    str | None, typer.Option("--name", metavar="PATTERN", help="Only those of this name, such as 'ant-*'.")
]
SinceOption = Annotated[
    str | None, typer.Option(metavar="DURATION", help="Only what is newer than this: 90s, 10m, 2h or 1d.")
]
DatabaseOption = Annotated[
    str | None,
    typer.Option(
        envvar="MUSTER_DATABASE",
        metavar="URL|PATH",
        help="postgresql+psycopg://USER@HOST/NAME, or path of an SQLite file on a local disk; $MUSTER_HOME/muster.db by default.",
    ),
]


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


def split_model(reference: str) -> tuple[str, int | None]:
    """Name and version of ``NAME`` or ``NAME@VERSION``. Raises UsageError."""
    name, sign, version = reference.partition("@")
    if sign and not (version.isascii() and version.isdecimal() and 0 < len(version) < 10 and int(version) > 0):
        raise UsageError(f"{reference}: expected a version after @, such as {name}@1")
    return name, int(version) if sign else None


def literal_part(pattern: str | None) -> str:
    """The longest part of a pattern without wildcards, which the controller can search for."""
    return max(re.split(r"\[.*?\]|[*?]", pattern or ""), key=len)


def changes_of(changes: Sequence[str] | None, **values: tuple[str, object]) -> list[str]:
    """``--set`` assignments for options that set a key of the spec, too.

    Args:
        changes: The ``--set`` assignments.
        values: By key of the spec: the option, and its value as YAML; None: it is not used.

    Raises:
        SpecError: ``changes`` and an option set the same key.
    """
    found = []
    for key, (option, value) in values.items():
        if value is None:
            continue
        if twice := next((each for each in changes or () if each.partition("=")[0].partition(".")[0] == key), None):
            raise SpecError(f"--set {twice}: {option} sets {key}; use one of them")
        found.append(f"{key}={value}")
    return found


def check_engine(name: str) -> None:
    """Raises SpecError for a name that no engine has."""
    if name not in ENGINES:
        raise SpecError(f"--engine {name}: unknown engine; {nearest(name, ENGINES)}")


def seconds_since(text: str | None) -> float | None:
    """Seconds of ``--since``. Raises SpecError."""
    return seconds_of("--since", text)
