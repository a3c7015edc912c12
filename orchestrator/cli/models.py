"""``muster models``: the registry of exported policies."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from orchestrator.cli.clones import split_reference
from orchestrator.cli.export import CheckpointArgument
from orchestrator.cli.jobs import JsonOption
from orchestrator.cli.misuse import make_group
from orchestrator.cli.serving import StoreOption, controller
from orchestrator.cli.show import scored
from orchestrator.cli.terminal import echo, echo_json, print_cut
from orchestrator.client import named
from orchestrator.domain.errors import UsageError
from shared_store.contract.documents import DocumentError
from shared_store.contract.error_text import counted
from shared_store.contract.policy import read
from shared_store.contract.policy_changes import differences, robot_changes
from shared_store.volume.bundles import POLICY
from shared_store.volume.evaluations import in_one_line, told_changes

ModelArgument = Annotated[str, typer.Argument(metavar="NAME[@VERSION]", help="A model; its newest version by default.")]

_EXAMPLES = """Examples:  muster export ant-1f2e3d4c@best   then   muster models register ant-1f2e3d4c@best --name ant
muster models verify ant@1"""


def register(app: typer.Typer) -> None:
    group = make_group(
        "Manage exported policies: register, list, show, diff, verify. Versions are immutable.",
        _EXAMPLES,
    )
    group.command("register", epilog="Example:  muster models register ant-1f2e3d4c@best --name ant")(register_model)
    group.command("list", epilog="Example:  muster models list --json")(list_models)
    group.command("show", epilog="Example:  muster models show ant@2")(show)
    group.command("diff", epilog="Example:  muster models diff ant@1 ant@2")(diff)
    group.command("verify", epilog="Example:  muster models verify ant")(verify)
    app.add_typer(group, name="models")


def register_model(
    source: CheckpointArgument,
    name: Annotated[str, typer.Option(help="Name of the model; its versions count up from 1.")],
    again: Annotated[
        bool, typer.Option("--again", help="Register a checkpoint again that the model already has.")
    ] = False,
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """Register a checkpoint's bundle, made by `muster export`, as the next version of a model."""
    run, checkpoint = split_reference(source)
    with controller(store, None) as connect:
        body = {"name": name, "checkpoint": checkpoint, "again": again}
        found = connect().post(f"/api/runs/{named(run)}/models", body, seconds=300)
    if as_json:
        echo_json(found, indent=1)
    else:
        echo(f"registered {found['run']}@{found['iteration']} as {found['name']}@{found['version']}: {found['path']}")


def list_models(store: StoreOption = None, as_json: JsonOption = False) -> None:
    """List the newest version of each model."""
    with controller(store, None) as connect:
        found = connect().get("/api/models")
    if as_json:
        echo_json(found, indent=1)
        return
    if not found:
        echo("no model is registered yet; muster models register RUN --name NAME")
        return
    table = Table(box=None, pad_edge=False)
    for column in ("MODEL", "VERSION", "TASK", "RUN", "ITERATION", "RETURN", "REGISTERED"):
        table.add_column(column, no_wrap=True)
    for each in found:
        table.add_row(
            *(each["name"], str(each["version"]), str(each.get("task", "-")), str(each.get("run", "-"))),
            *(str(each.get("iteration", "-")), _return(each), _when(each.get("registered"))),
        )
    print_cut(table)


def _return(model: dict[str, Any]) -> str:
    """The mean return of its evaluation with the most episodes in the training's worlds, or else the training's score."""
    own = [each for each in model.get("evaluations") or [] if not each.get("config")]
    best = max(own, key=lambda each: each["episodes"], default=None)
    return f"{best['mean_return']:.2f}" if best else scored(model.get("score"), None)


def show(model: ModelArgument, store: StoreOption = None, as_json: JsonOption = False) -> None:
    """Show a model's origin, evaluation and bundle."""
    found = _read(model, store)
    if as_json:
        echo_json(found, indent=1)
        return
    parent = found.get("parent")
    echo(f"{found['name']}@{found['version']}, of versions {', '.join(map(str, found['versions']))}")
    echo(f"  task:        {found.get('task')}, algorithm {found.get('algorithm')}")
    echo(f"  from:        run {found.get('run')}, checkpoint {found.get('checkpoint')}")
    if parent:
        echo(f"  parent:      run {parent.get('run')}, checkpoint {parent.get('checkpoint')}")
    for evaluation in found.get("evaluations") or []:
        changed = ", ".join(f"{place} {value}" for place, value in told_changes(evaluation))
        seed = evaluation.get("seed")
        worlds = "at the end of the training" if seed is None else f"seed {seed}"
        echo(f"  evaluation:  {in_one_line(evaluation)}, {worlds}{f', with {changed}' if changed else ''}")
    if judged := found.get("judged"):
        echo(
            f"  judged:      return {judged['bundle']['mean_return']:.2f} of the bundle, {counted(judged['episodes'], 'episode')}"
        )
    if found.get("changed_robot"):
        echo(f"  robot:       {found['changed_robot']}; the bundle was made and judged with that file")
    versions = ", ".join(f"{name} {version}" for name, version in (found.get("made_with") or {}).items())
    echo(f"  made with:   {versions or 'not known'}")
    echo(f"  registered:  {_when(found.get('registered'))} by {found.get('registered_by')}")
    echo(f"  bundle:      {found['path']}/bundle")
    if found.get("problem"):
        echo(f"  problem:     {found['problem']}")


def diff(
    model: ModelArgument,
    other: Annotated[
        str | None,
        typer.Argument(metavar="NAME[@VERSION]", help="Version to compare with; by default the previous one."),
    ] = None,
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """List differences between two versions: contract, settings, programs, weights; exit 1 if anything differs."""
    now = _read(model, store)
    if other is None:
        earlier = [version for version in now["versions"] if version < now["version"]]
        if not earlier:
            raise UsageError(
                f"{now['name']}@{now['version']} is the first version; name another model to compare it with"
            )
        before = _read(f"{now['name']}@{earlier[-1]}", store)
    else:
        before, now = now, _read(other, store)
    try:
        old, new = (read(each.get("contract")) for each in (before, now))
    except DocumentError as error:
        raise UsageError(str(error)) from None
    lines = [*differences(old, new, ranges=True), *robot_changes(old.robots, new.robots)]
    for section in ("task", "algorithm", "train", "settings", "made_with", "code"):
        lines += _changed(section, before.get(section), now.get(section))
    if weights := _weights(before, now):
        lines.append(weights)
    if as_json:
        echo_json(lines, indent=1)
    else:
        names = [f"{each['name']}@{each['version']}" for each in (before, now)]
        for line in lines or [f"{names[0]} and {names[1]} have the same contract, settings, versions and weights"]:
            echo(line)
    if lines:
        raise typer.Exit(1)


def verify(model: ModelArgument, store: StoreOption = None) -> None:
    """Read every file of a model and check its digest; exit 1 if one was altered, removed or added."""
    found = _read(model, store, verify=True)
    if found.get("problem"):
        echo(f"{found['name']}@{found['version']}: damaged: {found['problem']}")
        raise typer.Exit(1)
    echo(f"{found['name']}@{found['version']}: all files are unchanged since registration")


def _read(reference: str, store: str | None, **options: Any) -> dict[str, Any]:
    """A model by ``NAME[@VERSION]``. Raises UsageError."""
    name, version = split_model(reference)
    with controller(store, None) as connect:
        path = f"/api/models/{named(name)}"
        found: dict[str, Any] = connect().get(path, seconds=300, version=version, **options)
    return found


def split_model(reference: str) -> tuple[str, int | None]:
    """Name and version of ``NAME`` or ``NAME@VERSION``. Raises UsageError."""
    name, sign, version = reference.partition("@")
    if sign and not (version.isascii() and version.isdecimal() and 0 < len(version) < 10 and int(version) > 0):
        raise UsageError(f"{reference}: expected a version after @, such as {name}@1")
    return name, int(version) if sign else None


def _weights(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Difference of the weights, in one line; empty if they are the same."""
    digests = [str(each.get("weights")) for each in (before, now)]
    if digests[0] == digests[1]:
        return ""
    from orchestrator.cli.comparison.weights import difference  # imports the ONNX reader, if that package is installed

    told = difference(*(Path(each["path"]) / "bundle" / POLICY for each in (before, now)))
    return "" if told == "" else f"weights {told or f'differ: SHA-256 {digests[0][:12]} became {digests[1][:12]}'}"


def _changed(place: str, before: Any, now: Any) -> list[str]:
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        keys = sorted({*before, *now})
        return [line for key in keys for line in _changed(f"{place}.{key}", before.get(key), now.get(key))]
    return [] if before == now else [f"{place} {before} became {now}"]


def _when(seconds: float | None) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(seconds)) if seconds else "-"
