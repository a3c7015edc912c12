"""A camera for every world, whose images go straight into the buffer that the policy reads."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import warp as wp
from newton.sensors import SensorCamera

from worker.simulation.episodes import STEP, EpisodeArrays, numbered_stream
from worker.simulation.worlds import Worlds
from worker.tasks.configs.camera import CameraConfig

if TYPE_CHECKING:
    from worker.tasks.config import Randomization

wp.set_module_options({"enable_backward": False})

_SKY = 0x00D0B090
"""What the camera sees where there is nothing: packed as alpha, blue, green, red."""
_STREAM = wp.constant(-100)
"""The scene is drawn from this random stream and below, the physics from those above it."""


@wp.kernel
def _draw_scene(
    position: float,
    angle: float,
    colors: float,
    pose: wp.transformf,
    episodes: EpisodeArrays,
    poses: wp.array(dtype=wp.transformf),
    shape_colors: wp.array2d(dtype=wp.vec3f),
):
    """Where one world's camera stands, and the colours of its shapes: drawn once, from the seed and the world alone."""
    world = wp.tid()
    stream = numbered_stream(episodes, world, _STREAM)
    shift = wp.vec3f(wp.randf(stream, -1.0, 1.0), wp.randf(stream, -1.0, 1.0), wp.randf(stream, -1.0, 1.0))
    turn = wp.vec3f(wp.randf(stream, -1.0, 1.0), wp.randf(stream, -1.0, 1.0), wp.randf(stream, -1.0, 1.0))
    turned = wp.quat_rpy(angle * turn[0], angle * turn[1], angle * turn[2])
    poses[world] = wp.transformf(
        wp.transform_get_translation(pose) + position * shift, wp.transform_get_rotation(pose) * turned
    )
    for shape in range(shape_colors.shape[1]):
        change = wp.vec3f(wp.randf(stream, -1.0, 1.0), wp.randf(stream, -1.0, 1.0), wp.randf(stream, -1.0, 1.0))
        color = shape_colors[world, shape] + colors * change
        for channel in range(3):
            color[channel] = wp.clamp(color[channel], 0.0, 1.0)
        shape_colors[world, shape] = color


@wp.kernel
def _draw_light(ends: wp.vec2, episodes: EpisodeArrays, light: wp.array(dtype=wp.float32)):
    """How bright one world's image is."""
    world = wp.tid()
    light[world] = wp.randf(numbered_stream(episodes, world, _STREAM - 1), ends[0], ends[1])


@wp.kernel
def _stack(
    mode: int,
    frames: int,
    rendered: wp.array3d(dtype=wp.uint32),
    light: wp.array(dtype=wp.float32),
    episodes: EpisodeArrays,
    images: wp.array4d(dtype=wp.uint8),
):
    """Unpack one pixel and push it before the earlier ones; an episode's first image stands for those before it."""
    world, row, column = wp.tid()
    pixel = rendered[world, row, column]
    first = mode != STEP or episodes.dones[world]
    for channel in range(3):
        value = float((pixel >> wp.uint32(8 * channel)) & wp.uint32(255)) * light[world]
        value = wp.min(wp.round(value), 255.0)
        for back in range(frames - 1):
            slot = 3 * (frames - 1 - back) + channel
            if first:
                images[world, slot, row, column] = wp.uint8(value)
            else:
                images[world, slot, row, column] = images[world, slot - 3, row, column]
        images[world, channel, row, column] = wp.uint8(value)


class Camera:
    """Renders all worlds into :attr:`images`; launches only, so that it can be captured.

    Args:
        config: Where it stands, how it sees.
        randomize: How the scenes of the worlds differ; colours are changed here, in the worlds' model.
        worlds: What it sees.
        episodes: The task's buffers; ``random`` holds seed and global indices already.

    Attributes:
        images: What the policy sees, shape ``(worlds, 3 * frames, height, width)``, uint8: red, green and blue in sRGB, the
            present frame first.
    """

    def __init__(self, config: CameraConfig, randomize: Randomization, worlds: Worlds, episodes: EpisodeArrays) -> None:
        self._worlds, self._episodes, self._frames = worlds, episodes, config.frames
        model, count = worlds.model, worlds.world_count
        self._device = model.device
        smooth = SensorCamera.AntiAliasing.MSAA if config.samples > 1 else SensorCamera.AntiAliasing.NONE
        self._sensor = SensorCamera(
            model,
            default_clear_data=SensorCamera.ClearData(clear_color=_SKY),
            default_render_config=SensorCamera.RenderConfig(
                render_order=SensorCamera.RenderOrder.TILED, anti_aliasing=smooth
            ),
        )
        self._sensor.create_default_light(enable_shadows=False)
        self._rays = SensorCamera.compute_camera_rays_pinhole(
            config.width, config.height, camera_fov=config.fov, sample_count=config.samples, device=self._device
        )
        self._rendered = self._sensor.allocate_image_color(count, config.width, config.height)
        shape = (count, config.channels, config.height, config.width)
        self._images = wp.zeros(shape, dtype=wp.uint8, device=self._device)
        self.images: torch.Tensor = wp.to_torch(self._images)
        self._poses = wp.zeros(count, dtype=wp.transformf, device=self._device)
        self._light = wp.ones(count, dtype=wp.float32, device=self._device)
        # those of the ground come last and belong to no world
        shapes = int((model.shape_world.numpy() >= 0).sum()) // count
        colors = model.shape_color[: shapes * count].reshape((count, shapes))
        wp.launch(
            _draw_scene,
            dim=count,
            inputs=[randomize.camera_position, randomize.camera_angle, randomize.colors, _look(config), episodes],
            outputs=[self._poses, colors],
            device=self._device,
        )
        wp.launch(
            _draw_light, dim=count, inputs=[wp.vec2(*randomize.light), episodes, self._light], device=self._device
        )

    def render(self, mode: int) -> None:
        """After ``observe`` in ``mode``: take a picture of every world, of those that were placed afresh too."""
        worlds = self._worlds
        worlds.update_bodies()
        worlds.model.bvh_refit_shapes(worlds.state)
        self._sensor.update(worlds.state, self._poses, self._rays, color_image=self._rendered)
        wp.launch(
            _stack,
            dim=self._rendered.shape,
            inputs=[mode, self._frames, self._rendered, self._light, self._episodes],
            outputs=[self._images],
            device=self._device,
        )


def _look(config: CameraConfig) -> wp.transformf:
    """The pose of a camera that looks along its own -z, with its +y as near to the world's +z as can be."""
    back = wp.normalize(wp.vec3f(*config.position) - wp.vec3f(*config.target))
    upward = wp.vec3f(0.0, 1.0, 0.0) if abs(back[2]) > 0.999 else wp.vec3f(0.0, 0.0, 1.0)
    right = wp.normalize(wp.cross(upward, back))
    up = wp.cross(back, right)
    return wp.transformf(wp.vec3f(*config.position), wp.quat_from_matrix(wp.matrix_from_cols(right, up, back)))
