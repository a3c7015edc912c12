"""Terms of locomotion, contacts, sensors and the ground, judged by numpy."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.support.refusals import refusal
from tests.support.worker.terms_rig import JOINTS, ROOT, WORLDS, Rig, array, close, matrix, rotations, terms_of
from worker.simulation.sensors.contact import ContactArrays
from worker.simulation.sensors.frames import FrameArrays
from worker.simulation.sensors.height_scan import HeightScanArrays
from worker.simulation.sensors.imu import ImuArrays
from worker.simulation.sensors.momentum import MomentumArrays
from worker.simulation.sensors.rays import RayArrays
from worker.simulation.terrain_arrays import TerrainArrays
from worker.tasks.terms.tolerances import ToleranceArrays, Tolerances

FEET, POINTS, COMMAND = 4, 6, 10
near = partial(close, rtol=2e-4, atol=3e-5)


def structs() -> dict[Any, Any]:
    random = np.random.default_rng(5)
    touch = random.random((WORLDS, FEET)) < 0.5
    touch[0] = [True, False, False, False]  # one foot stands
    arrays = ContactArrays()
    arrays.found = array(touch * random.integers(1, 4, touch.shape), wp.int32)
    arrays.forces = array(20 * touch[..., None] * random.normal(size=(*touch.shape, 3)), wp.vec3)
    arrays.air_time = array(~touch * random.uniform(0.02, 0.6, touch.shape))
    arrays.contact_time = array(touch * random.choice([0.02, 0.3], touch.shape))
    arrays.last_air_time = array(random.uniform(0, 0.5, touch.shape))
    arrays.last_contact_time = array(random.uniform(0, 0.5, touch.shape))
    arrays.peaks = array(random.uniform(0, 4, touch.shape))
    arrays.history = array(random.uniform(0, 20, (*touch.shape, 5)))
    arrays.step, arrays.seconds = 0.004, 0.02
    frames = FrameArrays()
    frames.positions = array(random.normal(size=(WORLDS, FEET, 3)), wp.vec3)
    frames.rotations = array(rotations(random, WORLDS, FEET), wp.quat)
    frames.linear = array(random.normal(size=(WORLDS, FEET, 3)), wp.vec3)
    frames.angular = array(random.normal(size=(WORLDS, FEET, 3)), wp.vec3)
    imu = ImuArrays()
    for name in ("gyro", "accelerometer", "velocimeter"):
        setattr(imu, name, array(random.normal(size=(WORLDS, 3)), wp.vec3))
    imu.rotations = array(rotations(random, WORLDS), wp.quat)
    momentum = MomentumArrays()
    for name in ("angular", "velocities", "centers"):
        setattr(momentum, name, array(random.normal(size=(WORLDS, 3)), wp.vec3))
    momentum.masses = array(random.uniform(1, 2, WORLDS))
    scan = HeightScanArrays()
    scan.heights = array(random.normal(size=(WORLDS, POINTS)))
    scan.points = array(random.normal(size=(WORLDS, POINTS, 3)), wp.vec3)
    terrain = TerrainArrays()
    terrain.levels, terrain.kinds = array([0, 1, 1], wp.int32), array([2, 0, 1], wp.int32)
    terrain.origins = array(random.normal(size=(2, 3, 3)), wp.vec3)
    slope = 0.3 * np.arange(13) - 1.8  # height = 0.3 (x + 6) - 1.8 = 0.3 x along x, whatever y
    terrain.heights = array(np.tile(slope, (13, 1)))
    terrain.corner, terrain.size, terrain.resolution = wp.vec2(-6.0, -6.0), wp.vec2(2.0, 3.0), 1.0
    allowed = ToleranceArrays()
    allowed.columns = array([0, 3], wp.int32)
    allowed.standing, allowed.walking, allowed.running = array([0.5, 1.0]), array([1.0, 2.0]), array([3.0, 4.0])
    rays = RayArrays()
    rays.distances = array(random.uniform(0.1, 5.0, (WORLDS, POINTS)))
    found = (arrays, frames, imu, momentum, scan, terrain, rays, allowed)
    kinds = (ContactArrays, FrameArrays, ImuArrays, MomentumArrays, HeightScanArrays, TerrainArrays, RayArrays)
    return dict(zip((*kinds, ToleranceArrays), found, strict=True))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    made = Rig(
        terms_of("contacts", "ground", "locomotion", "sensing", "tolerances"),
        tmp_path_factory.mktemp("locomotion"),
        structs(),
    )
    values = made.episodes.memory.numpy()
    values[:, COMMAND : COMMAND + 3] = [[0.3, -0.4, 0.2], [0.0, 0.0, 0.04], [1.2, 0.5, 0.9]]  # walk, nearly stand, run
    made.episodes.memory.assign(values)
    made.episodes.sums = array(np.ones((WORLDS, 3)))
    return made


@pytest.fixture
def rig(made: Rig) -> Iterator[Rig]:
    with made.kept():
        yield made


def test_tracking_rewards_and_errors(rig: Rig) -> None:
    r, requested = rig.root(), rig.episodes.memory.numpy()[:, COMMAND : COMMAND + 3].astype(float)
    planar = requested * [1, 1, 0]
    seen = (r.linear[:, 0] + 1j * r.linear[:, 1]) * np.exp(-1j * r.yaw)
    for name, error in {
        "track_linear_velocity": ((r.own_origin - planar) ** 2).sum(1),
        "track_angular_velocity": ((r.own_angular - requested * [0, 0, 1]) ** 2).sum(1),
        "track_planar_velocity": ((r.own_linear - requested)[:, :2] ** 2).sum(1),
        "track_planar_velocity_by_heading": np.abs(seen - requested[:, 0] - 1j * requested[:, 1]) ** 2,
        "track_turning_velocity": (r.own_angular[:, 2] - requested[:, 2]) ** 2,
        "track_turning_velocity_in_world": (r.angular[:, 2] - requested[:, 2]) ** 2,
    }.items():
        near(rig.call(name, command=COMMAND, std=1.5), np.exp(-error / 2.25), name)
    near(
        rig.call("planar_velocity_error", command=COMMAND),
        np.linalg.norm((r.own_origin - requested)[:, :2], axis=1),
    )
    near(rig.call("turning_velocity_error", command=COMMAND), np.abs(r.own_angular[:, 2] - requested[:, 2]))
    length = np.linalg.norm(planar, axis=1)
    along = np.where(length > 0, (r.own_origin * planar).sum(1) / np.maximum(length, 1e-9), 0)
    near(rig.call("velocity_along_command", command=COMMAND), np.minimum(along, length))
    near(rig.call("heading_error", command=COMMAND), np.abs(requested[:, 2]))
    near(rig.call("distance_left", command=COMMAND), length)
    near(rig.call("near_place", command=COMMAND, std=0.4), 1 - np.tanh(length / 0.4))


def test_posture(rig: Rig) -> None:
    offsets = rig.q[:, rig.robot.coordinates.numpy()] - rig.robot.defaults.numpy()
    near(rig.call("posture", std=1.2), np.exp(-(offsets**2).mean(1) / 1.44))
    for joint in range(JOINTS):
        found = rig.call("deviation_when_standing", joint, command=COMMAND)
        near(found, np.abs(offsets[:, joint]) * [0, 1, 0])
    r = rig.root()
    moves = (r.origin**2).sum(1) + (r.angular**2).sum(1)
    near(rig.call("motion_when_standing", command=COMMAND), moves * [0, 1, 0])
    two = offsets[:, [0, 3]]
    near(rig.call("tolerant_posture"), np.exp(-((two / [0.5, 1.0]) ** 2).mean(1)))
    allowed = np.array([[1.0, 2.0], [0.5, 1.0], [3.0, 4.0]])
    near(rig.call("commanded_posture", command=COMMAND), np.exp(-((two / allowed) ** 2).mean(1)))


def test_contacts(rig: Rig) -> None:
    c, f = rig.structs[ContactArrays], rig.structs[FrameArrays]
    touch, force = c.found.numpy() > 0, c.forces.numpy()
    norm = np.linalg.norm(force, axis=-1)
    came = (c.contact_time.numpy() > 0) & (c.contact_time.numpy() < 0.021)
    went = (c.air_time.numpy() > 0) & (c.air_time.numpy() < 0.021)
    air, speed = c.air_time.numpy(), np.linalg.norm(f.linear.numpy()[..., :2], axis=-1)
    peaks, history, lifted = c.peaks.numpy(), c.history.numpy(), np.abs(f.positions.numpy()[..., 2] - 0.1)
    assert came.any() and not came.all() and touch.any()
    asks = np.array([[True], [False], [True]])  # for 0.7, 0.04 and 2.2; planar 0.5, 0 and 1.3
    for foot in range(FEET):
        for name, requested, numbers in (
            ("in_contact", touch, {}),
            ("contact_strength", norm, {}),
            ("air_time", air, {}),
            ("contact_time", c.contact_time.numpy(), {}),
            ("touchdown", came, {}),
            ("liftoff", went, {}),
            ("time_in_air", (air > 0.05) & (air < 0.5), {}),
            ("commanded_time_in_air", (air > 0.05) & (air < 0.5) & asks, {"command": COMMAND}),
            ("step_time", came * asks * (c.last_air_time.numpy() - 0.4), {"command": COMMAND, "target": 0.4}),
            ("foot_slip", asks * touch * speed**2, {"command": COMMAND, "threshold": 0.1}),
            ("foot_slide", (peaks > 1) * speed, {}),
            ("soft_landing", asks * came * norm, {"command": COMMAND}),
            ("foot_clearance", asks * lifted * speed, {"command": COMMAND, "height": 0.1, "threshold": 0.1}),
            ("foot_stumble", np.linalg.norm(force[..., :2], axis=-1) > 2 * np.abs(force[..., 2]), {"ratio": 2.0}),
            ("contact_count", c.found.numpy(), {}),
            ("column_hard_contact_steps", (history > 15).sum(-1), {"force": 15.0}),
            ("undesired_contact", peaks > 2, {"force": 2.0}),
            ("contact_force_excess", np.maximum(peaks - 2, 0), {"force": 2.0}),
            ("illegal_contact", history.max(-1) > 18, {"force": 18.0}),
        ):
            near(rig.call(name, foot, **numbers), requested[:, foot], name)
        near(rig.call("contact_force", foot), force[:, foot])
        near(rig.call("contact_force_logarithm", foot), (np.sign(force) * np.log1p(np.abs(force)))[:, foot])
    near(rig.call("hard_contact_steps", force=18.0), (history.max(1) > 18).sum(-1))
    near(rig.call("no_contact", force=3.0), ~(peaks > 3).any(1))
    times = np.where(touch, c.contact_time.numpy(), air).min(1)
    alone = (touch.sum(1) == 1) & asks[:, 0]
    assert alone.any() and not alone.all()
    near(rig.call("single_stance_time", command=COMMAND, greatest=0.3), alone * np.minimum(times, 0.3))


@pytest.mark.parametrize("where", ["flat", "terrain"])
def test_the_greatest_height_of_a_swing_counts_at_touchdown(rig: Rig, where: str) -> None:
    c, f = rig.structs[ContactArrays], rig.structs[FrameArrays]
    term = "swing_height_error" if where == "flat" else "swing_height_error_above_ground"
    numbers = {"command": COMMAND, "memory": 20, "height": 0.1}
    values = rig.episodes.memory.numpy()
    values[:, 20:24] = 0.0
    rig.episodes.memory.assign(values)
    swing = (0.05, 0.13, 0.08)
    for height in swing:
        c.found.zero_()
        c.contact_time.zero_()
        places = f.positions.numpy()
        places[..., 2] = height + (0.3 * places[..., 0] if where == "terrain" else 0.0)
        f.positions.assign(places)
        assert not rig.call(term, 1, **numbers).any()
    c.found.fill_(1)
    c.contact_time.fill_(0.02)
    near(rig.call(term, 1, threshold=0.1, **numbers), (max(swing) / 0.1 - 1) ** 2 * np.array([1, 0, 1]))
    assert not rig.episodes.memory.numpy()[:, 20:24].any()


def test_sensors(rig: Rig) -> None:
    imu, frames, momentum = rig.structs[ImuArrays], rig.structs[FrameArrays], rig.structs[MomentumArrays]
    turn = matrix(imu.rotations.numpy())
    near(rig.call("imu_angular_velocity"), imu.gyro.numpy())
    near(rig.call("imu_linear_velocity"), imu.velocimeter.numpy())
    near(rig.call("imu_acceleration"), imu.accelerometer.numpy())
    near(rig.call("imu_projected_gravity"), -turn[:, 2, :])
    near(rig.call("imu_acceleration_squared"), ((imu.accelerometer.numpy() - 9.81 * turn[:, 2, :]) ** 2).sum(1))
    near(matrix(rig.call("imu_orientation")), turn)
    turns = matrix(frames.rotations.numpy())
    for column in range(FEET):
        near(rig.call("frame_position", column), frames.positions.numpy()[:, column])
        near(rig.call("frame_height", column), frames.positions.numpy()[:, column, 2])
        near(matrix(rig.call("frame_orientation", column)), turns[:, column])
        near(rig.call("frame_linear_velocity", column), frames.linear.numpy()[:, column])
        near(rig.call("frame_angular_velocity", column), frames.angular.numpy()[:, column])
        own = np.einsum("wji,wj->wi", turns[:, column], frames.linear.numpy()[:, column])
        near(rig.call("frame_velocity_in_own_frame", column), own)
    for index in range(6):
        near(rig.call("frame_orientation_element", index), turns[:, 0, :, :2].reshape(WORLDS, 6)[:, index])
    near(rig.call("angular_momentum"), momentum.angular.numpy())
    near(rig.call("angular_momentum_squared"), (momentum.angular.numpy() ** 2).sum(1))
    near(rig.call("center_of_mass_velocity"), momentum.velocities.numpy())
    near(rig.call("center_of_mass"), momentum.centers.numpy())
    distances = rig.structs[RayArrays].distances.numpy()
    near(rig.call("ray_distance", 1), distances[:, 1])
    near(rig.call("nearest_obstacle"), distances.min(1))


def test_the_ground(rig: Rig) -> None:
    scan, terrain, frames = rig.structs[HeightScanArrays], rig.structs[TerrainArrays], rig.structs[FrameArrays]
    heights, here = scan.heights.numpy(), rig.q[:, ROOT : ROOT + 3].astype(float)
    near(rig.call("scanned_height", 4, offset=0.5), heights[:, 4] - 0.5)
    near(rig.call("scanned_height_mean"), heights.mean(1))
    near(rig.call("scanned_height_error_squared", target=0.3), (heights.mean(1) - 0.3) ** 2)
    r, requested = rig.root(), []
    for world, points in enumerate(scan.points.numpy().astype(float)):
        a, b, _ = np.linalg.lstsq(np.column_stack([points[:, :2], np.ones(POINTS)]), points[:, 2], rcond=None)[0]
        local = r.turn[world].T @ (np.array([-a, -b, 1]) / np.sqrt(a * a + b * b + 1))
        requested.append(np.exp(-(local[:2] ** 2).sum() / 0.64))
    near(rig.call("upright_on_ground", std=0.8), requested)
    above = here[:, 2] - 0.3 * here[:, 0]
    near(rig.call("height_above_ground"), above)
    near(rig.call("too_low_above_ground", height=float(np.median(above))), above < np.median(above))
    feet = frames.positions.numpy()
    clear = feet[..., 2] - 0.3 * feet[..., 0]
    speed = np.linalg.norm(frames.linear.numpy()[..., :2], axis=-1)
    for foot in range(FEET):
        near(rig.call("frame_height_above_ground", foot), clear[:, foot])
        found = rig.call("foot_clearance_above_ground", foot, command=COMMAND, height=0.1, threshold=0.1)
        near(found, np.abs(clear[:, foot] - 0.1) * speed[:, foot] * [1, 0, 1])
    near(rig.call("terrain_level"), [0, 1, 1])
    way = here - terrain.origins.numpy()[[0, 1, 1], [2, 0, 1]]
    beyond = (np.abs(way[:, 0]) > 0.3) | (np.abs(way[:, 1]) > 0.45)
    assert beyond.any()
    near(rig.call("left_patch", share=0.3), beyond & [False, True, True])  # the first has just begun
    near(rig.call("left_terrain", margin=-5.5), (np.abs(here[:, :2]) > 0.5).any(1))


def test_worlds_are_placed_on_their_patch_and_walk_to_others(rig: Rig) -> None:
    terrain = rig.structs[TerrainArrays]
    origins = terrain.origins.numpy()
    rig.call("reset_root_on_terrain", x=(0.5, 0.5))
    places = rig.worlds.joint_q.numpy()[:, ROOT : ROOT + 3]
    start = np.array(rig.robot.start)[:3]
    near(places, start + origins[[0, 1, 1], [2, 0, 1]] + [0.5, 0, 0])
    # half a patch is 1 m along x: the first walked far, the second not at all where it was to, the third was not asked to
    values = rig.episodes.memory.numpy()
    values[:, COMMAND : COMMAND + 2] = [[1, 0], [1, 0], [0, 0]]
    rig.episodes.memory.assign(values)
    now = rig.worlds.joint_q.numpy()
    now[:, ROOT : ROOT + 3] = origins[[0, 1, 1], [2, 0, 1]] + [[1.5, 0, 0], [0, 0.1, 0], [0, 0.1, 0]]
    rig.worlds.joint_q.assign(now)
    rig.call("walk_to_levels", command=COMMAND, episode_seconds=2.0)
    assert terrain.levels.numpy().tolist() == [1, 0, 1]
    seen = set()
    for seed in range(40):
        rig.call("draw_patch", stream=seed)
        seen |= set(zip(terrain.levels.numpy().tolist(), terrain.kinds.numpy().tolist(), strict=True))
    assert seen == {(level, kind) for level in range(2) for kind in range(3)}


def test_tolerances_by_pattern() -> None:
    names = ["left_hip", "left_knee", "right_hip", "right_knee", "waist"]
    view = SimpleNamespace(joint_names=names)
    context: Any = SimpleNamespace(device="cpu", view=lambda name, what: view)
    built = Tolerances(standing={"*_hip": 0.1, "left_*": 0.2, "right_knee": 0.3}, running=0.9).build(context)
    assert built.names == ("left_hip", "left_knee", "right_hip", "right_knee")
    assert built.arrays.columns.numpy().tolist() == [0, 1, 2, 3]
    near(built.arrays.standing.numpy(), [0.1, 0.2, 0.1, 0.3])
    near(built.arrays.walking.numpy(), [0.1, 0.2, 0.1, 0.3])
    near(built.arrays.running.numpy(), [0.9] * 4)
    for wrong, output in (
        ({"standing": {"*_hipp": 0.1}}, "Tolerances.standing: no joint matches '*_hipp'; "),
        ({"standing": {"*": 0.0}}, "Tolerances.standing.*: a tolerance is a number above 0, found 0.0"),
        ({"standing": 0.1, "walking": {"*_hip": 0.2}}, "walking: no pattern fits left_knee, which standing has"),
    ):
        assert output in refusal(Tolerances(**wrong).build, context)


def test_what_counts_from_the_start_counts_from_the_patch_on_a_terrain(rig: Rig) -> None:
    origins = rig.structs[TerrainArrays].origins.numpy()[[0, 1, 1], [2, 0, 1]]
    start = np.array(rig.robot.start)[:3]
    here = rig.worlds.joint_q.numpy()[:, ROOT : ROOT + 3]
    way = here - start - origins
    near(rig.call("root_displacement_on_terrain"), way)
    far = np.hypot(way[:, 0], way[:, 1])
    limit = np.sort(far)[:2].mean()
    near(rig.call("root_too_far_on_terrain", distance=limit), far > limit)
    rig.call("planar_pose_command_on_terrain", command=3, stream=2, x=(-1.0, 1.0), y=(1.0, 2.0), heading=(0.0, 3.0))  # fmt: skip
    target = rig.episodes.memory.numpy()[:, 6:8] - start[:2] - origins[:, :2]
    assert (np.abs(target[:, 0]) <= 1.0 + 1e-5).all() and (target[:, 1] >= 1.0 - 1e-5).all() and (target[:, 1] <= 2.0 + 1e-5).all()  # fmt: skip
    rig.call("reset_to_default_on_terrain")
    placed = rig.worlds.joint_q.numpy()
    near(placed[:, ROOT : ROOT + 3], start + origins)
    near(placed[:, rig.robot.coordinates.numpy()], np.tile(rig.robot.defaults.numpy(), (len(placed), 1)))
