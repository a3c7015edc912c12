"""A robot of a scene: its file, initial pose, actuators and collisions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import newton
import warp as wp

from worker.simulation import actuators as actuation
from worker.simulation import collisions as contacts
from worker.simulation import robot_reading
from worker.simulation.actuators import Actuator, Number
from worker.simulation.collisions import Collision
from worker.simulation.patterns import FLOORS, resolve
from worker.simulation.robot_view import RobotView

UPRIGHT = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Robot:
    """A robot from an MJCF, URDF or USD file.

    Patterns work like those of file names (``*``, ``?``, ``[ab]``); the first pattern that matches a name wins. Names are those in the
    file, with underscores for characters that USD does not allow, such as dashes.

    Args:
        file: A path, ``"package:NAME/path"`` (a file inside an installed Python package), ``"newton:NAME"`` (one of Newton's assets), or
            the text of an MJCF or URDF file.
        name: Its name in the world; labels in the model begin with it.
        position: Of its root at the start [m]; None: as in the file.
        rotation: Of its root at the start (quaternion xyzw); None: as in the file, or upright where a position is given.
        joint_positions: Initial joint positions [rad, m], by pattern; other joints start as in the file.
        actuators: Actuators that replace those of the file; without any, the file's are kept.
        fixed: Whether its root is fixed to the world, or moves freely; None: as in the file. A joint of the root that an actuator, a
            tendon or an equality of an MJCF file needs is not taken away: then only None is accepted.
        self_collisions: Whether its own geoms may touch each other; None: as in the file and in ``collisions``.
        collisions: How its geoms collide; geoms without a match collide as in the file.
        armature: Inertia of rotors, reflected to the joint [kg m^2, kg], by pattern or for all joints; None: as in the file.
        friction_loss: Dry friction of joints [N m, N]; None: as in the file.
        viscous_damping: Damping of joints [N m s/rad, N s/m]; None: as in the file.
        ignore: Patterns of bodies and geoms to leave out, such as the file's own floor (MJCF and USD).
        passive: Whether it may have no actuators at all, like a door.
        visuals: Whether visual-only geoms are read, which cameras and pictures need (from URDF they always are).
        file_options: Whether solver options of an MJCF or USD file apply where the task sets none; the last robot added wins.
        accept: Differences between the robot and its file that would be refused, as patterns of ``"ELEMENT: FIELD"``, such as
            ``"joint root: stiffness"``; ``muster robot`` prints them so.
    """

    file: str | Path
    name: str = field(default="robot", kw_only=True)
    position: tuple[float, float, float] | None = field(default=None, kw_only=True)
    rotation: tuple[float, float, float, float] | None = field(default=None, kw_only=True)
    joint_positions: Mapping[str, float] = field(default_factory=dict, kw_only=True)
    actuators: Sequence[Actuator] = field(default=(), kw_only=True)
    fixed: bool | None = field(default=None, kw_only=True)
    self_collisions: bool | None = field(default=None, kw_only=True)
    collisions: Sequence[Collision] = field(default=(), kw_only=True)
    armature: Number | None = field(default=None, kw_only=True)
    friction_loss: Number | None = field(default=None, kw_only=True)
    viscous_damping: Number | None = field(default=None, kw_only=True)
    ignore: Sequence[str] = field(default=FLOORS, kw_only=True)
    passive: bool = field(default=False, kw_only=True)
    visuals: bool = field(default=True, kw_only=True)
    file_options: bool = field(default=True, kw_only=True)
    accept: Sequence[str] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        check_word(self.name)
        for name, value, count in (("position", self.position, 3), ("rotation", self.rotation, 4)):
            if value is not None and (len(value) != count or not all(map(math.isfinite, value))):
                raise ValueError(f"Robot {self.name}: {name} is {value!r}; give {count} finite numbers")
        for name in ("joint_positions", "armature", "friction_loss", "viscous_damping"):
            value = getattr(self, name)
            for number in value.values() if isinstance(value, Mapping) else [] if value is None else [value]:
                if not math.isfinite(number):
                    raise ValueError(f"Robot {self.name}: {name} is {value!r}; give finite numbers")

    def add_to(self, builder: newton.ModelBuilder) -> robot_reading.Reading:
        """Add the robot to a builder that holds one world.

        Args:
            builder: ``SolverMuJoCo.register_custom_attributes`` was called on it.

        Returns:
            How its file was read.

        Raises:
            ValueError: The file or a mesh is missing or can't be read, the name is taken, a pattern matches nothing, two actuators
                drive one joint, or nothing would move the robot's joints.
        """
        check_name(builder, self.name)
        reading = self.read()
        own = reading.builder
        view = RobotView(own, "")
        self._set_joints(own, view)
        if self.actuators:
            actuation.clear(own)
            actuation.add(own, view.joint_names, view.dofs, self.actuators, self.name)
        self._check_driven(own, view)
        contacts.apply(own, view.geom_names, view.geoms, self.collisions, self.name)
        if self.self_collisions is False:
            contacts.without_self(own, builder)
        self._place(own, view)
        builder.add_builder(own, label_prefix=self.name)
        return reading

    def read(self) -> robot_reading.Reading:
        """Read the file alone, without what the other arguments change of the robot.

        Raises:
            ValueError: See :meth:`add_to`.
        """
        try:
            return robot_reading.read(self)
        except ValueError as error:
            raise ValueError(f"{self.name}: {error}") from error
        except Exception as error:  # of a library that reads the file
            words = f"{type(error).__name__}: {' '.join(str(error).split())}"
            raise ValueError(f"{self.name}: {robot_reading.shown(self.file)} can't be read: {words}") from error

    def _set_joints(self, own: newton.ModelBuilder, view: RobotView) -> None:
        for values, starts, argument in (
            (own.joint_q, view.coordinates, "joint_positions"),
            (own.joint_armature, view.dofs, "armature"),
            (own.joint_friction, view.dofs, "friction_loss"),
            (own.joint_damping, view.dofs, "viscous_damping"),
        ):
            numbers = getattr(self, argument)
            if numbers is None or numbers == {}:
                continue
            try:
                resolved = resolve(view.joint_names, numbers, f"joint of {self.name}")
            except ValueError as error:
                raise ValueError(f"{self.name}: {argument}: {error}") from error
            for column, value in zip(starts, resolved, strict=True):
                if value is not None:
                    values[column] = float(value)

    def _check_driven(self, own: newton.ModelBuilder, view: RobotView) -> None:
        if view.joint_names and not self.passive and not own.custom_attributes["mujoco:actuator_trnid"].values:
            raise ValueError(
                f"{self.name}: {robot_reading.shown(self.file)} has no actuators that a task could control; declare them, such as "
                "actuators=(PositionActuator('*', stiffness=20.0, damping=0.5),), or say passive=True "
                f"(joints: {', '.join(view.joint_names)})"
            )

    def _place(self, own: newton.ModelBuilder, view: RobotView) -> None:
        """Move the root, and with a fixed root everything in the file that is fixed to the world."""
        if self.position is None and self.rotation is None:
            return
        position = wp.vec3(*(self.position or tuple(view.start.p)))
        pose = wp.transform(position, wp.normalize(wp.quat(*(self.rotation or UPRIGHT))))
        own.body_q[view.root_body] = pose
        if view.root_coordinate >= 0:
            own.joint_q[view.root_coordinate : view.root_coordinate + 7] = [*pose.p, *pose.q]
            return
        change = pose * wp.transform_inverse(view.start)
        for joint, parent in enumerate(own.joint_parent):
            if parent == -1:
                own.joint_X_p[joint] = change * wp.transform(*own.joint_X_p[joint])
        for shape, body in enumerate(own.shape_body):
            if body == -1:
                own.shape_transform[shape] = change * wp.transform(*own.shape_transform[shape])


def check_word(name: str) -> None:
    """Refuse a name that can't begin a label."""
    if not name or "/" in name:
        raise ValueError(f"the name of a robot or object is a word without slashes, not {name!r}")


def check_name(builder: newton.ModelBuilder, name: str) -> None:
    """Refuse a name that is already taken in the world or can't begin a label."""
    check_word(name)
    if any(label.startswith(f"{name}/") for label in builder.body_label):
        raise ValueError(f"two things in the world are called {name!r}; give one of them another name")
