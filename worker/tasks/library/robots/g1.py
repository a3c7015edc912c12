"""Unitree's G1, a humanoid of 29 joints: mjlab 1.6's file and numbers (``asset_zoo/robots/unitree_g1/g1_constants.py``)."""

from __future__ import annotations

from worker.simulation.collisions import Collision
from worker.simulation.robot import Robot
from worker.tasks.library.robots.mjlab import action_scale, robot_file, servo


def planetary(rotors: tuple[float, float, float], second: float, third: float) -> float:
    """Inertia of a motor with a gearbox of two planetary stages, reflected to the joint [kg m^2].

    Args:
        rotors: Inertias of the rotor and of the parts behind the first and the second stage [kg m^2], from Unitree.
        second: Ratio of the first stage.
        third: Ratio of the second stage.
    """
    return rotors[0] * (second * third) ** 2 + rotors[1] * third**2 + rotors[2]


ROTOR_5020 = planetary((0.139e-4, 0.017e-4, 0.169e-4), 1.0 + 46.0 / 18.0, 1.0 + 56.0 / 16.0)
ROTOR_7520_14 = planetary((0.489e-4, 0.098e-4, 0.533e-4), 4.5, 1.0 + 48.0 / 22.0)
ROTOR_7520_22 = planetary((0.489e-4, 0.109e-4, 0.738e-4), 4.5, 5.0)
ROTOR_4010 = planetary((0.068e-4, 0.0, 0.0), 5.0, 5.0)
"""Inertias of motors, by Unitree's names [kg m^2]."""
SERVOS = (
    servo(("*_elbow_joint", "*_shoulder_*_joint", "*_wrist_roll_joint"), ROTOR_5020, 25.0),
    servo(("*_hip_pitch_joint", "*_hip_yaw_joint", "waist_yaw_joint"), ROTOR_7520_14, 88.0),
    servo(("*_hip_roll_joint", "*_knee_joint"), ROTOR_7520_22, 139.0),
    servo(("*_wrist_pitch_joint", "*_wrist_yaw_joint"), ROTOR_4010, 5.0),
    # two motors drive each of these through four bars, as if they turned about the joint itself
    servo(("waist_pitch_joint", "waist_roll_joint", "*_ankle_*_joint"), 2.0 * ROTOR_5020, 2.0 * 25.0),
)
"""All motors of the robot."""
ACTION_SCALE = action_scale(SERVOS)
"""Displacement of a joint's target for an action of 1 [rad], by joint pattern."""
FEET = "*_foot[1-7]_collision"
"""Geoms of the feet."""
COLLISIONS = Collision("*_collision", condim={FEET: 3, "*": 1}, priority={FEET: 1, "*": 0}, friction={FEET: 0.6})
"""All geoms collide, also with the robot itself; only feet have friction."""


def g1() -> Robot:
    """The robot, standing with bent knees, its pelvis 76 cm high.

    Raises:
        ValueError: The package with its file is not installed.
    """
    return Robot(
        robot_file("asset_zoo/robots/unitree_g1/xmls/g1.xml"),
        position=(0.0, 0.0, 0.76),
        joint_positions={
            "*_hip_pitch_joint": -0.312,
            "*_knee_joint": 0.669,
            "*_ankle_pitch_joint": -0.363,
            "*_elbow_joint": 0.6,
            "left_shoulder_roll_joint": 0.2,
            "right_shoulder_roll_joint": -0.2,
            "*_shoulder_pitch_joint": 0.2,
        },
        actuators=SERVOS,
        collisions=(COLLISIONS,),
        visuals=False,
    )
