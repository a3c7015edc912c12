"""Terrain in the physics, judged by MuJoCo's own engine: its rays, what rests where, and height scans."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import warp as wp

from tests.support.refusals import refusal
from tests.support.worker.sensing import scene
from tests.support.worker.terms_rig import matrix
from worker.simulation.episodes import CAPACITY_BITS
from worker.simulation.sensors.height_scan import GridPattern, HeightScan, HeightScanSensor, RingPattern
from worker.simulation.sensors.sensor import SensorContext
from worker.simulation.terrain import Terrain
from worker.simulation.terrain_arrays import TerrainArrays, flat_ground, ground_height
from worker.simulation.terrain_patches import Flat, Gaps, Grid, Patch, Rough, Slope, Stairs, Steps, Stones, Waves
from worker.simulation.worlds import Worlds

KINDS: tuple[Patch, ...] = (
    Flat(),
    Slope(slopes=(0.2, 0.8), platform=1.0),
    Slope(slopes=(0.2, 0.8), platform=1.0, inverted=True),
    Stairs(platform=1.0, border=0.3),
    Stairs(platform=1.0, border=0.3, inverted=True),
    Grid(),
    Steps(),
    Rough(),
    Waves(count=2),
    Gaps(platform=1.0),
    Stones(),
)
TERRAIN = Terrain(kinds=dict.fromkeys(KINDS, 1.0), levels=2, size=(4.0, 4.0), border=3.0)
ITEM = """<mujoco><worldbody>
  <body name="thing"><freejoint/>{geom}<site name="eye" pos="0.05 0.1 0.2" euler="0 0 30"/></body>
  <body name="slider" pos="0 0 60"><joint name="slide" type="slide" axis="1 0 0"/>
    <geom size="0.1" contype="0" conaffinity="0"/></body>
</worldbody><actuator><motor joint="slide"/></actuator></mujoco>"""
"""Something that falls, and, far above, something for an actuator to drive."""
BALL = '<geom type="sphere" size="0.06" mass="1"/>'


def context(geom: str, worlds: int, ground: bool | Terrain = TERRAIN) -> SensorContext:
    return scene({"robot": ITEM.format(geom=geom)}, worlds, ground=ground)


@pytest.fixture(scope="module")
def balls() -> SensorContext:
    return context(BALL, 2 * len(KINDS))


@wp.kernel
def _heights(terrain: TerrainArrays, places: wp.array[wp.vec2], heights: wp.array[wp.float32]):
    point = wp.tid()
    heights[point] = ground_height(terrain, places[point][0], places[point][1])


def found_names(terrain: TerrainArrays, places: np.ndarray) -> np.ndarray:
    heights = wp.zeros(len(places), dtype=wp.float32, device="cpu")
    inputs = [terrain, wp.array(places, dtype=wp.vec2, device="cpu"), heights]
    wp.launch(_heights, dim=len(places), inputs=inputs, device="cpu")
    return heights.numpy()


def rays(model: mujoco.MjModel, starts: np.ndarray) -> np.ndarray:
    """Height at which MuJoCo's own vertical rays meet the ground below each start."""
    data = mujoco.MjData(model)
    data.qpos[2] = 100.0
    mujoco.mj_forward(model, data)
    geom = np.zeros(1, np.int32)
    down = np.array([0.0, 0.0, -1.0])
    return np.array(
        [start[2] - mujoco.mj_ray(model, data, start, down, None, 1, -1, geom) for start in starts.astype(float)]
    )


def test_ground_height_is_where_rays_of_mujoco_meet_the_ground(balls: SensorContext) -> None:
    ground = balls.worlds.ground
    assert ground is not None
    half = -np.array(TERRAIN.corner)
    random = np.random.default_rng(5)
    places = random.uniform(-1, 1, (900, 2)) * (half + 2.5)
    places[:100] = np.round(places[:100], 1)  # on the points, and on edges of patches
    places = places.astype(np.float32)
    met = rays(balls.worlds.solver.mj_model, np.c_[places, np.full(len(places), 20.0)])
    assert met.min() < -0.7 and met.max() > 0.9, "pits and hills are among them"
    assert found_names(ground.arrays, places) == pytest.approx(met, abs=1e-4)


def test_beyond_the_patches_and_without_a_terrain_the_ground_is_at_zero(balls: SensorContext) -> None:
    ground = balls.worlds.ground
    assert ground is not None
    far = np.array([(1e6, 0), (0, -1e9), (np.nan, 0), (-TERRAIN.corner[0] + 0.01, 1)], np.float32)
    assert not found_names(ground.arrays, far).any()
    assert not found_names(flat_ground("cpu"), np.append(far, [(0, 0), (0.5, 0.4)], axis=0).astype(np.float32)).any()


def fall(worlds: Worlds, places: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Where things end that begin 8 cm above the highest ground around each place: here, and in MuJoCo's own engine."""
    assert worlds.ground is not None
    around = np.array([(x, y) for x in (-0.07, 0, 0.07) for y in (-0.07, 0, 0.07)])
    highest = np.max([found_names(worlds.ground.arrays, (places + step).astype(np.float32)) for step in around], axis=0)
    worlds.restore_defaults()
    coordinates = worlds.arrays.joint_q.numpy().copy()
    coordinates[:, 0:2], coordinates[:, 2] = places, highest + 0.08
    worlds.arrays.joint_q.assign(coordinates)
    model = worlds.solver.mj_model
    model.opt.timestep, model.opt.iterations, model.opt.tolerance = worlds.timestep, 100, 1e-10
    data = [mujoco.MjData(model) for _ in places]
    for each, start in zip(data, coordinates, strict=True):
        each.qpos[:] = start
        each.qpos[3:7] = start[[6, 3, 4, 5]]
    for _ in range(steps):
        worlds.simulate()
        for each in data:
            mujoco.mj_step(model, each)
    assert not (worlds.arrays.overflow.numpy() & int(CAPACITY_BITS)).any()
    return worlds.arrays.joint_q.numpy()[:, :3], np.array([each.qpos[:3] for each in data])


def test_a_ball_rolls_over_each_kind_as_in_mujocos_own_engine(balls: SensorContext) -> None:
    middles = TERRAIN.origins[1, :, :2]
    places = np.concatenate((middles, middles + np.array((0.95, 0.15)))).astype(np.float32)
    ours, theirs = fall(balls.worlds, places, 110)
    # it rolls down slopes and waves, where a millimetre at the first contact grows
    assert ours == pytest.approx(theirs, abs=0.03)
    assert np.median(np.abs(ours - theirs)) < 1e-4
    level = [KINDS.index(kind) for kind in KINDS if not isinstance(kind, Rough | Waves)]
    assert ours[level, 2] == pytest.approx(TERRAIN.origins[1, level, 2] + 0.06, abs=2e-3), "at rest on each platform"
    assert np.linalg.norm(ours[len(KINDS) + 1, :2] - places[len(KINDS) + 1]) > 0.1, "on a slope it rolls"


def turned(worlds: Worlds, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Put every world's robot somewhere on the terrain, turned in all axes; returns positions and rotations [xyzw]."""
    random = np.random.default_rng(seed)
    coordinates = worlds.arrays.joint_q.numpy().copy()
    half = -np.array(TERRAIN.corner)
    coordinates[:, :2] = random.uniform(-1, 1, (len(coordinates), 2)) * half
    coordinates[:, 2] = random.uniform(3.0, 3.5, len(coordinates))
    rotations = random.normal(size=(len(coordinates), 4)) * (0.4, 0.4, 1, 1)
    coordinates[:, 3:7] = rotations / np.linalg.norm(rotations, axis=1, keepdims=True)
    worlds.arrays.joint_q.assign(coordinates)
    worlds.update_bodies()
    return coordinates[:, :3], coordinates[:, 3:7]


@pytest.mark.parametrize("alignment", ["yaw", "base", "world"])
def test_a_scan_measures_what_rays_of_mujoco_do(alignment: str, balls: SensorContext) -> None:
    worlds = balls.worlds
    positions, rotations = turned(worlds)
    offset = np.array((0.3, -0.1, 0.05))
    declared = HeightScan(bodies="thing", alignment=alignment, offset=tuple(offset), max_distance=50.0)
    sensor = declared.build(balls)
    sensor.advance()
    pattern = np.array([(x, y, 0.0) for y in np.arange(-0.5, 0.51, 0.1) for x in np.arange(-0.8, 0.81, 0.1)])
    assert len(sensor.names) == len(pattern) == 187
    assert sensor.names[0] == "thing -0.80 -0.50"
    for world in (0, 5, 11):
        rotation = matrix(rotations[world])
        heading = math.atan2(rotation[1, 0], rotation[0, 0])
        about = {
            "yaw": matrix(np.array((0, 0, math.sin(heading / 2), math.cos(heading / 2)))),
            "base": rotation,
            "world": np.eye(3),
        }[alignment]
        starts = positions[world] + rotation @ offset + pattern @ about.T
        met = rays(worlds.solver.mj_model, starts)
        # A point at the very edge of a steep cell may be on its other side: coordinates of 20 m have 2 micrometres in float32.
        measured = sensor.arrays.heights.numpy()[world]
        assert measured == pytest.approx(starts[:, 2] - met, abs=3e-4)
        assert sensor.arrays.points.numpy()[world] == pytest.approx(np.c_[starts[:, :2], met], abs=3e-4)


def test_a_scan_of_sites_has_its_points_frame_by_frame_and_a_greatest_distance(balls: SensorContext) -> None:
    worlds = balls.worlds
    positions, rotations = turned(worlds, seed=2)
    ring = RingPattern(radius=0.04, count=4, center=True)
    sensor = HeightScan(sites=("eye",), pattern=ring, alignment="world", max_distance=3.2).build(balls)
    sensor.advance()
    assert sensor.names[:3] == ("eye +0.00 +0.00", "eye +0.04 +0.00", "eye +0.00 +0.04")
    eye = positions + matrix(rotations) @ (0.05, 0.1, 0.2)
    met = rays(worlds.solver.mj_model, eye)
    heights = np.minimum(eye[:, 2] - met, 3.2)
    assert heights.max() == 3.2 and heights.min() < 3.2
    assert sensor.arrays.heights.numpy()[:, 0] == pytest.approx(heights, abs=3e-4)
    two = HeightScan(bodies="*", pattern=RingPattern(0.0, 1), max_distance=100.0).build(balls)
    two.advance()
    assert two.arrays.heights.shape == (worlds.world_count, 2)
    assert two.arrays.heights.numpy()[:, 1] == pytest.approx(np.full(worlds.world_count, 60.0), abs=2.1)


def test_only_worlds_that_were_placed_afresh_are_measured_again(balls: SensorContext) -> None:
    turned(balls.worlds, seed=3)
    sensor: HeightScanSensor = HeightScan(bodies="thing", pattern=RingPattern(0.0, 1), max_distance=50.0).build(balls)
    sensor.advance()
    before = sensor.state_tensors()["heights"].clone()
    turned(balls.worlds, seed=4)
    ages = np.ones(balls.worlds.world_count, np.int32)
    ages[3] = 0
    balls.episodes.ages.assign(ages)
    sensor.settle()
    balls.episodes.ages.fill_(1)
    after = sensor.state_tensors()["heights"]
    changed = (before != after).flatten().tolist()
    assert changed == [world == 3 for world in range(balls.worlds.world_count)]


def test_a_scan_above_a_plane_measures_the_height_itself() -> None:
    scene = context(BALL, 2, ground=True)
    positions, _ = turned(scene.worlds)
    sensor = HeightScan(bodies="thing").build(scene)
    sensor.advance()
    assert sensor.arrays.heights.numpy() == pytest.approx(np.repeat(positions[:, 2:], 187, axis=1), abs=1e-5)


@pytest.mark.parametrize(
    ("scan", "parts"),
    [
        (HeightScan(bodies="thin"), ["thin", "did you mean thing?"]),
        (HeightScan(), ["HeightScan", "either bodies or sites"]),
        (HeightScan(bodies="thing", robot="robo"), ["HeightScan.robot", "'robo'", "robot"]),
        (HeightScan(bodies="thing", alignment="pitch"), ["'pitch'", "yaw, base, world"]),
        (HeightScan(bodies="thing", max_distance=0.0), ["HeightScan.max_distance is 0.0"]),
        (HeightScan(bodies="thing", pattern=GridPattern(resolution=0.0)), ["GridPattern.resolution is 0.0"]),
        (HeightScan(bodies="thing", pattern=GridPattern(resolution=0.001)), ["1,602,601 points", "coarser than 0.001"]),
        (HeightScan(bodies="thing", pattern=GridPattern(size=(-1, 1))), ["GridPattern.size"]),
        (HeightScan(bodies="thing", pattern=RingPattern(0.1, 0)), ["RingPattern has 0 points"]),
    ],
)
def test_a_scan_that_cannot_be_measured_is_refused_in_one_line(
    scan: HeightScan, parts: list[str], balls: SensorContext
) -> None:
    output = refusal(scan.build, balls)
    assert all(part in output for part in parts), output


def test_worlds_refuse_a_terrain_outside_memory() -> None:
    with pytest.raises(ValueError, match="heights, which take about"):
        context(BALL, 1, ground=Terrain(resolution=0.0005))
