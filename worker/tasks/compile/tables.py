"""A declaration as tables: what ``muster tasks NAME`` prints."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from worker.settings.overrides import training_sections
from worker.tasks.compile.acting import frame_of
from worker.tasks.compile.binding import Bound
from worker.tasks.compile.images import shown
from worker.tasks.declare.declaration import Adaptive, Choice, Event, Reward, Termination

if TYPE_CHECKING:
    from worker.tasks.compile.plan import Column, KernelPlan, Seen

Row = dict[str, str]
_ELSEWHERE = {"rewards", "randomize", "numbers", "curriculum"}
"""Fields of a configuration that are not in the table of its other settings."""


def tables(plan: KernelPlan) -> dict[str, list[Row]]:
    """Every non-empty section of a plan, as rows of text by column; all rows of a section have the same columns."""
    found: dict[str, list[Row]] = {"actions": _actions(plan)}
    for group, seen in plan.groups.items():
        if group in plan.declaration.groups:
            title = "observations" if group == "policy" else f"observations of {group}"
            found[title] = [_observation(plan, each) for each in seen]
    for group, name in plan.images.items():
        title = "observations" if group == "policy" else f"observations of {group}"
        if "policy" in plan.images and group == "policy":
            found["observations of critic"] = found.pop("observations")
        found[title] = [{"camera": name, "image": shown(plan, group)}]
    found["rewards"] = [_reward(plan, bound) for bound in plan.rewards]
    found["metrics"] = [_term(plan, bound) for bound in plan.metrics]
    found["terminations"] = [
        _term(plan, bound) | {"counts as": "time out" if _is_cut(bound) else "end"} for bound in plan.terminations
    ]
    if plan.declaration.success:
        of = "metric" if plan.declaration.success in plan.declaration.metrics else "termination"
        found["success"] = [{of: plan.declaration.success}]
    found["commands"] = [
        _term(plan, command.bound)
        | {
            "numbers": ", ".join(plan.declaration.commands[command.bound.name].names),
            "every": _seconds(plan, command.seconds),
        }
        for command in plan.commands
    ]
    found["events"] = [
        _term(plan, event.bound)
        | {"when": f"every {_seconds(plan, event.seconds)}" if event.seconds >= 0 else _when(event.bound)}
        for event in plan.events
    ]
    found["curricula"] = [_term(plan, bound) for bound in plan.curricula] + [
        {"name": name, "term": "Adaptive", "of": rule.place, "numbers": _adaptive(rule)}
        for name, rule in plan.adaptive.items()
    ]
    found["sensors"] = [
        {"name": name, "kind": type(sensor).__name__, "of": settings(sensor)}
        for name, sensor in plan.declaration.sensors.items()
    ]
    found["randomize"] = [
        {"name": name, "kind": type(each).__name__, "of": settings(each)}
        for name, each in plan.declaration.randomize.items()
    ]
    found["curriculum"] = [
        {"name": name, "value by iteration": ", ".join(f"{iteration:g}: {value:g}" for iteration, value in points)}
        for name, points in plan.config.curriculum.items()
    ]
    found["configuration"] = [{"name": path, "value": as_json(value)} for path, value in _settings_of(plan.config)]
    return {section: rows for section, rows in found.items() if rows}


def numbers(plan: KernelPlan) -> dict[str, list[float]]:
    """The numbers of every place, as ``config.numbers`` and ``config.curriculum`` name them.

    Those of ``randomize`` are as the task declares them; ``config.numbers`` sets them when the worlds are built.
    """
    values, places = plan.numbers.values, plan.numbers.places
    found = {place: values[first : first + count] for place, (first, count) in places.items()}
    for name, entry in plan.declaration.randomize.items():
        place = f"randomize.{name}"
        if isinstance(entry.range, Mapping):
            found |= {f"{place}.range.{axis}": [*ends] for axis, ends in zip(entry.drawn_axes, entry.ends, strict=True)}
        else:
            found[f"{place}.range"] = [end for ends in entry.ends for end in ends]
        if entry.when == "interval":
            found[f"{place}.seconds"] = [*(entry.seconds or (0.0, 0.0))]
    return found


def _settings_of(config: Any) -> Iterator[tuple[str, Any]]:
    """Path and value of each setting, such as ``substeps`` or ``camera.width``; without those of training."""
    apart = {*_ELSEWHERE, *training_sections()}
    for item in dataclasses.fields(config):
        if item.name in apart:
            continue
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            yield from ((f"{item.name}.{path}", each) for path, each in _settings_of(value))
        else:
            yield item.name, value


def as_json(value: Any) -> str:
    """A value of a configuration, or a whole one, as a job's YAML may have it."""
    return json.dumps(value, default=_plain)


def _plain(part: Any) -> Any:
    """A part of a value that JSON does not know, in types that it knows."""
    if isinstance(part, Mapping):
        return dict(part)
    if dataclasses.is_dataclass(part):
        return {item.name: getattr(part, item.name) for item in dataclasses.fields(part)}
    return str(part)


def _adaptive(rule: Adaptive) -> str:
    back = "" if rule.below is None else f", back below {rule.below:g}"
    return f"{rule.start:g} to {rule.end:g} in {rule.steps} steps, on above a mean {rule.of} of {rule.above:g}{back}"


def _actions(plan: KernelPlan) -> list[Row]:
    if plan.choice:
        assert isinstance(plan.choice.term, Choice)
        return [_term(plan, plan.choice) | {"choices": ", ".join(plan.choice.term.names)}]
    rows = []
    for driven in plan.driven:
        count = len(driven.bound.elements or ())
        rows.append(
            _term(plan, driven.bound)
            | {
                "joints": ", ".join(_joints(plan, driven.bound)),
                "scale": _spread(plan, driven.scale, count),
                "offset": _spread(plan, driven.offset, count),
            }
        )
    return rows


def _joints(plan: KernelPlan, bound: Bound) -> list[str]:
    """Names of the joints that an action term drives."""
    frame = frame_of(bound, plan.declaration.sensors)
    if frame is None:
        return bound.element_names
    return [plan.views[frame.robot].joint_names[joint] for joint in frame.driven(plan.views)]


def _observation(plan: KernelPlan, seen: Seen) -> Row:
    count = len(seen.names)
    noises = [
        f"{'normal' if noise.normal else 'uniform'} {_spread(plan, noise.amounts, count)}" for noise in seen.noises
    ]
    clip = "" if seen.clip is None else _vector([*plan.numbers.pair(seen.clip)])
    least, greatest = seen.term.delay
    return _term(plan, seen.bound) | {
        "columns": str(seen.size),
        "scale": _spread(plan, seen.scale, count) if seen.scale else "",
        "noise": ", ".join(noises),
        "clip": clip,
        "delay": f"{least} to {greatest}" if greatest else "",
        "history": str(seen.term.history) if seen.term.history > 1 else "",
    }


def _reward(plan: KernelPlan, bound: Bound) -> Row:
    term = bound.term
    assert isinstance(term, Reward)
    return (
        {"name": bound.name, "weight": f"{plan.weights[bound.name]:g}"}
        | _term(plan, bound)
        | {"per": "second" if term.per_second else "step"}
    )


def _term(plan: KernelPlan, bound: Bound) -> Row:
    """Name, function, elements and numbers of a term."""
    of = ""
    if bound.elements is not None and not bound.takes("action") and bound.element_names:
        of = (
            ", ".join(bound.element_names)
            if len(bound.element_names) <= 4
            else f"{len(bound.element_names)} {_plural(bound)}"
        )
    return {"name": bound.name, "term": bound.term.function_name, "of": of, "numbers": ", ".join(_numbers(plan, bound))}


def _plural(bound: Bound) -> str:
    element = bound.signature.element if bound.signature else None
    return {"body": "bodies", "index": "columns"}.get(str(element), f"{element}s")


def _numbers(plan: KernelPlan, bound: Bound) -> Iterator[str]:
    own = {"clip", "scale", "offset", "noise", "seconds"}
    for place, (first, count) in plan.numbers.places.items():
        where, _, name = place.rpartition(".")
        if where == bound.place and name not in own:
            yield f"{name} {_vector(plan.numbers.values[first : first + count])}"


def _vector(values: list[float]) -> str:
    return f"{values[0]:g}" if len(values) == 1 else f"[{', '.join(f'{value:g}' for value in values)}]"


def _spread(plan: KernelPlan, column: Column, count: int) -> str:
    """The number of all ``count`` columns, or the least and the greatest of them."""
    found = plan.numbers.values[column.first : column.first + (count if column.each else min(count, 1))]
    if not found:
        return ""
    return f"{found[0]:g}" if min(found) == max(found) else f"{min(found):g} to {max(found):g}"


def _seconds(plan: KernelPlan, first: int) -> str:
    least, greatest = plan.numbers.pair(first)
    return f"{least:g} s" if least == greatest else f"{least:g} to {greatest:g} s"


def _is_cut(bound: Bound) -> bool:
    return isinstance(bound.term, Termination) and bound.term.time_out


def _when(bound: Bound) -> str:
    return bound.term.when if isinstance(bound.term, Event) else ""


def settings(declared: Any) -> str:
    """The settings of a sensor or of a randomisation that are not their defaults."""
    settings = {
        name: value
        for name, value in vars(declared).items()
        if not name.startswith("_") and value is not None and value != getattr(type(declared), name, None)
    }
    return ", ".join(f"{name} {value}" for name, value in settings.items())
