"""Contacts: further measurements, and rewards of feet."""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.sensors.contact import ContactArrays, first_air, first_contact, steps_above
from worker.simulation.sensors.frames import FrameArrays
from worker.tasks.terms.composing import composed, length
from worker.tasks.terms.feet import clearance_error, planar_speed, swing_error
from worker.tasks.terms.sensing import frame_height

wp.set_module_options({"enable_backward": False})


@wp.func
def contact_force(world: int, contacts: ContactArrays, index: int) -> wp.vec3:
    """Sum of the contact forces in the last physics step, in the world frame [N].

    Isaac Lab: net_forces_w (of a contact sensor's data).
    """
    return contacts.forces[world, index]


@composed(length, contact_force)
def contact_strength():
    """Norm of the sum of the contact forces in the last physics step [N]."""


@wp.func
def contact_time(world: int, contacts: ContactArrays, index: int) -> float:
    """Time since contact began, 0 without [s]. mjlab, Isaac Lab: current_contact_time (of a contact sensor's data)."""
    return contacts.contact_time[world, index]


@wp.func
def touchdown(world: int, contacts: ContactArrays, index: int) -> float:
    """1 in the step in which contact began, else 0. mjlab, Isaac Lab: compute_first_contact (of a contact sensor)."""
    return wp.where(first_contact(contacts, world, index), 1.0, 0.0)


@wp.func
def liftoff(world: int, contacts: ContactArrays, index: int) -> float:
    """1 in the step in which contact was lost, else 0. mjlab, Isaac Lab: compute_first_air (of a contact sensor)."""
    return wp.where(first_air(contacts, world, index), 1.0, 0.0)


@wp.func
def step_time(
    world: int,
    episodes: EpisodeArrays,
    contacts: ContactArrays,
    index: int,
    command: int,
    target: float,
    threshold: float = 0.1,
) -> float:
    """At touchdown, the foot's air time minus ``target`` [s], else 0.

    It counts while the command's planar speed is above ``threshold`` [m/s].

    Isaac Lab: feet_air_time (target: threshold).
    """
    commanded = wp.vec2(episodes.memory[world, command], episodes.memory[world, command + 1])
    if wp.length(commanded) <= threshold or not first_contact(contacts, world, index):
        return 0.0
    return contacts.last_air_time[world, index] - target


@wp.func
def single_stance_time(
    world: int,
    episodes: EpisodeArrays,
    contacts: ContactArrays,
    command: int,
    greatest: float,
    threshold: float = 0.1,
) -> float:
    """While exactly one of the sensor's feet stands: the shortest time for which a foot has stood or swung, at most ``greatest`` [s].

    It counts while the command's planar speed is above ``threshold`` [m/s].

    Isaac Lab: feet_air_time_positive_biped (greatest: threshold).
    """
    commanded = wp.vec2(episodes.memory[world, command], episodes.memory[world, command + 1])
    standing = int(0)  # noqa: RUF046 (a variable for Warp, not a constant)
    shortest = float(greatest)
    for index in range(contacts.found.shape[1]):
        time = contacts.air_time[world, index]
        if contacts.contact_time[world, index] > 0.0:
            standing += 1
            time = contacts.contact_time[world, index]
        shortest = wp.min(shortest, time)
    if standing != 1 or wp.length(commanded) <= threshold:
        return 0.0
    return shortest


@wp.func
def foot_slide(world: int, contacts: ContactArrays, frames: FrameArrays, index: int, force: float = 1.0) -> float:
    """Planar speed of a foot [m/s] where a net contact force within the last control step was above ``force`` [N], else 0.

    Isaac Lab: feet_slide.
    """
    if contacts.peaks[world, index] <= force:
        return 0.0
    return planar_speed(frames, world, index)


@composed(clearance_error, clearance=frame_height)
def foot_clearance():
    """|z - height| times the planar speed of a foot [m^2/s], z its height above z = 0, while the command asks for more than ``threshold``.

    mjlab: feet_clearance (on flat ground). Isaac Lab: foot_clearance_reward (of Spot, which makes another function of both).
    """


@composed(swing_error, clearance=frame_height)
def swing_height_error():
    """At touchdown (p / height - 1)^2, p the greatest height of the foot above z = 0 in its swing [m], else 0.

    It counts while the command asks for more than ``threshold``.

    mjlab: feet_swing_height (on flat ground).
    """


@wp.func
def foot_stumble(world: int, contacts: ContactArrays, index: int, ratio: float = 5.0) -> float:
    """1 where the horizontal part of a foot's contact force is more than ``ratio`` times the vertical, as against a wall, else 0."""
    force = contacts.forces[world, index]
    return wp.where(wp.length(wp.vec2(force[0], force[1])) > ratio * wp.abs(force[2]), 1.0, 0.0)


@wp.func
def contact_count(world: int, contacts: ContactArrays, index: int) -> float:
    """Number of contacts in the last physics step, such as of a robot with itself.

    mjlab: self_collision_cost (without a history).
    """
    return float(contacts.found[world, index])


@wp.func
def column_hard_contact_steps(world: int, contacts: ContactArrays, index: int, force: float = 10.0) -> float:
    """Number of physics steps of the last control step in which a contact of this column was stronger than ``force`` [N]."""
    return float(steps_above(contacts, world, index, force))


@wp.func
def undesired_contact(world: int, contacts: ContactArrays, index: int, force: float = 1.0) -> float:
    """1 where a net contact force within the last control step was above ``force`` [N], else 0.

    Isaac Lab: undesired_contacts.
    """
    return wp.where(contacts.peaks[world, index] > force, 1.0, 0.0)


@wp.func
def no_contact(world: int, contacts: ContactArrays, force: float = 1.0) -> float:
    """1 where no column had a net contact force above ``force`` [N] within the last control step, else 0.

    Isaac Lab: desired_contacts.
    """
    for index in range(contacts.peaks.shape[1]):
        if contacts.peaks[world, index] > force:
            return 0.0
    return 1.0


@wp.func
def contact_force_excess(world: int, contacts: ContactArrays, index: int, force: float) -> float:
    """Excess of the greatest net force within the last control step over ``force`` [N]. Isaac Lab: contact_forces."""
    return wp.max(contacts.peaks[world, index] - force, 0.0)
