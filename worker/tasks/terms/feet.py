"""Functions shared by terms of feet: their contacts, speeds and clearances; a clearance is a height above the ground [m]."""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.sensors.contact import ContactArrays, first_contact
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
def clearance_error(
    world: int,
    episodes: EpisodeArrays,
    frames: FrameArrays,
    clearance: float,
    index: int,
    command: int,
    height: float,
    threshold: float = 0.01,
) -> float:
    """|clearance - height| times the planar speed of a foot [m^2/s], while the command asks for more than ``threshold``."""
    if command_speed(world, episodes, command) <= threshold:
        return 0.0
    return wp.abs(clearance - height) * planar_speed(frames, world, index)


@needs(memory_each=1)
@wp.func
def swing_error(
    world: int,
    episodes: EpisodeArrays,
    contacts: ContactArrays,
    clearance: float,
    index: int,
    command: int,
    memory: int,
    height: float,
    threshold: float = 0.01,
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
