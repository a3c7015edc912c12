"""Kernels that draw the differences between worlds and write them into the model."""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays, numbered_stream, random_stream
from worker.simulation.inverse_weights import Inertials

wp.set_module_options({"enable_backward": False})

SCALE, ADD, SET = 0, 1, 2
"""Operations, in the order of :data:`worker.simulation.declared_randomization.OPERATIONS`."""
UNIFORM, LOG_UNIFORM, NORMAL = 0, 1, 2
"""Distributions, in the order of :data:`worker.simulation.declared_randomization.DISTRIBUTIONS`."""
STARTUP, RESET, INTERVAL = 0, 1, 2
"""Times at which an entry is drawn, in the order of :data:`worker.simulation.declared_randomization.MOMENTS`."""
MASS, CENTER, INERTIA, PAYLOAD = 0, 1, 2, 3
"""Properties of a body that a change can affect."""

FIRST_STREAM = -200
"""Number of the stream from which a world's first entry is drawn at startup; each further entry uses the next lower number."""
LEAST_MASS = wp.constant(0.01)
"""Least fraction of its mass that a body keeps, whatever is drawn."""

_SCALE, _ADD = wp.constant(SCALE), wp.constant(ADD)
_LOG_UNIFORM, _NORMAL = wp.constant(LOG_UNIFORM), wp.constant(NORMAL)
_RESET, _INTERVAL = wp.constant(RESET), wp.constant(INTERVAL)
_MASS, _CENTER, _INERTIA = wp.constant(MASS), wp.constant(CENTER), wp.constant(INERTIA)


@wp.struct
class Entries:
    """Table of draws, one row per entry. The numbers drawn for an entry are adjacent columns of the draws.

    Attributes:
        first_columns: First column of an entry's draws, shape ``(entries,)``.
        counts: Number of these columns, shape ``(entries,)``.
        axes: Number of columns after which its ranges repeat, shape ``(entries,)``.
        first_ranges: Its first row in ``ranges``, shape ``(entries,)``.
        distributions: See :data:`UNIFORM`, shape ``(entries,)``.
        moments: See :data:`STARTUP`, shape ``(entries,)``.
        streams: Number of the stream from which it is drawn at startup, shape ``(entries,)``.
        ranges: Least and greatest number, or mean and standard deviation, shape ``(ranges,)``.
        seconds: Least and greatest time between the draws of an interval [s], shape ``(entries,)``.
        control_hz: Control steps per simulated second [Hz].
    """

    first_columns: wp.array[wp.int32]
    counts: wp.array[wp.int32]
    axes: wp.array[wp.int32]
    first_ranges: wp.array[wp.int32]
    distributions: wp.array[wp.int32]
    moments: wp.array[wp.int32]
    streams: wp.array[wp.int32]
    ranges: wp.array[wp.vec2]
    seconds: wp.array[wp.vec2]
    control_hz: float


@wp.struct
class ModelChanges:
    """The changes that draws make to numbers of the model. Changes ``starts[i]`` to ``starts[i + 1]`` apply to number ``i``, in order.

    Attributes:
        columns: Column of each number in its array, or body, shape ``(numbers,)``.
        least: Least value of each number, shape ``(numbers,)``.
        greatest: Greatest value of each number, shape ``(numbers,)``.
        starts: First change of each number, shape ``(numbers + 1,)``.
        operations: See :data:`SCALE`, shape ``(changes,)``.
        draws: Column of the draws, shape ``(changes,)``.
        factors: Factor of the draw, where it is added or set, shape ``(changes,)``.
        kinds: Property of a body, see :data:`MASS`, shape ``(changes,)``.
        axes: Axis of a body's property: 0, 1, 2, or -1 for all, shape ``(changes,)``.
        points: Position of a payload in the body's frame [m], shape ``(changes,)``.
    """

    columns: wp.array[wp.int32]
    least: wp.array[wp.float32]
    greatest: wp.array[wp.float32]
    starts: wp.array[wp.int32]
    operations: wp.array[wp.int32]
    draws: wp.array[wp.int32]
    factors: wp.array[wp.float32]
    kinds: wp.array[wp.int32]
    axes: wp.array[wp.int32]
    points: wp.array[wp.vec3]


@wp.struct
class Bodies:
    """Masses, centres of mass [m] in the bodies' frames, and inertias about these [kg m^2] along the frames' axes."""

    masses: wp.array2d[wp.float32]
    centers: wp.array2d[wp.vec3]
    inertias: wp.array2d[wp.mat33]


@wp.struct
class BodyFields:
    """Columns of the bodies in mujoco_warp's arrays, shape ``(bodies,)``, and Newton's inverses, shape ``(worlds, bodies)``."""

    columns: wp.array[wp.int32]
    inverse_masses: wp.array2d[wp.float32]
    inverse_inertias: wp.array2d[wp.mat33]


@wp.func
def _draw_entry(
    entries: Entries, world: int, entry: int, stream: wp.uint32, draws: wp.array2d[wp.float32]
) -> wp.uint32:
    """Draw an entry's numbers of one world; returns the generator as it is afterwards."""
    for index in range(entries.counts[entry]):
        ends = entries.ranges[entries.first_ranges[entry] + index % entries.axes[entry]]
        number = float(0.0)
        if entries.distributions[entry] == _NORMAL:
            number = ends[0] + ends[1] * wp.randn(stream)
        elif entries.distributions[entry] == _LOG_UNIFORM:
            number = wp.exp(wp.randf(stream, wp.log(ends[0]), wp.log(ends[1])))
        else:
            number = wp.randf(stream, ends[0], ends[1])
        draws[world, entries.first_columns[entry] + index] = number
    return stream


@wp.func
def _draw_countdown(
    entries: Entries, world: int, entry: int, stream: wp.uint32, countdowns: wp.array2d[wp.int32]
) -> wp.uint32:
    """Draw the control steps until the next draw of an interval, at least one; returns the generator as it is afterwards."""
    seconds = entries.seconds[entry]
    steps = wp.randf(stream, seconds[0], seconds[1]) * entries.control_hz
    countdowns[world, entry] = wp.max(1, int(wp.round(steps)))
    return stream


@wp.kernel
def draw_at_start(
    entries: Entries,
    episodes: EpisodeArrays,
    draws: wp.array2d[wp.float32],
    countdowns: wp.array2d[wp.int32],
):
    """Draw one entry of one world. Each has a stream of its own: what one is does not depend on what else is drawn."""
    world, entry = wp.tid()
    stream = _draw_entry(entries, world, entry, numbered_stream(episodes, world, entries.streams[entry]), draws)
    if entries.moments[entry] == _INTERVAL:
        _draw_countdown(entries, world, entry, stream, countdowns)


@wp.kernel
def draw_due(
    entries: Entries,
    episodes: EpisodeArrays,
    draws: wp.array2d[wp.float32],
    countdowns: wp.array2d[wp.int32],
    changed: wp.array[wp.bool],
):
    """Draw what is due in one world: a new episode's entries, and intervals that are over. A new episode begins its intervals afresh."""
    world = wp.tid()
    begins = episodes.ages[world] == 0
    any_drawn = bool(False)
    for entry in range(entries.moments.shape[0]):
        moment = entries.moments[entry]
        if begins and moment == _RESET:
            _draw_entry(entries, world, entry, random_stream(episodes, world), draws)
            any_drawn = True
        elif begins and moment == _INTERVAL:
            _draw_countdown(entries, world, entry, random_stream(episodes, world), countdowns)
        elif moment == _INTERVAL:
            left = countdowns[world, entry] - 1
            countdowns[world, entry] = left
            if left <= 0:
                stream = _draw_entry(entries, world, entry, random_stream(episodes, world), draws)
                _draw_countdown(entries, world, entry, stream, countdowns)
                any_drawn = True
    changed[world] = any_drawn


@wp.func
def _combined(operation: int, value: float, number: float) -> float:
    """Applies a drawn number to a value."""
    if operation == _SCALE:
        return value * number
    if operation == _ADD:
        return value + number
    return number


@wp.kernel
def change_numbers(
    changed: wp.array[wp.bool],
    changes: ModelChanges,
    draws: wp.array2d[wp.float32],
    defaults: wp.array2d[wp.float32],
    values: wp.array2d[wp.float32],
):
    """Write one number of one world, from the model's own and all that was drawn for it."""
    world, index = wp.tid()
    if not changed[world]:
        return
    value = defaults[world, index]
    for change in range(changes.starts[index], changes.starts[index + 1]):
        number = draws[world, changes.draws[change]]
        if changes.operations[change] != _SCALE:
            number = number * changes.factors[change]
        value = _combined(changes.operations[change], value, number)
    values[world, changes.columns[index]] = wp.clamp(value, changes.least[index], changes.greatest[index])


@wp.func
def _stretched(inertia: wp.mat33, axis: int, factor: float) -> wp.mat33:
    """Inertia of a mass whose squares of coordinates along an axis have become ``factor`` times as great.

    With the second moments S = tr(I) / 2 - I, which are positive for every distribution of mass and stay so.
    """
    moments = wp.identity(n=3, dtype=float) * (0.5 * wp.trace(inertia)) - inertia
    stretch = wp.vec3(1.0, 1.0, 1.0)
    stretch[axis] = wp.sqrt(factor)
    moments = wp.diag(stretch) * moments * wp.diag(stretch)
    return wp.identity(n=3, dtype=float) * wp.trace(moments) - moments


@wp.func
def _principal_frame(axes: wp.mat33) -> wp.quat:
    """Rotation from principal axes (columns) to the body's frame, real part first as in mujoco_warp."""
    turn = axes
    if wp.determinant(turn) < 0.0:
        turn = turn * wp.diag(wp.vec3(1.0, 1.0, -1.0))
    rotation = wp.normalize(wp.quat_from_matrix(turn))
    return wp.quat(rotation[3], rotation[0], rotation[1], rotation[2])


@wp.kernel
def change_bodies(
    changed: wp.array[wp.bool],
    changes: ModelChanges,
    draws: wp.array2d[wp.float32],
    defaults: Bodies,
    values: Bodies,
    fields: BodyFields,
    inertials: Inertials,
):
    """Write the inertial properties of one body of one world, from the model's own and all that was drawn for it."""
    world, index = wp.tid()
    if not changed[world]:
        return
    mass = defaults.masses[world, index]
    center = defaults.centers[world, index]
    inertia = defaults.inertias[world, index]
    least = LEAST_MASS * mass
    for change in range(changes.starts[index], changes.starts[index + 1]):
        kind, axis, operation = changes.kinds[change], changes.axes[change], changes.operations[change]
        number = draws[world, changes.draws[change]]
        if kind == _MASS:
            before = mass
            mass = wp.max(_combined(operation, mass, number), least)
            inertia = inertia * (mass / before)
        elif kind == _CENTER:
            center[axis] = _combined(operation, center[axis], number)
        elif kind == _INERTIA:
            # A normal distribution has no least number, an inertia has.
            number = wp.max(number, LEAST_MASS)
            inertia = _stretched(inertia, axis, number) if axis >= 0 else inertia * number
        elif number > 0.0:  # a payload, a point mass: the parallel axis theorem, for both about their common centre
            arm = changes.points[change] - center
            reduced = mass * number / (mass + number)
            inertia = inertia + reduced * (wp.identity(n=3, dtype=float) * wp.dot(arm, arm) - wp.outer(arm, arm))
            center = center + arm * (number / (mass + number))
            mass = mass + number
    body = changes.columns[index]
    values.masses[world, body] = mass
    values.centers[world, body] = center
    values.inertias[world, body] = inertia
    fields.inverse_masses[world, body] = 1.0 / mass
    fields.inverse_inertias[world, body] = wp.inverse(inertia)
    column = fields.columns[index]
    axes, moments = wp.eig3(inertia)
    inertials.masses[world, column] = mass
    inertials.centers[world, column] = center
    inertials.moments[world, column] = moments
    inertials.frames[world, column] = _principal_frame(axes)
