"""A contract by hand: two joints, of which one is driven, an IMU that is turned on the trunk, odometry, a velocity command."""

from __future__ import annotations

import math

from shared_store.contract.policy import Action, Command, Contract, Frame, Group, State, Term

HALF = math.sqrt(0.5)
UNIT = Frame("imu", "trunk", (0.1, 0.0, 0.2), (0.0, 0.0, HALF, HALF), True)
"""Turned by 90 degrees about z: its x axis is the trunk's y axis."""
TRUNK = Frame("trunk", "trunk", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), True)


def term(name: str, first: int, size: int, **options: object) -> Term:
    """A term of Muster's library whose function has its name."""
    supplied: dict[str, object] = {
        "kind": "measured",
        "names": tuple(f"{name}_{index}" for index in range(size)),
        "units": ("1",) * size,
        "scale": (1.0,) * size,
        "offset": (0.0,) * size,
        "quantity": name,
        "library": True,
        **options,
    }
    return Term(name=name, first=first, **supplied)


KNEE = Action(
    "knee",
    "position",
    "rad",
    scale=0.5,
    default_position=0.3,
    offset=0.3,
    clip=(-2.0, 2.0),
    stiffness=20.0,
    damping=1.0,
    effort_limit=10.0,
    range=(-1.0, 1.0),
)
JOINTS = {"element": "joint", "elements": ("knee", "wheel")}
TERMS = (
    term("joint_position", 0, 2, **JOINTS, offset=(0.3, 0.0), scale=(2.0, 1.0), clip=(-0.5, 0.5)),
    term("joint_velocity", 2, 2, **JOINTS, history=2),
    term("projected_gravity", 6, 3, frame=TRUNK),
    term("imu_angular_velocity", 9, 3, frame=UNIT),
    term("imu_linear_velocity", 12, 3, frame=UNIT),
    term("command_vector", 15, 3, kind="command", command="velocity"),
    term("last_action", 18, 1, kind="previous_action", element="action", elements=("knee",)),
)
VELOCITY = Command(
    "velocity",
    ("forward", "left", "turn"),
    ("m/s", "m/s", "rad/s"),
    ((-1.0, 2.0), (-0.5, 0.5), None),
    (5.0, 5.0),
    "velocity_command",
    True,
)


def contract(*terms: Term, recurrent: bool = False, **changes: object) -> Contract:
    """Of these terms, by default all of them."""
    supplied = terms or TERMS
    size = sum(each.size for each in supplied)
    fields: dict[str, object] = {
        "task": "Walker",
        "muster": "0.1.0",
        "control_hz": 50.0,
        "groups": (Group("policy", "obs", (size,), "float32", supplied),),
        "actions": (KNEE,),
        "action_names": ("knee",),
        "commands": (VELOCITY,),
        "states": (State("total", "total_out", (size,)),) if recurrent else (),
        **changes,
    }
    return Contract(**fields)
