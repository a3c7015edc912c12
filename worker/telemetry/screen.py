"""The screen of the live view, in Rerun: shapes on links in 3-D, curves, the log. Nothing else of Muster imports Rerun.

On the timeline ``time`` are wall-clock times; of a recording its own ones. ``iteration`` and ``step`` (control steps) are beside it.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

os.environ["RUST_LOG"] = "off"  # read by the import: a server that is gone is reported in one line, by who started it

import rerun as rr
import rerun.blueprint as rrb

from worker.telemetry.messages import png, tiled

_ROOT, _MIDDLE = "world", "middle"
"""Frames: of all worlds, and of what the eye follows."""
_UPRIGHT = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
"""Turns glTF's y-up into z-up: a quaternion xyzw."""
_COLORS = (
    *((114, 183, 255), (255, 183, 77), (129, 230, 150), (255, 121, 121), (200, 150, 255)),
    *((96, 214, 214), (255, 150, 205), (222, 222, 110), (176, 190, 197), (188, 143, 95)),
)
"""Of curves, on a dark ground."""
_TERMS = 5
"""Control steps whose reward terms are sent together."""
_RECENT = 20.0
"""Seconds of the curves of the watched worlds."""


@dataclass(frozen=True)
class Appearance:
    """The stage of a few equal worlds.

    Attributes:
        links: Names of the links that poses are given for, in order.
        shapes: Binary glTF by link; ``""``: what is fixed to a world, ``"ground"``: what no world has for itself.
        places: Origins of the worlds [m], shape ``(worlds, 3)``.
        terms: Names of the reward terms.
        cameras: Names of the observation groups of images.
    """

    links: tuple[str, ...]
    shapes: Mapping[str, bytes]
    places: np.ndarray
    terms: tuple[str, ...]
    cameras: tuple[str, ...] = ()


@dataclass(frozen=True)
class ShownSteps:
    """Consecutive control steps of the worlds.

    Attributes:
        times: [ns since 1970], shape ``(steps,)``.
        steps: Their numbers.
        poses: Position [m] and quaternion xyzw of the links in their worlds, shape ``(steps, worlds, links, 7)``.
        rewards: Weighted reward terms, mean of the worlds; shape ``(steps, terms)``.
        iteration: Of the training, where there is one.
        images: By camera and index of the step: uint8, shape ``(worlds, height, width, 3)`` or ``(worlds, height, width)``.
        log: Lines: time [ns], source, text.
        returns: Of episodes that ended: time [ns], return.
    """

    times: np.ndarray
    steps: np.ndarray
    poses: np.ndarray
    rewards: np.ndarray
    iteration: int | None = None
    images: Mapping[str, Mapping[int, np.ndarray]] = field(default_factory=dict)
    log: Sequence[tuple[int, str, str]] = ()
    returns: Sequence[tuple[int, float]] = ()


class Screen:
    """A stream to Rerun's server.

    Args:
        server: Its URL, or the path of an .rrd file.
        title: What is shown, in a few words.
        look: Of the worlds.
        live: Whether the newest state is followed; otherwise it is played from its beginning.
    """

    def __init__(self, server: str | Path, title: str, look: Appearance, live: bool) -> None:
        self._look, self._live, self._is_aimed = look, live, False
        self._pending: list[ShownSteps] = []
        """Those whose reward terms are not sent yet."""
        self._rr = rr.RecordingStream("muster")
        self._rr.set_sinks(rr.FileSink(server) if isinstance(server, Path) else rr.GrpcSink(server))
        self._rr.send_recording_name(title)
        self._log_fixed()

    def show(self, shown: ShownSteps) -> None:
        """Show control steps; with the first of all, the eye is placed."""
        count, placed = len(shown.times), self._placed(shown.poses)
        if not self._is_aimed:
            self._is_aimed = True
            self._rr.send_blueprint(_blueprint(placed[0], self._look.cameras, self._live), make_default=True)
        frames = [_frame(world, link) for world in range(placed.shape[1]) for link in self._look.links]
        middle = np.zeros((count, 1, 7))
        middle[:, 0, :3], middle[:, 0, 6] = placed[..., :3].mean((1, 2)), 1.0
        frames.append(_MIDDLE)
        rows = np.concatenate([placed.reshape(count, -1, 7), middle], 1).reshape(-1, 7)
        columns = rr.Transform3D.columns(
            translation=rows[:, :3],
            quaternion=rows[:, 3:],
            child_frame=frames * count,
            parent_frame=[_ROOT] * len(rows),
        )
        self._rr.send_columns("tf", _index(shown.times, shown.steps, shown.iteration, len(frames)), columns)
        self._pending.append(shown)
        if sum(len(each.times) for each in self._pending) >= _TERMS:
            self._send_terms()
        for camera, images in shown.images.items():
            if places := list(images):
                # what a camera saw in all worlds, as one image of tiles
                blobs = [png(tiled(each, math.ceil(math.sqrt(len(each))), ground=0)) for each in images.values()]
                tiles = rr.EncodedImage.columns(blob=blobs, media_type=["image/png"] * len(blobs))
                index = _index(shown.times[places], shown.steps[places], shown.iteration)
                self._rr.send_columns(f"images/{camera}", index, tiles)
        self.log(shown.log)
        self.curve("episodes", [value for _, value in shown.returns], np.array([at for at, _ in shown.returns]), [])

    def _send_terms(self) -> None:
        """Several steps at once: each chunk that is sent costs the browser about the same, whatever is in it."""
        pending, self._pending = self._pending, []
        if self._look.terms and pending:
            times, steps = (np.concatenate([getattr(each, name) for each in pending]) for name in ("times", "steps"))
            rewards = np.concatenate([each.rewards for each in pending]).astype(np.float64)
            columns = rr.Scalars.columns(scalars=rewards.reshape(-1)).partition([len(self._look.terms)] * len(times))
            self._rr.send_columns("terms", _index(times, steps, pending[-1].iteration), columns)

    def curve(self, name: str, values: Sequence[float], times: np.ndarray | None, iterations: Sequence[int]) -> None:
        """Add points to a curve of returns, at times [ns], where they belong on that timeline, and at iterations, if any."""
        index = [] if times is None else [rr.TimeColumn("time", timestamp=times.astype("datetime64[ns]"))]
        if len(iterations):
            index.append(rr.TimeColumn("iteration", sequence=np.asarray(iterations)))
        if len(values) and index:
            self._rr.send_columns(f"return/{name}", index, rr.Scalars.columns(scalars=np.asarray(values, np.float64)))

    def log(self, lines: Iterable[tuple[int, str, str]]) -> None:
        """Add lines of the log: time [ns since 1970], source, text."""
        found = list(lines)
        if found:
            times = np.array([time for time, _, _ in found]).astype("datetime64[ns]")
            texts = [
                f"{str(time)[11:19]}  {source}  {text}" for time, (_, source, text) in zip(times, found, strict=True)
            ]
            self._rr.send_columns("log", [rr.TimeColumn("time", timestamp=times)], rr.TextLog.columns(text=texts))

    def close(self) -> None:
        """Send what was not sent yet, where the server is still there."""
        with contextlib.suppress(RuntimeError, ValueError):
            self._send_terms()
            self._rr.flush(timeout_sec=5.0)
            self._rr.disconnect()

    def _log_fixed(self) -> None:
        """Log the parts that do not move."""
        self._rr.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._rr.log(
            "worlds/middle", rr.Points3D([[0.0, 0.0, 0.0]], radii=0.001), rr.CoordinateFrame(_MIDDLE), static=True
        )
        colors = [_COLORS[number % len(_COLORS)] for number in range(len(self._look.terms))]
        self._rr.log("terms", rr.SeriesLines(names=list(self._look.terms), colors=colors), static=True)
        for name, data in self._look.shapes.items():
            shape = rr.Asset3D(contents=data, media_type="model/gltf-binary")
            entity, is_ground = name.replace("/", "_") or "fixed", name == "ground"
            worlds = (
                [("ground", "ground", np.zeros(3))]
                if is_ground
                else [
                    (f"worlds/world_{world}/{entity}", _frame(world, name), place)
                    for world, place in enumerate(self._look.places)
                ]
            )
            for path, frame, place in worlds:
                self._rr.log(path, shape, rr.CoordinateFrame(frame), static=True)
                if is_ground or not name:
                    upright = rr.Quaternion(xyzw=_UPRIGHT)
                    where = rr.Transform3D(translation=place, quaternion=upright, child_frame=frame, parent_frame=_ROOT)
                    self._rr.log(f"fixed/{frame}", where, static=True)

    def _placed(self, poses: np.ndarray) -> np.ndarray:
        """Poses of the shapes, which are y-up, with the worlds beside each other."""
        x, y, z, w = np.moveaxis(poses[..., 3:].astype(np.float64), -1, 0)
        half = np.sqrt(0.5)  # times _UPRIGHT, from the right
        turned = np.stack([half * (x + w), half * (y + z), half * (z - y), half * (w - x)], -1)
        return np.concatenate([poses[..., :3] + self._look.places[:, None], turned], -1)


def _index(times: np.ndarray, steps: np.ndarray, iteration: int | None, rows: int = 1) -> list[rr.TimeColumn]:
    """The place of control steps on the timelines, with so many rows of each."""
    index = [rr.TimeColumn("time", timestamp=np.repeat(times, rows).astype("datetime64[ns]"))]
    index.append(rr.TimeColumn("step", sequence=np.repeat(steps, rows)))
    if iteration is not None:
        index.append(rr.TimeColumn("iteration", sequence=np.full(len(times) * rows, iteration)))
    return index


def _frame(world: int, link: str) -> str:
    return f"world_{world}/{link}" if link else f"world_{world}"


def _blueprint(placed: np.ndarray, cameras: Sequence[str], live: bool) -> rrb.Blueprint:
    """The views, and an eye that sees all worlds; ``placed``: shape ``(worlds, links, 7)``."""
    low, high = placed[..., :3].min((0, 1)), placed[..., :3].max((0, 1))
    center = (low + high) / 2
    span = max(1.0, float(np.linalg.norm(high - low)))
    cursor = rrb.TimeRangeBoundary.cursor_relative
    recent: Any = rrb.VisibleTimeRange("time", start=cursor(seconds=-_RECENT), end=cursor(seconds=0))
    worlds = rrb.Spatial3DView(
        name="Worlds",
        contents=["/worlds/**", "/ground/**"],
        background=rrb.Background(color=(30, 34, 40)),
        spatial_information=rrb.SpatialInformation(_ROOT, show_axes=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=center + (0.6 * span + 1.2) * np.array([1.0, -0.55, 0.5]),
            look_target=center,
            eye_up=(0, 0, 1),
            tracking_entity="/worlds/middle",
        ),
    )
    images = [rrb.Spatial2DView(name=f"Images: {camera}", origin=f"/images/{camera}") for camera in cameras]
    curves = rrb.Vertical(
        *([rrb.Horizontal(*images)] if images else []),
        rrb.TimeSeriesView(name="Return", contents="/return/**"),
        rrb.TimeSeriesView(name="Reward terms", contents="/terms", time_ranges=recent),
    )
    # each line begins with its time and its source: the view's own columns for these are too narrow to be read
    log = rrb.TextLogView(
        name="Log",
        contents="/log",
        columns=rrb.TextLogColumns(timeline_columns=[], text_log_columns=["Body"]),
        format_options=rrb.TextLogFormat(monospace_body=True),
    )
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(worlds, curves, column_shares=[3, 2]),
            log,
            row_shares=[3, 1],
        ),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="following" if live else "playing"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )
