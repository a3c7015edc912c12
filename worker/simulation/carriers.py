"""Masses as MuJoCo has them: bodies that only carry a joint, and inertias that Newton leaves alone.

MuJoCo lets several joints stand between a body and its parent, each at another place. Newton has one joint for each body, so all
but the last of them move a body without mass.
"""

from __future__ import annotations

from typing import Any

import newton
from newton.solvers import SolverMuJoCo

from worker.simulation.robot_elements import short

MARK = "__carries_joint_"
"""What stands in the name of such a body."""
MASS = 1e-9
"""Its mass until the model is compiled [kg]: MuJoCo's compiler demands some of every body that moves."""
INERTIA = 4e-15
"""Its moments of inertia until then [kg m^2], little more than the compiler's least."""


def is_carrier(label: str) -> bool:
    """Whether the body with this label only carries a joint."""
    return MARK in short(label)


def keep_inertias(builder: newton.ModelBuilder) -> None:
    """Let Newton leave moments of inertia as they are: MuJoCo's compiler judges them."""
    builder.balance_inertia = False
    builder.inertia_relative_tolerance = builder.inertia_correction = 0.0
    builder.inertia_absolute_tolerance = 1e-30  # Newton wants more than 0


def unload(model: newton.Model, solver: SolverMuJoCo) -> None:
    """Take the mass from the carriers of a model, after its solver was built."""
    bodies = [index for index, label in enumerate(model.body_label) if is_carrier(label)]
    if not bodies:
        return
    arrays: tuple[Any, ...] = (model.body_mass, model.body_inv_mass, model.body_inertia, model.body_inv_inertia)
    for array in arrays:
        values = array.numpy()
        values[bodies] = 0.0
        array.assign(values)
    solver.notify_model_changed(newton.ModelFlags.BODY_INERTIAL_PROPERTIES)
