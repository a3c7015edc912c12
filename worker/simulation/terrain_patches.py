"""Kinds of terrain patches: heights on a grid of points that grow harder with a number from 0 to 1.

The kinds and the meaning of their numbers are those of Isaac Lab's terrain configurations (``isaaclab.terrains.height_field`` and
``isaaclab.terrains.trimesh``), which mjlab took over, so that their terrains can be declared here. Every kind is a field of heights:
vertical faces, such as the riser of a step, become ramps over one cell of the grid.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np

Range = tuple[float, float]

SLACK = 1e-6
"""Share of a step or cell by which a grid point may miss an edge and still be on it: coordinates are rounded."""


class PatchGrid:
    """The points of one patch, whose middle is the origin.

    Args:
        size: Lengths along x and y [m].
        resolution: Distance between neighbouring points [m], a whole part of both lengths.

    Attributes:
        x: Coordinate of each column [m], shape ``(1, columns)``.
        y: Coordinate of each row [m], shape ``(rows, 1)``.
        shape: Rows, columns.
    """

    def __init__(self, size: tuple[float, float], resolution: float) -> None:
        self.size, self.resolution = size, resolution
        columns, rows = (round(length / resolution) for length in size)
        self.x = ((np.arange(columns + 1) - columns / 2) * resolution)[None, :]
        self.y = ((np.arange(rows + 1) - rows / 2) * resolution)[:, None]
        self.shape = (rows + 1, columns + 1)

    def from_middle(self) -> np.ndarray:
        """Distance of each point from the middle along the axis on which it is farther [m]: its lines of equal value are squares."""
        distances: np.ndarray = np.maximum(np.abs(self.x), np.abs(self.y))
        return distances

    def from_edge(self, border: float) -> np.ndarray:
        """Distance of each point from the nearest inner edge of a border [m], negative on the border."""
        width, length = (size / 2 - border for size in self.size)
        distances: np.ndarray = np.minimum(width - np.abs(self.x), length - np.abs(self.y))
        return distances


def between(ends: Range, difficulty: float) -> float:
    """Linear interpolation between both ends by ``difficulty``."""
    return ends[0] + difficulty * (ends[1] - ends[0])


@dataclass(frozen=True, kw_only=True)
class Patch:
    """One kind of ground. To write your own, subclass it as a frozen dataclass and override :meth:`heights`.

    Attributes:
        platform: Side of the flat square in the middle on which robots begin [m].
        border: Width of the level strip at height 0 along the edges [m]. The outermost points are at 0 in any case, so that
            neighbouring patches meet.

    Raises:
        ValueError: A length is negative, or a range goes down.
    """

    platform: float = 1.0
    border: float = 0.25

    FEATURES: ClassVar[tuple[str, ...]] = ()
    """Fields that are lengths on the ground; each must span at least one cell of the resolution."""

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            place = f"{type(self).__name__}.{item.name}"
            if isinstance(value, tuple) and not (len(value) == 2 and 0 <= value[0] <= value[1]):
                raise ValueError(f"{place} is {value}; use two numbers >= 0, the smaller one first")
            if isinstance(value, float | int) and not value >= 0:
                raise ValueError(f"{place} is {value}; use a number >= 0")

    @property
    def name(self) -> str:
        """Name of the kind in labels and tables."""
        return ("inverted " if getattr(self, "inverted", False) else "") + type(self).__name__.lower()

    def heights(self, grid: PatchGrid, difficulty: float, random: np.random.Generator) -> np.ndarray:
        """Height of each point [m], shape ``grid.shape``.

        Args:
            grid: The points.
            difficulty: From 0 (easiest) to 1.
            random: Source of all random numbers.
        """
        raise NotImplementedError

    def check(self, size: tuple[float, float], resolution: float) -> None:
        """Refuse features that patches of this size and resolution can't represent.

        Raises:
            ValueError: Border and platform leave nothing between them, or a part of the ground is smaller than a cell.
        """
        room = min(size) - 2 * self.border - self.platform
        if room < 0:
            raise ValueError(
                f"{type(self).__name__}: a platform of {self.platform:g} m and two borders of {self.border:g} m are wider than a "
                f"patch of {min(size):g} m; make them smaller, or the terrain's size larger"
            )
        for name in self.FEATURES:
            value = getattr(self, name)
            least = value[0] if isinstance(value, tuple) else value
            if least < resolution - SLACK:
                raise ValueError(
                    f"{type(self).__name__}.{name} begins at {least:g} m, less than a cell of the terrain's resolution of "
                    f"{resolution:g} m; make it larger, or the resolution finer"
                )


@dataclass(frozen=True, kw_only=True)
class Flat(Patch):
    """Level ground at height 0. It collides as a box, which is as cheap as a plane."""

    def heights(self, grid: PatchGrid, difficulty: float, random: np.random.Generator) -> np.ndarray:
        return np.zeros(grid.shape)


@dataclass(frozen=True, kw_only=True)
class Slope(Patch):
    """A hill whose height is the product of two ramps towards the middle, cut off at the corners of its platform.

    Attributes:
        slopes: Rise over run, from the easiest to the hardest.
        inverted: Whether it is a hollow.
    """

    slopes: Range = (0.0, 0.7)
    platform: float = 2.0
    inverted: bool = False

    def heights(self, grid: PatchGrid, difficulty: float, random: np.random.Generator) -> np.ndarray:
        width, length = (size / 2 - self.border for size in grid.size)
        top = between(self.slopes, difficulty) * width
        ramp_x = np.clip(1 - np.abs(grid.x) / width, 0, 1)
        ramp_y = np.clip(1 - np.abs(grid.y) / length, 0, 1)
        half = self.platform / 2
        heights: np.ndarray = np.minimum(top * ramp_x * ramp_y, top * (1 - half / width) * (1 - half / length))
        return -heights if self.inverted else heights


@dataclass(frozen=True, kw_only=True)
class Stairs(Patch):
    """Square rings of steps that lead up to a platform in the middle, or down.

    Attributes:
        step_heights: From the easiest to the hardest [m].
        step_width: Tread of a step [m].
        inverted: Whether they lead down.
    """

    step_heights: Range = (0.0, 0.2)
    step_width: float = 0.3
    platform: float = 3.0
    border: float = 1.0
    inverted: bool = False

    FEATURES = ("step_width",)

    def heights(self, grid: PatchGrid, difficulty: float, random: np.random.Generator) -> np.ndarray:
        steps = int((min(grid.size) - 2 * self.border - self.platform) / (2 * self.step_width) + SLACK)
        inside = grid.from_edge(self.border) / self.step_width
        rings = np.clip(np.floor(inside + SLACK) + 1, 0, steps + 1)
        heights: np.ndarray = rings * between(self.step_heights, difficulty)
        return -heights if self.inverted else heights


@dataclass(frozen=True, kw_only=True)
class Grid(Patch):
    """Squares side by side, each at a random height, around a platform at their greatest height.

    Attributes:
        bounds: Greatest height above and below 0, from the easiest to the hardest [m].
        width: Side of a square [m].
    """

    bounds: Range = (0.0, 0.3)
    width: float = 0.4

    FEATURES = ("width",)

    def heights(self, grid: PatchGrid, difficulty: float, random: np.random.Generator) -> np.ndarray:
        bound = between(self.bounds, difficulty)
        counts = [int((size - 2 * self.border) / self.width + SLACK) for size in grid.size]
        squares = random.uniform(-bound, bound, (counts[1], counts[0]))
        columns, rows = (
            np.floor(points / self.width + count / 2 + SLACK).astype(int)
            for points, count in ((grid.x[0], counts[0]), (grid.y[:, 0], counts[1]))
        )
        padded = np.pad(squares, 1)  # around the squares the ground is at 0
        heights = padded[np.ix_(np.clip(rows + 1, 0, counts[1] + 1), np.clip(columns + 1, 0, counts[0] + 1))]
        return np.where(grid.from_middle() <= self.platform / 2 + SLACK, bound, heights)


@dataclass(frozen=True, kw_only=True)
class Steps(Patch):
    """Blocks and pits at random places on level ground, the later over the earlier.

    Attributes:
        step_heights: Height of the highest blocks, from the easiest to the hardest [m]: each block is at plus or minus this, or half of it.
        sides: Least and greatest side of a block [m].
        count: Number of blocks.
    """

    step_heights: Range = (0.05, 0.3)
    sides: Range = (0.3, 1.0)
    count: int = 40

    FEATURES = ("sides",)

    def heights(self, grid: PatchGrid, difficulty: float, random: np.random.Generator) -> np.ndarray:
        top = between(self.step_heights, difficulty)
        heights = np.zeros(grid.shape)
        width, length = (size / 2 - self.border for size in grid.size)
        for _ in range(self.count):
            height = top * random.choice((-1.0, -0.5, 0.5, 1.0))
            side_x, side_y = random.uniform(*self.sides, 2)
            x, y = random.uniform(-width, width), random.uniform(-length, length)
            heights[(np.abs(grid.y - y) <= side_y / 2) & (np.abs(grid.x - x) <= side_x / 2)] = height
        heights[grid.from_edge(self.border) < -SLACK] = 0.0
        heights[grid.from_middle() <= self.platform / 2 + SLACK] = 0.0
        return heights


@dataclass(frozen=True, kw_only=True)
class Rough(Patch):
    """Random heights at every point, all of them multiples of ``step`` from the lower bound on. There is no platform.

    Attributes:
        bounds: Lowest and highest [m].
        step: Difference between neighbouring heights that can be drawn [m].
        grows: Whether both bounds grow from 0 with the difficulty; otherwise every level is equally rough.
        spacing: Distance between random points, straight ground between them [m]; None: the terrain's resolution.
    """

    bounds: Range = (0.02, 0.10)
    step: float = 0.02
    grows: bool = False
    spacing: float | None = None
    platform: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.step > 0:
            raise ValueError(f"Rough.step is {self.step}; use a number > 0")

    def check(self, size: tuple[float, float], resolution: float) -> None:
        super().check(size, resolution)
        if self.spacing is not None and self.spacing < resolution - SLACK:
            raise ValueError(
                f"Rough.spacing is {self.spacing:g} m, less than the terrain's resolution of {resolution:g} m; make it larger"
            )

    def heights(self, grid: PatchGrid, difficulty: float, random: np.random.Generator) -> np.ndarray:
        spacing = self.spacing or grid.resolution
        columns, rows = (int(np.ceil(size / spacing - SLACK)) + 1 for size in grid.size)
        choices = int((self.bounds[1] - self.bounds[0]) / self.step + SLACK) + 1
        drawn = self.bounds[0] + self.step * random.integers(0, choices, (rows, columns))
        heights = (difficulty if self.grows else 1.0) * _between_points(drawn, grid, spacing)
        return np.where(grid.from_edge(self.border) < -SLACK, 0.0, heights)


def _between_points(drawn: np.ndarray, grid: PatchGrid, spacing: float) -> np.ndarray:
    """Bilinear interpolation of heights that were drawn ``spacing`` apart from the first corner on."""
    (rows, down), (columns, right) = (
        np.divmod(np.round((points + size / 2) / spacing, 6), 1.0)  # a point at a drawn one takes its height
        for points, size in ((grid.y[:, 0], grid.size[1]), (grid.x[0], grid.size[0]))
    )
    row, column = rows.astype(int), columns.astype(int)
    below, beside = np.minimum(row + 1, drawn.shape[0] - 1), np.minimum(column + 1, drawn.shape[1] - 1)
    right, down = right[None, :], down[:, None]
    upper = drawn[np.ix_(row, column)] * (1 - right) + drawn[np.ix_(row, beside)] * right
    lower = drawn[np.ix_(below, column)] * (1 - right) + drawn[np.ix_(below, beside)] * right
    heights: np.ndarray = upper * (1 - down) + lower * down
    return heights


@dataclass(frozen=True, kw_only=True)
class Waves(Patch):
    """A sine along x plus a cosine along y. There is no platform.

    Attributes:
        amplitudes: Greatest height above and below 0, from the easiest to the hardest [m].
        count: Waves from border to border.
    """

    amplitudes: Range = (0.0, 0.2)
    count: int = 4
    platform: float = 0.0

    def heights(self, grid: PatchGrid, difficulty: float, random: np.random.Generator) -> np.ndarray:
        width, length = (size - 2 * self.border for size in grid.size)
        along_x = np.sin(2 * np.pi * self.count * (grid.x + width / 2) / width)
        along_y = np.cos(2 * np.pi * self.count * (grid.y + length / 2) / length)
        heights = 0.5 * between(self.amplitudes, difficulty) * (along_x + along_y)
        return np.where(grid.from_edge(self.border) < -SLACK, 0.0, heights)


@dataclass(frozen=True, kw_only=True)
class Gaps(Patch):
    """Square trenches around the platform.

    Attributes:
        widths: Opening of a trench, from the easiest to the hardest, each rounded up to whole cells of the grid [m].
        ground: Width of the ground between two trenches [m].
        count: Greatest number of trenches; as many as fit inside the border.
        depth: Depth of a trench [m]. MuJoCo-Warp occasionally ejects shapes wedged at such a steep wall, more often in deeper trenches.
    """

    widths: Range = (0.2, 0.6)
    ground: float = 1.0
    count: int = 1
    depth: float = 0.3
    platform: float = 2.0

    FEATURES = ("ground",)

    def check(self, size: tuple[float, float], resolution: float) -> None:
        super().check(size, resolution)
        if self.widths[0] < 2 * resolution - SLACK:
            raise ValueError(
                f"Gaps.widths begins at {self.widths[0]:g} m, less than two cells of the terrain's resolution of {resolution:g} m, "
                "which a trench needs; make it larger, or the resolution finer"
            )

    def heights(self, grid: PatchGrid, difficulty: float, random: np.random.Generator) -> np.ndarray:
        width = between(self.widths, difficulty)
        heights = np.zeros(grid.shape)
        distance, room = grid.from_middle(), min(grid.size) / 2 - self.border
        for trench in range(self.count):
            start = self.platform / 2 + trench * (width + self.ground)
            if start + width <= room + SLACK:
                heights[(distance > start + SLACK) & (distance < start + width - SLACK)] = -self.depth
        return heights


@dataclass(frozen=True, kw_only=True)
class Stones(Patch):
    """Stepping stones over a pit: the harder, the smaller, the farther apart and the less even.

    Attributes:
        sides: Least and greatest side of a stone [m]; the easiest are the greatest.
        gap: Distance between the greatest stones [m]. The centres of the stones are the same at every difficulty.
        height_variation: Greatest height of the hardest stones above or below 0 [m].
        side_variation: Variation of the hardest stones' sides [m].
        displacement: Greatest displacement of the hardest stones, along x and y [m].
        depth: Depth of the pit [m]; other frameworks use 2 m, but see :class:`Gaps`.
    """

    sides: Range = (0.4, 0.8)
    gap: float = 0.2
    height_variation: float = 0.1
    side_variation: float = 0.2
    displacement: float = 0.1
    depth: float = 0.3

    FEATURES = ("sides",)

    def heights(self, grid: PatchGrid, difficulty: float, random: np.random.Generator) -> np.ndarray:
        side = self.sides[1] - difficulty * (self.sides[1] - self.sides[0])
        heights = np.full(grid.shape, -self.depth)
        places = []
        for size in grid.size:
            inner = size - 2 * self.border
            count = max(2, int(inner / (self.sides[1] + self.gap) + SLACK) + 1)
            places.append(np.linspace(-inner / 2, inner / 2, count))
        for y in places[1]:
            for x in places[0]:
                sides = side + difficulty * self.side_variation * random.uniform(-1, 1, 2)
                middle = (x, y) + difficulty * self.displacement * random.uniform(-1, 1, 2)
                height = difficulty * self.height_variation * random.uniform(-1, 1)
                inside = np.abs(grid.x - middle[0]) <= sides[0] / 2 + SLACK
                heights[inside & (np.abs(grid.y - middle[1]) <= sides[1] / 2 + SLACK)] = height
        heights[grid.from_edge(self.border) < -SLACK] = 0.0
        heights[grid.from_middle() <= self.platform / 2 + SLACK] = 0.0
        return heights
