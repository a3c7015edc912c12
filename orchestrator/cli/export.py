"""``muster export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.cli import command_options as options
from orchestrator.cli.controllers import controller, see_through
from orchestrator.cli.listings import show_facts
from orchestrator.cli.progress import await_end, follow_main
from orchestrator.cli.runs import chosen
from orchestrator.cli.submitting import submit_spec
from orchestrator.cli.terminal import echo, echo_json
from orchestrator.domain.errors import ServerError, UsageError
from orchestrator.spec.changes import override
from orchestrator.spec.model import validate
from shared_store.contract.error_text import counted
from shared_store.volume import bundles
from shared_store.volume.files import read_json
from shared_store.volume.layout import Store

_EXAMPLES = """Examples:  muster export ant-1f2e3d4c -o ant-policy
muster export ant-1f2e3d4c@300 --episodes 64 --set resources.gpus=1"""


def register(app: typer.Typer) -> None:
    app.command(epilog=_EXAMPLES)(export)


def export(
    source: options.CheckpointArgument,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIRECTORY", help="Copy the bundle to this directory.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing bundle.")] = False,
    episodes: Annotated[
        int, typer.Option(min=0, help="Judge the bundle on at least this many episodes; 0: compare only its actions.")
    ] = 16,
    worlds: Annotated[int, typer.Option(min=1, help="Number of simulated worlds in the comparison.")] = 16,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="Change a key of the job, such as resources.gpus=1. Repeatable."
        ),
    ] = None,
    accept_changed_robot: options.AcceptOption = False,
    store: options.StoreOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Export a policy as a bundle for a robot, and check it.

    A job writes ONNX, contract and self-test to the run's exports/, with a temporary controller if none is running. The bundle appears
    only if its policy acts like the trained one on recorded observations (within 1e-5) and performs as well in the same simulated worlds.
    """
    if output is not None and output.exists():
        if not (output / bundles.MANIFEST).is_file():
            raise UsageError(f"-o {output}: it exists and is not a bundle; name a new directory")
        if not overwrite:
            raise UsageError(f"-o {output}: it exists; --overwrite replaces it")
    run, reference = options.split_reference(source)
    with controller(store, None) as connect:
        client = connect()
        checkpoint = chosen(client, run, reference)
        section = {"run": run, "checkpoint": checkpoint["iteration"], "episodes": episodes, "worlds": worlds}
        section |= {"accept_changed_robot": accept_changed_robot}
        document = {"name": f"export-{run}"[:128], "resources": {"cpus": 1, "memory": "2GiB"}, "export": section}
        spec = validate(override(document, set_ or []), "muster export")
        job = submit_spec(client, spec, "muster export")["jobId"]
        code = see_through(client, job, await_end if as_json else follow_main)
        if code == 0:
            place = Store(client.get("/api/capacity")["store"]).run(run).exports / checkpoint["name"]
            facts = _checks(place, output, overwrite)
            if as_json:
                echo_json({"run": run, "iteration": checkpoint["iteration"], "jobId": job, **facts}, indent=1)
            elif facts["report"] is None:
                echo(_elsewhere(place))
            else:
                _show(facts)
    raise typer.Exit(code)


def _elsewhere(place: Path) -> str:
    return f"the bundle is in the controller's store, {place}, which is not on this machine"


def _checks(place: Path, output: Path | None, overwrite: bool) -> dict[str, Any]:
    """Copy the bundle. Raises ServerError if it can't be copied.

    Returns:
        ``bundle``: its path; ``files``, ``bytes``; ``report``: the results of its checks. None where the store is on another machine.
    """
    if not place.is_dir():
        if output is not None:
            raise ServerError(f"-o {output}: {_elsewhere(place)}; copy it from there")
        return {"bundle": str(place), "files": None, "bytes": None, "report": None}
    try:
        report = read_json(place / bundles.REPORT) or {}
        files = bundles.verify(place)["files"]
        if output is not None:
            bundles.copy(place, output, overwrite)
    except (OSError, ValueError, bundles.DamagedBundle) as error:
        raise ServerError(str(error)) from None
    size = sum(entry["size"] for entry in files.values())
    return {"bundle": str(output or place), "files": len(files) + 1, "bytes": size, "report": report}


def _show(facts: dict[str, Any]) -> None:
    parity, judged = facts["report"].get("parity") or {}, facts["report"].get("judged")
    shown = {}
    if differences := parity.get("greatest_difference"):
        count = sum((parity.get("observations") or {}).values())
        greatest = ", ".join(f"{name} {value:.1e}" for name, value in differences.items())
        shown["parity"] = f"{greatest} at most, over {count:,} observations"
    if judged:
        a, b = judged["trained"], judged["bundle"]
        returns = f"return {b['mean_return']:.2f} of the bundle, {a['mean_return']:.2f} of the trained policy"
        known = b.get("success") is not None and a.get("success") is not None
        successes = f"; success {b['success']:.0%} and {a['success']:.0%}" if known else ""
        shown["judged"] = f"{returns}{successes}; {counted(judged['episodes'], 'episode')}"
    shown["bundle"] = f"{facts['bundle']} ({facts['files']} files, {facts['bytes'] / 1024:.0f} KiB)"
    show_facts(shown, width=12)
