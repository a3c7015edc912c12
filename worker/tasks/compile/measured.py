"""The frame on the robot in which a term is measured, for the policy contract."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from shared_store.contract.policy import Frame
from worker.simulation.sensors.imu import Imu
from worker.tasks import terms
from worker.tasks.declare.functions import is_warp

if TYPE_CHECKING:
    from worker.simulation.robot_view import RobotView
    from worker.tasks.compile.plan import KernelPlan
    from worker.tasks.declare.declaration import Term

_AT_CENTRE_OF_MASS = frozenset({terms.root_com_linear_velocity, terms.root_com_linear_velocity_in_world})
_HERE, _NOT_TURNED = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)


def is_library(term: Term) -> bool:
    """Whether a term's function is from Muster's library, rather than the task's own with the same name."""
    return is_warp(term.function) and term.function.func.__module__.startswith(f"{terms.__name__}.")


def frame_of(plan: KernelPlan, term: Term, sensors: Sequence[str]) -> Frame | None:
    """The frame of an observation term: of its root or of its inertial measurement unit; None for all others.

    Args:
        plan: The task's.
        term: The term.
        sensors: Names of the sensors that it reads.
    """
    if not is_library(term):
        return None
    units = [plan.declaration.sensors[name] for name in sensors]
    if len(units) == 1 and isinstance(units[0], Imu):
        return _of_unit(plan.views[units[0].robot], units[0])
    if term.function.func.__module__.rpartition(".")[2] != "root":
        return None
    view = plan.views[term.robot]
    position = view.root_com if term.function in _AT_CENTRE_OF_MASS else _HERE
    return Frame(view.body_names[0], view.body_names[0], position, _NOT_TURNED, root=True)


def _of_unit(view: RobotView, unit: Imu) -> Frame:
    """The frame of the site or body of an inertial measurement unit."""
    if unit.site is None:
        (body,) = view.find_bodies(unit.body or "*")
        name = view.body_names[body]
        return Frame(name, name, _HERE, _NOT_TURNED, root=body == 0)
    (site,) = view.find_sites(unit.site)
    column = view.site_bodies[site]
    body_name = view.body_names[view.bodies.index(column)]
    x, y, z, *turn = (float(each) for each in view.site_poses[site])
    return Frame(
        view.site_names[site], body_name, (x, y, z), (turn[0], turn[1], turn[2], turn[3]), column == view.root_body
    )
