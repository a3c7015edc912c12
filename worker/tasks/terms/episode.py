"""The episode itself: its clock, its end and its difficulty."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def alive(world: int, terminated: bool) -> float:
    """1 in every step in which no termination ends the episode, else 0. mjlab, Isaac Lab: is_alive."""
    return wp.where(terminated, 0.0, 1.0)


@wp.func
def ended(world: int, terminated: bool) -> float:
    """1 in a step in which a termination ends the episode, else 0; the clock is not a termination.

    mjlab, Isaac Lab: is_terminated.
    """
    return wp.where(terminated, 1.0, 0.0)
