"""The episode: its clock and its difficulty."""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.worlds import WorldArrays

wp.set_module_options({"enable_backward": False})


@wp.func
def elapsed(world: int, episodes: EpisodeArrays, seconds: float) -> float:
    """Time on the episode's clock [s]. Isaac Lab: current_time_s."""
    return float(episodes.ages[world]) * seconds


@wp.func
def time_left(world: int, episodes: EpisodeArrays, seconds: float, limit: float) -> float:
    """Remaining time of the episode, whose length is ``limit`` [s]. Isaac Lab: remaining_time_s."""
    return limit - float(episodes.ages[world]) * seconds


@wp.func
def gait_clock(world: int, episodes: EpisodeArrays, seconds: float, period: float) -> wp.vec2:
    """Sine and cosine of a phase with this ``period`` [s], 0 when the episode begins."""
    phase = 2.0 * wp.pi * float(episodes.ages[world]) * seconds / period
    return wp.vec2(wp.sin(phase), wp.cos(phase))


@wp.func
def level(world: int, episodes: EpisodeArrays) -> float:
    """Present difficulty of the task from its curriculum, from 0 to 1."""
    return episodes.level[0]


@wp.func
def not_finite(world: int, worlds: WorldArrays) -> bool:
    """Whether a joint's position or velocity is NaN or infinite; a task resets such worlds by itself, and counts them.

    mjlab: nan_detection.
    """
    for column in range(worlds.joint_q.shape[1]):
        if not wp.isfinite(worlds.joint_q[world, column]):
            return True
    for column in range(worlds.joint_qd.shape[1]):  # noqa: SIM110 (Warp has no any())
        if not wp.isfinite(worlds.joint_qd[world, column]):
            return True
    return False


@wp.func
def older_than(world: int, episodes: EpisodeArrays, seconds: float, limit: float) -> bool:
    """Whether the episode has lasted ``limit`` [s], including the present step; the task's own clock needs no term.

    mjlab, Isaac Lab: time_out.
    """
    return float(episodes.ages[world] + 1) * seconds >= limit - 0.5 * seconds
