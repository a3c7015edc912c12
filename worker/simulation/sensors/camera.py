"""Cameras on bodies, on sites or fixed in the world: colour, grey, depth and segmentation, rendered inside the graph of a step."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import torch
import warp as wp
from newton.sensors import SensorCamera

from shared_store.contract.error_text import nearest
from worker.simulation.episodes import EpisodeArrays, random_stream
from worker.simulation.rendering import (
    displace,
    displaced,
    draw_light,
    look,
    push_pixel,
    renderer,
    shaded,
    shapes_of_worlds,
    to_byte,
)
from worker.simulation.robot_arrays import BodyArrays
from worker.simulation.robot_view import RobotView
from worker.simulation.sensors.sensor import BodyFrame, Sensor, SensorContext, SensorDeclaration, place_pose
from worker.simulation.structs import views_of

if TYPE_CHECKING:
    from worker.settings.task import Randomization

wp.set_module_options({"enable_backward": False})

GROUND = "ground"
"""Name in a segmentation of the terrain, the plane, and geoms that a robot's file fixes to the world."""
CHANNELS: Mapping[str, tuple[str, ...]] = {"color": ("red", "green", "blue"), "grey": ("grey",), "depth": ("depth",)}
"""Channels of an image of each kind; a segmentation has one channel per class."""
_FIRST_STREAM = 2**21
"""Cameras draw their poses from streams below minus this number, two each, separate from those of physics, terrain and events."""


@wp.struct
class CameraArrays:
    """Latest image of a camera, taken after the last reset and before the last observation. One row per world.

    A reward reads the image on which the action was based, since the next one is taken only after resets.

    Attributes:
        images: Bytes, with the present frame's channels first; shape ``(worlds, channels * frames, height, width)``.
        depths: Of the present frame, along the camera's axis, from ``near`` to ``far`` [m]; shape ``(worlds, height, width)``, of other
            kinds than depth ``(worlds, 0, 0)``.
        poses: Of the camera in the world's frame; it looks along its own -z, its +y is up; shape ``(worlds,)``.
    """

    images: wp.array4d[wp.uint8]
    depths: wp.array3d[wp.float32]
    poses: wp.array[wp.transform]


@wp.kernel
def _redraw(
    position: wp.vec3,
    angle: wp.vec3,
    episodes: EpisodeArrays,
    usual: wp.array[wp.transform],
    mounts: wp.array[wp.transform],
):
    """Draws the camera's mount for a world that begins an episode."""
    world = wp.tid()
    if episodes.ages[world] == 0:
        mounts[world] = displaced(usual[world], random_stream(episodes, world), position, angle)


@wp.kernel
def _follow(bodies: BodyArrays, body: int, mounts: wp.array[wp.transform], camera: CameraArrays):
    world = wp.tid()
    camera.poses[world] = place_pose(bodies, world, body, mounts[world])


@wp.kernel
def _stack_color(
    pixels: wp.array3d[wp.uint32],
    light: wp.array[wp.float32],
    episodes: EpisodeArrays,
    camera: CameraArrays,
):
    world, row, column = wp.tid()
    first = episodes.ages[world] == 0
    for channel in range(3):
        value = to_byte(shaded(pixels[world, row, column], channel, light[world]))
        push_pixel(camera.images, world, channel, 3, row, column, value, first)


@wp.kernel
def _stack_grey(
    pixels: wp.array3d[wp.uint32],
    light: wp.array[wp.float32],
    episodes: EpisodeArrays,
    camera: CameraArrays,
):
    """The luma of ITU-R BT.601: 0.299 red + 0.587 green + 0.114 blue, of the sRGB bytes."""
    world, row, column = wp.tid()
    pixel, bright = pixels[world, row, column], light[world]
    luma = 0.299 * shaded(pixel, 0, bright) + 0.587 * shaded(pixel, 1, bright) + 0.114 * shaded(pixel, 2, bright)
    push_pixel(camera.images, world, 0, 1, row, column, to_byte(luma), episodes.ages[world] == 0)


@wp.kernel
def _stack_depth(
    near: float, far: float, pixels: wp.array3d[wp.float32], episodes: EpisodeArrays, camera: CameraArrays
):
    """Nothing is as far as can be; Newton says 0 there."""
    world, row, column = wp.tid()
    depth = pixels[world, row, column]
    if depth <= 0.0:
        depth = far
    depth = wp.clamp(depth, near, far)
    camera.depths[world, row, column] = depth
    value = to_byte(255.0 * (depth - near) / (far - near))
    push_pixel(camera.images, world, 0, 1, row, column, value, episodes.ages[world] == 0)


@wp.kernel
def _stack_masks(
    channels: int,
    channel_of: wp.array[wp.int32],
    pixels: wp.array3d[wp.uint32],
    episodes: EpisodeArrays,
    camera: CameraArrays,
):
    world, row, column = wp.tid()
    shape = int(pixels[world, row, column])
    seen = int(-1)  # noqa: RUF046 (a variable for Warp, not a constant)
    if shape >= 0 and shape < channel_of.shape[0]:  # where nothing is hit the number is beyond all shapes
        seen = channel_of[shape]
    for channel in range(channels):
        value = wp.uint8(0)
        if channel == seen:
            value = wp.uint8(255)
        push_pixel(camera.images, world, channel, channels, row, column, value, episodes.ages[world] == 0)


class Camera(Sensor):
    """:class:`CameraSensor` of some worlds.

    It renders in :meth:`settle` alone, once a control step. Before that ``Worlds.update_bodies`` and ``Worlds.update_shapes`` must
    have been called.

    Attributes:
        images: ``arrays.images`` as a torch tensor, uint8, shape ``(worlds, channels * frames, height, width)``.
    """

    def __init__(self, declared: CameraSensor, context: SensorContext) -> None:
        super().__init__(context, declared.rows(context.views))
        (place,) = declared.places(context.views)
        self.declared, self._body = declared, place.body
        count, size = self._count, (declared.height, declared.width)
        self._stream = -_FIRST_STREAM - 2 * (zlib.crc32(context.name.encode()) % 2**19)
        mount = wp.transform_multiply(place.pose, declared.mount)
        self._place = wp.full(count, mount, dtype=wp.transform, device=self._device)
        self._usual, self._mounts = wp.clone(self._place), wp.clone(self._place)
        self.arrays = CameraArrays()
        self.arrays.images = context.array((count, len(self.names), *size), wp.uint8)
        self.arrays.depths = context.array((count, *(size if declared.kind == "depth" else (0, 0))), wp.float32)
        self.arrays.poses = context.array((count,), wp.transform)
        self.images: torch.Tensor = wp.to_torch(self.arrays.images)
        self._light = wp.full(count, 1.0, dtype=wp.float32, device=self._device)
        self._sensor = renderer(context.worlds.model, declared.samples)
        self._rays = SensorCamera.compute_camera_rays_pinhole(
            declared.width,
            declared.height,
            camera_fov=declared.fov,
            sample_count=declared.samples,
            device=self._device,
        )
        self._pixels = context.array((count, *size), wp.float32 if declared.kind == "depth" else wp.uint32)
        if declared.kind == "segmentation":
            self._channel_of = wp.array(self._owners(context), dtype=wp.int32, device=self._device)

    def _owners(self, context: SensorContext) -> np.ndarray:
        """The channel that shows each shape of the model, -1: none."""
        channels = {name: index for index, name in enumerate(self.declared.channels(context.views))}
        model, count = context.worlds.model, context.worlds.world_count
        shapes = shapes_of_worlds(model)
        one = np.full(shapes, -1, np.int32)
        for name, view in context.views.items():
            for shape, body in zip(view.geoms, view.geom_bodies, strict=True):
                one[shape] = channels.get(name if body >= 0 else GROUND, -1)
        rest = np.full(model.shape_count - count * shapes, channels.get(GROUND, -1), np.int32)
        return np.concatenate([np.tile(one, count), rest])

    def begin(self, randomize: Randomization) -> None:
        """Draw each camera's permanent offsets after random streams are seeded; a second call draws the same.

        Args:
            randomize: How the worlds differ besides: ``camera_position``, ``camera_angle``, ``light``.
        """
        self._displace(self._stream, randomize.camera_position, randomize.camera_angle, self._place, self._usual)
        if not self.declared.redraw:
            own = self.declared.position_range, self.declared.angle_range
            self._displace(self._stream - 1, *own, self._usual, self._mounts)
        draw_light(randomize.light, self._episodes, self._light)
        self._update_poses()

    def _displace(
        self, stream: int, position: Any, angle: Any, usual_poses: wp.array[wp.transform], poses: wp.array[wp.transform]
    ) -> None:
        inputs = [stream, wp.vec3(*_three(position)), wp.vec3(*_three(angle)), self._episodes, usual_poses]
        wp.launch(displace, dim=usual_poses.shape, inputs=inputs, outputs=[poses], device=self._device)

    def _update_poses(self) -> None:
        inputs = [self._bodies, self._body, self._mounts, self.arrays]
        wp.launch(_follow, dim=self._mounts.shape, inputs=inputs, device=self._device)

    def settle(self) -> None:
        """Render every world; an episode's first image also fills the earlier frames."""
        declared = self.declared
        if declared.redraw:
            ranges = [wp.vec3(*_three(declared.position_range)), wp.vec3(*_three(declared.angle_range))]
            inputs = [*ranges, self._episodes, self._usual]
            wp.launch(_redraw, dim=self._mounts.shape, inputs=inputs, outputs=[self._mounts], device=self._device)
        if declared.redraw or self._body >= 0:
            self._update_poses()
        output = {"depth": "forward_depth_image", "segmentation": "shape_index_image"}.get(declared.kind, "color_image")
        image: dict[str, Any] = {output: self._pixels}
        self._sensor.update(self._worlds.state, self.arrays.poses, self._rays, **image)
        inputs = [self._pixels, self._episodes, self.arrays]
        if declared.kind == "depth":
            kernel, inputs = _stack_depth, [declared.near, declared.far, *inputs]
        elif declared.kind == "segmentation":
            kernel, inputs = _stack_masks, [len(self.names) // declared.frames, self._channel_of, *inputs]
        else:
            kernel = _stack_grey if declared.kind == "grey" else _stack_color
            inputs = [self._pixels, self._light, self._episodes, self.arrays]
        wp.launch(kernel, dim=self._pixels.shape, inputs=inputs, device=self._device)

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """The images, the depths that rewards may read, and the camera poses of the running episodes."""
        tensors = views_of(self.arrays, "images", *(("depths",) if self.declared.kind == "depth" else ()))
        return tensors | ({"mounts": wp.to_torch(self._mounts)} if self.declared.redraw else {})


@dataclass(frozen=True)
class CameraSensor(SensorDeclaration):
    """A pinhole camera in every world, on a body, on a site, or fixed in the world.

    :class:`worker.tasks.declare.declaration.Image` makes an observation group of its images; terms read :class:`CameraArrays`. Bytes of each kind:

    - ``color``: red, green and blue in sRGB; the background is light blue.
    - ``grey``: the luma of the colour image.
    - ``depth``: distance along the camera's axis, from 0 at ``near`` or nearer to 255 at ``far``, beyond it or in the background;
      ``CameraArrays.depths`` has it in metres.
    - ``segmentation``: one channel for each name in ``of``: 255 where a pixel shows it, else 0; the background is 0 in all channels.

    Attributes:
        body: Name in the file of the body that carries it. Without ``body`` and ``site`` it is fixed in the world.
        site: Name of the site that carries it.
        robot: The robot with that body or site.
        position: Position in the frame of the body, site or world [m].
        target: Point in that frame at the centre of the image [m]; +z of the frame is up.
        rotation: From the camera's axes (x to the right, y up, looking along -z) to those of the frame, quaternion xyzw. Without
            ``target`` and ``rotation`` it looks along the frame's +x, with +z up.
        width: Width of an image [px].
        height: Height of an image [px].
        fov: Vertical field of view [rad].
        kind: ``"color"``, ``"grey"``, ``"depth"`` or ``"segmentation"``.
        frames: Images of one observation: the present one and those of the control steps before.
        samples: Rays per pixel, for colour and grey.
        near: Least depth in an image [m].
        far: Greatest depth in an image [m].
        of: Classes of a segmentation: names of robots and objects, and ``"ground"``; None: all of them.
        position_range: Each camera is mounted up to this far from its place, along each axis of its body or the world [m]; a number, or
            three.
        angle_range: Each camera is turned by up to this about each of its own axes [rad]; a number, or three.
        redraw: Whether every episode draws these offsets again; otherwise each world keeps its own.

    Raises:
        ValueError: A number is out of range, or two arguments exclude each other.
    """

    body: str | None = None
    site: str | None = None
    robot: str = "robot"
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    target: tuple[float, float, float] | None = None
    rotation: tuple[float, float, float, float] | None = None
    width: int = 64
    height: int = 64
    fov: float = 0.9
    kind: Literal["color", "grey", "depth", "segmentation"] = "color"
    frames: int = 1
    samples: int = 1
    near: float = 0.05
    far: float = 5.0
    of: Sequence[str] | None = None
    position_range: float | tuple[float, float, float] = 0.0
    angle_range: float | tuple[float, float, float] = 0.0
    redraw: bool = False
    arrays_type: ClassVar[Any] = CameraArrays
    sensor_type: ClassVar[Any] = Camera

    def __post_init__(self) -> None:
        kinds = (*CHANNELS, "segmentation")
        if self.kind not in kinds:
            raise ValueError(f"CameraSensor.kind: there is no kind {self.kind!r}; {nearest(str(self.kind), kinds)}")
        for name, greatest in (("width", 1024), ("height", 1024), ("frames", 16), ("samples", 64)):
            value = getattr(self, name)
            if not isinstance(value, int) or not 1 <= value <= greatest:
                raise ValueError(f"CameraSensor.{name}: expected an integer from 1 to {greatest}, found {value!r}")
        if not 0.0 < self.fov < math.pi:
            raise ValueError(f"CameraSensor.fov: expected an angle between 0 and pi [rad], found {self.fov!r}")
        if not 0.0 <= self.near < self.far < math.inf:
            raise ValueError(
                f"CameraSensor.near and far: expected 0 <= near < far [m], found {self.near!r} and {self.far!r}"
            )
        for name in ("position_range", "angle_range"):
            if not all(0.0 <= each < math.inf for each in _three(getattr(self, name))):
                raise ValueError(f"CameraSensor.{name}: expected 0 or more, found {getattr(self, name)!r}")
        self._check_choices()

    def _check_choices(self) -> None:
        """Refuse arguments that exclude each other."""
        if self.body is not None and self.site is not None:
            raise ValueError(
                "CameraSensor: give either body or site, and not both; without them it is fixed in the world"
            )
        if self.target is not None and self.rotation is not None:
            raise ValueError("CameraSensor: give either target or rotation, and not both")
        if self.target is not None and math.dist(self.position, self.target) < 1e-6:
            raise ValueError(
                f"CameraSensor.target: the camera stands there, at {list(self.position)}; choose another point"
            )
        if self.rotation is not None and not 0.0 < math.hypot(*self.rotation) < math.inf:
            raise ValueError(f"CameraSensor.rotation: expected a quaternion xyzw, found {list(self.rotation)}")
        if self.samples > 1 and self.kind not in ("color", "grey"):
            raise ValueError(
                f"CameraSensor.samples: {self.kind} takes one ray per pixel, since it can't be averaged over rays"
            )
        if self.of is not None and self.kind != "segmentation":
            raise ValueError(f"CameraSensor.of: only a segmentation takes it, and kind is {self.kind}")

    def channels(self, views: Mapping[str, RobotView]) -> tuple[str, ...]:
        """Names of the channels of one frame, with these robots and objects. Raises ValueError where ``of`` names another."""
        if self.kind != "segmentation":
            return CHANNELS[self.kind]
        existing = (*views, *((GROUND,) if GROUND not in views else ()))
        for name in self.of if self.of is not None else ():
            if name not in existing:
                raise ValueError(f"CameraSensor.of: there is no robot or object {name!r}; {nearest(name, existing)}")
        return tuple(self.of) if self.of is not None else existing

    def rows(self, views: Mapping[str, RobotView]) -> list[str]:
        """Name of each channel of an observation, those of earlier frames ending on ``_1``, ``_2``, …

        Raises:
            ValueError: The body, site, robot or object is unknown.
        """
        self.places(views)
        channels = self.channels(views)
        return [f"{name}_{back}" if back else name for back in range(self.frames) for name in channels]

    @property
    def mount(self) -> wp.transform:
        """The camera's pose in the frame of its body, of its site, or of the world."""
        if self.rotation is not None:
            return wp.transform(wp.vec3(*self.position), wp.normalize(wp.quat(*self.rotation)))
        ahead = (self.position[0] + 1.0, self.position[1], self.position[2])
        return look(self.position, ahead if self.target is None else self.target)

    def places(self, views: Mapping[str, RobotView]) -> list[BodyFrame]:
        """The frame that carries it, the world's by default. Raises ValueError where there is none, or a pattern matches several."""
        if self.body is None and self.site is None:
            return [BodyFrame("world", -1, wp.transform_identity())]
        return super().places(views)


def _three(value: float | Sequence[float]) -> tuple[float, float, float]:
    """A number for each axis."""
    if isinstance(value, int | float):
        return (float(value),) * 3
    first, second, third = value
    return (float(first), float(second), float(third))
