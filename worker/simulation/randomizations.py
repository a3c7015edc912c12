"""The randomisations of the model: declared quantities, drawn for each world at startup, at resets and at intervals.

The draws are state. The model's values are computed from them and from its original values, so changes never compound and a run resumes
from its state bit for bit.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from worker.simulation.declared_randomization import DISTRIBUTIONS, MOMENTS, OPERATIONS, Randomize
from worker.simulation.episodes import EpisodeArrays
from worker.simulation.inverse_weights import InverseWeights, inertials_of
from worker.simulation.randomization_kernels import (
    FIRST_STREAM,
    STARTUP,
    Bodies,
    BodyFields,
    Entries,
    ModelChanges,
    change_bodies,
    change_numbers,
    draw_at_start,
    draw_due,
)
from worker.simulation.randomization_targets import Change, EntryTargets, body_column, find_target
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.robot_view import RobotView
from worker.simulation.structs import filled
from worker.simulation.worlds import Worlds


@dataclass(frozen=True)
class _Drawn:
    """A change and the column of its draw."""

    change: Change
    entry: Randomize
    column: int


class Randomizations:
    """All declared randomisations of a task: launches only, on arrays with fixed addresses.

    Construct it while the model holds its original values, and before a capture.
    It draws and applies every entry at once, so entries of resets and intervals have a value from the start.

    Of a step, :meth:`settle` costs one launch for the draws, one for each array that entries of resets and intervals change, and
    three where bodies or armatures are among them; threads of worlds in which nothing is due end at once.

    Args:
        entries: Declarations by name. Their order is that in which they are applied, and keys their random numbers: an entry
            added at the end leaves the others' as they were.
        worlds: The task's worlds, whose model is changed.
        episodes: The task's buffers; ``random`` holds seed and global indices already.
        views: Robots and objects by name.
        robots: Their arrays by name, for the encoders' bias.
        control_hz: Control steps per simulated second [Hz].
        streams: Numbers of the streams of some entries at startup, by name; those of others follow from their order.

    Raises:
        ValueError: An entry names an unknown robot, a pattern without a match, or a part without such a property.

    Attributes:
        names: Name of each column of the draws, as ``entry/part/axis``, or ``entry/axis`` of a shared draw.
        draws: The drawn numbers, shape ``(worlds, len(names))``, float32.
    """

    def __init__(
        self,
        entries: Mapping[str, Randomize],
        worlds: Worlds,
        episodes: EpisodeArrays,
        views: Mapping[str, RobotView],
        robots: Mapping[str, RobotArrays],
        control_hz: float,
        streams: Mapping[str, int] | None = None,
    ) -> None:
        self._worlds, self._episodes = worlds, episodes
        self._device = worlds.model.device
        self._entries = dict(entries)
        count = worlds.world_count
        targets = {}
        for name, entry in self._entries.items():
            try:
                targets[name] = find_target(entry, worlds, views)
            except ValueError as error:
                raise ValueError(f"randomize.{name}: {error}") from error
        self._list_entries(targets, control_hz, streams or {})
        draws = wp.zeros((count, len(self.names)), dtype=wp.float32, device=self._device)
        countdowns = wp.zeros((count, len(self._entries)), dtype=wp.int32, device=self._device)
        self._draws, self._countdowns = draws, countdowns
        self.draws = wp.to_torch(draws)
        self._changed = wp.zeros(count, dtype=wp.bool, device=self._device)
        self._all = wp.full(count, True, dtype=wp.bool, device=self._device)
        self._group(targets, robots)
        self.restart()

    def restart(self) -> None:
        """Draw every entry as at startup and apply it, after ``episodes.random`` was reseeded."""
        if not self._entries:
            return
        shape = (self._worlds.world_count, len(self._entries))
        inputs = [self._table, self._episodes, self._draws, self._countdowns]
        wp.launch(draw_at_start, dim=shape, inputs=inputs, device=self._device)
        self.apply()

    def settle(self) -> None:
        """Draw and apply all due entries, at the end of every control step and of a reset, after worlds were placed.

        Reset entries are due in worlds with ``episodes.ages[world] == 0``, and interval entries when their interval ends. A new episode
        restarts the intervals.
        """
        if not self._is_live:
            return
        inputs = [self._table, self._episodes, self._draws, self._countdowns, self._changed]
        wp.launch(draw_due, dim=self._worlds.world_count, inputs=inputs, device=self._device)
        self._write(self._changed, live=True)

    def apply(self) -> None:
        """Recompute the whole model from the draws, after :meth:`state_tensors` were filled from a saved state."""
        self._write(self._all, live=False)

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """Live views of the state kept between control steps, each with leading dimension worlds. Call :meth:`apply` after filling them.

        ``randomization_draws`` are the drawn numbers, float32; ``randomization_countdowns`` the control steps until each interval ends,
        int32, one column per entry.
        """
        if not self._entries:
            return {}
        return {
            "randomization_draws": self.draws,
            "randomization_countdowns": wp.to_torch(self._countdowns),
        }

    def numbers(self) -> dict[str, torch.Tensor]:
        """Live views of the ranges by path, which a curriculum may change. They apply, unchecked, from the next draw on.

        Returns:
            ``<entry>.range``, shape ``(axes, 2)``, or, of a range declared by axis, ``<entry>.range.<axis>``, shape ``(2,)``; and of an
            interval ``<entry>.seconds``, shape ``(2,)``; float32.
        """
        ranges, seconds = wp.to_torch(self._table.ranges), wp.to_torch(self._table.seconds)
        found: dict[str, torch.Tensor] = {}
        for index, (name, entry) in enumerate(self._entries.items()):
            first = self._first_ranges[index]
            if isinstance(entry.range, Mapping):
                found |= {f"{name}.range.{axis}": ranges[first + row] for row, axis in enumerate(entry.drawn_axes)}
            else:
                found[f"{name}.range"] = ranges[first : first + len(entry.ends)]
            if entry.when == "interval":
                found[f"{name}.seconds"] = seconds[index]
        return found

    def _list_entries(self, targets: Mapping[str, EntryTargets], control_hz: float, streams: Mapping[str, int]) -> None:
        """Give every drawn number a column, and every entry its row in the tables."""
        self.names: list[str] = []
        self._first_columns: list[int] = []
        self._first_ranges: list[int] = []
        ranges: list[tuple[float, float]] = []
        counts = []
        for name, entry in self._entries.items():
            self._first_columns.append(len(self.names))
            self._first_ranges.append(len(ranges))
            ranges += entry.ends
            parts = [name] if entry.shared else [f"{name}/{part}" for part in targets[name].names]
            new = [f"{part}/{axis}" if axis else part for part in parts for axis in entry.drawn_axes or ("",)]
            counts.append(len(new))
            self.names += new
        every = list(self._entries.values())
        table = self._table = Entries()
        for field, values in {
            "first_columns": self._first_columns,
            "counts": counts,
            "axes": [len(entry.ends) for entry in every],
            "first_ranges": self._first_ranges,
            "distributions": [DISTRIBUTIONS.index(entry.distribution) for entry in every],
            "moments": [MOMENTS.index(entry.when) for entry in every],
            "streams": [streams.get(name, FIRST_STREAM - index) for index, name in enumerate(self._entries)],
        }.items():
            setattr(table, field, wp.array(values, dtype=wp.int32, device=self._device))
        table.ranges = _pairs(ranges, self._device)
        table.seconds = _pairs([entry.seconds or (0.0, 0.0) for entry in every], self._device)
        table.control_hz = control_hz

    def _group(self, targets: Mapping[str, EntryTargets], robots: Mapping[str, RobotArrays]) -> None:
        """Gather the changes of each array, in the order of the entries."""
        grouped: dict[str, list[_Drawn]] = {}
        for (name, entry), first in zip(self._entries.items(), self._first_columns, strict=True):
            for change in targets[name].changes:
                element = 0 if entry.shared else change.element
                drawn = _Drawn(change, entry, first + element * len(entry.ends) + change.axis)
                grouped.setdefault(change.array, []).append(drawn)
        self._is_live = any(_is_live(entry) for entry in self._entries.values())
        weighty = [*grouped.get("bodies", ()), *grouped.get("dof_armature", ())]
        self._weights = InverseWeights(self._worlds) if weighty else None
        self._weights_live = any(_is_live(drawn.entry) for drawn in weighty)
        bodies = grouped.pop("bodies", None)
        self._bodies = _BodyChanges(bodies, self._worlds) if bodies else None
        self._arrays = [
            _NumberChanges(changes, _array(array, self._worlds, robots)) for array, changes in grouped.items()
        ]

    def _write(self, changed: wp.array[wp.bool], live: bool) -> None:
        """Write the model's numbers in the worlds with ``changed``; with ``live``, only the numbers that can change after startup."""
        if self._bodies and (self._bodies.is_live or not live):
            self._bodies.launch(changed, self._draws)
        written = [array for array in self._arrays if array.is_live or not live]
        for array in written:
            array.launch(changed, self._draws)
        if self._weights and (self._weights_live or not live):
            self._weights.update(changed)
            if self._weights.whole:  # Newton also resolves damping ratios anew, in all worlds
                for array in self._arrays:
                    array.launch(self._all, self._draws)


class _NumberChanges:
    """Changes of numbers in one array.

    Args:
        drawn: The changes.
        values: The array as numbers, shape ``(worlds, columns)``; it holds the model's own values.
    """

    def __init__(self, drawn: list[_Drawn], values: wp.array[wp.float32]) -> None:
        self.is_live = any(_is_live(each.entry) for each in drawn)
        self._device = values.device
        self._values = values
        self._changes, columns = _table(drawn, self._device)
        self._defaults = wp.array(values.numpy()[:, columns], dtype=wp.float32, device=self._device)

    def launch(self, changed: wp.array[wp.bool], draws: wp.array2d[wp.float32]) -> None:
        inputs = [changed, self._changes, draws, self._defaults, self._values]
        wp.launch(change_numbers, dim=self._defaults.shape, inputs=inputs, device=self._device)


class _BodyChanges:
    """Changes of bodies' inertial properties, in Newton's model and in mujoco_warp's."""

    def __init__(self, drawn: list[_Drawn], worlds: Worlds) -> None:
        self.is_live = any(_is_live(each.entry) for each in drawn)
        model = worlds.model
        self._device = model.device
        self._changes, bodies = _table(drawn, self._device)
        shape = (worlds.world_count, model.body_count // worlds.world_count)
        sources: dict[str, wp.array[Any]] = {
            "masses": model.body_mass,
            "centers": model.body_com,
            "inertias": model.body_inertia,
        }
        values = {name: source.reshape(shape) for name, source in sources.items()}
        self._values = filled(Bodies, self._device, **values)
        own = {name: rows.numpy()[:, bodies] for name, rows in values.items()}
        self._defaults = filled(Bodies, self._device, **own)
        self._fields = filled(
            BodyFields,
            self._device,
            columns=[body_column(worlds, body) for body in bodies],
            inverse_masses=model.body_inv_mass.reshape(shape),
            inverse_inertias=model.body_inv_inertia.reshape(shape),
        )
        self._inertials = inertials_of(worlds.solver)
        self._shape = (worlds.world_count, len(bodies))

    def launch(self, changed: wp.array[wp.bool], draws: wp.array2d[wp.float32]) -> None:
        inputs = [changed, self._changes, draws, self._defaults, self._values, self._fields, self._inertials]
        wp.launch(change_bodies, dim=self._shape, inputs=inputs, device=self._device)


def _is_live(entry: Randomize) -> bool:
    """Whether it is drawn again after startup."""
    return MOMENTS.index(entry.when) != STARTUP


def _pairs(values: Iterable[tuple[float, float]], device: wp.Device | None) -> wp.array[wp.vec2]:
    return wp.array(np.array(list(values), np.float32).reshape(-1, 2), dtype=wp.vec2, device=device)


def _table(drawn: list[_Drawn], device: wp.Device | None) -> tuple[Any, list[int]]:
    """The changes as :class:`ModelChanges`, and the changed columns, ascending."""
    columns = sorted({each.change.column for each in drawn})
    of_column: dict[int, list[_Drawn]] = {column: [] for column in columns}
    for each in drawn:
        of_column[each.change.column].append(each)
    ordered = [each for column in columns for each in of_column[column]]
    starts = np.cumsum([0, *(len(of_column[column]) for column in columns)])
    table = filled(
        ModelChanges,
        device,
        columns=columns,
        least=[max(each.change.least for each in of_column[column]) for column in columns],
        greatest=[min(each.change.greatest for each in of_column[column]) for column in columns],
        starts=starts,
        operations=[OPERATIONS.index(each.entry.operation) for each in ordered],
        draws=[each.column for each in ordered],
        factors=[each.change.factor for each in ordered],
        kinds=[each.change.kind for each in ordered],
        axes=[each.change.body_axis for each in ordered],
        points=[each.entry.at for each in ordered],
    )
    return table, columns


def _array(name: str, worlds: Worlds, robots: Mapping[str, RobotArrays]) -> wp.array[wp.float32]:
    """The array of a :class:`Change` as rows of numbers, one row a world: a view, which keeps the array."""
    model: Any = worlds.solver.mjw_model
    if name.startswith("bias "):
        return robots[name.removeprefix("bias ")].encoder_bias
    if name == "gravity":
        source = worlds.model.gravity[: worlds.world_count]  # the last row belongs to no world
    elif name == "opt.gravity":
        source = model.opt.gravity
    elif name.startswith("muster."):
        motors: Any = vars(worlds.model)["muster"]
        source = getattr(motors, name.removeprefix("muster.")).reshape((worlds.world_count, -1))
    else:
        source = getattr(model, name)
    if source.shape[0] != worlds.world_count or not source.is_contiguous:
        raise RuntimeError(f"{name} has shape {source.shape}: it is shared by the {worlds.world_count} worlds")
    rows: wp.array[wp.float32] = wp.array(
        ptr=source.ptr,
        shape=(worlds.world_count, source.size * wp.types.type_size_in_bytes(source.dtype) // 4 // worlds.world_count),
        dtype=wp.float32,
        device=source.device,
        copy=False,
    )
    vars(rows)["owner_of_memory"] = source
    return rows
