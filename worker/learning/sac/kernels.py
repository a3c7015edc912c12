"""Kernels for exploration and for the projection of a distribution. Torch would need many launches, or its result would depend on the
number of ranks."""

from __future__ import annotations

import torch
import warp as wp

from worker.learning.parts import launch

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _explore(
    keys: wp.array[wp.int32],
    step: int,
    first_world: int,
    uniform: wp.array[wp.int32],
    limit: float,
    mean: wp.array2d[wp.float32],
    log_std: wp.array2d[wp.float32],
    actions: wp.array2d[wp.float32],
):
    """The action of one world. Its numbers follow from the step's key and the world's global index alone."""
    world = wp.tid()
    stream = wp.rand_init(keys[step], first_world + world)
    for i in range(actions.shape[1]):
        if uniform[0] != 0:
            actions[world, i] = limit * wp.randf(stream, -1.0, 1.0)
        else:
            actions[world, i] = limit * wp.tanh(mean[world, i] + wp.exp(log_std[world, i]) * wp.randn(stream))


@wp.kernel
def _look_ahead(
    rows: wp.array[wp.int64],
    outcomes: wp.array2d[wp.float32],
    worlds: int,
    powers: wp.array[wp.float32],
    last: wp.array[wp.int64],
    returns: wp.array[wp.float32],
    discounts: wp.array[wp.float32],
):
    """The steps of one transition, of n or up to the end of its episode."""
    sample = wp.tid()
    row = wp.int32(rows[sample])
    total = powers[0] * outcomes[row, 0]
    steps = wp.int32(1)
    while steps < powers.shape[0] - 1 and outcomes[row, 1] != 0.0:
        row = (row + worlds) % outcomes.shape[0]
        total += powers[steps] * outcomes[row, 0]
        steps += 1
    last[sample] = wp.int64(row)
    returns[sample] = total
    discounts[sample] = powers[steps] * outcomes[row, 2]


@wp.kernel
def _project(
    probabilities: wp.array2d[wp.float32],
    returns: wp.array[wp.float32],
    discounts: wp.array[wp.float32],
    bonuses: wp.array[wp.float32],
    least: float,
    gap: float,
    projected: wp.array2d[wp.float32],
):
    """The probability of one atom of one sample: of all that falls within a gap of it, the nearer the more.

    Adding up what arrives, in order, gives the same bits each time, which scattering what is sent would not on a GPU.
    """
    sample, atom = wp.tid()
    atoms = projected.shape[1]
    discount = discounts[sample]
    # where atom 0 falls, counted in gaps from atom 0; atom j falls `discount` · j beyond it
    start = (returns[sample] + discount * (least + bonuses[sample]) - least) / gap
    begin = wp.int32(0)
    end = atoms
    if discount > 1.0e-3:  # else all may fall into one place
        nearest = (float(atom) - start) / discount
        reach = 1.0 / discount + 1.0  # one more, for rounding
        if atom > 0:
            begin = wp.clamp(int(wp.clamp(nearest - reach, 0.0, float(atoms))), 0, atoms)
        if atom < atoms - 1:
            end = wp.clamp(int(wp.clamp(nearest + reach, -1.0, float(atoms))) + 1, 0, atoms)
    total = 0.0 * start  # a return that is not finite must not end up as a distribution
    for other in range(begin, end):
        place = wp.clamp(start + discount * float(other), 0.0, float(atoms - 1))
        distance = wp.abs(place - float(atom))
        if distance < 1.0:
            total += probabilities[sample, other] * (1.0 - distance)
    projected[sample, atom] = total


def explore(
    keys: torch.Tensor,
    step: int,
    first_world: int,
    uniform: torch.Tensor,
    limit: float,
    mean: torch.Tensor,
    log_std: torch.Tensor,
    actions: torch.Tensor,
) -> None:
    """Draw an action for each world, into ``actions``.

    Args:
        keys: Random keys of the iteration's steps, the same on all ranks; shape (steps,), int32.
        step: Index of the step.
        first_world: Global index of the first world.
        uniform: Whether to draw uniformly instead of from the policy; shape (1,), int32.
        limit: Actions lie within ± this.
        mean: Mean of the policy before squashing, shape (worlds, actions), float32.
        log_std: Logarithm of its standard deviation, same shape.
        actions: Same shape.
    """
    arguments = keys, step, first_world, uniform, limit, mean, log_std, actions
    launch(_explore, len(actions), arguments, str(actions.device))


def look_ahead(
    rows: torch.Tensor, outcomes: torch.Tensor, worlds: int, powers: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Ends, returns and discounts of transitions, from the replay's ring of steps.

    Args:
        rows: Rows of their first steps, shape (samples,), int64.
        outcomes: Reward, whether the episode continued, whether a future follows; shape (steps · worlds, 3), float32.
        worlds: Rows of one step.
        powers: Discounts of 0 to n steps, shape (n + 1,), float32.

    Returns:
        Rows of their last steps, int64, discounted sums of their rewards, and the discount of the future, float32; each (samples,).
    """
    last, (returns, discounts) = torch.empty_like(rows), powers.new_empty(2, len(rows))
    launch(_look_ahead, len(rows), (rows, outcomes, worlds, powers, last, returns, discounts), str(rows.device))
    return last, returns, discounts


def project(
    probabilities: torch.Tensor,
    returns: torch.Tensor,
    discounts: torch.Tensor,
    bonuses: torch.Tensor,
    least: float,
    greatest: float,
    projected: torch.Tensor,
) -> torch.Tensor:
    """The distribution of ``returns + discounts · (z + bonuses)``, projected onto the atoms (arXiv:1707.06887, eq. 7).

    Args:
        probabilities: Probabilities of the atoms z, spaced evenly from ``least`` to ``greatest``; shape (samples, atoms), float32.
        returns: Discounted sums of the transitions' rewards, shape (samples,), float32.
        discounts: Discounts of the future, 0 or more; shape (samples,), float32.
        bonuses: Added to the future: SAC's entropy term; shape (samples,), float32.
        least: The first atom.
        greatest: The last atom.
        projected: Filled, and returned; shape (samples, atoms).
    """
    gap = (greatest - least) / (projected.shape[1] - 1)
    arguments = probabilities, returns, discounts, bonuses, least, gap, projected
    launch(_project, projected.shape, arguments, str(projected.device))
    return projected
