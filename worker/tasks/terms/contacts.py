"""Contacts: measurements of a contact sensor, and rewards of feet.

Each function is called with ``index``, a column of the sensor, by default for every column. If it takes frames too, column
``index`` of both sensors must be the same foot: name feet in the same order in both. A term with a velocity command is 0 unless the
command exceeds its ``threshold``, speed [m/s] + turning velocity [rad/s].
"""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.sensors.contact import ContactArrays, first_air, first_contact, steps_above, strongest_contact
from worker.simulation.sensors.frames import FrameArrays
from worker.tasks.declare.term_needs import needs
from worker.tasks.terms.commands import command_speed

wp.set_module_options({"enable_backward": False})


@wp.func
def touches(contacts: ContactArrays, world: int, index: int) -> bool:
    """Whether a column of a sensor is in contact."""
    return contacts.found[world, index] > 0


@wp.func
def planar_speed(frames: FrameArrays, world: int, index: int) -> float:
    """Speed of a frame's origin along x and y [m/s]."""
    velocity = frames.linear[world, index]
    return wp.length(wp.vec2(velocity[0], velocity[1]))


@wp.func
def in_contact(world: int, contacts: ContactArrays, index: int) -> float:
    """1 while there is a contact, else 0.

    mjlab: foot_contact. Isaac Lab: -.
    """
    return wp.where(touches(contacts, world, index), 1.0, 0.0)


@wp.func
def contact_force(world: int, contacts: ContactArrays, index: int) -> wp.vec3:
    """Sum of the contact forces in the last physics step, in the world frame [N].

    mjlab: -. Isaac Lab: net_forces_w (of a contact sensor's data).
    """
    return contacts.forces[world, index]


@wp.func
def contact_force_logarithm(world: int, contacts: ContactArrays, index: int) -> wp.vec3:
    """sign(f) log(1 + |f|) of each component of the contact force f in the world frame [N]: small forces and impacts on one scale.

    mjlab: foot_contact_forces. Isaac Lab: -.
    """
    force = contacts.forces[world, index]
    result = wp.vec3(0.0, 0.0, 0.0)
    for axis in range(3):
        result[axis] = wp.sign(force[axis]) * wp.log(1.0 + wp.abs(force[axis]))
    return result


@wp.func
def contact_strength(world: int, contacts: ContactArrays, index: int) -> float:
    """Norm of the sum of the contact forces in the last physics step [N].

    mjlab: -. Isaac Lab: -.
    """
    return wp.length(contacts.forces[world, index])


@wp.func
def air_time(world: int, contacts: ContactArrays, index: int) -> float:
    """Time since contact was lost, 0 during contact [s].

    mjlab: foot_air_time. Isaac Lab: current_air_time (of a contact sensor's data).
    """
    return contacts.air_time[world, index]


@wp.func
def contact_time(world: int, contacts: ContactArrays, index: int) -> float:
    """Time since contact began, 0 without contact [s].

    mjlab: current_contact_time (of a contact sensor's data). Isaac Lab: current_contact_time (of a contact sensor's data).
    """
    return contacts.contact_time[world, index]


@wp.func
def touchdown(world: int, contacts: ContactArrays, index: int) -> float:
    """1 in the control step in which contact began, else 0.

    mjlab: compute_first_contact (of a contact sensor). Isaac Lab: compute_first_contact (of a contact sensor).
    """
    return wp.where(first_contact(contacts, world, index), 1.0, 0.0)


@wp.func
def liftoff(world: int, contacts: ContactArrays, index: int) -> float:
    """1 in the control step in which contact was lost, else 0.

    mjlab: compute_first_air (of a contact sensor). Isaac Lab: compute_first_air (of a contact sensor).
    """
    return wp.where(first_air(contacts, world, index), 1.0, 0.0)


@wp.func
def time_in_air(world: int, contacts: ContactArrays, index: int, least: float = 0.05, greatest: float = 0.5) -> float:
    """1 while a foot has been in the air for more than ``least`` and less than ``greatest`` [s], else 0.

    mjlab: feet_air_time (without a command). Isaac Lab: -.
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
    """As :func:`time_in_air`, while the command asks for more than ``threshold``.

    mjlab: feet_air_time. Isaac Lab: -.
    """
    if command_speed(world, episodes, command) <= threshold:
        return 0.0
    return time_in_air(world, contacts, index, least, greatest)


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

    mjlab: -. Isaac Lab: feet_air_time (target: threshold).
    """
    asked = wp.vec2(episodes.memory[world, command], episodes.memory[world, command + 1])
    if wp.length(asked) <= threshold or not first_contact(contacts, world, index):
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

    mjlab: -. Isaac Lab: feet_air_time_positive_biped (greatest: threshold).
    """
    asked = wp.vec2(episodes.memory[world, command], episodes.memory[world, command + 1])
    standing = int(0)  # noqa: RUF046 (a variable for Warp, not a constant)
    shortest = float(greatest)
    for index in range(contacts.found.shape[1]):
        time = contacts.air_time[world, index]
        if contacts.contact_time[world, index] > 0.0:
            standing += 1
            time = contacts.contact_time[world, index]
        shortest = wp.min(shortest, time)
    if standing != 1 or wp.length(asked) <= threshold:
        return 0.0
    return shortest


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

    mjlab: feet_slip. Isaac Lab: -.
    """
    if command_speed(world, episodes, command) <= threshold or not touches(contacts, world, index):
        return 0.0
    speed = planar_speed(frames, world, index)
    return speed * speed


@wp.func
def foot_slide(world: int, contacts: ContactArrays, frames: FrameArrays, index: int, force: float = 1.0) -> float:
    """Planar speed of a foot [m/s] where a net contact force within the last control step was above ``force`` [N], else 0.

    mjlab: -. Isaac Lab: feet_slide.
    """
    if contacts.peaks[world, index] <= force:
        return 0.0
    return planar_speed(frames, world, index)


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

    mjlab: soft_landing. Isaac Lab: -.
    """
    if command_speed(world, episodes, command) <= threshold or not first_contact(contacts, world, index):
        return 0.0
    return wp.length(contacts.forces[world, index])


@wp.func
def foot_clearance(
    world: int,
    episodes: EpisodeArrays,
    frames: FrameArrays,
    index: int,
    command: int,
    height: float,
    threshold: float = 0.01,
) -> float:
    """|z - height| times the planar speed of a foot [m^2/s], z its height above z = 0, while the command asks for more than ``threshold``.

    mjlab: feet_clearance (on flat ground). Isaac Lab: foot_clearance_reward (of Spot, which makes another function of both).
    """
    if command_speed(world, episodes, command) <= threshold:
        return 0.0
    return wp.abs(frames.positions[world, index][2] - height) * planar_speed(frames, world, index)


@wp.func
def swing_error(
    world: int,
    episodes: EpisodeArrays,
    contacts: ContactArrays,
    index: int,
    command: int,
    memory: int,
    clearance: float,
    height: float,
    threshold: float,
) -> float:
    """At touchdown (p / height - 1)^2, p the greatest ``clearance`` of the foot in its swing [m], else 0; it remembers p."""
    peak = episodes.memory[world, memory + index]
    if not touches(contacts, world, index):
        peak = wp.max(peak, clearance)
    error = float(0.0)
    if first_contact(contacts, world, index):
        if command_speed(world, episodes, command) > threshold:
            error = (peak / height - 1.0) * (peak / height - 1.0)
        peak = 0.0
    episodes.memory[world, memory + index] = peak
    return error


@needs(memory_each=1)
@wp.func
def swing_height_error(
    world: int,
    episodes: EpisodeArrays,
    contacts: ContactArrays,
    frames: FrameArrays,
    index: int,
    command: int,
    memory: int,
    height: float,
    threshold: float = 0.01,
) -> float:
    """At touchdown (p / height - 1)^2, p the greatest height of the foot above z = 0 in its swing [m], else 0.

    It counts while the command asks for more than ``threshold``.

    mjlab: feet_swing_height (on flat ground). Isaac Lab: -.
    """
    clearance = frames.positions[world, index][2]
    return swing_error(world, episodes, contacts, index, command, memory, clearance, height, threshold)


@wp.func
def foot_stumble(world: int, contacts: ContactArrays, index: int, ratio: float = 5.0) -> float:
    """1 where the horizontal part of a foot's contact force is more than ``ratio`` times the vertical, as against a wall, else 0.

    mjlab: -. Isaac Lab: -.
    """
    force = contacts.forces[world, index]
    return wp.where(wp.length(wp.vec2(force[0], force[1])) > ratio * wp.abs(force[2]), 1.0, 0.0)


@wp.func
def contact_count(world: int, contacts: ContactArrays, index: int) -> float:
    """Number of contacts in the last physics step, such as of a robot with itself.

    mjlab: self_collision_cost (without a history). Isaac Lab: -.
    """
    return float(contacts.found[world, index])


@wp.func
def hard_contact_steps(world: int, contacts: ContactArrays, force: float = 10.0) -> float:
    """Number of physics steps of the last control step in which a contact of any column was stronger than ``force`` [N].

    mjlab: self_collision_cost. Isaac Lab: -.
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
def column_hard_contact_steps(world: int, contacts: ContactArrays, index: int, force: float = 10.0) -> float:
    """Number of physics steps of the last control step in which a contact of this column was stronger than ``force`` [N].

    mjlab: -. Isaac Lab: -.
    """
    return float(steps_above(contacts, world, index, force))


@wp.func
def undesired_contact(world: int, contacts: ContactArrays, index: int, force: float = 1.0) -> float:
    """1 where a net contact force within the last control step was above ``force`` [N], else 0.

    mjlab: -. Isaac Lab: undesired_contacts.
    """
    return wp.where(contacts.peaks[world, index] > force, 1.0, 0.0)


@wp.func
def no_contact(world: int, contacts: ContactArrays, force: float = 1.0) -> float:
    """1 where no column had a net contact force above ``force`` [N] within the last control step, else 0.

    mjlab: -. Isaac Lab: desired_contacts.
    """
    for index in range(contacts.peaks.shape[1]):
        if contacts.peaks[world, index] > force:
            return 0.0
    return 1.0


@wp.func
def contact_force_excess(world: int, contacts: ContactArrays, index: int, force: float) -> float:
    """Excess of the greatest net contact force within the last control step over ``force`` [N].

    mjlab: -. Isaac Lab: contact_forces.
    """
    return wp.max(contacts.peaks[world, index] - force, 0.0)


@wp.func
def illegal_contact(world: int, contacts: ContactArrays, index: int, force: float = 10.0) -> bool:
    """Whether a single contact within the last control step was stronger than ``force`` [N].

    mjlab: illegal_contact. Isaac Lab: illegal_contact (which takes the net force).
    """
    return strongest_contact(contacts, world, index) > force
