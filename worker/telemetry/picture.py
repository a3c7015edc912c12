"""Pictures of worlds by Newton's own camera: on a CPU as well as on a GPU, without a display.

A camera follows each robot from the side. What it shows is exactly what :class:`worker.telemetry.stage.Stage` poses.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import worker.simulation  # noqa: F401 - before Newton, which it keeps from importing Rerun

# isort: split
import newton
import numpy as np
import warp as wp
from newton.sensors import SensorCamera

from shared_store.volume.files import EVERY_LEVEL, write_atomic
from worker.settings.errors import UserError
from worker.simulation.rendering import look
from worker.simulation.structs import numbers
from worker.telemetry.messages import tiled
from worker.telemetry.stage import Stage
from worker.telemetry.tap import Tap, TapReader

if TYPE_CHECKING:
    from worker.settings.task import TaskConfig
    from worker.tasks.run.task import Task

FILMS = (".gif", ".mp4")
MOMENTS = 6
"""Frames beside each other in a still image."""
STRIP = 3, 2
"""Columns and gap [px] of such an image."""
_EPISODE_STEPS, _EPISODE_SECONDS = 4096, 2.0
_FOV = 0.7
"""Vertical [rad]."""
_VIEW = (-0.55, -0.78, 0.3)
"""From the robot to the camera, for which only the direction counts: behind, on its right, a little above."""
_SKY = 0x00E6D9CC
"""Packed as alpha, blue, green, red."""
_LIGHT, _AMBIENT = (1.2, 1.2, 1.15), (0.45, 0.45, 0.48)
_SMOOTH = 0.15
"""Share of the way to the robot that the camera goes in each frame, up and down; along the ground it keeps up."""


class StageCamera:
    """Takes pictures of a stage's worlds, tiled.

    Args:
        stage: What is seen.
        width: Of a whole picture [px].
        height: Of a whole picture [px].
    """

    def __init__(self, stage: Stage, width: int, height: int) -> None:
        self.stage, model = stage, stage.model
        self.columns = math.ceil(math.sqrt(stage.worlds))
        self.size = max(2, width // self.columns), max(2, height // math.ceil(stage.worlds / self.columns))
        configuration = SensorCamera.RenderConfig(
            render_order=SensorCamera.RenderOrder.TILED,
            anti_aliasing=SensorCamera.AntiAliasing.MSAA,
            enable_shadows=True,
            enable_textures=True,
        )
        self._sensor = SensorCamera(
            model,
            default_clear_data=SensorCamera.ClearData(clear_color=_SKY),
            default_render_config=configuration,
            load_textures=False,
        )
        direction: Any = wp.vec3f(0.5, 0.35, -0.8)  # Warp's annotation of normalize takes none of its own vectors
        self._sensor.create_default_light(enable_shadows=True, direction=wp.normalize(direction), color=_LIGHT)
        self._sensor.set_ambient_light(_AMBIENT, _AMBIENT)
        planes = np.flatnonzero((numbers(model.shape_type) == newton.GeoType.PLANE) & (numbers(model.shape_world) < 0))
        if len(planes):
            self._sensor.assign_checkerboard_material(shape_indices=planes)
        self._rays = SensorCamera.compute_camera_rays_pinhole(
            *self.size, camera_fov=_FOV, sample_count=2, device=model.device
        )
        self._pixels = self._sensor.allocate_image_color(stage.worlds, *self.size)
        self._targets: np.ndarray | None = None
        self._offset = np.zeros(3)
        """From a robot's root to its middle [m]."""
        self._distance = 1.0

    def take(self, coordinates: np.ndarray) -> np.ndarray:
        """A picture of the worlds where joint coordinates say, worlds row by row.

        Args:
            coordinates: Shape ``(worlds, coordinates)``.

        Returns:
            Red, green, blue, uint8, shape ``(height, width, 3)``.
        """
        stage, model = self.stage, self.stage.model
        poses = stage.pose(coordinates)
        roots = poses[:, stage.root, :3]
        if self._targets is None:  # point at each robot, from as far as shows all of it
            middle, radius = self._extent(poses)
            self._offset = middle - roots[0]
            self._targets = roots + self._offset
            self._distance = 0.95 * radius / math.sin(_FOV / 2)  # the corners of the box are seldom filled
        else:
            self._targets[:, :2] = roots[:, :2] + self._offset[:2]
            self._targets[:, 2] += _SMOOTH * (roots[:, 2] + self._offset[2] - self._targets[:, 2])
        direction = np.array(_VIEW) / np.linalg.norm(_VIEW)
        cameras = [look((target + self._distance * direction).tolist(), target.tolist()) for target in self._targets]
        transforms = wp.array(cameras, dtype=wp.transformf, device=model.device)
        model.bvh_refit_shapes(stage.state)
        self._sensor.update(stage.state, transforms, self._rays, color_image=self._pixels)
        packed = self._pixels.numpy()
        return tiled(packed.view(np.uint8).reshape(*packed.shape, 4)[..., :3], self.columns)

    def _extent(self, poses: np.ndarray) -> tuple[np.ndarray, float]:
        """Middle and radius of what is seen of the first world [m]."""
        model = self.stage.model
        owners, bodies, flags = numbers(model.shape_world), numbers(model.shape_body), numbers(model.shape_flags)
        radii, places = numbers(model.shape_collision_radius), numbers(model.shape_transform)
        scales = numbers(model.shape_scale)
        least, most = np.full(3, np.inf), np.full(3, -np.inf)
        for shape in np.flatnonzero((owners == 0) & (bodies >= 0) & (flags & int(newton.ShapeFlags.VISIBLE) > 0)):
            pose = wp.transform(*map(float, poses[0, self.stage.link_of[bodies[shape]]]))
            place = pose * wp.transform(*map(float, places[shape]))
            source = model.shape_source[shape]
            if isinstance(source, newton.Mesh):  # its origin may be anywhere
                rotation = np.array(wp.quat_to_matrix(place.q)).reshape(3, 3)
                points = (source.vertices * scales[shape]) @ rotation.T + np.array(place.p)
                low, high = points.min(0), points.max(0)
            else:
                low, high = np.array(place.p) - radii[shape], np.array(place.p) + radii[shape]
            least, most = np.minimum(least, low), np.maximum(most, high)
        if not np.isfinite(least).all():
            return poses[0, 0, :3].copy(), 1.0
        return (least + most) / 2, float(np.linalg.norm(most - least)) / 2


class EpisodePicture:
    """A picture of what a policy does while it is evaluated: moments of the first episode of world 0.

    Args:
        task: The worlds; between here and :meth:`picture` they step.
    """

    def __init__(self, task: Task) -> None:
        self._task = task
        self._tap = Tap(task, 1, rows=min(task.max_episode_length + 1, _EPISODE_STEPS))
        self._tap.open()

    def picture(
        self,
        config: TaskConfig,
        count: Callable[[int, int], None] = lambda done, total: None,
        width: int = 320,
        height: int = 180,
    ) -> bytes:
        """:data:`MOMENTS` frames of that size as one PNG.

        ``count``: called after each with how many are done, and how many there will be.
        """
        rows = TapReader(self._tap).take()
        self._tap.close()
        length = int(np.argmax(rows.mark("done")[:, 0])) if rows.mark("done").any() else len(rows)
        span = max(1, min(length, round(_EPISODE_SECONDS * config.control_hz)))
        camera = StageCamera(Stage(type(self._task), config, 1, self._task.device), width, height)
        frames = []
        for step in np.linspace(0, span - 1, MOMENTS).round().astype(int):
            frames.append(camera.take(rows.coordinates[step]))
            count(len(frames), MOMENTS)
        return encode([tiled(frames, *STRIP)], ".png", 1.0)


def encode(pictures: Sequence[np.ndarray], ending: str, rate: float) -> bytes:
    """Pictures as one file.

    Args:
        pictures: Of one size, uint8, shape ``(height, width, 3)``.
        ending: ``.mp4`` (H.264), ``.gif``, or ``.png`` (the first of them).
        rate: Frames a second.

    Raises:
        ImportError: PyAV, which writes films, is not installed.
    """
    from PIL import Image

    buffer = io.BytesIO()
    if ending == ".mp4":
        import av

        height, width = pictures[0].shape[:2]
        with av.open(buffer, "w", format="mp4") as container:
            stream = container.add_stream("libx264", rate=Fraction(rate).limit_denominator(1000))
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            stream.options = {"crf": "20", "preset": "veryfast"}
            for picture in pictures:
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        return buffer.getvalue()
    images = [Image.fromarray(picture) for picture in pictures]
    if ending == ".png":
        images[0].save(buffer, "PNG", optimize=True)
        return buffer.getvalue()
    # one palette for all frames, or colours would flicker; taken from some of them
    palette = Image.fromarray(tiled(pictures[:: max(1, len(pictures) // 8)], *STRIP)).quantize(128)
    small = [image.quantize(128, palette=palette, dither=Image.Dither.NONE) for image in images]
    small[0].save(buffer, "GIF", save_all=True, append_images=small[1:], duration=round(1000 / rate), loop=0)
    return buffer.getvalue()


def pace(control_hz: float, ending: str) -> tuple[int, float]:
    """Control steps of a frame, and frames a second: at most 30, of a GIF, whose times are hundredths of a second, 25."""
    stride = max(1, math.ceil(control_hz / (25 if ending == ".gif" else 30)))
    return stride, control_hz / stride


def write(path: Path, data: bytes) -> None:
    """Write a picture as a whole or not at all. Raises UserError."""
    try:
        write_atomic(path, data, levels=EVERY_LEVEL)
    except OSError as error:
        raise UserError(f"{path}: it can't be written ({error.strerror or error})") from error
