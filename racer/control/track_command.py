"""The command ``muster tracks``: the racer's tracks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.cli.command_options import JsonOption, OverwriteOption, StoreOption
from orchestrator.cli.controllers import controller
from orchestrator.cli.listings import Resource, date, show_facts
from orchestrator.cli.misuse import make_group
from orchestrator.cli.outputs import check_output
from orchestrator.cli.terminal import echo, echo_json
from orchestrator.domain.errors import ServerError, UsageError
from racer.control.track_orders import carry_out

TrackArgument = Annotated[
    str, typer.Argument(metavar="NAME", help="A preset (oval), a seed (random:7), or a track of the store.")
]
OutOption = Annotated[
    Path | None,
    typer.Option("--output", "-o", help="Write the track as a picture (.png) or as data (.npy).", show_default=False),
]
NewName = Annotated[str, typer.Option("--name", metavar="NAME", help="Name of the track.")]

_EXAMPLES = """Examples:  muster tracks show random:7 -o track.png
muster tracks make hills --seed 7 --length 45   then   muster tracks list"""


def register(app: typer.Typer) -> None:
    group = make_group(
        "Manage the racer's tracks: list, show, make, import. Tracks are immutable.",
        _EXAMPLES,
        list_tracks,
    )
    group.command("list", epilog="Example:  muster tracks list --json")(list_tracks)
    group.command("show", epilog="Example:  muster tracks show chicane -o chicane.png")(show)
    group.command("make", epilog="Example:  muster tracks make hills --seed 7 --length 45 --width 1.2 -o hills.png")(
        make
    )
    group.command("import", epilog="Example:  muster tracks import reinvent_base.npy --name reinvent")(import_file)
    app.add_typer(group, name="tracks")


def list_tracks(store: StoreOption = None, as_json: JsonOption = False) -> None:
    """List the presets and the tracks of the store, with their measures."""
    _TRACKS.show(_request({"action": "list"}, store), as_json)


def show(
    track: TrackArgument,
    output: OutOption = None,
    overwrite: OverwriteOption = False,
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show a track's measures; with -o draw it as a picture, or write it as a file for other tools."""
    _print(_request({"action": "show", "name": track}, store, output, overwrite), output, as_json)


def make(
    name: Annotated[str, typer.Argument(help="Name of the track.")],
    preset: Annotated[
        str | None, typer.Option(metavar="NAME", help="Exact straights and arcs: oval, rounded-rectangle, chicane.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of a random closed curve.")] = None,
    length: Annotated[
        float | None, typer.Option(help="Length of the centre line, in metres; by default the preset's own, or 30.")
    ] = None,
    width: Annotated[float | None, typer.Option(help="Width of the road, in metres; 1 by default.")] = None,
    spacing: Annotated[float | None, typer.Option(help="Spacing of waypoints, in metres; 0.15 by default.")] = None,
    roughness: Annotated[
        float | None, typer.Option(help="Variation of a random curve: 0 is a circle, 1 is wild; 0.7 by default.")
    ] = None,
    least_radius: Annotated[
        float | None,
        typer.Option(help="Least radius of a random curve, in metres; 0.75 by default.", show_default=False),
    ] = None,
    direction: Annotated[
        str | None,
        typer.Option(metavar="clockwise|counter-clockwise", help="counter-clockwise by default.", show_default=False),
    ] = None,
    output: OutOption = None,
    overwrite: OverwriteOption = False,
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """Make a track from a preset or a seed, and store it."""
    if (preset is None) == (seed is None):
        raise UsageError("give one of --preset (oval, rounded-rectangle, chicane) and --seed N")
    named = {"length": length, "width": width, "spacing": spacing, "direction": direction}
    drawn = {"roughness": roughness, "least_radius": least_radius}
    for option, value in drawn.items():
        if preset is not None and value is not None:
            raise UsageError(
                f"--{option.replace('_', '-')} belongs to --seed; a preset's curves follow from its length"
            )
    measures = {key: value for key, value in {**named, **drawn}.items() if value is not None}
    order = {"action": "make", "name": name, "preset": preset, "seed": seed, "measures": measures}
    _print(_request(order, store, output, overwrite), output, as_json)


def import_file(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="An .npy file of the shape (N, 6): centre, inner and outer x and y, in metres."
        ),
    ],
    name: NewName,
    output: OutOption = None,
    overwrite: OverwriteOption = False,
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """Check a track in DeepRacer's community format, and store it."""
    order = {"action": "import", "file": str(file.absolute()), "name": name}
    _print(_request(order, store, output, overwrite), output, as_json)


def _request(order: Mapping[str, Any], store: str | None, output: Path | None = None, overwrite: bool = False) -> Any:
    """Have another process do it, in the controller's store. Raises UsageError, ServerError."""
    if output is not None:
        check_output(output, overwrite, ".png", ".npy")
    with controller(store, None) as connect:
        place = connect().get("/api/capacity")["store"]
    if not Path(place).is_dir():
        raise ServerError(f"the controller's store, {place}, is not on this machine; run the command where it is")
    return carry_out({**order, "store": place, "output": str(output.absolute()) if output else None})


def _print(track: Mapping[str, Any], output: Path | None, as_json: bool) -> None:
    if as_json:
        echo_json(track, indent=1)
        return
    echo(f"{track['name']}: {track['length']:.2f} m long, {_width(track)} wide, {track['direction']}")
    steps, origin = track["waypoints"] - (not track["closed"]), track.get("origin") or {}
    apart = f"{track['waypoints']}, {track['length'] / steps:.3f} m apart"
    show_facts(
        {"tightest": f"a radius of {track['least_radius']:.2f} m", "waypoints": apart, "from": _origin(origin)}, 11
    )
    for note in origin.get("notes") or ():
        show_facts({"mended": note}, 11)
    show_facts({"kept": date(track.get("created")), "digest": track["digest"], "lies in": track.get("path")}, 11)
    if output is not None:
        echo(f"written: {output}")


def _width(track: Mapping[str, Any]) -> str:
    least, most = track["width"]
    return f"{least:.2f} m" if most - least < 0.005 else f"{least:.2f} to {most:.2f} m"


def _origin(origin: Mapping[str, Any]) -> str:
    """The origin of a track, then its settings."""
    keys = sorted(origin.keys() - {"notes"}, key=lambda key: (key not in ("preset", "seed", "file"), key))
    return ", ".join(f"{key.replace('_', ' ')} {origin[key]}" for key in keys)


_TRACKS = Resource(
    {
        "TRACK": "name",
        "LENGTH": lambda track: f"{track['length']:.2f} m",
        "WIDTH": _width,
        "RADIUS": lambda track: f"{track['least_radius']:.2f} m",
        "DIRECTION": "direction",
        "WAYPOINTS": "waypoints",
        "FROM": lambda track: _origin(track["origin"]),
    },
    problem=("problem", ""),
)
