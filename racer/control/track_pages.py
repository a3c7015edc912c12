"""The pages of tracks: pictures and measures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any
from urllib.parse import quote

from fastapi import Depends, Query, Request, Response

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.console.forms import Form, body_of, done, sent_form
from orchestrator.console.live import Recent
from orchestrator.console.pages import render
from orchestrator.console.routing import page_router
from orchestrator.domain.errors import ClientError
from racer.control.operations import LIST_TRACKS
from racer.control.track_routes import MakeRequest, list_tracks, make_track, picture
from racer.store import tracks as stored
from shared_store.contract.error_text import nearest

router = page_router(stored=True)

OUTLINE = "/tracks/{}/outline.svg"
"""Address of a track's drawing, in which ``{}`` is its name."""
_SIZE = (240.0, 160.0)
"""Width and height of an outline."""
_GREY, _RED = "#808791", "#d55e00"
"""Colours of road and start line, visible on light and on dark: a picture does not know the page's theme."""
_recent = Recent(60.0)
"""Tracks never change; an added track makes another list."""


@router.get("/tracks")
def tracks(request: Request, name: str = Query(default="", max_length=130)) -> Response:
    """All tracks; with ``name`` that one, so that any seed can be looked at."""
    actor = actor_of(request)
    if name:
        return track(request, name)
    may_make = actor.queues is None
    shown = [facts(each) for each in known(request)]
    return render(request, "tracks.html", tracks=shown, may_make=may_make, presets=stored.PRESETS)


@router.post("/tracks")
def make(request: Request, form: Form = Depends(sent_form)) -> Response:
    """Make a track, for good: of the preset that was chosen, else of the seed."""
    fields = {key: value for key in MakeRequest.model_fields if (value := form.one(key).strip())}
    if "preset" in fields:
        fields.pop("seed", None)
    track = make_track(request, body_of(MakeRequest, {"name": "", **fields}))
    return done(request, f"/tracks/{quote(track['name'], safe='')}", f"made track {track['name']}")


@router.get("/tracks/{name}")
def track(request: Request, name: str) -> Response:
    """A track's picture and measures."""
    found = _one(request, name)
    if "problem" in found:
        raise ClientError(found["problem"], 409)
    return render(request, "track.html", track=facts(found))


@router.get("/tracks/{name}/outline.svg")
def outline(request: Request, name: str) -> Response:
    """A small drawing of a track."""
    found = _one(request, name)
    if "rings" not in found:
        raise ClientError(f"track {name[:130]} can't be drawn", 404)
    return _picture(drawn(found["rings"], found["closed"]).encode(), "image/svg+xml")


@router.get("/tracks/{name}/picture.png")
def large(request: Request, name: str) -> Response:
    """The picture that ``muster tracks show`` draws."""
    controller, actor = controller_of(request), actor_of(request)
    actor.check(LIST_TRACKS)
    key = ("picture", str(controller.access.store.path), name)
    return _picture(_recent.get(key, partial(picture, controller, name)), "image/png")


def known(request: Request) -> Sequence[Mapping[str, Any]]:
    """All tracks with their measures and borders. Raises ClientError."""
    actor = actor_of(request)
    actor.check(LIST_TRACKS)
    store = controller_of(request).access.store
    try:
        names = tuple(stored.names(store))
    except stored.TrackError as error:
        raise ClientError(str(error), 409) from None
    found: Sequence[Mapping[str, Any]] = _recent.get(
        ("tracks", str(store.path), names), partial(list_tracks, request, None, True)
    )
    return found


def track_names(request: Request) -> tuple[list[str], str]:
    """The names of the usable tracks, and the reason where there is none."""
    try:
        return [str(each["name"]) for each in known(request) if "problem" not in each], ""
    except ClientError as error:
        return [], str(error)


def _one(request: Request, name: str) -> Mapping[str, Any]:
    found = {str(each["name"]): each for each in known(request)}
    if name in found:
        return found[name]
    if not stored.is_made(name):
        raise ClientError(f"track {name[:130]!r} does not exist; {nearest(name, [*found, 'random:7'])}", 404)
    store = controller_of(request).access.store
    drawn_one: Mapping[str, Any] = _recent.get(
        ("track", str(store.path), name), partial(list_tracks, request, name, True)
    )[0]
    return drawn_one


def _picture(content: bytes, kind: str) -> Response:
    headers = {
        "Cache-Control": "private, max-age=60",
        "Content-Security-Policy": "default-src 'none'",
        "Cross-Origin-Resource-Policy": "same-origin",
    }
    return Response(content, media_type=kind, headers=headers)


def facts(track: Mapping[str, Any]) -> dict[str, Any]:
    """The facts about a track on its page."""
    name = str(track["name"])
    shown = {"name": name, "path": f"/tracks/{quote(name, safe='')}", "problem": track.get("problem", "")}
    if "problem" in track:
        return {**shown, "facts": []}
    least, most = track["width"]
    origin = track.get("origin") or {}
    details = {
        "Length": f"{track['length']:.2f} m",
        "Width": f"{least:.2f} m" if most - least < 0.005 else f"{least:.2f} to {most:.2f} m",
        "Tightest radius": f"{track['least_radius']:.2f} m",
        "Direction": track["direction"],
        "Waypoints": f"{track['waypoints']}, {track['length'] / (track['waypoints'] - (not track['closed'])):.3f} m apart",
        "From": ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in origin.items() if key != "notes"),
        "Mended": "; ".join(map(str, origin.get("notes") or ())),
        "Digest": track["digest"],
    }
    return {**shown, "about": track.get("about", ""), "facts": list(details.items())}


def drawn(rings: Mapping[str, Sequence[Sequence[float]]], closed: bool = True) -> str:
    """The road between two borders as SVG, with its start line; an open road ends where they do. Numbers alone are written."""
    inner, outer = rings["inner"], rings["outer"]
    points = [*inner, *outer]
    low = [min(float(point[axis]) for point in points) for axis in (0, 1)]
    span = [max(float(point[axis]) for point in points) - low[axis] or 1.0 for axis in (0, 1)]
    scale = min((_SIZE[axis] - 12) / span[axis] for axis in (0, 1))
    edge = [(_SIZE[axis] - span[axis] * scale) / 2 for axis in (0, 1)]

    def place(point: Sequence[float]) -> str:
        x, y = ((float(point[axis]) - low[axis]) * scale + edge[axis] for axis in (0, 1))
        return f"{x:.1f} {_SIZE[1] - y:.1f}"

    outlines = (outer, inner) if closed else ([*outer, *reversed(inner)],)
    road = " ".join(f"M{'L'.join(place(point) for point in ring)}Z" for ring in outlines)
    start = "M" + "L".join(place(point) for point in rings["start"])
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_SIZE[0]:g} {_SIZE[1]:g}">'
        f'<path d="{road}" fill="{_GREY}" fill-rule="evenodd"/>'
        f'<path d="{start}" stroke="{_RED}" stroke-width="3"/></svg>'
    )
