"""``muster runs`` and ``muster checkpoints``: what the store has."""

from __future__ import annotations

import sys
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.cli.command_options import JsonOption, NamesOption, RunArgument, YesOption, literal_part
from orchestrator.cli.listings import Resource, date, date_ms, mebibytes, number, scored
from orchestrator.cli.misuse import make_group
from orchestrator.cli.terminal import echo, echo_json
from orchestrator.client import Client, named
from orchestrator.domain.errors import UsageError
from shared_store.contract.error_text import counted, unknown_iteration

_A_PAGE = 100


def _train(run: dict[str, Any]) -> dict[str, Any]:
    return (run["spec"] or {}).get("train") or {}


def _last_job(run: dict[str, Any]) -> dict[str, Any]:
    return run["jobs"][-1] if run["jobs"] else {}


RUNS = Resource(
    {
        "RUN": "run",
        "TASK": lambda run: _train(run).get("task"),
        "ITERATION": lambda run: f"{run['iteration']}/{_train(run).get('iterations', '?')}" if _train(run) else "",
        "CHECKPOINTS": lambda run: run["checkpoints"],
        "NEWEST": lambda run: Path(run["checkpoint"] or "").name,
        "LAST JOB": lambda run: _last_job(run).get("id", "")[:8],
        "STATUS": lambda run: _last_job(run).get("status"),
        "OWNER": lambda run: run["owner"],
        "QUEUE": "queue",
        "CREATED": lambda run: date_ms(run["created"]),
    },
    route="/api/runs",
)
CHECKPOINTS = Resource(
    {
        "CHECKPOINT": "name",
        "ITERATION": "iteration",
        "REWARD": lambda each: number(each.get("reward")),
        "SCORE": lambda each: scored(each.get("score"), each.get("scoreError")),
        "EVALUATED": lambda each: _evaluated(each["evaluated"]),
        "WORLDS": "worlds",
        "SIZE": lambda each: mebibytes(each.get("size")),
        "CREATED": lambda each: date(each.get("created")),
        "STATE": lambda each: _state(each) + (", the best" if each["best"] else ""),
    }
)


def register(app: typer.Typer) -> None:
    group = make_group(
        "List, archive and delete the runs of the store.\n\nOld runs that hold nothing but logs go by themselves, as `muster gc --help` says.",
        "Examples:  muster runs --name 'ant-*'   then   muster runs archive ant-1f2e3d4c",
        list_runs,
    )
    group.command("list", epilog="Example:  muster runs list --name 'ant-*'")(list_runs)
    group.command(epilog="Examples:  muster runs archive ant-1f2e3d4c   and   muster runs archive ant-1f2e3d4c --undo")(
        archive
    )
    group.command(epilog="Example:  muster runs delete ant-1f2e3d4c --yes")(delete)
    app.add_typer(group, name="runs")
    app.command(epilog="Example:  muster checkpoints ant-1f2e3d4c --verify")(checkpoints)


def list_runs(
    name: NamesOption = None,
    archived: Annotated[bool, typer.Option("--archived", help="List the archived runs instead.")] = False,
    as_json: JsonOption = False,
) -> None:
    """List the runs that you may see, by name, each with its newest checkpoint and its last job."""
    with Client.connect() as client:
        matching = all_runs(client, search=literal_part(name), archived=str(archived).lower())
    found = [run for run in matching if name is None or fnmatchcase(run["run"], name)]
    RUNS.show(found, as_json)
    if not found and not as_json:
        what = f"no run {'is archived' if archived else 'exists'}" if name is None else f"--name {name}: no run matches"
        echo(what if archived else f"{what}; `muster runs --archived` lists archived runs")


def all_runs(client: Client, **query: Any) -> list[dict[str, Any]]:
    """The runs that the caller may see, page by page. Raises ApiError, Unreachable."""
    found: list[dict[str, Any]] = []
    page = found
    while page is found or len(page) == _A_PAGE:
        after = found[-1]["run"] if found else ""
        page = client.get("/api/runs", after=after, max=_A_PAGE, seconds=610, **query)
        found = [*found, *page]
    return found


def archive(
    run: RunArgument,
    undo: Annotated[bool, typer.Option("--undo", help="Take the run out of the archive.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Archive a run: it is kept, with its jobs and logs, until it is taken out again.

    Nothing is added to it meanwhile (no job continues or evaluates it), and `muster runs` lists it with --archived only. Its weights
    can be cloned and imitated as before.
    """
    with Client.connect() as client:
        archived = client.post(f"/api/runs/{named(run)}/archive", {"archived": not undo})
    if as_json:
        echo_json(archived)
    else:
        echo(f"run {run} is {'no longer archived' if undo else 'archived: it is neither continued nor deleted'}")


def delete(run: RunArgument, yes: YesOption = False, as_json: JsonOption = False) -> None:
    """Delete a run with its checkpoints, logs and results, for good.

    It is refused while something needs the run: an unfinished job, a clone, a pupil, a model, or what a plug-in keeps, such as an entry of
    a league. The jobs of the run stay in the history.
    """
    with Client.connect() as client:
        found = client.get(f"/api/runs/{named(run)}")
        if not yes:
            _confirm(found)
        deleted = client.delete(f"/api/runs/{named(run)}", seconds=610)
    if as_json:
        echo_json(deleted)
        return
    echo(f"deleted run {run}: {counted(deleted['files'], 'file')}, {mebibytes(deleted['bytes'])}")
    if left := deleted["left"]:
        echo(f"not all of them can be removed; remove the rest by hand: {left}")


def _confirm(found: dict[str, Any]) -> None:
    """Raises typer.Abort if the user does not confirm, UsageError where nobody can answer."""
    run = found["run"]
    if not sys.stdin.isatty():
        raise UsageError(f"run {run} is not deleted: add --yes where nobody can answer")
    what = f"{counted(found['checkpoints'], 'checkpoint')} and everything else in it"
    typer.confirm(f"delete run {run} with {what} for good?", abort=True)


def checkpoints(
    run: RunArgument,
    verify: Annotated[bool, typer.Option("--verify", help="Read every file and check its digest.")] = False,
    as_json: JsonOption = False,
) -> None:
    """List a run's checkpoints; with --verify, exit 1 if one is damaged."""
    with Client.connect() as client:
        found = client.get(f"/api/runs/{named(run)}/checkpoints", verify=verify)
    CHECKPOINTS.show(found, as_json)
    if not found and not as_json:
        echo(f"run {run} has no checkpoint yet")
    if any(each.get("problem") for each in found):
        raise typer.Exit(1)


def _state(checkpoint: dict[str, Any]) -> str:
    return checkpoint.get("problem") or ("verified" if checkpoint.get("verified") else "committed")


def _evaluated(summary: dict[str, Any] | None) -> str:
    """The mean return of an evaluation, with half of its 95 % interval."""
    if summary is None:
        return ""
    high = summary["high"]
    return scored(summary["mean"], high - summary["mean"] if isinstance(high, int | float) else None)


def chosen(client: Client, run: str, reference: int | str | None) -> dict[str, Any]:
    """The API's description of the referenced checkpoint. Raises UsageError with the available ones."""
    found: list[dict[str, Any]] = client.get(f"/api/runs/{named(run)}/checkpoints")
    if not found:
        raise UsageError(f"run {run} has no checkpoint yet; train it first")
    if reference in (None, "latest"):
        return found[-1]
    if reference == "best":
        best = next((each for each in found if each["best"]), None)
        if best is None:
            raise UsageError(f"run {run} has no checkpoint with a score or two evaluations yet; name an iteration")
        return best
    fitting = [each for each in found if each["iteration"] == reference]
    if not fitting:
        raise UsageError(unknown_iteration(run, reference, (each["iteration"] for each in found)))
    return fitting[-1]
