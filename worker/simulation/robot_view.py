"""A view of one robot or object: its joints, bodies, sites and geoms, by name, and their columns in the arrays of a world."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable
from typing import Any, Literal

import mujoco
import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo

from shared_store.contract.error_text import nearest
from worker.simulation.actuators import Input
from worker.simulation.patterns import find
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.robot_elements import is_carrier, short
from worker.simulation.robot_values import UNLIMITED
from worker.simulation.structs import filled
from worker.simulation.worlds import Worlds

Patterns = str | Iterable[str]


class RobotView:
    """A robot or object in a builder of one world, before it is replicated.

    Labels of its parts begin with its name and a slash, as written by ``Robot.add_to`` and the objects' ``add_to``.

    Args:
        template: Builder holding one world.
        name: Name of the robot or object; "" for the whole world.

    Raises:
        ValueError: Nothing in the world has this name.

    Attributes:
        joint_names: Joints of one degree of freedom, as in the file; a joint of several counts as so many.
        body_names: Bodies, as in the file.
        site_names: Sites, as in the file.
        geom_names: Geoms except sites, including visual-only ones. They are numbered if the format has no geom names.
        coordinates: Column of each joint in ``WorldArrays.joint_q``.
        dofs: Column of each joint in ``WorldArrays.joint_qd`` and ``drives``.
        actuators: Column of each joint's actuator in ``WorldArrays.controls``, -1 where it has none.
        joint_types: Type of the Newton joint behind each joint, one of ``newton.JointType``.
        joint_bodies: Column of the body that each joint moves.
        parents: Column of the parent of each body; -1: the world.
        defaults: Default position of each joint [m, rad].
        ranges: Lower and upper limit of each joint [m, rad], infinite where there is none.
        efforts: Greatest force of each joint's actuator [N, N m], infinite where it is not limited.
        gains: Force on each joint per unit of its actuator's input, gear times gain [N, N m]; 1 without an actuator of such a gain.
        inputs: What each joint's actuator takes: ``"effort"``, ``"position"`` or ``"velocity"``; empty without one, or of another kind.
        bodies: Column of each body in ``BodyArrays``.
        sites: Index of each site among the shapes of a world.
        site_bodies: Column of the body of each site; -1: the world.
        site_poses: Pose of each site in its body's frame [m, quaternion xyzw].
        geoms: Index of each geom among the shapes of a world.
        geom_bodies: Column of the body of each geom; -1: the world.
        root_coordinate: First column of the free root in ``joint_q``; -1: it is fixed.
        root_dof: First column of the free root in ``joint_qd``; -1: it is fixed.
        root_body: Column of its first body.
        root_com: Centre of mass of its first body, in the body's frame [m].
        start: Pose of the root at the start, in the world frame.
    """

    def __init__(self, template: newton.ModelBuilder, name: str = "robot") -> None:
        self.name = name
        self._prefix = f"{name}/" if name else ""
        self.bodies = [body for body in self._mine(template.body_label) if not is_carrier(template.body_label[body])]
        if not self.bodies:
            existing = sorted({label.partition("/")[0] for label in template.body_label})
            raise ValueError(f"the world has no robot or object {name!r}; {nearest(name, existing)}")
        self.body_names = [short(template.body_label[body]) for body in self.bodies]
        self._read_joints(template)
        self._read_shapes(template)

    def _mine(self, labels: list[str]) -> list[int]:
        return [index for index, label in enumerate(labels) if label.startswith(self._prefix)]

    def _read_joints(self, template: newton.ModelBuilder) -> None:
        self.joint_names: list[str] = []
        self.coordinates: list[int] = []
        self.dofs: list[int] = []
        self.joint_types: list[newton.JointType] = []
        self.joint_bodies: list[int] = []
        self.parents: dict[int, int] = {}
        self.root_coordinate = self.root_dof = -1
        self.root_body = self.bodies[0]
        x, y, z = (float(each) for each in template.body_com[self.root_body])
        self.root_com = (x, y, z)
        self.start = wp.transform(*template.body_q[self.root_body])
        for joint in self._mine(template.joint_label):
            first, dof = template.joint_q_start[joint], template.joint_qd_start[joint]
            self.parents[template.joint_child[joint]] = template.joint_parent[joint]
            if template.joint_type[joint] == newton.JointType.FREE:
                if template.joint_child[joint] == self.root_body:
                    self.root_coordinate, self.root_dof = first, dof
                    self.start = wp.transform(*template.joint_q[first : first + 7])
                continue
            if template.joint_type[joint] == newton.JointType.BALL:
                continue  # four coordinates to three degrees of freedom: none of them is a joint of its own
            for axis, joint_name in enumerate(dof_names(template, joint)):
                self.joint_names.append(joint_name)
                self.coordinates.append(first + axis)
                self.dofs.append(dof + axis)
                self.joint_types.append(newton.JointType(template.joint_type[joint]))
                self.joint_bodies.append(template.joint_child[joint])
        self.defaults = [float(template.joint_q[column]) for column in self.coordinates]
        self.ranges = [
            (_limit(template.joint_limit_lower[dof], -1), _limit(template.joint_limit_upper[dof], 1))
            for dof in self.dofs
        ]
        self.references = [float(_value(template, "mujoco:dof_ref", dof)) for dof in self.dofs]
        columns = actuators_of_dofs(template)
        self.actuators = [columns.get(dof, -1) for dof in self.dofs]
        self.efforts = [
            _effort(template, dof, actuator) for dof, actuator in zip(self.dofs, self.actuators, strict=True)
        ]
        self.gains = [_gain(template, actuator) for actuator in self.actuators]
        self.inputs = [_input(template, actuator) for actuator in self.actuators]

    def _read_shapes(self, template: newton.ModelBuilder) -> None:
        mine = self._mine(template.shape_label)
        self.sites = [shape for shape in mine if template.shape_flags[shape] & newton.ShapeFlags.SITE]
        self.geoms = [shape for shape in mine if not template.shape_flags[shape] & newton.ShapeFlags.SITE]
        self.site_names = [short(template.shape_label[shape]) for shape in self.sites]
        self.geom_names = [short(template.shape_label[shape]) for shape in self.geoms]
        self.site_bodies = [template.shape_body[shape] for shape in self.sites]
        self.geom_bodies = [template.shape_body[shape] for shape in self.geoms]
        self.site_poses = [wp.transform(*template.shape_transform[shape]) for shape in self.sites]

    def find_joints(self, patterns: Patterns) -> list[int]:
        """Indices into :attr:`joint_names`, in the model's order. Raises ValueError where a pattern matches nothing."""
        return find(self.joint_names, patterns, f"joint of {self.name}")

    def find_bodies(self, patterns: Patterns) -> list[int]:
        """Indices into :attr:`body_names`, in the model's order. Raises ValueError where a pattern matches nothing."""
        return find(self.body_names, patterns, f"body of {self.name}")

    def find_sites(self, patterns: Patterns) -> list[int]:
        """Indices into :attr:`site_names`, in the model's order. Raises ValueError where a pattern matches nothing."""
        return find(self.site_names, patterns, f"site of {self.name}")

    def find_geoms(self, patterns: Patterns) -> list[int]:
        """Indices into :attr:`geom_names`, in the model's order. Raises ValueError where a pattern matches nothing."""
        return find(self.geom_names, patterns, f"geom of {self.name}")

    def joints_moving(self, body: int) -> list[int]:
        """Indices into :attr:`joint_names` of the joints between the root and a body, given by its column; none for the world, -1."""
        above: set[int] = set()
        while body >= 0 and body not in above:
            above.add(body)
            body = self.parents.get(body, -1)
        return [joint for joint, moved in enumerate(self.joint_bodies) if moved in above]

    def beyond_limits(self) -> list[str]:
        """The joints with a default position beyond their limits, one sentence each."""
        return [
            f"joint {name}: its default position {default:.6g} lies outside its limits, {lower:.6g} to {upper:.6g}"
            for name, default, (lower, upper) in zip(self.joint_names, self.defaults, self.ranges, strict=True)
            if not lower - 1e-6 <= default <= upper + 1e-6
        ]

    def need_ranges(self, joints: Iterable[int], purpose: str) -> None:
        """Raise ValueError where a joint has no lower or no upper limit, which ``purpose`` needs, such as ``"reward joint_limits"``."""
        missing = [joint for joint in joints if not all(map(math.isfinite, self.ranges[joint]))]
        self._refuse(missing, purpose, "limits of its position", "give it a range in the robot's file, or leave it out")

    def need_efforts(self, joints: Iterable[int], purpose: str) -> None:
        """Refuse joints whose actuator is missing or has no force limit."""
        joints = list(joints)
        undriven = [joint for joint in joints if self.actuators[joint] < 0]
        self._refuse(undriven, purpose, "an actuator", "declare one, or leave it out")
        missing = [joint for joint in joints if not math.isfinite(self.efforts[joint])]
        self._refuse(missing, purpose, "a limit of its force", "give its actuator an effort_limit, or leave it out")

    def _refuse(self, joints: list[int], purpose: str, lacking: str, remedy: str) -> None:
        if joints:
            having = [name for joint, name in enumerate(self.joint_names) if joint not in joints]
            raise ValueError(
                f"{purpose} needs {lacking}, which joint {self.joint_names[joints[0]]} of {self.name} lacks; {remedy} "
                f"(joints of {self.name} beside {', '.join(self.joint_names[joint] for joint in joints)}: {', '.join(having) or 'none'})"
            )

    def arrays(self, worlds: Worlds) -> RobotArrays:
        """The robot as kernels see it, on the device of ``worlds``, which were built from this view's template."""
        device = worlds.model.device
        shape = (worlds.world_count, len(self.joint_names))
        own = {name: getattr(self, name) for name in RobotArrays.__annotations__ if name != "encoder_bias"}
        own["ranges"] = np.array(self.ranges, np.float32).reshape(-1, 2)
        found: RobotArrays = filled(RobotArrays, device, shape, **own)
        return found


def body_arrays(worlds: Worlds) -> BodyArrays:
    """Poses, velocities and centres of mass of all bodies: views of ``worlds``, current after ``worlds.update_bodies``."""
    shape = (worlds.world_count, worlds.model.body_count // worlds.world_count)
    found: BodyArrays = filled(
        BodyArrays,
        None,
        poses=worlds.state.body_q.reshape(shape),
        velocities=worlds.state.body_qd.reshape(shape),
        coms=worlds.model.body_com.reshape(shape),
    )
    return found


def joint_of(template: newton.ModelBuilder, dof: int) -> int:
    """Index of the joint that has a degree of freedom."""
    return bisect_right(template.joint_qd_start[: template.joint_count], dof) - 1


def dof_names(template: newton.ModelBuilder, joint: int) -> list[str]:
    """A name for each degree of freedom of a joint: Newton makes one joint of all hinges between two bodies.

    ``Robot.add_to`` writes the names of such hinges to MuJoCo's ``joint_dof_label``; hinges without a name there are numbered.
    """
    name, count = short(template.joint_label[joint]), sum(template.joint_dof_dim[joint])
    if count == 1:
        return [name]
    labels: Any = template.custom_attributes["mujoco:joint_dof_label"].values or {}
    first = template.joint_qd_start[joint]
    return [short(labels[dof]) if labels.get(dof) else f"{name}_{dof - first}" for dof in range(first, first + count)]


def actuator_value(template: newton.ModelBuilder, attribute: str, actuator: int) -> Any:
    """One of the builder's ``mujoco:actuator_...`` values, or its default where the file didn't give it."""
    return _value(template, f"mujoco:{attribute}", actuator)


def _value(template: newton.ModelBuilder, attribute: str, index: int) -> Any:
    attributes = template.custom_attributes[attribute]
    values: Any = attributes.values
    value = values.get(index) if isinstance(values, dict) else values[index] if values else None
    return attributes.default if value is None else value


def actuators_of_dofs(template: newton.ModelBuilder) -> dict[int, int]:
    """The first actuator on each degree of freedom with a joint transmission; further ones can't be addressed by joint name."""
    columns: dict[int, int] = {}
    labels: Any = template.custom_attributes["mujoco:joint_dof_label"].values or {}
    dofs_of_labels = {label: dof for dof, label in labels.items()}
    joint_like = (int(SolverMuJoCo.TrnType.JOINT), int(SolverMuJoCo.TrnType.JOINT_IN_PARENT))
    for actuator in range(len(template.custom_attributes["mujoco:actuator_trnid"].values or ())):
        if int(actuator_value(template, "actuator_trntype", actuator)) not in joint_like:
            continue
        dof = int(actuator_value(template, "actuator_trnid", actuator)[0])
        if dof < 0:
            dof = dofs_of_labels.get(actuator_value(template, "actuator_target_label", actuator), -1)
        columns.setdefault(dof, actuator)
    return columns


def _effort(template: newton.ModelBuilder, dof: int, actuator: int) -> float:
    """Effective force limit of an actuator: the least of its own range, the range of a motor's input, and the joint's."""
    joint_limit = float(template.joint_effort_limit[dof])
    limits = [joint_limit if joint_limit < UNLIMITED else math.inf]
    if actuator >= 0:
        gear = abs(float(actuator_value(template, "actuator_gear", actuator)[0]))
        if is_limited(template, "force", actuator):
            limits.append(gear * max(map(abs, actuator_value(template, "actuator_forcerange", actuator))))
        if is_motor(template, actuator) and is_limited(template, "ctrl", actuator):
            gain = abs(float(actuator_value(template, "actuator_gainprm", actuator)[0]))
            limits.append(gear * gain * max(map(abs, actuator_value(template, "actuator_ctrlrange", actuator))))
    return float(min(limits))


def _gain(template: newton.ModelBuilder, actuator: int) -> float:
    """Force on the joint per unit of input; 1 without an actuator whose force is proportional to it."""
    if actuator < 0 or not has_fixed_gain(template, actuator):
        return 1.0
    gear = float(actuator_value(template, "actuator_gear", actuator)[0])
    return gear * float(actuator_value(template, "actuator_gainprm", actuator)[0]) or 1.0


def _input(template: newton.ModelBuilder, actuator: int) -> Input | Literal[""]:
    """What an actuator takes, by the shortcuts of MuJoCo's file format: motor, position, velocity; empty for any other."""
    if actuator < 0 or int(actuator_value(template, "actuator_dyntype", actuator)) == mujoco.mjtDyn.mjDYN_INTEGRATOR:
        return ""
    if "muster:explicit" in template.custom_attributes and _value(template, "muster:explicit", actuator):
        return "position"
    if not has_fixed_gain(template, actuator):
        return ""
    if is_motor(template, actuator):
        return "effort"
    gain = float(actuator_value(template, "actuator_gainprm", actuator)[0])
    _, position, velocity, *_ = map(float, actuator_value(template, "actuator_biasprm", actuator))
    if position:
        return "position" if math.isclose(position, -gain, rel_tol=1e-5) else ""
    return "velocity" if math.isclose(velocity, -gain, rel_tol=1e-5) else ""


def has_fixed_gain(template: newton.ModelBuilder, actuator: int) -> bool:
    """Whether an actuator's force is proportional to its input, unlike a damper's or a muscle's."""
    return bool(int(actuator_value(template, "actuator_gaintype", actuator)) == mujoco.mjtGain.mjGAIN_FIXED)


def is_motor(template: newton.ModelBuilder, actuator: int) -> bool:
    """Whether an actuator's force depends on its input alone."""
    is_unbiased = int(actuator_value(template, "actuator_biastype", actuator)) == mujoco.mjtBias.mjBIAS_NONE
    return is_unbiased and has_fixed_gain(template, actuator)


def is_limited(template: newton.ModelBuilder, what: str, actuator: int) -> bool:
    """MuJoCo's rule for limits: on, off, or (2) on if a range is given."""
    limited = int(actuator_value(template, f"actuator_{what}limited", actuator))
    return bool(actuator_value(template, f"actuator_has_{what}range", actuator)) if limited == 2 else limited == 1


def _limit(value: float, sign: int) -> float:
    return sign * math.inf if abs(value) >= newton.MAXVAL else float(value)
