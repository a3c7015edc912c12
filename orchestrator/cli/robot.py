"""``muster robot``: a robot's file as it is loaded, beside MuJoCo's own reading."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table
from rich.text import Text

from orchestrator.cli.jobs import JsonOption
from orchestrator.cli.recordings import check_output
from orchestrator.cli.tasks import ask_worker
from orchestrator.cli.terminal import echo, echo_json, print_cut, print_wrapped
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
        typer.Option("--output", "-o", help="Draw its default pose into this PNG file.", show_default=False),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing picture.")] = False,
    fixed: Annotated[
        bool | None,
        typer.Option(
            "--fixed/--no-fixed",
            help="Fix its root to the world, or let it move; else as in the file.",
            show_default=False,
        ),
    ] = None,
    ignore: Annotated[
        list[str] | None,
        typer.Option(
            "--ignore",
            metavar="PATTERN",
            help="Leave out these bodies and geoms (repeatable); else floor and ground.",
            show_default=False,
        ),
    ] = None,
    accept: Annotated[
        list[str] | None,
        typer.Option(
            "--accept",
            metavar="PATTERN",
            help='Accept these differences from the file, "ELEMENT: VALUE" (repeatable).',
            show_default=False,
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
    if sys.stderr.isatty():
        echo("importing the simulation, which takes some seconds …", err=True)
    arguments = ["--picture", str(output)] if output else []
    arguments += [] if fixed is None else ["--fixed" if fixed else "--no-fixed"]
    arguments += [
        f"--{name}={each}" for name, given in (("ignore", ignore), ("accept", accept)) for each in given or ()
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


def _print(found: dict[str, Any], compare: bool) -> None:
    root = "no free root" if found["fixed"] else "a free root"
    counts = f"{counted(len(found['bodies']), 'body', 'bodies')}, {counted(len(found['joints']), 'joint')}"
    echo(f"{found['file']}: {found['mass']:g} kg, {counts}, {root}")
    _table(
        "JOINTS",
        ("NAME", "KIND", "LIMITS [rad, m]", "DEFAULT", "STIFFNESS", "DAMPING", "ARMATURE", "EFFORT"),
        [
            (
                each["name"],
                each["kind"],
                _range(each["lower"], each["upper"]),
                *(_number(each[name]) for name in ("default", "stiffness", "damping", "armature", "effort_limit")),
            )
            for each in found["joints"]
        ],
    )
    _table("BODIES", ("NAME", "MASS [kg]"), [(each["name"], f"{each['mass']:.6g}") for each in found["bodies"]])
    _table(
        "ACTUATORS",
        ("NAME", "DRIVES", "GEAR", "GAIN", "STIFFNESS", "DAMPING", "CONTROL", "FORCE", "DYNAMICS"),
        [
            (
                each["name"],
                each["drives"],
                *(_number(each[name]) for name in ("gear", "gain", "stiffness", "damping")),
                *("" if each[name] is None else _range(*each[name]) for name in ("control_range", "force_range")),
                each["dynamics"],
            )
            for each in found["actuators"]
        ],
    )
    _table(
        "TENDONS",
        ("NAME", "LIMITS [rad, m]", "STIFFNESS", "DAMPING", "CONNECTS"),
        [
            (
                each["name"],
                _range(each["lower"], each["upper"]),
                _number(each["stiffness"]),
                _number(each["damping"]),
                ", ".join(each["connects"]),
            )
            for each in found["tendons"]
        ],
    )
    _table(
        "EQUALITIES",
        ("NAME", "KIND", "CONNECTS"),
        [
            (each["name"], each["kind"] if each["active"] else f"{each['kind']}, off", ", ".join(each["connects"]))
            for each in found["equalities"]
        ],
    )
    _table(
        "SENSORS of the file (tasks declare sensors themselves)",
        ("NAME", "KIND"),
        [(each["name"], each["kind"]) for each in found["sensors"]],
    )
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
    if not differences:
        echo(f"\n{title}: nothing; Newton's importer reads the robot that its file says")
        return
    rows = [(each["element"], each["field"], each["here"], each["file"]) for each in differences]
    _table(title, ("ELEMENT", "VALUE", "NEWTON", "FILE"), rows, fold=True)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def _range(lower: float | None, upper: float | None) -> str:
    if lower is None and upper is None:
        return ""
    return " to ".join("-" if each is None else f"{each:.4g}" for each in (lower, upper))


def _table(title: str, columns: tuple[str, ...], rows: Sequence[tuple[str, ...]], fold: bool = False) -> None:
    """``fold``: long cells take several lines, and nothing is cut."""
    if not rows:
        return
    table = Table(box=None, pad_edge=False)
    for column in columns:
        table.add_column(Text(column), overflow="fold", no_wrap=not fold)
    for row in rows:
        table.add_row(*row)
    echo(f"\n{title}")
    if fold:
        print_wrapped(table)
    else:
        print_cut(table)
