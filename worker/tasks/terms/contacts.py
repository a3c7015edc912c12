"""Contacts: measurements of a contact sensor, and rewards of feet.

Each function is called with ``index``, a column of the sensor, by default for every column. If it takes frames too, column
``index`` of both sensors must be the same foot: name feet in the same order in both. A term with a velocity command is 0 unless the
command exceeds its ``threshold``, speed [m/s] + turning velocity [rad/s].
"""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.sensors.contact import ContactArrays, first_contact, strongest_contact
from worker.simulation.sensors.frames import FrameArrays
from worker.tasks.terms.commands import command_speed
from worker.tasks.terms.feet import planar_speed, touches

wp.set_module_options({"enable_backward": False})


@wp.func
def in_contact(world: int, contacts: ContactArrays, index: int) -> float:
    """1 while there is a contact, else 0. mjlab: foot_contact."""
    return wp.where(touches(contacts, world, index), 1.0, 0.0)


@wp.func
def contact_force_logarithm(world: int, contacts: ContactArrays, index: int) -> wp.vec3:
    """sign(f) log(1 + |f|) of each component of the contact force f in the world frame [N]: small forces and impacts on one scale.

    mjlab: foot_contact_forces.
    """
    force = contacts.forces[world, index]
    result = wp.vec3(0.0, 0.0, 0.0)
    for axis in range(3):
        result[axis] = wp.sign(force[axis]) * wp.log(1.0 + wp.abs(force[axis]))
    return result


@wp.func
def air_time(world: int, contacts: ContactArrays, index: int) -> float:
    """Time since contact was lost, 0 during contact [s].

    mjlab: foot_air_time. Isaac Lab: current_air_time (of a contact sensor's data).
    """
    return contacts.air_time[world, index]


@wp.func
def time_in_air(world: int, contacts: ContactArrays, index: int, least: float = 0.05, greatest: float = 0.5) -> float:
    """1 while a foot has been in the air for more than ``least`` and less than ``greatest`` [s], else 0.

    mjlab: feet_air_time (without a command).
    """
    time = contacts.air_time[world, index]
    return wp.where(time > least and time < greatest, 1.0, 0.0)


@wp.func
def commanded_time_in_air(
    world: int,
    episodes: EpisodeArrays,
    contacts: ContactArrays,
    index: int,
    command: int,
    least: float = 0.05,
    greatest: float = 0.5,
    threshold: float = 0.5,
) -> float:
    """As :func:`time_in_air`, while the command asks for more than ``threshold``. mjlab: feet_air_time."""
    if command_speed(world, episodes, command) <= threshold:
        return 0.0
    return time_in_air(world, contacts, index, least, greatest)


@wp.func
def foot_slip(
    world: int,
    episodes: EpisodeArrays,
    contacts: ContactArrays,
    frames: FrameArrays,
    index: int,
    command: int,
    threshold: float = 0.01,
) -> float:
    """Square of a foot's planar speed while it touches the ground [m^2/s^2], while the command asks for more than ``threshold``.

    mjlab: feet_slip.
    """
    if command_speed(world, episodes, command) <= threshold or not touches(contacts, world, index):
        return 0.0
    speed = planar_speed(frames, world, index)
    return speed * speed


@wp.func
def soft_landing(
    world: int,
    episodes: EpisodeArrays,
    contacts: ContactArrays,
    index: int,
    command: int,
    threshold: float = 0.05,
) -> float:
    """Norm of the contact force at touchdown [N], else 0, while the command asks for more than ``threshold``.

    mjlab: soft_landing.
    """
    if command_speed(world, episodes, command) <= threshold or not first_contact(contacts, world, index):
        return 0.0
    return wp.length(contacts.forces[world, index])


@wp.func
def hard_contact_steps(world: int, contacts: ContactArrays, force: float = 10.0) -> float:
    """Number of physics steps of the last control step in which a contact of any column was stronger than ``force`` [N].

    mjlab: self_collision_cost.
    """
    steps = float(0.0)
    for step in range(contacts.history.shape[2]):
        strongest = float(0.0)
        for index in range(contacts.history.shape[1]):
            strongest = wp.max(strongest, contacts.history[world, index, step])
        if strongest > force:
            steps += 1.0
    return steps


@wp.func
def illegal_contact(world: int, contacts: ContactArrays, index: int, force: float = 10.0) -> bool:
    """Whether a single contact within the last control step was stronger than ``force`` [N].

    mjlab: illegal_contact. Isaac Lab: illegal_contact (which takes the net force).
    """
    return strongest_contact(contacts, world, index) > force
