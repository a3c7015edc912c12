"""The YAM arm of I2RT: six joints and a gripper of two fingers, from the file that comes with the package ``mjlab``.

Numbers are those of mjlab 1.6 (``mjlab/asset_zoo/robots/i2rt_yam/yam_constants.py``): each joint has the inertia and the greatest
torque of its motor, and a position servo whose gains give the joint's effective inertia a natural frequency of 2 Hz (the gripper: 1 Hz)
at twice the critical damping.
"""

from __future__ import annotations

from worker.simulation.actuators import PositionActuator
from worker.simulation.collisions import Collision
from worker.simulation.robot import Robot

FILE = "package:mjlab/asset_zoo/robots/i2rt_yam/xmls/yam.xml"

GRASP = "grasp_site"
"""The site between the fingers' tips."""
GRIPPER = ("link_6", "?f_rot", "?f_down")
"""The colliding bodies from the wrist on."""
FINGERTIPS = ("[lr]f_down[6-9]_collision", "[lr]f_down1[01]_collision")
"""The spheres on the inner sides of the fingers."""

HOME = {
    "joint2": 1.047,
    "joint3": 1.05,
    "joint4": -0.9,
    "left_finger": 0.01875,
    "right_finger": -0.01875,
}
"""Default positions [rad, m]; the other joints' are 0."""

EFFECTIVE_INERTIAS = {
    "joint1": 0.123153,
    "joint2": 0.277411,
    "joint3": 0.232763,
    "joint4": 0.030154,
    "joint5": 0.009126,
    "joint6": 0.002868,
    "left_finger": 2.781624,
}
"""Effective inertia that each actuator moves, at its joint [kg m^2, kg]."""

DAMPING_RATIO = 2.0
_PI = 3.1415926535  # mjlab's
ARM_FREQUENCY = 4.0 * _PI
"""Natural frequency of the arm's servos [rad/s]."""
GRIPPER_FREQUENCY = 2.0 * _PI
"""Natural frequency of the gripper's servo [rad/s]."""

LARGE_MOTOR = (0.032, 28.0)
"""DM 4340: inertia of the rotor behind its gear [kg m^2] and greatest torque [N m]."""
SMALL_MOTOR = (0.0018, 10.0)
"""DM 4310: the same."""
CRANK = 0.071 / 2.7
"""Transmission of the gripper's crank [m/rad]: its stroke over the motor's range."""
GRIPPER_SHARE = 0.1
"""Usable share of the gripper's greatest force, as on the real arm; it keeps the simulation stable."""

_MOTORS = dict.fromkeys(("joint1", "joint2", "joint3"), LARGE_MOTOR)
_MOTORS |= dict.fromkeys(("joint4", "joint5", "joint6"), SMALL_MOTOR)
# a transmission of r [m/rad] makes an inertia I the mass I / r^2 and a torque T the force T / r
_MOTORS["left_finger"] = (SMALL_MOTOR[0] / CRANK**2, GRIPPER_SHARE * SMALL_MOTOR[1] / CRANK)


def frequency(joint: str) -> float:
    """Natural frequency of a joint's servo [rad/s]."""
    return GRIPPER_FREQUENCY if joint == "left_finger" else ARM_FREQUENCY


ARMATURES = {joint: armature for joint, (armature, _) in _MOTORS.items()}
"""[kg m^2, kg]"""
EFFORTS = {joint: effort for joint, (_, effort) in _MOTORS.items()}
"""[N m, N]"""
STIFFNESS = {joint: inertia * frequency(joint) ** 2 for joint, inertia in EFFECTIVE_INERTIAS.items()}
"""[N m/rad, N/m]"""
DAMPING = {joint: 2.0 * DAMPING_RATIO * inertia * frequency(joint) for joint, inertia in EFFECTIVE_INERTIAS.items()}
"""[N m s/rad, N s/m]"""
ACTION_SCALE = {joint: 0.25 * EFFORTS[joint] / STIFFNESS[joint] for joint in STIFFNESS}
"""Displacement of a joint's target for an action of 1: a quarter of the servo's error at the greatest force [rad, m]."""


def yam() -> Robot:
    """The arm on its fixed base at the origin, its gripper 35 cm above the ground.

    Only geoms of the gripper collide. The right finger follows the left one, as the file couples them.
    """
    tips = dict.fromkeys(FINGERTIPS, 6) | {"*": 3}
    return Robot(
        FILE,
        position=(0.0, 0.0, 0.01),
        joint_positions=HOME,
        actuators=(
            PositionActuator(
                tuple(STIFFNESS), stiffness=STIFFNESS, damping=DAMPING, effort_limit=EFFORTS, armature=ARMATURES
            ),
        ),
        collisions=(
            Collision(
                ("link6_*_collision", "[lr]f_*_collision"),
                condim=tips,
                friction=dict.fromkeys(FINGERTIPS, (1.0, 5e-3, 5e-4)) | {"*": 0.6},
                solref=dict.fromkeys(FINGERTIPS, (0.01, 1.0)),
                priority=dict.fromkeys(FINGERTIPS, 1) | {"*": 0},
            ),
        ),
    )
