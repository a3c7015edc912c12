"""Unitree's G1 follows velocity commands on a plane and on rough ground: mjlab 1.6's ``Mjlab-Velocity-{Flat,Rough}-Unitree-G1``."""

from __future__ import annotations

from typing import ClassVar

from worker.settings.velocity import G1FlatConfig, G1RoughConfig, VelocityConfig
from worker.simulation.declared_randomization import Randomize
from worker.simulation.sensors.contact import ContactSensor
from worker.simulation.sensors.height_scan import RingPattern
from worker.tasks import terms
from worker.tasks.library.robots.g1 import ACTION_SCALE, FEET, g1
from worker.tasks.library.robots.mjlab import walking
from worker.tasks.library.velocity import Velocity, Walker, rate

G1 = Walker(
    robot=g1,
    action_scale=ACTION_SCALE,
    base="pelvis",
    torso="torso_link",
    imu="imu_in_pelvis",
    soles=("left_foot", "right_foot"),
    touching=ContactSensor(bodies="*_ankle_roll_link", fine=True),
    ring=RingPattern(radius=0.03, count=6, center=True),
    tolerances=terms.Tolerances(
        standing=0.05,
        walking={
            "*hip_pitch*": 0.3,
            "*hip_roll*": 0.15,
            "*hip_yaw*": 0.15,
            "*knee*": 0.35,
            "*ankle_pitch*": 0.25,
            "*ankle_roll*": 0.1,
            "*waist_yaw*": 0.2,
            "*waist_roll*": 0.08,
            "*waist_pitch*": 0.1,
            "*shoulder_pitch*": 0.15,
            "*shoulder_roll*": 0.15,
            "*shoulder_yaw*": 0.1,
            "*elbow*": 0.15,
            "*wrist*": 0.3,
        },
        running={
            "*hip_pitch*": 0.5,
            "*hip_roll*": 0.2,
            "*hip_yaw*": 0.2,
            "*knee*": 0.6,
            "*ankle_pitch*": 0.35,
            "*ankle_roll*": 0.15,
            "*waist_yaw*": 0.3,
            "*waist_roll*": 0.08,
            "*waist_pitch*": 0.2,
            "*shoulder_pitch*": 0.5,
            "*shoulder_roll*": 0.2,
            "*shoulder_yaw*": 0.15,
            "*elbow*": 0.35,
            "*wrist*": 0.3,
        },
    ),
    randomize={
        "foot_friction": Randomize("friction", geoms=FEET, range=(0.3, 1.2), operation="set", shared=True),
        **walking("torso_link"),
    },
)


class G1Flat(Velocity):
    """G1 on a plane: 99 observations, 29 actions, 50 control steps a second, episodes of 20 s."""

    config_type: ClassVar[type[VelocityConfig]] = G1FlatConfig
    walker = G1
    solver_options = {
        "integrator": "implicitfast",
        "cone": "pyramidal",
        "impratio": 1.0,
        "tolerance": 1.0e-8,
        "ls_tolerance": 0.01,
        "ccd_iterations": 50,
        # 16 worlds x 100 steps of random, zero, held and far too large random actions had at most 31 contacts and 115 rows.
        "nconmax": 64,
        "njmax": 230,
    }
    changes = (  # contacts with itself
        {
            "sensors": {"self_contacts": ContactSensor(bodies="*", against="robot", fine=True, together=True)},
            "rewards": {"self_collisions": rate(terms.hard_contact_steps, contacts="self_contacts", force=10.0)},
        },
    )


class G1Rough(G1Flat):
    """G1 on stairs, slopes and rough ground, which it sees: 286 observations, 29 actions, 50 control steps a second, episodes of 20 s."""

    config_type = G1RoughConfig
    rough = True
    solver_options = {
        **G1Flat.solver_options,
        "ccd_iterations": 500,
        # In 8 worlds x 60 steps, as above, at most 34 contacts and 136 rows.
        "nconmax": 80,
        "njmax": 280,
    }
