"""Arrays of the terrain for kernels: the height at a point, and the patch of each world."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from worker.simulation.episodes import EpisodeArrays, numbered_stream
from worker.simulation.structs import filled, views_of
from worker.simulation.terrain import Terrain

wp.set_module_options({"enable_backward": False})

LEVEL_STREAM = wp.constant(-(2**20))
"""Number of the stream from which a world's first level is drawn, see :func:`worker.simulation.episodes.numbered_stream`."""
GOLDEN = 0.6180339887498949


@wp.struct
class TerrainArrays:
    """The terrain as terms read it, and each world's patch.

    Attributes:
        levels: Level of each world's patch, shape ``(worlds,)``.
        kinds: Column of each world's patch, which determines its kind (``Terrain.column_names``), shape ``(worlds,)``.
        origins: Start of the robots on each patch [m], shape ``(levels, columns)``.
        heights: Height of each point [m], first along y and then along x, shape as ``Terrain.heights``.
        ends: Sum of the columns' shares up to and with each, shape ``(columns,)``.
        corner: Coordinates x and y of the first point [m].
        size: Lengths of a patch along x and y [m].
        resolution: Distance between neighbouring points [m].
        start_levels: Number of levels on which a world may begin.
    """

    levels: wp.array[wp.int32]
    kinds: wp.array[wp.int32]
    origins: wp.array2d[wp.vec3]
    heights: wp.array2d[wp.float32]
    ends: wp.array[wp.float64]
    corner: wp.vec2
    size: wp.vec2
    resolution: float
    start_levels: int


@wp.func
def ground_height(terrain: TerrainArrays, x: float, y: float) -> float:
    """Height of the ground at a point [m], on the very triangles with which shapes collide; 0 beyond the patches, as their border is."""
    column = (x - terrain.corner[0]) / terrain.resolution
    row = (y - terrain.corner[1]) / terrain.resolution
    rows = terrain.heights.shape[0] - 1
    columns = terrain.heights.shape[1] - 1
    # written so that NaN is outside too
    if not (column >= 0.0 and row >= 0.0 and column <= float(columns) and row <= float(rows)):
        return 0.0
    i = wp.min(int(row), rows - 1)
    j = wp.min(int(column), columns - 1)
    down = row - float(i)
    right = column - float(j)
    first = terrain.heights[i, j]
    last = terrain.heights[i + 1, j + 1]
    if right > down:
        corner = terrain.heights[i, j + 1]
        return first + right * (corner - first) + down * (last - corner)
    corner = terrain.heights[i + 1, j]
    return first + down * (corner - first) + right * (last - corner)


@wp.func
def terrain_origin(terrain: TerrainArrays, world: int) -> wp.vec3:
    """Starting place of a world's robot [m]: the middle of its patch, on the ground."""
    return terrain.origins[terrain.levels[world], terrain.kinds[world]]


@wp.func
def on_terrain(terrain: TerrainArrays, x: float, y: float, margin: float) -> bool:
    """Whether a point is on the patches, or at most ``margin`` beyond them [m]."""
    return wp.abs(x) <= margin - terrain.corner[0] and wp.abs(y) <= margin - terrain.corner[1]


@wp.kernel
def _deal(episodes: EpisodeArrays, golden: wp.float64, terrain: TerrainArrays):
    """Put a world on its column, by its global index, and on its first level, by seed and global index."""
    world = wp.tid()
    # Multiples of the golden ratio fill [0, 1) evenly, whichever worlds a rank has: each kind gets its share of them everywhere.
    place = (wp.float64(episodes.random[world, 1]) + wp.float64(0.5)) * golden
    place = place - wp.floor(place)
    column = int(0)  # noqa: RUF046 (a variable for Warp, not a constant)
    while column < terrain.ends.shape[0] - 1 and place >= terrain.ends[column]:
        column += 1
    terrain.kinds[world] = column
    terrain.levels[world] = wp.randi(numbered_stream(episodes, world, LEVEL_STREAM), 0, terrain.start_levels)


def flat_ground(device: str) -> TerrainArrays:
    """A terrain at height 0 everywhere, for worlds without a terrain; it has no levels and no origins."""
    heights = wp.zeros((2, 2), dtype=wp.float32, device=device)
    origins = wp.zeros((0, 0), dtype=wp.vec3, device=device)
    found: TerrainArrays = filled(TerrainArrays, device, (0,), origins=origins, heights=heights, resolution=1.0)
    return found


class Ground:
    """A terrain on a device, and the patch of every world.

    Args:
        terrain: The declaration.
        world_count: Number of worlds.
        device: ``"cpu"`` or ``"cuda:<n>"``.

    Attributes:
        terrain: The declaration.
        arrays: The struct that kernels read.
    """

    def __init__(self, terrain: Terrain, world_count: int, device: str) -> None:
        self.terrain = terrain
        self._device = device
        first_levels = terrain.levels
        if terrain.curriculum and terrain.start_level is not None:
            first_levels = min(terrain.start_level + 1, terrain.levels)
        self.arrays: TerrainArrays = filled(
            TerrainArrays,
            device,
            (world_count,),
            origins=terrain.origins,
            heights=terrain.heights,
            ends=np.cumsum(terrain.column_shares),
            corner=wp.vec2(*terrain.corner),
            size=wp.vec2(*terrain.size),
            resolution=terrain.resolution,
            start_levels=first_levels,
        )

    def deal(self, episodes: EpisodeArrays) -> None:
        """Put every world on its first patch; call it once, after ``episodes.random`` is set and before worlds are placed."""
        inputs = [episodes, wp.float64(GOLDEN), self.arrays]
        wp.launch(_deal, dim=len(self.arrays.levels), inputs=inputs, device=self._device)

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """Level and column of each world, int32, shape ``(worlds,)``: views, part of the state of a run."""
        return {f"terrain_{name}": rows for name, rows in views_of(self.arrays, "levels", "kinds").items()}
