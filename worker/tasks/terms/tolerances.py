"""Posture: distances of joints from their default positions, each relative to its own tolerance.

The tolerances are declared beside a task's sensors, ``sensors={"tolerances": terms.Tolerances(standing={"*_hip": 0.05, "*": 0.1})}``,
for terms with a parameter ``tolerances``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import torch
import warp as wp

from shared_store.contract.error_text import nearest
from worker.simulation.episodes import EpisodeArrays
from worker.simulation.patterns import resolve
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.terms.commands import command_speed
from worker.tasks.terms.joints import joint_offset

if TYPE_CHECKING:
    from worker.simulation.robot_view import RobotView
    from worker.simulation.sensors.sensor import SensorContext

wp.set_module_options({"enable_backward": False})


@wp.struct
class ToleranceArrays:
    """Tolerated distance of each joint from its default position: standard deviations [m, rad], shape ``(joints,)`` of ``columns``.

    Attributes:
        columns: The joints with a tolerance, as indices into the arrays of ``RobotArrays``.
        standing: For commands to stand.
        walking: For commands to walk.
        running: For commands to run.
    """

    columns: wp.array[wp.int32]
    standing: wp.array[wp.float32]
    walking: wp.array[wp.float32]
    running: wp.array[wp.float32]


@wp.func
def posture_within(
    worlds: WorldArrays,
    robot: RobotArrays,
    columns: wp.array[wp.int32],
    deviations: wp.array[wp.float32],
    world: int,
) -> float:
    """exp(-mean of e^2 / s^2) over joints, e the distance of each from its default and s its tolerance."""
    total = float(0.0)
    for number in range(columns.shape[0]):
        error = joint_offset(world, worlds, robot, columns[number]) / deviations[number]
        total += error * error
    return wp.exp(-total / float(columns.shape[0]))


@wp.func
def commanded_posture(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    tolerances: ToleranceArrays,
    command: int,
    walking: float = 0.5,
    running: float = 1.5,
) -> float:
    """As :func:`tolerant_posture`, with tolerances chosen by the velocity command.

    Commands of at least ``walking`` or ``running`` use those tolerances: speed [m/s] + turning velocity [rad/s].

    mjlab: variable_posture.
    """
    commanded = command_speed(world, episodes, command)
    if commanded < walking:
        return posture_within(worlds, robot, tolerances.columns, tolerances.standing, world)
    if commanded < running:
        return posture_within(worlds, robot, tolerances.columns, tolerances.walking, world)
    return posture_within(worlds, robot, tolerances.columns, tolerances.running, world)


@dataclass(frozen=True)
class Tolerances:
    """Tolerated distance of each joint from its default position, by joint pattern; the first pattern that fits wins.

    Attributes:
        standing: Standard deviation of each joint [m, rad], or one for all. Joints without a fitting pattern don't count.
        walking: The same for commands to walk, with the same joints; None: as ``standing``.
        running: The same for commands to run; None: as ``walking``.
        robot: The robot with these joints.
    """

    arrays_type: ClassVar[Any] = ToleranceArrays
    standing: Mapping[str, float] | float
    walking: Mapping[str, float] | float | None = None
    running: Mapping[str, float] | float | None = None
    robot: str = "robot"

    def rows(self, views: Mapping[str, RobotView]) -> list[str]:
        """Name of each joint with a tolerance. Raises ValueError if a pattern or a name matches nothing."""
        if self.robot not in views:
            raise ValueError(f"Tolerances.robot: there is no robot {self.robot!r}; {nearest(self.robot, list(views))}")
        return list(_by_joint("Tolerances.standing", self.standing, views[self.robot].joint_names))

    def build(self, context: SensorContext) -> JointTolerances:
        """The tolerances on the device of these worlds.

        Raises:
            ValueError: A pattern fits no joint, a joint of ``standing`` has no other tolerance, or a tolerance is not above 0.
        """
        names = list(context.view(self.robot, "Tolerances.robot").joint_names)
        walking = self.standing if self.walking is None else self.walking
        running = walking if self.running is None else self.running
        found = {}
        for speed, values in (("standing", self.standing), ("walking", walking), ("running", running)):
            found[speed] = _by_joint(f"Tolerances.{speed}", values, names)
            if lacking := [name for name in found["standing"] if name not in found[speed]]:
                raise ValueError(f"Tolerances.{speed}: no pattern fits {lacking[0]}, which standing has; add one")
        joints = [name for name in names if name in found["standing"]]
        arrays = ToleranceArrays()
        arrays.columns = wp.array([names.index(name) for name in joints], dtype=wp.int32, device=context.device)
        for speed, values in found.items():
            setattr(arrays, speed, wp.array([values[name] for name in joints], dtype=wp.float32, device=context.device))
        return JointTolerances(arrays, tuple(joints))


class JointTolerances:
    """:class:`Tolerances` of some worlds; they never change, so it has nothing to measure.

    Args:
        arrays: The tolerances.
        names: Names of the joints, in the order of the arrays.
    """

    needs_bodies = False

    def __init__(self, arrays: ToleranceArrays, names: tuple[str, ...]) -> None:
        self.arrays, self.names = arrays, names

    def advance(self) -> None:
        """No-op: a step changes nothing."""

    def settle(self) -> None:
        """No-op: a reset changes nothing."""

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """Empty: no state persists between steps."""
        return {}


def _by_joint(place: str, values: Mapping[str, float] | float, names: list[str]) -> dict[str, float]:
    """The value of each joint with a fitting pattern."""
    for pattern, value in values.items() if isinstance(values, Mapping) else (("*", values),):
        if isinstance(value, bool) or not isinstance(value, int | float) or not (0.0 < value < math.inf):
            raise ValueError(f"{place}.{pattern}: a tolerance is a number above 0, found {value!r}")
    try:
        found = resolve(names, values, "joint")
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from error
    result = {name: float(value) for name, value in zip(names, found, strict=True) if value is not None}
    if not result:
        raise ValueError(f"{place}: name at least one joint; available: {', '.join(names) or 'none'}")
    return result
