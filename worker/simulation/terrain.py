"""Terrain of many patches, side by side: kinds along y, levels of difficulty along x. All worlds share it.

The declaration alone determines the patches, so they are the same on every rank. The physics sees a few shapes: neighbouring columns of
one kind are one height field, level ones and the border are boxes. A field for each patch would add pairs of shapes to every step; one
field for all would reach as high and as deep as the roughest patch, so that the solver would also check every shape of a robot on flat
ground.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import groupby
from typing import Any

import newton
import numpy as np
import psutil
import warp as wp

from worker.simulation.terrain_patches import Flat, Patch, PatchGrid, Rough, Slope, Stairs, Waves

DEPTH = 1.0
"""Depth of the ground below its lowest point [m]: shapes that sink into it are pushed up again."""
PLATFORM_REACH = 0.5
"""A robot starts at the height of the highest point within this distance from the middle of its patch, along x and y [m]."""
BYTES_PER_POINT = 400
"""Memory per point of a height field, during construction and in a model [bytes]: measured, nearly all of it Newton's mesh for rays."""
POINT_LIMIT = 80_000_000
"""Number of points from which the indices of Newton's mesh would not fit in 32 bits."""
LABEL = "terrain"
"""Prefix of its shapes' labels, before a slash."""
COLOR = (0.125, 0.125, 0.15)
"""Red, green and blue of the ground, those of Newton's plane; Newton's other choice would depend on the number of worlds."""


@dataclass(frozen=True, kw_only=True)
class Terrain:
    """A declaration of ground.

    Attributes:
        kinds: Share of the worlds on each kind of patch; the shares need not add up to 1.
        levels: Patches along x. With a curriculum their difficulty grows from 0 to 1.
        columns: Patches along y; None: one per kind, 20 without a curriculum. Each of several columns of one kind is drawn separately.
        size: Lengths of a patch along x and y [m].
        resolution: Distance between neighbouring heights [m]. Risers are as steep as one cell allows; finer fields cost more in every
            step, since each cell that a shape touches is a collision.
        border: Width of the level strip around all patches [m].
        curriculum: Whether difficulty grows with the level. Otherwise kind and difficulty of every patch are random.
        start_level: Highest level at which a world begins (:func:`worker.simulation.terrain_levels.walked_levels` moves it from there);
            None, or a level beyond the last: any.
        friction: Sliding friction of the ground.
        seed: Seed of all randomness in the patches.

    Raises:
        ValueError: The patches can't be built: no kinds, a share that is not positive, a size that is not a multiple of the
            resolution or has under 2 x 2 cells, fewer columns than kinds, or what :meth:`Patch.check` refuses.
    """

    kinds: Mapping[Patch, float] = field(default_factory=lambda: dict(ROUGH_KINDS))
    levels: int = 10
    columns: int | None = None
    size: tuple[float, float] = (8.0, 8.0)
    resolution: float = 0.1
    border: float = 20.0
    curriculum: bool = True
    start_level: int | None = 5
    friction: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.kinds:
            raise ValueError("Terrain.kinds is empty; give at least one, such as {Flat(): 1.0}")
        for patch, share in self.kinds.items():
            if not isinstance(patch, Patch):
                raise ValueError(f"Terrain.kinds: {patch!r} is not a patch; use one such as Flat() or Stairs()")
            if not 0 < share < float("inf"):
                raise ValueError(f"Terrain.kinds: the share of {type(patch).__name__} is {share}; use a number > 0")
        for name, least in {"levels": 1, "seed": 0, "border": 0, "friction": 0, "start_level": 0}.items():
            value = getattr(self, name)
            if value is not None and not value >= least:
                raise ValueError(f"Terrain.{name} is {value}; use a number >= {least}")
        least = len(self.kinds) if self.curriculum else 1
        if self.columns is not None and self.columns < least:
            raise ValueError(f"Terrain.columns is {self.columns}; use at least {least}, one for each kind")
        if not self.resolution > 0:
            raise ValueError(f"Terrain.resolution is {self.resolution}; use a number of metres > 0")
        for length in self.size:
            cells = length / self.resolution
            if not cells >= 2 - 1e-6:
                raise ValueError(
                    f"Terrain.size of {length:g} m has fewer than 2 cells of {self.resolution:g} m; make it larger, or the resolution finer"
                )
            if abs(cells - round(cells)) > 1e-6:
                raise ValueError(
                    f"Terrain.size of {length:g} m is not a multiple of its resolution of {self.resolution:g} m; "
                    f"use {round(cells) * self.resolution:g} m"
                )
        for patch in self.kinds:
            patch.check(self.size, self.resolution)

    @property
    def column_count(self) -> int:
        """Patches along y."""
        return self.columns or (len(self.kinds) if self.curriculum else 20)

    @property
    def cells(self) -> tuple[int, int]:
        """Cells of one patch along x and y."""
        return round(self.size[0] / self.resolution), round(self.size[1] / self.resolution)

    @property
    def corner(self) -> tuple[float, float]:
        """Coordinates x and y of the first point of :attr:`heights` [m]; the middle of all patches is at 0."""
        return -0.5 * self.levels * self.size[0], -0.5 * self.column_count * self.size[1]

    @cached_property
    def column_kinds(self) -> list[int]:
        """Index into ``kinds`` of each column, in order, with a curriculum. Columns are shared out by the kinds' shares, at least one
        each."""
        shares = np.array(list(self.kinds.values())) / sum(self.kinds.values())
        counts = np.ones(len(shares), int)
        for _ in range(self.column_count - len(shares)):
            counts[np.argmax(shares / (counts + 0.5))] += 1  # Sainte-Laguë, as for seats in a parliament
        return [kind for kind, count in enumerate(counts) for _ in range(count)]

    @property
    def column_names(self) -> list[str]:
        """Name of each column's patches, for tables and statistics."""
        if not self.curriculum:
            return ["mixed"] * self.column_count
        names = [patch.name for patch in self.kinds]
        return [names[kind] for kind in self.column_kinds]

    @property
    def column_shares(self) -> np.ndarray:
        """Share of the worlds on each column, shape ``(columns,)``; together 1."""
        if not self.curriculum:
            return np.full(self.column_count, 1 / self.column_count)
        shares = list(self.kinds.values())
        each = np.array([shares[kind] / self.column_kinds.count(kind) for kind in self.column_kinds])
        whole: np.ndarray = each / each.sum()
        return whole

    @cached_property
    def heights(self) -> np.ndarray:
        """Height of every point [m], first along y and then along x, float32, shape ``(columns * cells + 1, levels * cells + 1)``.

        Between four points the ground is two triangles that share the edge from the first to the last of them, as in MuJoCo.
        """
        along_x, along_y = self.cells
        heights = np.zeros((self.column_count * along_y + 1, self.levels * along_x + 1), np.float32)
        for column in range(self.column_count):
            for level in range(self.levels):
                inner = self._patch(column, level)[1:-1, 1:-1]  # the edges stay at 0
                row, start = column * along_y, level * along_x
                heights[row + 1 : row + along_y, start + 1 : start + along_x] = inner
        return heights

    def _patch(self, column: int, level: int) -> np.ndarray:
        random = np.random.default_rng((self.seed, column, level))
        patches = list(self.kinds)
        if self.curriculum:
            patch, difficulty = patches[self.column_kinds[column]], level / max(self.levels - 1, 1)
        else:
            shares = np.array(list(self.kinds.values()))
            patch, difficulty = patches[random.choice(len(patches), p=shares / shares.sum())], random.uniform()
        heights = patch.heights(PatchGrid(self.size, self.resolution), difficulty, random)
        shape = tuple(cells + 1 for cells in reversed(self.cells))
        if heights.shape != shape or not np.isfinite(heights).all():
            raise ValueError(
                f"{type(patch).__name__}.heights gave {heights.shape} numbers; there must be {shape}, all of them finite"
            )
        return heights

    @cached_property
    def origins(self) -> np.ndarray:
        """Start of the robots: the middle of each patch, at the height of its platform [m], shape ``(levels, columns, 3)``, float32."""
        along_x, along_y = self.cells
        reach = round(min(PLATFORM_REACH, *(length / 2 for length in self.size)) / self.resolution)
        origins = np.zeros((self.levels, self.column_count, 3), np.float32)
        for level in range(self.levels):
            for column in range(self.column_count):
                x, y = (level + 0.5) * along_x, (column + 0.5) * along_y
                rows = slice(int(y) - reach, int(np.ceil(y)) + reach + 1)
                near = self.heights[rows, int(x) - reach : int(np.ceil(x)) + reach + 1]
                place = np.array(self.corner) + np.array((x, y)) * self.resolution
                origins[level, column] = (*place, near.max())
        return origins

    def check_memory(self, device: str | None = None) -> None:
        """Refuse a field that would not fit into free memory, before anything is built.

        Args:
            device: Device of the model; heights are on the host too. None: refuse only what no machine can hold.

        Raises:
            ValueError: It would not fit.
        """
        along_x, along_y = self.cells
        points = (self.levels * along_x + 1) * (self.column_count * along_y + 1)
        free = math.inf if device is None else psutil.virtual_memory().available
        if device is not None and (target := wp.get_device(device)).is_cuda:
            free = min(free, target.free_memory)
        most = min(free / BYTES_PER_POINT, POINT_LIMIT)
        if points > most:
            free_memory = "" if device is None else f" of {free / 2**30:,.1f} GiB that are free"
            raise ValueError(
                f"the terrain's {self.levels} x {self.column_count} patches at {self.resolution:g} m have {points:,} heights, which "
                f"take about {points * BYTES_PER_POINT / 2**30:,.1f} GiB{free_memory}; use a resolution of at least "
                f"{self.resolution * (points / most) ** 0.5:.2g} m, or fewer levels and columns"
            )

    def add_to(self, builder: newton.ModelBuilder) -> list[int]:
        """Add the ground to a scene, outside of its worlds.

        Args:
            builder: The scene. ``SolverMuJoCo.register_custom_attributes`` was called on it.

        Returns:
            Its shapes; their labels begin with ``terrain/``.
        """
        config = newton.ModelBuilder.ShapeConfig(mu=self.friction, gap=0.0)
        shapes = [self._add_columns(builder, config, *run) for run in self._runs()]
        for side, (middle, half) in enumerate(self._border()):
            shapes.append(_add_box(builder, config, middle, half, f"border {side}"))
        return shapes

    def _runs(self) -> Iterator[tuple[int, int, str, bool]]:
        """First column, end column, name and flatness of the ground that becomes one shape."""
        if not self.curriculum:
            yield 0, self.column_count, "mixed", False
            return
        patches = list(self.kinds)
        for kind, columns in groupby(range(self.column_count), lambda column: self.column_kinds[column]):
            run = list(columns)
            yield run[0], run[-1] + 1, f"{patches[kind].name} {run[0]}", isinstance(patches[kind], Flat)

    def _add_columns(
        self,
        builder: newton.ModelBuilder,
        config: newton.ModelBuilder.ShapeConfig,
        first: int,
        end: int,
        name: str,
        flat: bool,
    ) -> int:
        cells = self.cells[1]
        y = self.corner[1] + 0.5 * (first + end) * self.size[1]
        half = 0.5 * self.levels * self.size[0], 0.5 * (end - first) * self.size[1]
        heights = self.heights[first * cells : end * cells + 1]
        if flat or not heights.any():
            return _add_box(builder, config, (0.0, y), half, name)
        rows, columns = heights.shape
        return builder.add_shape_heightfield(
            xform=wp.transform((0.0, y, 0.0), wp.quat_identity()),
            heightfield=newton.Heightfield(heights, rows, columns, hx=half[0], hy=half[1]),
            cfg=config,
            color=COLOR,
            label=f"{LABEL}/{name}",
            # Newton's own choice, 0.1 mm, would let a shape that is a little too deep fall through
            custom_attributes={"mujoco:hfield_base": DEPTH},
        )

    def _border(self) -> Iterator[tuple[tuple[float, float], tuple[float, float]]]:
        """Middle and half lengths along x and y of the boxes around all patches [m]."""
        if not self.border:
            return
        x, y = -self.corner[0], -self.corner[1]
        half = 0.5 * self.border
        for side in (-1.0, 1.0):
            yield (0.0, side * (y + half)), (x + self.border, half)
            yield (side * (x + half), 0.0), (half, y)


def _add_box(
    builder: newton.ModelBuilder, config: Any, middle: tuple[float, float], half: tuple[float, float], name: str
) -> int:
    """Add level ground at height 0; returns its shape."""
    place = wp.transform((*middle, -0.5 * DEPTH), wp.quat_identity())
    return builder.add_shape_box(
        -1, xform=place, hx=half[0], hy=half[1], hz=0.5 * DEPTH, cfg=config, color=COLOR, label=f"{LABEL}/{name}"
    )


ROUGH_KINDS: Mapping[Patch, float] = {
    Flat(): 0.2,
    Stairs(step_heights=(0.0, 0.1)): 0.2,
    Stairs(step_heights=(0.0, 0.1), inverted=True): 0.2,
    Slope(slopes=(0.0, 1.0)): 0.1,
    Slope(slopes=(0.0, 1.0), inverted=True): 0.1,
    Rough(): 0.1,
    Waves(): 0.1,
}
"""The kinds of mjlab's ``ROUGH_TERRAINS_CFG`` and their shares; with the other defaults :class:`Terrain` is that terrain."""
