"""Cameras as sensors: geometry by hand and by MuJoCo's rays, kinds, mounts that differ, and what is refused."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import warp as wp

from tests.support.refusals import refusal
from tests.support.worker.sensing import Reference, scene
from worker.settings.task import Randomization
from worker.simulation.sensors.camera import Camera, CameraSensor
from worker.simulation.sensors.sensor import SensorContext

torch.set_num_threads(1)

ARM = """<mujoco><worldbody>
  <geom name="wall" type="box" size="0.05 3 3" pos="6 0 0"/>
  <body name="arm" pos="0 0 1"><joint name="turn" axis="0 0 1"/><joint name="lift" axis="0 1 0"/>
    <geom name="arm" type="capsule" fromto="0 0 0 0.3 0 0" size="0.04" mass="1" rgba="0.9 0.1 0.1 1"/>
    <site name="eye" pos="0.4 0.05 0.1" euler="10 -20 30"/></body></worldbody>
  <actuator><motor name="turn" joint="turn"/><motor name="lift" joint="lift"/></actuator></mujoco>"""
CUBE = """<mujoco><worldbody><body name="cube" pos="2.35 0.5 1"><freejoint/>
  <geom name="cube" type="box" size="0.25 0.2 0.15" mass="1" rgba="0.1 0.2 0.9 1"/></body></worldbody></mujoco>"""
WIDTH, HEIGHT, FOV = 48, 32, 1.0
FOCAL = HEIGHT / 2 / math.tan(FOV / 2)
"""Pixels that a metre at a distance of a metre takes."""
SIZE = {"width": WIDTH, "height": HEIGHT, "fov": FOV}


@pytest.fixture(scope="module")
def context() -> SensorContext:
    """Two worlds of an arm, a wall of its file and a cube above a plane; the arm turns in the second one."""
    made = scene({"robot": ARM, "cube": CUBE}, ground=True)
    made.episodes.random = wp.array([[7, 0, 0], [7, 1, 0]], dtype=wp.int32, device="cpu")
    return made


def turn(context: SensorContext, *joints: tuple[float, float]) -> None:
    """Put the arms of the worlds at these angles."""
    positions = context.worlds.arrays.joint_q.numpy()
    columns = context.views["robot"].coordinates
    for world, angles in enumerate(joints):
        positions[world, columns] = angles
    context.worlds.arrays.joint_q.assign(positions)


def camera(context: SensorContext, name: str = "front", randomize: Any = None, **options: Any) -> Camera:
    """A camera whose streams are drawn, and its first picture."""
    built = CameraSensor(**SIZE | options).build(dataclasses.replace(context, name=name))
    built.begin(randomize or Randomization())
    take(context, built)
    return built


def take(context: SensorContext, built: Camera, *, ages: tuple[int, int] = (1, 1)) -> None:
    """A picture, of worlds with these ages."""
    context.episodes.ages.assign(np.array(ages, np.int32))
    context.worlds.update_bodies()
    context.worlds.update_shapes()
    built.settle()


def test_a_box_is_as_far_as_large_and_where_a_pinhole_puts_it(context: SensorContext) -> None:
    turn(context, (2.0, 0.0), (2.0, 0.0))  # out of the camera's view
    at = {"position": (0.1, 0.0, 1.0)}
    depth = camera(context, **at, kind="depth", near=0.5, far=4.0)
    mask = camera(context, **at, kind="segmentation", of=("cube",)).images[0, 0] == 255
    rows, columns = mask.nonzero().T
    # its face is 2 m ahead, 0.4 m wide, 0.3 m high, and its middle 0.5 m to the left
    assert len(rows.unique()) == pytest.approx(FOCAL * 0.3 / 2.0, abs=1.0)
    assert rows.double().mean().item() == pytest.approx(HEIGHT / 2 - 0.5, abs=0.01)
    left, right = (WIDTH / 2 - FOCAL * side / 2.0 for side in (0.7, 0.3))
    assert columns.min().item() == math.ceil(left - 0.5)
    # to the right of its face its side is seen, which ends 2.5 m ahead
    assert columns.max().item() == math.floor(WIDTH / 2 - FOCAL * 0.3 / 2.5 - 0.5)
    seen = torch.from_numpy(depth.arrays.depths.numpy()[0])
    face = mask & (torch.arange(WIDTH) + 0.5 < right)
    assert (seen[face] - 2.0).abs().max() < 1e-4, "along the axis, not along the ray"
    assert (depth.images[0, 0][face] == round(255 * 1.5 / 3.5)).all()
    # the ground 1 m below is seen below the horizon, as far as the row is deep; above it the wall, beyond far
    row = HEIGHT - 3
    assert seen[row, 5].item() == pytest.approx(FOCAL / (row + 0.5 - HEIGHT / 2), rel=1e-4)
    assert seen[2, 40] == 4.0 and depth.images[0, 0, 2, 40] == 255
    assert torch.equal(depth.images[0], depth.images[1])


def test_depth_and_names_are_those_of_mujocos_rays_from_a_site_that_moves(context: SensorContext) -> None:
    turn(context, (0.2, 0.1), (-0.3, 0.35))
    options = {"site": "eye", "far": 50.0}
    depth = camera(context, **options, kind="depth", near=0.0)
    names = camera(context, **options, kind="segmentation")
    assert names.names == ("robot", "cube", "ground")
    cube = CUBE.partition("<worldbody>")[2].partition("</worldbody>")[0]
    ground = '<worldbody><geom name="plane" type="plane" size="0 0 1"/>'
    reference = Reference(ARM.replace("<worldbody>", ground).replace("</worldbody>", f"{cube}</worldbody>"))
    for world, joints in enumerate(((0.2, 0.1), (-0.3, 0.35))):
        reference.data.qpos[:2] = joints
        mujoco.mj_kinematics(reference.model, reference.data)
        reported, shown = rays(reference)
        seen = depth.arrays.depths.numpy()[world]
        # an edge may fall on the other side of a pixel's ray
        assert np.mean(np.abs(seen - reported) < 1e-3 * (1.0 + reported)) > 0.995
        masks = names.images[world].numpy()
        for channel, name in enumerate(names.names):
            assert (shown == name).any() or name == "robot", "the test sees nothing"
            assert np.mean((masks[channel] == 255) == (shown == name)) > 0.995, name


def rays(reference: Reference) -> tuple[np.ndarray, np.ndarray]:
    """What each pixel of a camera at the site sees, that looks along its x axis with z up: depth [m] and whose geom."""
    data, model = reference.data, reference.model
    frame = data.site("eye").xmat.reshape(3, 3)
    depths, names = np.full((HEIGHT, WIDTH), 50.0), np.full((HEIGHT, WIDTH), "nothing", object)
    owners = {"plane": "ground", "wall": "ground", "arm": "robot", "cube": "cube"}
    for row in range(HEIGHT):
        for column in range(WIDTH):
            inside = np.array([FOCAL, WIDTH / 2 - column - 0.5, HEIGHT / 2 - row - 0.5])
            inside /= np.linalg.norm(inside)
            geom = np.zeros(1, np.int32)
            distance = mujoco.mj_ray(model, data, data.site("eye").xpos, frame @ inside, None, 1, -1, geom)
            if distance >= 0.0:
                depths[row, column] = min(distance * inside[0], 50.0)
                names[row, column] = owners[model.geom(int(geom[0])).name]
    return depths, names


def test_a_camera_moves_with_its_body_and_one_in_the_world_does_not(context: SensorContext) -> None:
    turn(context, (0.0, 0.0), (0.0, 0.0))
    mounted = camera(context, body="arm", position=(0.4, 0.0, 0.0), target=(2.0, 0.0, 0.0))
    fixed = camera(context, position=(0.0, -1.0, 1.0), target=(0.0, 0.0, 1.0))
    before, still = mounted.arrays.poses.numpy()[:, :3].copy(), fixed.images.clone()
    assert before == pytest.approx(np.array([[0.4, 0.0, 1.0]] * 2), abs=1e-6)
    turn(context, (0.0, 0.0), (math.pi / 2, 0.0))
    for each in (mounted, fixed):
        take(context, each)
    assert mounted.arrays.poses.numpy()[1, :3] == pytest.approx([0.0, 0.4, 1.0], abs=1e-6)
    assert torch.equal(fixed.images[0], still[0]) and not torch.equal(fixed.images[1], still[1]), "it sees the arm turn"
    # along its own -z, turned by 90 degrees as well
    pose = wp.transform(*mounted.arrays.poses.numpy()[1])
    assert list(wp.transform_vector(pose, wp.vec3(0.0, 0.0, -1.0))) == pytest.approx([0.0, 1.0, 0.0], abs=1e-6)
    assert list(wp.transform_vector(pose, wp.vec3(0.0, 1.0, 0.0))) == pytest.approx([0.0, 0.0, 1.0], abs=1e-6)


def test_grey_is_the_luma_of_the_colours_and_light_dims_both(context: SensorContext) -> None:
    turn(context, (0.4, 0.0), (0.4, 0.0))
    at = {"position": (-1.0, 0.0, 1.2)}
    color, grey = camera(context, **at), camera(context, **at, kind="grey")
    luma = np.tensordot([0.299, 0.587, 0.114], color.images.numpy().astype(float), (0, 1))
    assert np.abs(luma - grey.images[:, 0].numpy()).max() <= 0.5 + 1e-3
    assert len(np.unique(grey.images.numpy())) > 4, "several surfaces"
    red, _, blue = color.images[0].float()
    assert (red > 2 * blue).any() and (blue > 2 * red).any(), "the arm, the cube"
    up = camera(context, position=(0.0, 0.0, 3.0), target=(0.0, 0.0, 9.0))
    assert (up.images == torch.tensor([0x90, 0xB0, 0xD0], dtype=torch.uint8).view(1, 3, 1, 1)).all(), "the sky"
    dark = camera(context, **at, randomize=Randomization(light=(0.5, 0.5)))
    assert torch.equal(dark.images, (color.images.float() * 0.5 + 0.5).floor().to(torch.uint8))


def test_an_episodes_first_image_stands_for_those_before_it(context: SensorContext) -> None:
    turn(context, (0.0, 0.0), (0.0, 0.0))
    stacked = camera(context, body="arm", position=(0.4, 0.0, 0.0), frames=3)
    assert stacked.names[3:5] == ("red_1", "green_1") and stacked.images.shape == (2, 9, HEIGHT, WIDTH)
    take(context, stacked, ages=(0, 0))
    for step in range(1, 4):
        before = stacked.images.clone()
        turn(context, (0.1 * step, 0.0), (0.1 * step, 0.0))
        take(context, stacked, ages=(step, 0 if step == 3 else step))
        assert torch.equal(stacked.images[0, 3:], before[0, :6])
        assert not torch.equal(stacked.images[0, :3], before[0, :3])
    assert all(torch.equal(stacked.images[1, :3], stacked.images[1, part : part + 3]) for part in (3, 6))


def test_mounts_differ_from_world_to_world_within_their_limits(context: SensorContext) -> None:
    turn(context, (0.0, 0.0), (0.0, 0.0))
    ranges = {"position_range": (0.1, 0.0, 0.05), "angle_range": 0.2}
    plain = camera(context, body="arm").arrays.poses.numpy()
    found = camera(context, body="arm", **ranges).arrays.poses.numpy()
    shift = np.abs(found - plain)[:, :3]
    assert (shift <= (0.1, 1e-6, 0.05)).all() and (shift[:, 0] > 0).all()
    turned = 2 * np.arccos(np.clip(np.abs((found[:, 3:] * plain[:, 3:]).sum(1)), 0, 1))
    assert (turned > 1e-3).all() and (turned <= 0.2 * math.sqrt(3) + 1e-3).all()
    assert not np.allclose(found[0], found[1])
    assert np.array_equal(found, camera(context, body="arm", **ranges).arrays.poses.numpy()), "seed and world alone"
    other = camera(context, "rear", body="arm", **ranges).arrays.poses.numpy()
    assert not np.allclose(found, other), "each camera has its own"
    requested = camera(context, body="arm", randomize=Randomization(camera_position=0.3)).arrays.poses.numpy()
    assert 0.0 < np.abs(requested - plain).max() <= 0.3
    twice = camera(context, body="arm", randomize=Randomization(camera_position=0.3))
    twice.begin(Randomization(camera_position=0.3))
    take(context, twice)
    assert np.array_equal(twice.arrays.poses.numpy(), requested), "drawn once, however often"
    supplied = context.episodes.random
    context.episodes.random = wp.array([[7, 1, 0], [7, 2, 0]], dtype=wp.int32, device="cpu")
    later = camera(context, body="arm", **ranges).arrays.poses.numpy()
    context.episodes.random = supplied
    assert np.array_equal(later[0], found[1]), "a world's mount does not depend on its rank"


def test_each_episode_may_draw_a_new_mount(context: SensorContext) -> None:
    turn(context, (0.0, 0.0), (0.0, 0.0))
    drawn = camera(context, body="arm", position_range=0.1, redraw=True)
    take(context, drawn, ages=(0, 0))
    first = drawn.arrays.poses.numpy().copy()
    take(context, drawn, ages=(1, 0))
    second = drawn.arrays.poses.numpy()
    assert np.array_equal(first[0], second[0]) and not np.allclose(first[1], second[1])
    assert np.abs(second[:, :3] - [0.0, 0.0, 1.0]).max() <= 0.1
    assert set(drawn.state_tensors()) == {"images", "mounts"}


REFUSED: dict[str, dict[str, Any]] = {
    "no body of robot matches 'amr'; did you mean arm?": {"body": "amr"},
    "CameraSensor.robot: there is no robot 'robt'; did you mean robot?": {"body": "arm", "robot": "robt"},
    "CameraSensor: give either body or site, and not both": {"site": "*e", "body": "arm"},
    "CameraSensor.kind: there is no kind 'gray'; did you mean grey?": {"kind": "gray"},
    "CameraSensor.width: expected an integer from 1 to 1024, found 0": {"width": 0},
    "CameraSensor.fov: expected an angle between 0 and pi [rad], found 180.0": {"fov": 180.0},
    "CameraSensor.near and far: expected 0 <= near < far": {"kind": "depth", "near": 2.0, "far": 1.0},
    "CameraSensor.samples: depth takes one ray per pixel": {"kind": "depth", "samples": 4},
    "of: there is no robot or object 'cub'; did you mean cube?": {"kind": "segmentation", "of": ("cub",)},
    "CameraSensor.of: only a segmentation takes it, and kind is color": {"of": ("cube",)},
    "CameraSensor.target: the camera stands there, at [0.0, 0.0, 0.0]": {"target": (0.0, 0.0, 0.0)},
    "give either target or rotation": {"target": (1.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0)},
    "CameraSensor.rotation: expected a quaternion xyzw": {"rotation": (0.0, 0.0, 0.0, 0.0)},
    "CameraSensor.angle_range: expected 0 or more, found -0.1": {"angle_range": -0.1},
}


@pytest.mark.parametrize("words", REFUSED)
def test_an_invalid_camera_is_refused_in_one_line(context: SensorContext, words: str) -> None:
    assert words in refusal(lambda: CameraSensor(**REFUSED[words]).build(context))
