"""Patches by hand, how a terrain puts them together, where worlds are on it, and how levels move."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import pytest
import warp as wp

from tests.support.refusals import refusal
from tests.support.worker.randomized_worlds import build_episodes
from worker.simulation.episodes import STEPS, EpisodeArrays, random_stream
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.robot_elements import empty_builder
from worker.simulation.terrain import ROUGH_KINDS, Terrain
from worker.simulation.terrain_arrays import Ground, TerrainArrays, on_terrain, terrain_origin
from worker.simulation.terrain_levels import walked_levels
from worker.simulation.terrain_patches import (
    Flat,
    Gaps,
    Grid,
    Patch,
    PatchGrid,
    Rough,
    Slope,
    Stairs,
    Steps,
    Stones,
    Waves,
)
from worker.simulation.worlds import WorldArrays

KINDS = (
    Flat(),
    Slope(),
    Slope(inverted=True),
    Stairs(),
    Stairs(inverted=True),
    Grid(),
    Steps(),
    Rough(grows=True),
    Waves(),
    Gaps(count=2),
    Stones(),
)
SIZE, RESOLUTION = (8.0, 8.0), 0.1


def heights(patch: Patch, difficulty: float, seed: int = 0) -> np.ndarray:
    return patch.heights(PatchGrid(SIZE, RESOLUTION), difficulty, np.random.default_rng(seed))


def at(field: np.ndarray, x: float, y: float) -> float:
    """Height of the point that is so far from the patch's middle [m]."""
    return float(field[round((y + SIZE[1] / 2) / RESOLUTION), round((x + SIZE[0] / 2) / RESOLUTION)])


@pytest.mark.parametrize(
    ("patch", "difficulty", "place", "height"),
    [
        (Flat(), 1.0, (1.0, 2.0), 0.0),
        # the ramps run over 4 m less the border: half way on one and at the top of the other
        (Slope(slopes=(0.0, 1.0), border=0.0), 0.5, (2.0, 0.0), 0.5 * 4 * 0.5 * 1),
        (Slope(slopes=(0.0, 1.0), border=0.0), 1.0, (-2.0, 3.0), 4 * 0.5 * 0.25),
        (Slope(slopes=(0.0, 1.0), border=0.0, platform=2.0), 1.0, (0.0, 0.0), 4 * 0.75 * 0.75),
        (Slope(slopes=(0.0, 1.0), border=0.0, inverted=True), 1.0, (2.0, 0.0), -2.0),
        # rings begin 3, 2.7, 2.4, 2.1 and 1.8 m from the middle, the platform 1.5 m from it
        (Stairs(step_heights=(0.0, 0.2)), 0.5, (3.1, 0.0), 0.0),
        (Stairs(step_heights=(0.0, 0.2)), 0.5, (2.8, 0.0), 0.1),
        (Stairs(step_heights=(0.0, 0.2)), 0.5, (0.0, -2.6), 0.2),
        (Stairs(step_heights=(0.0, 0.2)), 0.5, (-1.6, 1.0), 0.5),
        (Stairs(step_heights=(0.0, 0.2)), 1.0, (0.0, 0.0), 1.2),
        (Stairs(step_heights=(0.0, 0.2), inverted=True), 1.0, (0.0, 1.4), -1.2),
        (Grid(bounds=(0.0, 0.3)), 0.5, (0.0, 0.5), 0.15),
        (Steps(), 1.0, (0.4, -0.4), 0.0),
        # a quarter and a half of a wave of 2 m from where it begins: sin 90 + cos 180, and sin 180 + cos 90 degrees
        (Waves(amplitudes=(0.0, 0.4), count=4, border=0.0), 1.0, (-3.5, -3.0), 0.2 * (1 - 1)),
        (Waves(amplitudes=(0.0, 0.4), count=4, border=0.0), 0.5, (-3.5, -4.0), 0.1 * (1 + 1)),
        (Gaps(widths=(0.2, 0.6), platform=2.0, count=2), 1.0, (0.9, 0.0), 0.0),
        (Gaps(widths=(0.2, 0.6), platform=2.0, count=2), 1.0, (1.3, 0.0), -0.3),
        (Gaps(widths=(0.2, 0.6), platform=2.0, count=2), 1.0, (1.7, 0.0), 0.0),
        (Gaps(widths=(0.2, 0.6), platform=2.0, count=2), 1.0, (0.0, 2.9), -0.3),
        # the easiest stones are squares of 0.8 m every 7.5/7 m from the border on
        (Stones(), 0.0, (-3.75 + 7.5 / 7, 3.75), 0.0),
        (Stones(), 0.0, (-3.75 + 7.5 / 14, 3.7 - 7.5 / 14), -0.3),
    ],
)
def test_a_patch_has_the_heights_worked_out_by_hand(
    patch: Patch, difficulty: float, place: tuple[float, float], height: float
) -> None:
    assert at(heights(patch, difficulty), *place) == pytest.approx(height, abs=1e-9)


@pytest.mark.parametrize("patch", KINDS, ids=lambda patch: patch.name)
def test_a_patch_follows_from_its_generator_and_grows_harder(patch: Patch) -> None:
    def hardness(difficulty: float) -> float:
        """Ground in pits, where a kind has any; else the sum of all ascents."""
        fields = [heights(patch, difficulty, seed) for seed in range(4)]
        if isinstance(patch, Gaps | Stones):
            return float(np.mean([field < -0.2 for field in fields]))
        return float(np.mean([np.abs(np.diff(field)).sum() for field in fields]))

    assert np.array_equal(heights(patch, 0.7, seed=3), heights(patch, 0.7, seed=3))
    if isinstance(patch, Flat):
        assert hardness(1.0) == 0
    else:
        assert hardness(0.0) < hardness(1.0)
    if isinstance(patch, Grid | Steps | Rough | Stones):
        assert not np.array_equal(heights(patch, 0.7, seed=3), heights(patch, 0.7, seed=4))
    strip = heights(patch, 1.0)[: round(patch.border / RESOLUTION)]
    assert not strip.any(), "the border is level"


def test_random_heights_are_multiples_of_a_step_within_their_bounds() -> None:
    inner = heights(Rough(bounds=(0.02, 0.10), step=0.02), 0.3)[3:-3, 3:-3]
    steps = np.unique(np.round(inner / 0.02, 9))
    assert steps.tolist() == [1, 2, 3, 4, 5], "as rough as ever at a low difficulty"
    assert heights(Rough(bounds=(0.02, 0.10), grows=True), 0.5).max() == pytest.approx(0.05)
    coarse = heights(Rough(bounds=(0.0, 0.1), spacing=0.5, border=0.0), 1.0)
    assert coarse[5, 2] == pytest.approx(coarse[5, 0] + 0.4 * (coarse[5, 5] - coarse[5, 0]), abs=1e-6), (
        "straight between"
    )


def test_patches_lie_side_by_side_and_meet_at_height_zero() -> None:
    terrain = Terrain(
        kinds={Stairs(): 1.0, Rough(border=0.0): 1.0}, levels=3, size=(8.0, 8.0), resolution=0.1, border=0.0
    )
    assert terrain.corner == (-12.0, -8.0)
    assert terrain.heights.shape == (161, 241)
    hard = terrain.heights[:81, 160:]
    # what begins on its edge belongs to the patch; the edge itself is shared
    assert np.allclose(hard[1:-1, 1:-1], heights(Stairs(), 1.0)[1:-1, 1:-1])
    assert not terrain.heights[:, ::80].any() and not terrain.heights[::80].any()
    assert np.allclose(terrain.origins[:, 0], [(-8, -4, 0), (0, -4, 0.6), (8, -4, 1.2)])
    rough = terrain.heights[80:, 80:161]
    assert terrain.origins[1, 1, 2] == rough[35:46, 35:46].max(), "not in the ground where it is rough in the middle"


def test_a_terrain_follows_from_its_seed_and_a_level_does_not_change_the_others() -> None:
    def rough(**changes: Any) -> np.ndarray:
        return Terrain(kinds={Rough(): 1.0}, size=(2.0, 2.0), resolution=0.1, **changes).heights

    assert np.array_equal(rough(levels=3), rough(levels=3))
    assert not np.array_equal(rough(levels=3), rough(levels=3, seed=1))
    assert np.array_equal(rough(levels=3)[:, :41], rough(levels=2)[:, :41])


def test_columns_are_dealt_to_kinds_by_their_shares() -> None:
    kinds = {Flat(): 0.5, Waves(): 0.3, Rough(): 0.02}
    terrain = Terrain(kinds=kinds, columns=9)
    assert terrain.column_names == ["flat"] * 5 + ["waves"] * 3 + ["rough"]
    assert Terrain(kinds=kinds).column_names == ["flat", "waves", "rough"]
    assert terrain.column_shares[:5].sum() == pytest.approx(0.5 / 0.82)
    mixed = Terrain(kinds=kinds, curriculum=False, levels=2, columns=4, size=(4.0, 4.0))
    assert mixed.column_names == ["mixed"] * 4
    assert mixed.heights.any()


def test_the_default_is_the_rough_terrain_of_others() -> None:
    terrain = Terrain()
    assert list(terrain.kinds.values()) == [0.2, 0.2, 0.2, 0.1, 0.1, 0.1, 0.1]
    assert list(terrain.kinds) == list(ROUGH_KINDS)
    # five steps of 0.1 m and the platform, a hill of slope 1 cut off at its platform, up and down
    tops = terrain.origins[-1, :, 2]
    assert tops[:5] == pytest.approx([0, 0.6, -0.6, 3.75 * (1 - 1 / 3.75) ** 2, -3.75 * (1 - 1 / 3.75) ** 2])


@pytest.mark.parametrize(
    ("build", "parts"),
    [
        (lambda: Terrain(kinds={}), ["Terrain.kinds is empty"]),
        (lambda: Terrain(kinds={Flat(): 0.0}), ["share of Flat is 0.0", "> 0"]),
        (lambda: Terrain(kinds={"flat": 1.0}), ["'flat' is not a patch", "Flat()"]),
        (lambda: Terrain(levels=0), ["Terrain.levels is 0", ">= 1"]),
        (lambda: Terrain(columns=3), ["Terrain.columns is 3", "at least 7"]),
        (lambda: Terrain(resolution=0.0), ["Terrain.resolution is 0.0"]),
        (lambda: Terrain(kinds={Flat(platform=0, border=0): 1}, size=(0.1, 8.0)), ["0.1 m has fewer than 2 cells"]),
        (lambda: Terrain(size=(8.0, 8.05)), ["8.05 m is not a multiple", "use 8"]),
        (lambda: Terrain(size=(4.0, 4.0)), ["Stairs", "wider than a patch of 4 m"]),
        (lambda: Terrain(resolution=0.4), ["Stairs.step_width", "0.3 m", "0.4 m"]),
        (lambda: Terrain(kinds={Gaps(widths=(0.1, 0.5)): 1.0}), ["Gaps.widths", "two cells"]),
        (lambda: Terrain(kinds={Rough(spacing=0.05): 1.0}), ["Rough.spacing"]),
        (lambda: Rough(step=0.0), ["Rough.step is 0.0"]),
        (lambda: Slope(slopes=(0.5, 0.1)), ["Slope.slopes is (0.5, 0.1)"]),
        (lambda: Stairs(platform=-1.0), ["Stairs.platform is -1.0"]),
    ],
)
def test_an_impossible_configuration_is_refused_in_one_line(build: Any, parts: list[str]) -> None:
    output = refusal(build)
    assert all(part in output for part in parts), output


def test_shapes_are_one_a_kind_and_boxes_where_the_ground_is_level() -> None:
    scene = empty_builder()
    shapes = Terrain(columns=14, levels=2).add_to(scene)
    labels = [scene.shape_label[shape] for shape in shapes]
    assert all(label.startswith("terrain/") for label in labels)
    assert [scene.shape_type[shape] for shape in shapes].count(newton.GeoType.HFIELD) == 6
    assert len(shapes) == 7 + 4
    assert len(set(labels)) == len(labels)


def dealt(terrain: Terrain, worlds: int, seed: int = 0, first_world: int = 0) -> tuple[np.ndarray, np.ndarray]:
    ground = Ground(terrain, worlds, "cpu")
    ground.deal(build_episodes(worlds, first_world, seed))
    state = ground.state_tensors()
    return state["terrain_levels"].numpy().copy(), state["terrain_kinds"].numpy().copy()


def test_worlds_are_dealt_by_their_global_index_to_kinds_and_levels() -> None:
    terrain = Terrain(start_level=5)
    levels, kinds = dealt(terrain, 2000, seed=7)
    assert np.bincount(kinds) / 2000 == pytest.approx(terrain.column_shares, abs=0.003)
    assert np.bincount(kinds[500:600]) / 100 == pytest.approx(terrain.column_shares, abs=0.03), "on every rank"
    assert np.bincount(levels) / 2000 == pytest.approx(np.full(6, 1 / 6), abs=0.03)
    part = dealt(terrain, 300, seed=7, first_world=700)
    assert np.array_equal(part[0], levels[700:1000]) and np.array_equal(part[1], kinds[700:1000])
    assert not np.array_equal(dealt(terrain, 300, seed=8, first_world=700)[0], part[0])
    assert dealt(Terrain(start_level=None), 500)[0].max() == 9
    assert dealt(Terrain(start_level=50), 500)[0].max() == 9
    assert dealt(Terrain(start_level=0), 50)[0].max() == 0


@wp.kernel
def _walk(
    command: int,
    episode_seconds: float,
    worlds: WorldArrays,
    robot: RobotArrays,
    terrain: TerrainArrays,
    episodes: EpisodeArrays,
    inside: wp.array[wp.bool],
):
    world = wp.tid()
    walked_levels(world, worlds, robot, terrain, episodes, command, episode_seconds, random_stream(episodes, world))
    origin = terrain_origin(terrain, world)
    inside[world] = on_terrain(terrain, origin[0], origin[1], 0.0) and not on_terrain(terrain, 1e3, 0.0, 20.0)


def walk(ground: Ground, places: np.ndarray, lived: Any, requested: Any) -> np.ndarray:
    """Levels after episodes that end there, after so many steps with such commands."""
    positions, sums, memory = (np.zeros((len(places), width), np.float32) for width in (9, 3, 5))
    positions[:, 2:4], sums[:, int(STEPS)], memory[:, 1:3] = places, lived, requested
    memory[:, [0, 3]] = 50.0  # not the command
    worlds, robot, episodes = WorldArrays(), RobotArrays(), build_episodes(len(places))
    robot.root_coordinate = 2
    worlds.joint_q, episodes.sums, episodes.memory = (
        wp.array(each, dtype=wp.float32, device="cpu") for each in (positions, sums, memory)
    )
    inside = wp.zeros(len(places), dtype=wp.bool, device="cpu")
    inputs = [1, 10.0, worlds, robot, ground.arrays, episodes, inside]
    wp.launch(_walk, dim=len(places), inputs=inputs, device="cpu")
    assert inside.numpy().all()
    return ground.arrays.levels.numpy()


def test_levels_rise_where_the_robot_walked_half_a_patch_and_fall_where_it_stayed_behind() -> None:
    terrain = Terrain(kinds={Flat(): 1.0, Waves(): 1.0}, levels=4, size=(6.0, 6.0))
    ground = Ground(terrain, 8, "cpu")
    #        up, down, stays, up before down, first stays first, new world, beyond the last (twice)
    starts = np.array([1, 1, 1, 2, 0, 2, 3, 3], np.int32)
    kinds = np.array([0, 1, 0, 1, 0, 1, 0, 1], np.int32)
    walked = np.array([3.1, 1.9, 2.1, 3.1, 0.0, 0.0, 5.0, 5.0])
    speed = np.array([0.1, 0.4, 0.4, 2.0, 1.0, 1.0, 0.1, 0.1])
    ground.arrays.levels.assign(starts)
    ground.arrays.kinds.assign(kinds)
    direction = np.array([0.6, -0.8])
    places = terrain.origins[starts, kinds][:, :2] + walked[:, None] * direction
    after = walk(ground, places, [9, 9, 9, 9, 9, 0, 9, 9], speed[:, None] * direction[::-1])
    assert after[:6].tolist() == [2, 0, 1, 3, 0, 2]
    assert ((after[6:] >= 0) & (after[6:] < 4)).all()


def test_beyond_the_last_level_every_level_is_drawn() -> None:
    ground = Ground(Terrain(kinds={Flat(): 1.0}, levels=4, size=(6.0, 6.0)), 400, "cpu")
    ground.arrays.levels.fill_(3)
    after = walk(ground, np.full((400, 2), 99.0), 1, 0)
    assert np.bincount(after) / 400 == pytest.approx(np.full(4, 0.25), abs=0.08)
