"""An arm that finds one of several cubes and lifts it to a target, as mjlab 1.6 has it (``Mjlab-Multi-Cube-Seg-Yam``), without the camera."""

from __future__ import annotations

import colorsys
import dataclasses
from collections.abc import Mapping
from typing import Any

import newton

from worker.simulation.objects import Box
from worker.simulation.sensors.selection import ObjectSelection
from worker.tasks import terms
from worker.tasks.configs.lift import LiftCubesConfig
from worker.tasks.declaration import Command, Declaration, Metric, Observation, Reward
from worker.tasks.lift import EDGE, LiftCube

APART = 0.06
"""Cubes are put down with their middles at least so far from one another, more than the diagonal of a face [m]."""
CONTACTS, ROWS = 24, 72
"""Contacts of one more cube with the ground and with others, and their rows of constraints."""


class LiftCubes(LiftCube):
    """The YAM arm and cubes, three by default, of which one is to be lifted: 41 observations, 7 actions, else as LiftCube."""

    config_type = LiftCubesConfig

    def objects(self, config: LiftCubesConfig) -> Mapping[str, Any]:
        """The cubes, each of its own colour; where they begin is up to the command."""
        size, hues = (EDGE, EDGE, EDGE), [index / config.cubes for index in range(config.cubes)]
        return {
            f"cube_{index}": Box(
                f"cube_{index}",
                size=size,
                mass=0.05,
                position=(0.3, 0.0, EDGE),
                color=colorsys.hsv_to_rgb(hue, 0.8, 0.9),
            )
            for index, hue in enumerate(hues)
        }

    def build(self, builder: newton.ModelBuilder) -> None:
        """As :meth:`DeclaredTask.build`; the solver has room for the contacts of all cubes."""
        super().build(builder)
        more, options = self.config.cubes - 1, type(self).solver_options
        room = {"nconmax": options["nconmax"] + CONTACTS * more, "njmax": options["njmax"] + ROWS * more}
        self.solver_options = {**options, **room}  # type: ignore[misc]

    def declare(self, config: LiftCubesConfig) -> Declaration:
        """LiftCube's terms, of the cube that is chosen; beside them which one it is, and where all are."""
        single = super().declare(config)
        ways = {
            "ee_to_cube": Observation(terms.hand_to_chosen_object, noise=0.01, unit="m"),
            "cube_to_goal": Observation(terms.chosen_object_to_target, noise=0.01, unit="m", kind="measured"),
            "ee_to_cubes": Observation(terms.hand_to_each_object, noise=0.01, unit="m"),
            "chosen": Observation(terms.object_is_chosen, kind="command"),
        }
        seen = dict(single.observations)
        actions = {"actions": seen.pop("actions")}
        reaching = {"reaching_std": 0.2, "bringing_std": 0.3}
        lift = single.commands["lift_height"]
        return dataclasses.replace(
            single,
            sensors={**single.sensors, "cubes": ObjectSelection("cube_*")},
            observations=seen | ways | actions,
            rewards={
                **single.rewards,
                "lift": Reward(terms.reach_and_bring_chosen_object, hand="hand", per_second=True, **reaching),
                "lift_precise": Reward(terms.bring_chosen_object, per_second=True, std=0.05),
            },
            metrics={
                "object_height": Metric(terms.chosen_object_height),
                "position_error": Metric(terms.chosen_object_target_distance),
                "at_goal": Metric(terms.chosen_object_at_target, distance=0.05),
                "episode_success": Metric(terms.chosen_object_was_at_target, distance=0.05),
            },
            commands={
                "lift_height": Command(
                    terms.lift_one_command,
                    names=lift.names,
                    units=lift.units,
                    ranges=lift.ranges,
                    seconds=config.command_seconds,
                    apart=APART,
                    **lift.parameters,
                )
            },
        )
