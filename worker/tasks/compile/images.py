"""Image observation groups: their cameras, and their descriptions in manifests and tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from shared_store.contract.error_text import nearest
from worker.settings.task import TaskConfig
from worker.simulation.robot_view import RobotView
from worker.tasks.compile.declaration_checks import placed
from worker.tasks.declare.declaration import Declaration

if TYPE_CHECKING:
    from worker.tasks.compile.plan import KernelPlan


def cameras(
    declaration: Declaration, config: TaskConfig, sensors: Mapping[str, Any], views: Mapping[str, RobotView]
) -> dict[str, str]:
    """The camera's name for each image group.

    Args:
        declaration: The task's terms.
        config: Its configuration, which also names the groups.
        sensors: The sensors as declared, by name.
        views: Its robots and objects by name.

    Raises:
        ValueError: The camera or its mounting does not exist, or the configuration names other image groups.
    """
    _check_groups(config, declaration)
    known = [name for name, sensor in sensors.items() if hasattr(sensor, "channels")]
    for group, image in declaration.images.items():
        if image.sensor not in known:
            hint = nearest(image.sensor, known) if known else "the task declares none; give it a CameraSensor"
            no_camera = f"the sensor {image.sensor} is not a camera"
            what = no_camera if image.sensor in sensors else f"there is no camera {image.sensor!r}"
            raise ValueError(f"observations.{group}: {what}; {hint}")
    for name in known:
        with placed(f"sensors.{name}"):
            sensors[name].rows(views)
    return {group: image.sensor for group, image in declaration.images.items()}


def _check_groups(config: TaskConfig, declaration: Declaration) -> None:
    """Refuse image groups that the configuration does not declare: submission checks jobs against it."""
    groups, kind = config.observation_groups, type(config).__name__
    existing = [*declaration.groups, *declaration.images]
    for group in declaration.images:
        if not groups.get(group, False):
            raise ValueError(
                f"observations.{group}: it is an image, and {kind} does not declare it; give {kind} a "
                f'further_groups: ClassVar = {{"{group}": True}}'
            )
    for group, is_image in config.further_groups.items():
        if group not in existing:
            raise ValueError(
                f"observations: {kind}.further_groups has {group}, and the task declares no such group; {nearest(group, existing)}"
            )
        if is_image and group not in declaration.images:
            raise ValueError(
                f"observations.{group}: {kind}.further_groups says that it is an image, and the task gives terms; give "
                "Image(camera)"
            )


def shown(plan: KernelPlan, group: str) -> str:
    """Description of a group's images, in one line."""
    sensor = plan.declaration.sensors[plan.images[group]]
    kind = sensor.kind
    if kind == "segmentation":
        kind += f" of {', '.join(sensor.channels(plan.views))}"
    elif kind == "depth":
        kind += f" from {sensor.near:g} to {sensor.far:g} m"
    return f"{sensor.frames} x {kind} of {sensor.width} x {sensor.height} bytes, the present one first"
