"""``muster models``: the registry of exported policies."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.cli import command_options as options
from orchestrator.cli.controllers import controller
from orchestrator.cli.listings import Resource, date, number, show_facts
from orchestrator.cli.misuse import make_group
from orchestrator.cli.terminal import echo, echo_json
from orchestrator.client import named
from orchestrator.domain.errors import UsageError
from shared_store.contract.documents import DocumentError
from shared_store.contract.error_text import counted
from shared_store.contract.policy import read
from shared_store.contract.policy_changes import differences, robot_changes
from shared_store.volume.bundles import POLICY
from shared_store.volume.evaluations import changes_in_lines, in_one_line

MODELS = Resource(
    {
        "MODEL": "name",
        "VERSION": "version",
        "TASK": "task",
        "RUN": "run",
        "ITERATION": "iteration",
        "RETURN": lambda model: _return(model),
        "REGISTERED": lambda model: date(model.get("registered")),
    },
    "no model is registered yet; muster models register RUN --name NAME",
    "/api/models",
)

_EXAMPLES = """Examples:  muster export ant-1f2e3d4c@best   then   muster models register ant-1f2e3d4c@best --name ant
muster models verify ant@1"""


def register(app: typer.Typer) -> None:
    group = make_group(
        "Register, list, show, compare and verify exported policies.\n\nVersions are immutable.",
        _EXAMPLES,
        MODELS.lister("List the newest version of each model."),
    )
    group.command("register", epilog="Example:  muster models register ant-1f2e3d4c@best --name ant")(register_model)
    MODELS.add_list(group, "List the newest version of each model.", "Example:  muster models list --json")
    group.command("show", epilog="Example:  muster models show ant@2")(show)
    group.command("diff", epilog="Example:  muster models diff ant@1 ant@2")(diff)
    group.command("verify", epilog="Example:  muster models verify ant")(verify)
    app.add_typer(group, name="models")


def register_model(
    source: options.CheckpointArgument,
    name: Annotated[
        str, typer.Option("--name", metavar="NAME", help="Name of the model; its versions count up from 1.")
    ],
    again: Annotated[
        bool, typer.Option("--again", help="Register a checkpoint again that the model already has.")
    ] = False,
    store: options.StoreOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Register a checkpoint's bundle, made by `muster export`, as the next version of a model."""
    run, checkpoint = options.split_reference(source)
    with controller(store, None) as connect:
        body = {"name": name, "checkpoint": checkpoint, "again": again}
        found = connect().post(f"/api/runs/{named(run)}/models", body, seconds=300)
    if as_json:
        echo_json(found, indent=1)
    else:
        echo(f"registered {found['run']}@{found['iteration']} as {found['name']}@{found['version']}: {found['path']}")


def _return(model: dict[str, Any]) -> str:
    """The mean return of its evaluation with the most episodes in the training's worlds, or else the training's score."""
    own = [each for each in model.get("evaluations") or [] if not each.get("config")]
    best = max(own, key=lambda each: each["episodes"], default=None)
    return number(best["mean_return"] if best else model.get("score"))


def show(model: options.ModelArgument, store: options.StoreOption = None, as_json: options.JsonOption = False) -> None:
    """Show a model's origin, evaluation and bundle."""
    found = _read(model, store)
    if as_json:
        echo_json(found, indent=1)
        return
    parent, made_with = found.get("parent"), (found.get("made_with") or {}).items()
    echo(f"{found['name']}@{found['version']}, of versions {', '.join(map(str, found['versions']))}")
    show_facts(
        {
            "task": f"{found.get('task')}, algorithm {found.get('algorithm')}",
            "from": f"run {found.get('run')}, checkpoint {found.get('checkpoint')}",
            "parent": f"run {parent.get('run')}, checkpoint {parent.get('checkpoint')}" if parent else "",
        },
        width=12,
    )
    for evaluation in found.get("evaluations") or []:
        changed = ", ".join(f"{place} {value}" for place, value in changes_in_lines(evaluation))
        seed = evaluation.get("seed")
        worlds = "at the end of the training" if seed is None else f"seed {seed}"
        echo(f"  evaluation:  {in_one_line(evaluation)}, {worlds}{f', with {changed}' if changed else ''}")
    facts: dict[str, object] = {}
    if judged := found.get("judged"):
        episodes = counted(judged["episodes"], "episode")
        facts["judged"] = f"return {judged['bundle']['mean_return']:.2f} of the bundle, {episodes}"
    if robot := found.get("changed_robot"):
        facts["robot"] = f"{robot}; the bundle was made and judged with that file"
    facts |= {
        "made with": ", ".join(f"{name} {version}" for name, version in made_with) or "not known",
        "registered": f"{date(found.get('registered')) or '-'} by {found.get('registered_by')}",
        "bundle": f"{found['path']}/bundle",
        "problem": found.get("problem"),
    }
    show_facts(facts, width=12)


def diff(
    model: options.ModelArgument,
    other: Annotated[
        str | None,
        typer.Argument(metavar="NAME[@VERSION]", help="Version to compare with; by default the previous one."),
    ] = None,
    store: options.StoreOption = None,
    as_json: options.JsonOption = False,
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


def verify(
    model: options.ModelArgument, store: options.StoreOption = None, as_json: options.JsonOption = False
) -> None:
    """Read every file of a model and check its digest; exit 1 if one was altered, removed or added."""
    found = _read(model, store, verify=True)
    problem = found.get("problem")
    if as_json:
        echo_json({"name": found["name"], "version": found["version"], "problem": problem})
    else:
        state = f"damaged: {problem}" if problem else "all files are unchanged since registration"
        echo(f"{found['name']}@{found['version']}: {state}")
    if problem:
        raise typer.Exit(1)


def _read(reference: str, store: str | None, **query: Any) -> dict[str, Any]:
    """A model by ``NAME[@VERSION]``. Raises UsageError."""
    name, version = options.split_model(reference)
    with controller(store, None) as connect:
        path = f"/api/models/{named(name)}"
        found: dict[str, Any] = connect().get(path, seconds=300, version=version, **query)
    return found


def _weights(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Difference of the weights, in one line; empty if they are the same."""
    digests = [str(each.get("weights")) for each in (before, now)]
    if digests[0] == digests[1]:
        return ""
    from orchestrator.cli.comparison.weights import difference  # imports the ONNX reader, if that package is installed

    found = difference(*(Path(each["path"]) / "bundle" / POLICY for each in (before, now)))
    return "" if found == "" else f"weights {found or f'differ: SHA-256 {digests[0][:12]} became {digests[1][:12]}'}"


def _changed(place: str, before: Any, now: Any) -> list[str]:
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        keys = sorted({*before, *now})
        return [line for key in keys for line in _changed(f"{place}.{key}", before.get(key), now.get(key))]
    return [] if before == now else [f"{place} {before} became {now}"]
