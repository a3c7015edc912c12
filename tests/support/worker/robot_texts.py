"""Texts of small robot files, and their reading."""

from __future__ import annotations

from typing import Any

import newton

from worker.simulation.robot import Robot
from worker.simulation.robot_elements import empty_builder
from worker.simulation.robot_reading import Reading
from worker.simulation.robot_twins import Twins

BOX = '<geom type="box" size=".1 .1 .1" pos=".2 0 -.1" mass="1" contype="0" conaffinity="0"/>'
"""A geom that touches nothing, beside the joints of its body."""


def mjcf(body: str, rest: str = '<actuator><motor joint="j"/></actuator>', before: str = "") -> str:
    return f'<mujoco>{before}<worldbody><body name="b" pos="0 0 1">{body}</body></worldbody>{rest}</mujoco>'


HINGE = '<joint name="j" axis="0 1 0"/>'
SECOND = f'<body name="c" pos="0 0 -.6"><joint name="k" axis="0 1 0"/>{BOX}</body>'
SITE = '<site name="t" pos="0 .1 0"/>'


def template(*items: Any) -> newton.ModelBuilder:
    """One world of robots and objects."""
    builder = empty_builder()
    for item in items:
        item.add_to(builder)
    return builder


def read(file: str, **options: Any) -> Reading:
    return Robot(file, passive=True, **options).read()


def twins(reading: Reading) -> Twins:
    assert reading.reference is not None
    return Twins(reading.reference.model, reading.builder)
