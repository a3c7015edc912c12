"""The external results of terms written in torch, which kernels read from a table: adding or editing such a term compiles nothing."""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import TERMINATED, TERMS, EpisodeArrays, add_reward

wp.set_module_options({"enable_backward": False})

REWARD, METRIC, END = 0, 1, 2
"""Kinds of judged terms."""
PER_SECOND, UNLESS_TERMINATED, AT_END, TIME_OUT = 1, 2, 4, 8
"""Options of judged terms."""
_REWARD, _METRIC, _END = wp.constant(REWARD), wp.constant(METRIC), wp.constant(END)
_PER_SECOND, _UNLESS = wp.constant(PER_SECOND), wp.constant(UNLESS_TERMINATED)
_AT_END = wp.constant(AT_END)


@wp.struct
class ExternalArrays:
    """Results of torch terms, and the numbers of all judged terms in the order of their declaration.

    Attributes:
        values: One row per world, shape ``(worlds, columns)``; torch fills them before a kernel runs.
        judged: One row per judged torch term: kind, column of ``values``, number among the terms of its kind, and options;
            shape ``(terms, 4)``.
        rewards: Number of each reward in Warp among all rewards.
        metrics: As ``rewards``, of metrics.
        ends: As ``rewards``, of terminations.
        success: Column of the torch term that decides success, -1: a Warp function does, or none.
    """

    values: wp.array2d[wp.float32]
    judged: wp.array2d[wp.int32]
    rewards: wp.array[wp.int32]
    metrics: wp.array[wp.int32]
    ends: wp.array[wp.int32]
    success: int


@wp.func
def add_metric(episodes: EpisodeArrays, world: int, metric: int, value: float, at_end: bool):
    """Add to a metric's sum, or replace it; a non-finite value would spoil the mean over all worlds."""
    column = TERMS + episodes.weights.shape[0] + metric
    if wp.isfinite(value):
        if at_end:
            episodes.sums[world, column] = value
        else:
            episodes.sums[world, column] = episodes.sums[world, column] + value


@wp.func
def count_end(episodes: EpisodeArrays, world: int, end: int):
    """Count an end by termination number ``end``; of several at once, the first one declared is the cause."""
    cause = TERMINATED + 1 + end
    if episodes.causes[world] <= TERMINATED or cause < episodes.causes[world]:
        episodes.causes[world] = cause
    wp.atomic_add(episodes.statistics, episodes.sums.shape[1] + 4 + end, wp.float64(1.0))


@wp.func
def external_end(external: ExternalArrays, world: int, options: int) -> bool:
    """Whether a torch term with these options ends the episode: 0, or ``TIME_OUT`` for the terms that cut it as the clock does."""
    hit = bool(False)
    for row in range(external.judged.shape[0]):
        judged = external.judged[row, 0] == _END and external.judged[row, 3] == options
        if judged and external.values[world, external.judged[row, 1]] != 0.0:
            hit = True
    return hit


@wp.func
def judge_external(external: ExternalArrays, episodes: EpisodeArrays, world: int, terminated: bool, seconds: float):
    """Add the rewards and metrics of torch terms."""
    for row in range(external.judged.shape[0]):
        kind, number, options = external.judged[row, 0], external.judged[row, 2], external.judged[row, 3]
        value = external.values[world, external.judged[row, 1]]
        if kind == _REWARD:
            if (options & _PER_SECOND) != 0:
                value = seconds * value
            if (options & _UNLESS) != 0 and terminated:
                value = 0.0
            add_reward(episodes, world, number, value)
        elif kind == _METRIC:
            add_metric(episodes, world, number, value, options == _AT_END)
    if external.success >= 0:
        episodes.successes[world] = external.values[world, external.success] > 0.0


@wp.func
def count_external_ends(external: ExternalArrays, episodes: EpisodeArrays, world: int):
    """Count the ends by torch terms."""
    for row in range(external.judged.shape[0]):
        if external.judged[row, 0] == _END and external.values[world, external.judged[row, 1]] != 0.0:
            count_end(episodes, world, external.judged[row, 2])
