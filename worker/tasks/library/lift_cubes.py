"""An arm that lifts one of several cubes to a target, as in mjlab 1.6 (``Mjlab-Multi-Cube-Seg-Yam``), without the camera."""

from __future__ import annotations

import colorsys
import dataclasses
from collections.abc import Mapping
from typing import Any

import newton

from worker.settings.lift import LiftCubeConfig, LiftCubesConfig
from worker.simulation.sensors.selection import ObjectSelection
from worker.tasks import terms
from worker.tasks.declare.declaration import Command, Declaration, Metric, Observation, Reward
from worker.tasks.library.lift import LiftCube

APART = 0.06
"""Least distance between the centres of cubes at the start, more than the diagonal of a face [m]."""
ROOM = {"nconmax": 24, "njmax": 72}
"""Contacts of one more cube with the ground and with others, and their rows of constraints."""

REWARDS = (("lift", terms.reach_and_bring_chosen_object), ("lift_precise", terms.bring_chosen_object))
METRICS = (
    ("object_height", terms.chosen_object_height),
    ("position_error", terms.chosen_object_target_distance),
    ("at_goal", terms.chosen_object_at_target),
    ("episode_success", terms.chosen_object_was_at_target),
)
"""Replacements of LiftCube's terms of these names, with the same numbers."""


class LiftCubes(LiftCube):
    """The YAM arm and cubes, three by default; the task is to lift one: 41 observations, 7 actions, otherwise as LiftCube."""

    config_type = LiftCubesConfig

    def objects(self, config: LiftCubesConfig) -> Mapping[str, Any]:
        """The cubes, each of its own colour; the command places them."""
        cube = super().objects(config)["cube"]
        colors = [colorsys.hsv_to_rgb(index / config.cubes, 0.8, 0.9) for index in range(config.cubes)]
        return {f"cube_{index}": dataclasses.replace(cube, color=color) for index, color in enumerate(colors)}

    def build(self, builder: newton.ModelBuilder) -> None:
        """As :meth:`Task.build`; the solver has room for the contacts of all cubes."""
        super().build(builder)
        config: Any = self.config
        options = type(self).solver_options
        more = {name: options[name] + (config.cubes - 1) * each for name, each in ROOM.items()}
        self.solver_options = {**options, **more}

    def declare(self, config: LiftCubeConfig) -> Declaration:
        """LiftCube's terms and numbers for the chosen cube; also the choice, and the positions of all cubes."""
        single = super().declare(config)
        rewards, metrics, lift = single.rewards, single.metrics, single.commands["lift_height"]
        seen: dict[str, Any] = dict(single.observations)
        ways = {
            "ee_to_cube": Observation(terms.hand_to_chosen_object, noise=0.01, unit="m"),
            "cube_to_goal": Observation(terms.chosen_object_to_target, noise=0.01, unit="m", kind="measured"),
            "ee_to_cubes": Observation(terms.hand_to_each_object, noise=0.01, unit="m"),
            "chosen": Observation(terms.object_is_chosen, kind="command"),
            "actions": seen.pop("actions"),
        }
        command = Command(
            terms.lift_one_command,
            apart=APART,
            names=lift.names,
            units=lift.units,
            ranges=lift.ranges,
            seconds=lift.seconds,
            **lift.parameters,
        )
        return dataclasses.replace(
            single,
            sensors={**single.sensors, "cubes": ObjectSelection("cube_*")},
            observations=seen | ways,
            rewards={
                **rewards,
                **{name: Reward(each, per_second=True, **rewards[name].parameters) for name, each in REWARDS},
            },
            metrics={name: Metric(each, **metrics[name].parameters) for name, each in METRICS},
            commands={"lift_height": command},
        )
