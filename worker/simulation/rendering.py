"""Parts of cameras: Newton's renderer, poses and colours that differ from world to world, stacks of images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import newton
import warp as wp
from newton.sensors import SensorCamera

from worker.simulation.episodes import EpisodeArrays, numbered_stream
from worker.simulation.worlds import Worlds

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
    usual_poses: wp.array[wp.transformf],
    poses: wp.array[wp.transformf],
):
    """Pose of one world's camera: drawn once from stream ``number``, that is from the seed and the world alone."""
    world = wp.tid()
    poses[world] = displaced(usual_poses[world], numbered_stream(episodes, world, number), position, angle)


@wp.kernel
def _paint(colors: float, episodes: EpisodeArrays, shape_colors: wp.array2d[wp.vec3f]):
    """The colours of one world's shapes: drawn once, behind the six numbers of its camera's pose.

    Not a ``Randomize``: those change the solver's model, and images show Newton's.
    """
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
def push_pixel(
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
