"""Unitree's Go1, a four-legged robot of 12 joints: mjlab 1.6's file and numbers (``asset_zoo/robots/unitree_go1/go1_constants.py``)."""

from __future__ import annotations

from worker.simulation.collisions import Collision
from worker.simulation.robot import Robot
from worker.tasks.library.robots.mjlab import action_scale, robot_file, servo

ROTOR = 0.000111842
"""Inertia of a motor's rotor about its axis [kg m^2], from Unitree's ``go1.urdf``."""
GEAR = 6.0
"""Gear ratio of hips and thighs; that of the knees is 1.5 times as much."""
SERVOS = (
    servo(("*_hip_joint", "*_thigh_joint"), ROTOR * GEAR**2, 23.7),
    servo("*_calf_joint", ROTOR * (1.5 * GEAR) ** 2, 35.55),
)
"""All motors of the robot."""
ACTION_SCALE = action_scale(SERVOS)
"""Displacement of a joint's target for an action of 1 [rad], by joint pattern."""
FEET = "*_foot_collision"
"""Geoms of the feet."""
COLLISIONS = Collision(
    "*_collision*",
    condim={FEET: 6, "*": 1},
    priority={FEET: 1, "*": 0},
    friction={FEET: (1.0, 5e-3, 5e-4)},
    solref=(0.01, 1.0),
)
"""All geoms collide with other objects; only feet have friction."""


def go1() -> Robot:
    """The standing robot, 27.8 cm high.

    Raises:
        ValueError: The package with its file is not installed.
    """
    return Robot(
        robot_file("asset_zoo/robots/unitree_go1/xmls/go1.xml"),
        position=(0.0, 0.0, 0.278),
        joint_positions={"*thigh_joint": 0.9, "*calf_joint": -1.8, "*R_hip_joint": 0.1, "*L_hip_joint": -0.1},
        actuators=SERVOS,
        collisions=(COLLISIONS,),
        visuals=False,
    )
