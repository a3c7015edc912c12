"""Unitree's Go1 follows velocity commands on a plane and on rough ground: mjlab 1.6's ``Mjlab-Velocity-{Flat,Rough}-Unitree-Go1``."""

from __future__ import annotations

import math
from typing import Any, ClassVar

from worker.settings.velocity import Go1FlatConfig, Go1RoughConfig, VelocityConfig
from worker.simulation.sensors.contact import ContactSensor
from worker.simulation.sensors.height_scan import RingPattern
from worker.tasks import terms
from worker.tasks.declare.declaration import Termination
from worker.tasks.library.robots.go1 import ACTION_SCALE, FEET, go1
from worker.tasks.library.robots.mjlab import friction, walking
from worker.tasks.library.velocity import Velocity, Walker, rate

GO1 = Walker(
    robot=go1,
    action_scale=ACTION_SCALE,
    base="trunk",
    torso="trunk",
    imu="imu",
    soles=("FR", "FL", "RR", "RL"),
    touching=ContactSensor(geoms=FEET, fine=True),
    ring=RingPattern(radius=0.04, count=4, center=True),
    tolerances=terms.Tolerances(standing={"*_calf_joint": 0.1, "*": 0.05}, walking={"*_calf_joint": 0.6, "*": 0.3}),
    randomize={**friction("foot_friction", FEET, shared=True), **walking("trunk")},
)


class Go1Flat(Velocity):
    """Go1 on a plane: 48 observations, 12 actions, 50 control steps a second, episodes of 20 s."""

    config_type: ClassVar[type[VelocityConfig]] = Go1FlatConfig
    walker = GO1
    solver_options = {
        "integrator": "implicitfast",
        "cone": "elliptic",
        "impratio": 10.0,
        "tolerance": 1.0e-8,
        "ls_tolerance": 0.01,
        "ccd_iterations": 50,
        # In 8 worlds x 30 steps of random, zero, held and far too large random actions there were at most 5 contacts and 27 rows;
        # six rows for each foot, one for each joint's limit and 40 for everything else that may touch are 76.
        "nconmax": 24,
        "njmax": 100,
    }


def hits(against: str = "ground", **what: Any) -> ContactSensor:
    """Contacts of parts of the robot, in every physics step and in one column."""
    return ContactSensor(against=against, fine=True, together=True, **what)


class Go1Rough(Go1Flat):
    """Go1 on stairs, slopes and rough ground, which it sees: 235 observations, 12 actions, 50 control steps a second, episodes of 20 s."""

    config_type = Go1RoughConfig
    rough = True
    solver_options = {
        **Go1Flat.solver_options,
        "ccd_iterations": 500,
        # In 8 worlds x 60 steps, as above, at most 8 contacts and 48 rows. Several corners of the ground may touch one foot.
        "nconmax": 40,
        "njmax": 160,
    }
    changes = (
        {
            "sensors": {
                "self_contacts": hits("robot", bodies="*"),
                "thighs": hits(geoms="*_thigh_collision[123]"),
                "shanks": hits(geoms="*_calf_collision[12]"),
                "trunk_head": hits(geoms=("trunk_collision", "head_collision")),
            },
            "rewards": {
                # relative to the slope of the ground
                "upright": rate(
                    terms.body_upright_on_ground, bodies=GO1.torso, scan="terrain_scan", std=math.sqrt(0.2)
                ),
                "self_collisions": rate(terms.hard_contact_steps, contacts="self_contacts", force=10.0),
                "shank_collision": rate(terms.hard_contact_steps, contacts="shanks", force=10.0),
                "trunk_head_collision": rate(terms.hard_contact_steps, contacts="trunk_head", force=10.0),
            },
            # a thigh on the ground ends the episode, not a tilt
            "terminations": {
                "fell_over": None,
                "illegal_contact": Termination(terms.illegal_contact, contacts="thighs", force=10.0),
            },
        },
    )
