"""Source text of kernels: the calls of terms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import warp as wp

from worker.simulation import episodes, worlds
from worker.simulation.episodes import EpisodeArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.compile import external
from worker.tasks.compile.binding import Bound
from worker.tasks.compile.external import ExternalArrays
from worker.tasks.compile.plan import KernelPlan

_OURS = {
    episodes: ("STEP", "add_reward", "begin_episode", "clear_row", "end_step", "numbered_stream", "random_stream"),
    external: ("add_metric", "count_end", "count_external_ends", "external_end", "judge_external"),
    worlds: ("is_sound", "restore_start"),
}
"""Functions that every generated source may call, by module."""


class Source:
    """Names of functions and structs in the source of a task's kernels.

    Args:
        plan: The task's.

    Attributes:
        plan: As given.
        structs: Variables of structs, besides those that every kernel has, sorted.
    """

    def __init__(self, plan: KernelPlan) -> None:
        self.plan = plan
        self.structs = [name for name in sorted(plan.binder.structs) if name not in ("worlds", "episodes")]
        self._functions: dict[str, Any] = {}

    def function(self, bound: Bound) -> str:
        """The name of a term's function in the source."""
        function = bound.term.function
        stem = f"term_{function.func.__name__}"
        number = 0
        while self._functions.setdefault(name := f"{stem}_{number}" if number else stem, function) is not function:
            number += 1
        return name

    def group_draws(self, group: str) -> bool:
        """Whether a group's observations draw random numbers: noise, delays, terms with a stream."""
        return any(seen.noises or seen.past >= 0 or seen.bound.takes("stream") for seen in self.plan.groups[group])

    def scope(self) -> dict[str, Any]:
        """All names in the source."""
        ours = {name: getattr(module, name) for module, names in _OURS.items() for name in names}
        types = {_type_name(variable): kind for variable, kind in self.plan.binder.structs.items()}
        types |= {"WorldArrays": WorldArrays, "EpisodeArrays": EpisodeArrays, "ExternalArrays": ExternalArrays}
        return {"wp": wp, **ours, **types, **self._functions}


def _type_name(variable: str) -> str:
    return f"Type_{variable}"


def parameters_of(source: Source) -> str:
    """The structs among the parameters of a kernel."""
    return "".join(f", {name}: {_type_name(name)}" for name in source.structs)


def calls(source: Source, bound: Bound, use: Callable[[str], list[str]]) -> list[str]:
    """Lines that call a term's function once, or in a loop over its elements, counted by ``k``.

    Args:
        source: Names.
        bound: The term.
        use: Lines that use the call, given as an expression.
    """
    if bound.signature is None:
        return use(f"external.values[world, {bound.external}]")
    call = call_of(source, bound)
    return use(call) if bound.elements is None else loop(source, bound, use(call))


def call_of(source: Source, bound: Bound) -> str:
    """The call of a term's function, for one of its elements."""
    assert bound.signature is not None
    arguments = dict(bound.arguments)
    if bound.elements is not None and "stream" in arguments:
        arguments["stream"] = "wp.rand_init(int(stream), k)"  # a stream is a value: every element needs its own
    return f"{source.function(bound)}({', '.join(arguments[name] for name in bound.signature.parameters)})"


def loop(source: Source, bound: Bound, lines: list[str]) -> list[str]:
    """A loop over the elements of a term: ``k`` counts them, and the variable named after the element is passed to the function."""
    assert bound.signature is not None and bound.elements is not None
    element = f"{bound.signature.element} = {_element(source, bound.elements)}"
    if len(bound.elements) == 1:
        return ["k = int(0)", element, *lines]
    # Warp would unroll a loop over a constant: long to compile, and no faster
    return [
        f"count = int({len(bound.elements)})",
        "for k in range(count):",
        *[f"    {line}" for line in (element, *lines)],
    ]


def _element(source: Source, elements: list[int]) -> str:
    first, count = elements[0] if elements else 0, len(elements)
    if elements == list(range(first, first + count)):
        return f"k + {first}"
    indices = source.plan.binder.indices
    for start in range(len(indices) - count + 1):
        if indices[start : start + count] == elements:
            return f"indices[{start} + k]"
    indices += elements
    return f"indices[{len(indices) - count} + k]"
