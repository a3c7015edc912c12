"""``muster export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.cli.clones import split_reference
from orchestrator.cli.jobs import AcceptOption, submit_spec
from orchestrator.cli.serving import StoreOption, controller, see_through
from orchestrator.cli.terminal import echo
from orchestrator.client import Client, named
from orchestrator.domain.errors import ServerError, UsageError
from orchestrator.spec.changes import override
from orchestrator.spec.model import validate
from shared_store.contract.error_text import counted
from shared_store.volume import bundles
from shared_store.volume.files import read_json
from shared_store.volume.layout import Store

_EXAMPLES = """Examples:  muster export ant-1f2e3d4c -o ant-policy
muster export ant-1f2e3d4c@300 --episodes 64 --set resources.gpus=1"""

CheckpointArgument = Annotated[
    str,
    typer.Argument(
        metavar="RUN[@ITERATION|@best|@latest]",
        help="The policy: of a run's newest checkpoint, of an iteration's, or of the one with the best score.",
    ),
]


def register(app: typer.Typer) -> None:
    app.command(epilog=_EXAMPLES)(export)


def export(
    source: CheckpointArgument,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Copy the bundle to this directory, which must not exist.")
    ] = None,
    episodes: Annotated[
        int, typer.Option(min=0, help="Judge the bundle on at least this many episodes; 0: compare only its actions.")
    ] = 16,
    worlds: Annotated[int, typer.Option(min=1, help="Number of simulated worlds in the comparison.")] = 16,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Change a key of the job: resources.gpus=1. Repeatable.")
    ] = None,
    accept_changed_robot: AcceptOption = False,
    store: StoreOption = None,
) -> None:
    """Export a policy as a bundle for a robot (ONNX, contract, self-test), checked against the policy.

    A job writes it to the run's exports/, with a temporary controller if none is running. The bundle appears only if its policy acts like
    the trained one on recorded observations (within 1e-5) and performs as well in the same simulated worlds.
    """
    if output is not None and output.exists():
        raise UsageError(f"-o {output}: exists already; name a new directory")
    run, wanted = split_reference(source)
    with controller(store, None) as connect:
        client = connect()
        checkpoint = chosen(client, run, wanted)
        section = {"run": run, "checkpoint": checkpoint["iteration"], "episodes": episodes, "worlds": worlds}
        section |= {"accept_changed_robot": accept_changed_robot}
        document = {"name": f"export-{run}"[:128], "resources": {"cpus": 1, "memory": "2GiB"}, "export": section}
        spec = validate(override(document, set_ or []), "muster export")
        code = see_through(client, submit_spec(client, spec, "muster export")["jobId"])
        if code == 0:
            place = Store(client.get("/api/capacity")["store"]).run(run).exports / checkpoint["name"]
            _tell(place, output)
    raise typer.Exit(code)


def chosen(client: Client, run: str, wanted: int | str | None) -> dict[str, Any]:
    """The API's description of the referenced checkpoint. Raises UsageError with the nearest one."""
    found: list[dict[str, Any]] = client.get(f"/api/runs/{named(run)}/checkpoints")
    if not found:
        raise UsageError(f"run {run} has no checkpoint yet; train it first")
    if wanted in (None, "latest"):
        return found[-1]
    if wanted == "best":
        best = next((each for each in found if each["best"]), None)
        if best is None:
            raise UsageError(f"run {run} has no checkpoint with a score or two evaluations yet; name an iteration")
        return best
    there = [each for each in found if each["iteration"] == wanted]
    if not there:
        iterations = [str(each["iteration"]) for each in found]
        near = min(found, key=lambda each: abs(each["iteration"] - int(wanted)))["iteration"]
        raise UsageError(
            f"run {run} has no checkpoint of iteration {wanted}; the nearest is {near}; it has: {', '.join(iterations)}"
        )
    return there[-1]


def _tell(place: Path, output: Path | None) -> None:
    """Print the results of the bundle's checks, and copy it. Raises ServerError if the store is on another machine."""
    if not place.is_dir():
        where = f"the bundle is in the controller's store, {place}, which is not on this machine"
        if output is not None:
            raise ServerError(f"-o {output}: {where}; copy it from there")
        echo(where)
        return
    try:
        report = read_json(place / bundles.REPORT) or {}
        manifest = bundles.verify(place)
        if output is not None:
            bundles.copy(place, output)
    except (OSError, ValueError, bundles.DamagedBundle) as error:
        raise ServerError(str(error)) from None
    size = sum(entry["size"] for entry in manifest["files"].values())
    parity, judged = report.get("parity") or {}, report.get("judged")
    if differences := parity.get("greatest_difference"):
        count = sum((parity.get("observations") or {}).values())
        told = ", ".join(f"{name} {value:.1e}" for name, value in differences.items())
        echo(f"  parity:      {told} at most, over {count:,} observations")
    if judged:
        a, b = judged["trained"], judged["bundle"]
        returns = f"return {b['mean_return']:.2f} of the bundle, {a['mean_return']:.2f} of the trained policy"
        known = b.get("success") is not None and a.get("success") is not None
        successes = f"; success {b['success']:.0%} and {a['success']:.0%}" if known else ""
        echo(f"  judged:      {returns}{successes}; {counted(judged['episodes'], 'episode')}")
    echo(f"  bundle:      {output or place} ({len(manifest['files']) + 1} files, {size / 1024:.0f} KiB)")
