"""The needs of a task's step: the data, besides the joints, that it must update."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from worker.simulation.sensors.differential_ik import IkSolver
from worker.tasks.compile.binding import Bound
from worker.tasks.compile.plan import KernelPlan
from worker.tasks.declare.functions import reads_poses
from worker.tasks.run.torch_terms import TorchTerms


class StepNeeds:
    """What a step must update.

    Attributes:
        bodies: Poses of bodies, after the physics.
        apart: Whether observations have a kernel of their own: they read data that is stale right after a reset.
        placed: Poses of bodies again after the reset of worlds: observations or the next step's actions read them.
    """

    def __init__(self, plan: KernelPlan, sensors: Mapping[str, Any], torch_terms: TorchTerms) -> None:
        observed = [seen.bound for group in plan.groups.values() for seen in group]
        acting = [*(driven.bound for driven in plan.driven), *([plan.choice] if plan.choice else [])]
        measured = any(sensor.needs_bodies for sensor in sensors.values())
        self.bodies = measured or torch_terms.any or any(map(_reads_bodies, plan.terms))
        self.apart = torch_terms.observe_any or any(_reads_bodies(bound) or _reads_sensors(bound) for bound in observed)
        moved = any(isinstance(sensor, IkSolver) for sensor in sensors.values())
        self.placed = self.bodies and (self.apart or moved or any(map(_reads_bodies, acting)))


def _reads_bodies(bound: Bound) -> bool:
    return "bodies" in bound.arguments.values() and reads_poses(bound.term.function)


def _reads_sensors(bound: Bound) -> bool:
    return any(variable.startswith("sensor_") for variable in bound.arguments.values())
