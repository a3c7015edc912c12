"""The cameras of the worlds, one in each: they render straight into the buffer that the policy reads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import newton
import torch
import warp as wp
from newton.sensors import SensorCamera

from worker.settings.camera import CameraConfig
from worker.simulation.episodes import STEP, EpisodeArrays, numbered_stream
from worker.simulation.worlds import Worlds

if TYPE_CHECKING:
    from worker.settings.task import Randomization

wp.set_module_options({"enable_backward": False})

SKY = 0x00D0B090
"""Background colour of an image, packed as alpha, blue, green, red."""
_STREAM = wp.constant(-100)
"""Random streams from this number down belong to the scene; higher ones belong to the physics."""


@wp.func
def displaced(pose: wp.transformf, stream: wp.uint32, position: wp.vec3f, angle: wp.vec3f) -> wp.transformf:
    """A pose moved by up to +- ``position`` [m] along each axis and turned by up to +- ``angle`` [rad] about each of its own, uniformly."""
    shift = wp.vec3f(wp.randf(stream, -1.0, 1.0), wp.randf(stream, -1.0, 1.0), wp.randf(stream, -1.0, 1.0))
    turn = wp.vec3f(wp.randf(stream, -1.0, 1.0), wp.randf(stream, -1.0, 1.0), wp.randf(stream, -1.0, 1.0))
    turned = wp.quat_rpy(angle[0] * turn[0], angle[1] * turn[1], angle[2] * turn[2])
    return wp.transformf(
        wp.transform_get_translation(pose) + wp.cw_mul(position, shift), wp.transform_get_rotation(pose) * turned
    )


@wp.kernel
def displace(
    number: int,
    position: wp.vec3f,
    angle: wp.vec3f,
    episodes: EpisodeArrays,
    given: wp.array[wp.transformf],
    poses: wp.array[wp.transformf],
):
    """Pose of one world's camera: drawn once from stream ``number``, that is from the seed and the world alone."""
    world = wp.tid()
    poses[world] = displaced(given[world], numbered_stream(episodes, world, number), position, angle)


@wp.kernel
def _paint(colors: float, episodes: EpisodeArrays, shape_colors: wp.array2d[wp.vec3f]):
    """The colours of one world's shapes: drawn once, behind the six numbers of its camera's pose."""
    world = wp.tid()
    stream = numbered_stream(episodes, world, _STREAM)
    for _ in range(6):
        wp.randf(stream, -1.0, 1.0)
    for shape in range(shape_colors.shape[1]):
        change = wp.vec3f(wp.randf(stream, -1.0, 1.0), wp.randf(stream, -1.0, 1.0), wp.randf(stream, -1.0, 1.0))
        color = shape_colors[world, shape] + colors * change
        for channel in range(3):
            color[channel] = wp.clamp(color[channel], 0.0, 1.0)
        shape_colors[world, shape] = color


@wp.kernel
def _draw_light(ends: wp.vec2, episodes: EpisodeArrays, light: wp.array[wp.float32]):
    """Brightness of one world's image."""
    world = wp.tid()
    light[world] = wp.randf(numbered_stream(episodes, world, _STREAM - 1), ends[0], ends[1])


@wp.func
def push(
    images: wp.array4d[wp.uint8],
    world: int,
    channel: int,
    channels: int,
    row: int,
    column: int,
    value: wp.uint8,
    first: bool,
):
    """Put a pixel of one channel before the earlier ones of its world; an episode's first image stands for those before it."""
    frames = images.shape[1] / channels
    for back in range(frames - 1):
        slot = channels * (frames - 1 - back) + channel
        if first:
            images[world, slot, row, column] = value
        else:
            images[world, slot, row, column] = images[world, slot - channels, row, column]
    images[world, channel, row, column] = value


@wp.func
def shaded(pixel: wp.uint32, channel: int, light: float) -> float:
    """A channel of a packed pixel, from 0 to 255, as bright as the world's light makes it."""
    return float((pixel >> wp.uint32(8 * channel)) & wp.uint32(255)) * light


@wp.func
def to_byte(value: float) -> wp.uint8:
    """The nearest of 0 to 255."""
    return wp.uint8(wp.clamp(wp.round(value), 0.0, 255.0))


@wp.kernel
def _stack(
    mode: int,
    rendered: wp.array3d[wp.uint32],
    light: wp.array[wp.float32],
    episodes: EpisodeArrays,
    images: wp.array4d[wp.uint8],
):
    """Unpack one pixel and push it before the earlier ones; an episode's first image stands for those before it."""
    world, row, column = wp.tid()
    pixel = rendered[world, row, column]
    first = mode != STEP or episodes.dones[world]
    for channel in range(3):
        push(images, world, channel, 3, row, column, to_byte(shaded(pixel, channel, light[world])), first)


def renderer(model: newton.Model, samples: int) -> SensorCamera:
    """Newton's camera of a model, with a light from above and without shadows and textures.

    Args:
        model: All worlds.
        samples: Rays of each pixel.
    """
    smooth = SensorCamera.AntiAliasing.MSAA if samples > 1 else SensorCamera.AntiAliasing.NONE
    sensor = SensorCamera(
        model,
        default_clear_data=SensorCamera.ClearData(clear_color=SKY),
        default_render_config=SensorCamera.RenderConfig(
            render_order=SensorCamera.RenderOrder.TILED, anti_aliasing=smooth
        ),
        load_textures=False,
    )
    sensor.create_default_light(enable_shadows=False)
    return sensor


def look(position: Sequence[float], target: Sequence[float]) -> wp.transformf:
    """Pose of a camera at ``position`` that looks at ``target`` along its own -z, with its +y as close to +z as possible [m]."""
    back: Any = wp.normalize(wp.vec3(*position) - wp.vec3(*target))  # Any: to Warp's annotations it has no items
    upward = wp.vec3(0.0, 1.0, 0.0) if abs(back[2]) > 0.999 else wp.vec3(0.0, 0.0, 1.0)
    right: Any = wp.normalize(wp.cross(upward, back))
    up: Any = wp.cross(back, right)
    return wp.transform(wp.vec3(*position), wp.quat_from_matrix(wp.matrix_from_cols(right, up, back)))


def shapes_of_worlds(model: newton.Model) -> int:
    """Number of shapes of each world. Shapes of the ground come after them and belong to no world."""
    return int((model.shape_world.numpy() >= 0).sum()) // model.world_count


def paint(worlds: Worlds, episodes: EpisodeArrays, amount: float) -> None:
    """Change red, green and blue of each world's shapes by up to +- ``amount`` of 1, once for all cameras."""
    count, shapes = worlds.world_count, shapes_of_worlds(worlds.model)
    colors = worlds.model.shape_color[: shapes * count].reshape((count, shapes))
    wp.launch(_paint, dim=count, inputs=[amount, episodes], outputs=[colors], device=worlds.model.device)


def draw_light(ends: Sequence[float], episodes: EpisodeArrays, light: wp.array[wp.float32]) -> None:
    """Draw how bright each world is, the same for all its cameras, shape ``(worlds,)``."""
    wp.launch(_draw_light, dim=light.shape, inputs=[wp.vec2(*ends), episodes, light], device=light.device)


class WorldCameras:
    """Renders all worlds into :attr:`images`; launches only, so that it can be captured.

    Args:
        config: Pose, resolution and field of view.
        randomize: How the scenes of the worlds differ. The constructor changes the colours in the worlds' model.
        worlds: The worlds to render.
        episodes: The task's buffers; ``random`` holds seed and global indices already.

    Attributes:
        images: What the policy sees, shape ``(worlds, 3 * frames, height, width)``, uint8: red, green and blue in sRGB, the
            present frame first.
    """

    def __init__(self, config: CameraConfig, randomize: Randomization, worlds: Worlds, episodes: EpisodeArrays) -> None:
        self._worlds, self._episodes = worlds, episodes
        model, count = worlds.model, worlds.world_count
        self._device = model.device
        self._sensor = renderer(model, config.samples)
        self._rays = SensorCamera.compute_camera_rays_pinhole(
            config.width, config.height, camera_fov=config.fov, sample_count=config.samples, device=self._device
        )
        self._rendered = self._sensor.allocate_image_color(count, config.width, config.height)
        shape = (count, config.channels, config.height, config.width)
        self._images = wp.zeros(shape, dtype=wp.uint8, device=self._device)
        self.images: torch.Tensor = wp.to_torch(self._images)
        self._poses = wp.zeros(count, dtype=wp.transformf, device=self._device)
        usual = wp.full(count, look(config.position, config.target), dtype=wp.transformf, device=self._device)
        self._light = wp.ones(count, dtype=wp.float32, device=self._device)
        wp.launch(
            displace,
            dim=count,
            inputs=[_STREAM, wp.vec3(randomize.camera_position), wp.vec3(randomize.camera_angle), episodes, usual],
            outputs=[self._poses],
            device=self._device,
        )
        paint(worlds, episodes, randomize.colors)
        draw_light(randomize.light, episodes, self._light)

    def render(self, mode: int) -> None:
        """After ``observe`` in ``mode``: render every world, including those that were just reset."""
        self._worlds.update_bodies()
        self._worlds.update_shapes()
        self._sensor.update(self._worlds.state, self._poses, self._rays, color_image=self._rendered)
        wp.launch(
            _stack,
            dim=self._rendered.shape,
            inputs=[mode, self._rendered, self._light, self._episodes],
            outputs=[self._images],
            device=self._device,
        )
