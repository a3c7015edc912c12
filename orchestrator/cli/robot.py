"""``muster robot``: a robot's file as it is loaded, beside MuJoCo's own reading."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.cli.command_options import JsonOption, OverwriteOption
from orchestrator.cli.listings import Cell, Resource, number
from orchestrator.cli.outputs import check_output
from orchestrator.cli.tasks import ask_worker
from orchestrator.cli.terminal import echo, echo_json
from orchestrator.domain.errors import SpecError
from shared_store.contract.error_text import counted

_EXAMPLES = """Examples:  muster robot arm.urdf
muster robot package:mjlab/asset_zoo/robots/unitree_go1/xmls/go1.xml -o go1.png
muster robot humanoid.xml --compare
muster robot arm.usda --fixed --ignore "table*" --accept "joint root: stiffness\""""


def register(app: typer.Typer) -> None:
    app.command(epilog=_EXAMPLES)(robot)


def robot(
    file: Annotated[str, typer.Argument(help="An MJCF, URDF or USD file: a path, package:NAME/path, or newton:NAME.")],
    compare: Annotated[
        bool,
        typer.Option("--compare", help="List every value that Newton's importer reads otherwise than the file says."),
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Draw its default pose into this PNG file."),
    ] = None,
    overwrite: OverwriteOption = False,
    fixed: Annotated[
        bool | None,
        typer.Option("--fixed/--no-fixed", help="Fix its root to the world, or let it move; else as in the file."),
    ] = None,
    ignore: Annotated[
        list[str] | None,
        typer.Option(
            "--ignore", metavar="PATTERN", help="Leave out these bodies and geoms (repeatable); else floor and ground."
        ),
    ] = None,
    accept: Annotated[
        list[str] | None,
        typer.Option(
            "--accept", metavar="PATTERN", help='Accept these differences from the file, "ELEMENT: VALUE" (repeatable).'
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show a robot's file as a task would load it, beside MuJoCo's own reading.

    It lists joints, limits, masses, actuators, tendons, equalities and sensors, and with -o it draws the default pose. MuJoCo's compiled model judges the file,
    and USD's schema a USD file: what Newton's importer reads otherwise is corrected, and what can't be held is refused by name.
    --fixed, --ignore and --accept are Robot's arguments fixed, ignore and accept.
    """
    if output is not None:
        check_output(output, overwrite, ".png")
    arguments = ["--picture", str(output)] if output else []
    arguments += [] if fixed is None else ["--fixed" if fixed else "--no-fixed"]
    arguments += [
        f"--{name}={each}" for name, patterns in (("ignore", ignore), ("accept", accept)) for each in patterns or ()
    ]
    found: dict[str, Any] = ask_worker("worker.robot", [*arguments, "--", file], f"{file} can't be shown")
    if as_json:
        echo_json(found, indent=1)
        raise typer.Exit(2 if "error" in found else 0)
    if "error" in found:
        if compare and found["differences"]:
            _print_differences("WOULD DIFFER", found["differences"])
        raise SpecError(found["error"])
    _print(found, compare)


def _numbers(*names: str, **keys: str) -> dict[str, Cell]:
    """Columns of numbers: by name, or by heading and key."""
    columns = {name.upper(): name for name in names} | keys
    return {heading: partial(_number, key) for heading, key in columns.items()}


def _number(key: str, row: dict[str, Any]) -> str:
    return number(row[key], ".4g")


def _range(lower: float | None, upper: float | None) -> str:
    if lower is None and upper is None:
        return ""
    return " to ".join(number(each, ".4g") or "-" for each in (lower, upper))


def _limits(row: dict[str, Any]) -> str:
    return _range(row["lower"], row["upper"])


def _connects(row: dict[str, Any]) -> str:
    return ", ".join(row["connects"])


_TABLES: dict[str, dict[str, Cell]] = {
    "JOINTS": {
        "NAME": "name",
        "KIND": "kind",
        "LIMITS [rad, m]": _limits,
        **_numbers("default", "stiffness", "damping", "armature", EFFORT="effort_limit"),
    },
    "BODIES": {"NAME": "name", "MASS [kg]": lambda each: f"{each['mass']:.6g}"},
    "ACTUATORS": {
        "NAME": "name",
        "DRIVES": "drives",
        **_numbers("gear", "gain", "stiffness", "damping"),
        "CONTROL": lambda each: _range(*each["control_range"] or (None, None)),
        "FORCE": lambda each: _range(*each["force_range"] or (None, None)),
        "DYNAMICS": "dynamics",
    },
    "TENDONS": {
        "NAME": "name",
        "LIMITS [rad, m]": _limits,
        **_numbers("stiffness", "damping"),
        "CONNECTS": _connects,
    },
    "EQUALITIES": {
        "NAME": "name",
        "KIND": lambda each: each["kind"] if each["active"] else f"{each['kind']}, off",
        "CONNECTS": _connects,
    },
    "SENSORS of the file (tasks declare sensors themselves)": {"NAME": "name", "KIND": "kind"},
}
"""By title, which begins with the key of the robot's parts."""


def _print(found: dict[str, Any], compare: bool) -> None:
    root = "no free root" if found["fixed"] else "a free root"
    counts = f"{counted(len(found['bodies']), 'body', 'bodies')}, {counted(len(found['joints']), 'joint')}"
    echo(f"{found['file']}: {found['mass']:g} kg, {counts}, {root}")
    for title, columns in _TABLES.items():
        Resource(columns, title=title, blank="").show(found[title.partition(" ")[0].lower()])
    if found["corrected"] and not compare:
        first = found["corrected"][0]
        what = f"{counted(len(found['corrected']), 'value')} that Newton's importer reads otherwise, such as {first['field']} of {first['element']}"
        if first["element"] == "file":
            what = "Newton's importer can't read the file, so the robot is built from MuJoCo's compiled model"
        echo(f"\ncorrected: {what} (--compare lists all)")
    if compare:
        _print_differences("CORRECTED", found["corrected"])
    for note in found["notes"]:
        echo(f"note: {note}")
    if found.get("picture"):
        echo(f"written: {found['picture']}")


def _print_differences(title: str, differences: list[dict[str, str]]) -> None:
    columns = {"ELEMENT": "element", "VALUE": "field", "NEWTON": "here", "FILE": "file"}
    empty = f"\n{title}: nothing; Newton's importer reads the robot that its file says"
    Resource(columns, empty, title=title, blank="", folded=columns).show(differences)
