"""Episodes of many worlds: ages, sums, termination, statistics and random streams, as functions that kernels call.

The generated kernel that ends a step runs one thread a world and calls :func:`add_reward` for every term, :func:`end_step`, and, where that
says so, :func:`begin_episode` and the events of a reset.
"""

from __future__ import annotations

from collections.abc import Sequence

import warp as wp
from mujoco_warp import OverflowType

wp.set_module_options({"enable_backward": False})

STEP = wp.constant(0)
"""Mode of a step's end: reward, termination and reset of the worlds that ended."""
RESET = wp.constant(1)
"""Mode of a reset: begin a new episode in every world, without reward or statistics."""

ACTION_LIMIT = wp.constant(1.0)
"""Actions are clipped to plus and minus this."""
NO_FAILED_WORLD = wp.constant(2**31 - 1)
"""Value of ``EpisodeArrays.failed_world`` without a failure."""
RETURN = wp.constant(0)
STEPS = wp.constant(1)
TERMS = wp.constant(2)
"""Columns of ``EpisodeArrays.sums``: return, steps lived, then one column per reward term."""
TIME_OUT = wp.constant(0)
PHYSICS_FAILED = wp.constant(1)
TERMINATED = wp.constant(2)
"""Cause of an episode's end, in ``EpisodeArrays.causes``: the clock, a physics failure, or the task: the first
termination is ``TERMINATED + 1``, the second ``TERMINATED + 2``, …"""
CAPACITY_BITS = wp.constant(int(OverflowType.ALL & ~(OverflowType.ITERATIONS | OverflowType.LS_ITERATIONS)))
"""What the solver dropped for lack of room. Its limits of iterations are a chosen trade of accuracy for time, and no overflow here."""
WATCHED = 16
"""Number of worlds, from the first, whose reward terms are kept every step for telemetry."""


@wp.struct
class EpisodeArrays:
    """The buffers of a task, one row per world.

    Attributes:
        actions: The policy's actions, shape ``(worlds, actions)``.
        observations: The policy's next observations, shape ``(worlds, observations)``.
        terminal_observations: The observation before the reset where ``dones``, else stale; same shape.
        rewards: Sum of the reward terms of the last step, shape ``(worlds,)``.
        dones: Whether the episode ended in the last step, shape ``(worlds,)``.
        time_outs: Whether it ended by the clock alone, shape ``(worlds,)``.
        ages: Clock of the running episode [control steps], shape ``(worlds,)``.
        sums: Return, steps lived and one sum per reward term of the running episode, shape ``(worlds, 2 + terms)``.
        random: Seed, global world index and number of streams drawn, shape ``(worlds, 3)``.
        terms: Weighted reward terms of the step in the first worlds, which :mod:`worker.telemetry` reads and sets to zero; shape
            ``(min(WATCHED, worlds), terms)``.
        weights: Weight of each reward term, shape ``(terms,)``.
        level: Present difficulty from the curriculum, from 0 to 1 (1 without a curriculum), shape ``(1,)``.
        memory: The task's own state between steps, zero when an episode begins, shape ``(worlds, memory_size)``.
        lasting: The task's own state of each world across episodes, shape ``(worlds, lasting_size)``.
        last_actions: The actions of the step before while the task rewards, those that led here when it observes, 0 when an
            episode begins; shape ``(worlds, actions)``.
        earlier_actions: Those of one step earlier; shape ``(worlds, actions)``.
        warm_start: Accelerations of the worlds from which the constraint solver starts, shape ``(worlds, dofs)``.
        activations: State of the worlds' stateful actuators, shape ``(worlds, activations)``.
        broken: First column of the last observation groups that was not finite, plus 1; the columns of further groups follow those of
            ``observations``; 0 where all were finite; shape ``(worlds,)``.
        failure_causes: How many causes :func:`failed_world_code` tells apart.
        failed_world: Least :func:`failed_world_code` of the worlds that were reset because of NaN since the statistics were cleared, else
            :data:`NO_FAILED_WORLD`; shape ``(1,)``.
        last_sums: The ``sums`` of the world's last episode that ended, shape ``(worlds, 2 + terms)``.
        causes: Why that episode ended, see :data:`TERMINATED`; shape ``(worlds,)``.
        successes: Whether the last step was a success, if the task defines success; shape ``(worlds,)``.
        statistics: Running totals since they were cleared: finished episodes, their returns, their steps, one total
            a reward term and metric, worlds reset because of NaN, control steps with a solver overflow, the squares of the returns, the
            ends by each termination and by the clock; shape ``(6 + terms,)`` or more.
    """

    actions: wp.array2d[wp.float32]
    observations: wp.array2d[wp.float32]
    terminal_observations: wp.array2d[wp.float32]
    rewards: wp.array[wp.float32]
    dones: wp.array[wp.bool]
    time_outs: wp.array[wp.bool]
    ages: wp.array[wp.int32]
    sums: wp.array2d[wp.float32]
    random: wp.array2d[wp.int32]
    terms: wp.array2d[wp.float32]
    weights: wp.array[wp.float32]
    level: wp.array[wp.float32]
    memory: wp.array2d[wp.float32]
    lasting: wp.array2d[wp.float32]
    last_actions: wp.array2d[wp.float32]
    earlier_actions: wp.array2d[wp.float32]
    warm_start: wp.array2d[wp.float32]
    activations: wp.array2d[wp.float32]
    broken: wp.array[wp.int32]
    failure_causes: int
    failed_world: wp.array[wp.int32]
    last_sums: wp.array2d[wp.float32]
    causes: wp.array[wp.int32]
    successes: wp.array[wp.bool]
    statistics: wp.array[wp.float64]


@wp.func
def clear_row(rows: wp.array2d[wp.float32], world: int):
    """Set a world's row to zero."""
    for column in range(rows.shape[1]):
        rows[world, column] = 0.0


@wp.func
def clipped_action(episodes: EpisodeArrays, world: int, action: int) -> float:
    """The policy's action, clipped to the limits."""
    return wp.clamp(episodes.actions[world, action], -ACTION_LIMIT, ACTION_LIMIT)


@wp.func
def numbered_stream(episodes: EpisodeArrays, world: int, number: int) -> wp.uint32:
    """The generator ``number`` of one world. Non-negative numbers are per-episode streams; negative ones are drawn once per world."""
    key = wp.rand_init(episodes.random[world, 0], episodes.random[world, 1])
    return wp.rand_init(int(key), number)


@wp.func
def random_stream(episodes: EpisodeArrays, world: int) -> wp.uint32:
    """A fresh generator for one world, a function of (seed, global world index, streams drawn before) alone."""
    drawn = episodes.random[world, 2]
    episodes.random[world, 2] = drawn + 1
    return numbered_stream(episodes, world, drawn)


@wp.func
def add_reward(episodes: EpisodeArrays, world: int, term: int, value: float):
    """Add ``value`` times the term's weight to the step's reward and to the episode's sums (``rewards`` was set to zero)."""
    weighted = episodes.weights[term] * value
    episodes.rewards[world] = episodes.rewards[world] + weighted
    episodes.sums[world, TERMS + term] = episodes.sums[world, TERMS + term] + weighted
    if world < episodes.terms.shape[0]:
        episodes.terms[world, term] = weighted


@wp.func
def begin_episode(episodes: EpisodeArrays, world: int):
    """Clear a world's clock, sums and memory, and what its solver and its actuators remember of the old episode."""
    episodes.ages[world] = 0
    clear_row(episodes.sums, world)
    clear_row(episodes.memory, world)
    clear_row(episodes.warm_start, world)
    clear_row(episodes.activations, world)


@wp.func
def failed_world_code(episodes: EpisodeArrays, world: int, valid: bool) -> int:
    """World and cause as one number, the lower worlds first; :func:`read_failed_world` takes it apart.

    Only a step in which the world failed computes it. The reward terms are judged by their sums over the episode, which were finite before.
    """
    terms = episodes.weights.shape[0]
    cause = int(1)  # noqa: RUF046 (a variable for Warp, not a constant)
    if not valid:
        cause = 0
    elif episodes.broken[world] > 0:
        cause = 1 + terms + episodes.broken[world]
    else:
        for term in range(terms):
            if cause == 1 and not wp.isfinite(episodes.sums[world, TERMS + term]):
                cause = 2 + term
    return world * episodes.failure_causes + cause


def causes_of_failures(rewards: Sequence[str], observations: Sequence[str]) -> list[str]:
    """The causes that :func:`failed_world_code` tells apart, in words.

    Args:
        rewards: Names of the reward terms.
        observations: Names of the columns of all observation groups, the policy's first.
    """
    return [
        "its physics failed (a joint faster than `fastest`, or not finite)",
        "its reward was not finite, though each of its terms was",
        *(f"its reward term {name} was not finite" for name in rewards),
        *(f"its observation {name} was not finite" for name in observations),
    ]


def read_failed_world(code: int, causes: Sequence[str]) -> tuple[int, str]:
    """World and cause in a ``code`` other than :data:`NO_FAILED_WORLD`: the index of the world in this task, and which of ``causes`` it was."""
    world, cause = divmod(code, len(causes))
    return world, causes[cause]


@wp.func
def end_step(
    episodes: EpisodeArrays,
    overflow: wp.array[wp.int32],
    world: int,
    terminated: bool,
    valid: bool,
    max_age: int,
) -> bool:
    """Close one control step of one world: clock, flags, sums, statistics.

    Args:
        episodes: The task's buffers; ``rewards`` holds this step's reward.
        overflow: Bits of what the solver had no room for in this step, cleared once they are counted, shape ``(worlds,)``.
        world: Row.
        terminated: Whether the task ended the episode.
        valid: Whether the physics is finite. A world whose physics, last observation or reward is not finite is reset and counted,
            but not as a finished episode.
        max_age: Steps after which the clock ends an episode.

    Returns:
        Whether the episode ended, so that the world must be placed afresh.
    """
    terms = episodes.sums.shape[1] - TERMS
    sound = valid and episodes.broken[world] == 0 and wp.isfinite(episodes.rewards[world])
    age = episodes.ages[world] + 1
    episodes.ages[world] = age
    time_out = sound and not terminated and age >= max_age
    done = terminated or time_out or not sound
    episodes.dones[world] = done
    episodes.time_outs[world] = time_out

    if overflow[world] & CAPACITY_BITS != 0:
        overflow[world] = 0
        wp.atomic_add(episodes.statistics, TERMS + terms + 2, wp.float64(1.0))
    if not sound:
        wp.atomic_min(episodes.failed_world, 0, failed_world_code(episodes, world, valid))
        episodes.rewards[world] = 0.0
        wp.atomic_add(episodes.statistics, TERMS + terms + 1, wp.float64(1.0))
    else:
        episodes.sums[world, RETURN] = episodes.sums[world, RETURN] + episodes.rewards[world]
        episodes.sums[world, STEPS] = episodes.sums[world, STEPS] + 1.0
        if done:
            wp.atomic_add(episodes.statistics, 0, wp.float64(1.0))
            for column in range(episodes.sums.shape[1]):
                wp.atomic_add(episodes.statistics, 1 + column, wp.float64(episodes.sums[world, column]))
            whole = wp.float64(episodes.sums[world, RETURN])
            wp.atomic_add(episodes.statistics, TERMS + terms + 3, whole * whole)
    if done:
        for column in range(episodes.sums.shape[1]):
            episodes.last_sums[world, column] = episodes.sums[world, column]
        cause = TIME_OUT
        if not sound:
            cause = PHYSICS_FAILED
        elif terminated:
            cause = TERMINATED
        episodes.causes[world] = cause
    return done


@wp.kernel
def check_observations(episodes: EpisodeArrays):
    """Replace non-finite observations by 0; that world's episode ends at the next step."""
    world = wp.tid()
    broken = int(0)  # noqa: RUF046 (a variable for Warp, not a constant)
    for column in range(episodes.observations.shape[1]):
        if not wp.isfinite(episodes.observations[world, column]):
            episodes.observations[world, column] = 0.0
            if broken == 0:
                broken = column + 1
    episodes.broken[world] = broken
    if episodes.dones[world]:
        for column in range(episodes.terminal_observations.shape[1]):
            if not wp.isfinite(episodes.terminal_observations[world, column]):
                episodes.terminal_observations[world, column] = 0.0


@wp.kernel
def check_group(first: int, episodes: EpisodeArrays, rows: wp.array2d[wp.float32], ended: wp.array2d[wp.float32]):
    """As :func:`check_observations`, for a further group. ``first``: number of columns of the groups before it, which were checked."""
    world = wp.tid()
    for column in range(rows.shape[1]):
        if not wp.isfinite(rows[world, column]):
            rows[world, column] = 0.0
            if episodes.broken[world] == 0:
                episodes.broken[world] = first + column + 1
        if episodes.dones[world] and not wp.isfinite(ended[world, column]):
            ended[world, column] = 0.0


@wp.kernel
def randomize_ages(max_age: int, episodes: EpisodeArrays):
    """Set every clock to a random age in [0, max_age), so that worlds do not all time out in the same step."""
    world = wp.tid()
    stream = random_stream(episodes, world)
    episodes.ages[world] = wp.randi(stream, 0, max_age)
