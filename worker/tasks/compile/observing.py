"""The function that writes an observation group: noise, clip, scale, delay and history of each term."""

from __future__ import annotations

from worker.tasks.compile.plan import Seen
from worker.tasks.compile.source import Source, calls, parameters_of


def group_function(source: Source, group: str, terms: list[Seen]) -> str:
    """The source of ``observe_GROUP``.

    Its parameters: ``fresh``, whether the world was just reset; ``commit``, whether the observation is that of the next step rather
    than the last one of an episode; ``out``, the output; ``now``, the group's row of the step before, with its history.
    """
    own = (
        "world: int, fresh: bool, commit: bool, out: wp.array2d[wp.float32], now: wp.array2d[wp.float32], "
        "given: wp.uint32, numbers: wp.array[wp.float32], indices: wp.array[wp.int32], "
        "past: wp.array2d[wp.float32], external: ExternalArrays, seconds: float, "
        "worlds: WorldArrays, episodes: EpisodeArrays"
    )
    lines = ["stream = given"] if source.group_draws(group) else []
    for seen in terms:
        lines += _term(source, seen)
    return "\n".join([f"def observe_{group}({own}{parameters_of(source)}):", *[f"    {line}" for line in lines]])


def _term(source: Source, seen: Seen) -> list[str]:
    bound, signature = seen.bound, seen.bound.signature
    lines = _draw_delay(seen) if seen.past >= 0 else []
    if signature is None:
        for column in range(bound.width):
            lines += [f"x = external.values[world, {bound.external + column}]", *_column(seen, str(column))]
        return lines

    def use(call: str) -> list[str]:
        loop = bound.elements is not None
        if bound.width == 1:
            as_number = f"wp.where({call}, 1.0, 0.0)" if signature.returns is bool else f"float({call})"
            return [f"x = {as_number}", *_column(seen, "k" if loop else "0")]
        vector = f"vector_{getattr(signature.returns, '__name__', 'of')}"
        found = [f"{vector} = {call}"]
        for axis in range(bound.width):
            column = f"(k * {bound.width} + {axis})" if loop else str(axis)
            found += [f"x = {vector}[{axis}]", *_column(seen, column)]
        return found

    return lines + calls(source, bound, use)


def _draw_delay(seen: Seen) -> list[str]:
    least, greatest = seen.term.delay
    return [
        "if fresh and commit:",
        f"    past[world, {seen.past}] = float(wp.randi(stream, {least}, {greatest + 1}))",
        f"lag = int(past[world, {seen.past}])",
    ]


def _column(seen: Seen, column: str) -> list[str]:
    """Turn ``x``, the value of one column, into the observation."""
    lines = []
    if seen.offset:
        lines += [f"x = x - {seen.offset.at(column)}"]
    for noise in seen.noises:
        draw = "wp.randn(stream)" if noise.normal else "wp.randf(stream, -1.0, 1.0)"
        lines += [f"x = x + {noise.amounts.at(column)} * {draw}"]
    if seen.clip is not None:
        lines += [f"x = wp.clamp(x, numbers[{seen.clip}], numbers[{seen.clip + 1}])"]
    if seen.scale:
        lines += [f"x = x * {seen.scale.at(column)}"]
    if seen.past >= 0:
        lines += _delay(seen, column)
    return lines + _history(seen, column)


def _delay(seen: Seen, column: str) -> list[str]:
    """Take the value of ``lag`` steps ago, and keep this one; early in an episode, take its first value."""
    size, greatest = len(seen.names), seen.term.delay[1]
    first = f"{seen.past + 1} + {column}"
    return [
        "y = x",
        "if fresh:",
        f"    for s in range({greatest}):",
        f"        past[world, {first} + s * {size}] = x",
        "else:",
        "    if lag > 0:",
        f"        y = past[world, {first} + (lag - 1) * {size}]",
        "    if commit:",
        f"        for s in range({greatest - 1}):",
        f"            past[world, {first} + ({greatest - 1} - s) * {size}] = past[world, {first} + ({greatest - 2} - s) * {size}]",
        f"        past[world, {first}] = x",
        "x = y",
    ]


def _history(seen: Seen, column: str) -> list[str]:
    size, history = len(seen.names), seen.term.history
    if history == 1:
        return [f"out[world, {seen.first} + {column}] = x"]
    return [
        f"for h in range({history - 1}):",
        "    if fresh:",
        f"        out[world, {seen.first} + h * {size} + {column}] = x",
        "    else:",
        f"        out[world, {seen.first} + h * {size} + {column}] = now[world, {seen.first} + (h + 1) * {size} + {column}]",
        f"out[world, {seen.first + (history - 1) * size} + {column}] = x",
    ]
