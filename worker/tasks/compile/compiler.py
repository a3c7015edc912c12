"""The compiler of a plan to kernels: one for actions; one for rewards, resets and observations (two if observations need bodies or sensors).

The source of the kernels is generated and compiled as Warp code, under a name made of the source and of the functions that it calls.
It depends neither on the task's name nor on numbers, weights and terms in torch, which are data: changing these compiles nothing.
"""

from __future__ import annotations

import hashlib
import linecache
import re
from collections.abc import Iterable
from functools import partial
from typing import Any

import warp as wp

from worker.tasks.compile.binding import Bound
from worker.tasks.compile.external import TIME_OUT
from worker.tasks.compile.observing import group_function
from worker.tasks.compile.plan import KernelPlan, Timed
from worker.tasks.compile.source import Source, call_of, calls, loop, parameters_of
from worker.tasks.declare.declaration import Event, Reward, Termination
from worker.tasks.declare.functions import is_warp

COMMON = (
    "numbers: wp.array[wp.float32], indices: wp.array[wp.int32], past: wp.array2d[wp.float32], "
    "external: ExternalArrays, seconds: float, worlds: WorldArrays, episodes: EpisodeArrays"
)
"""Parameters of every kernel, after its own."""


class Kernels:
    """The kernels of a task.

    Args:
        plan: Their contents.
        apart: Whether observations have a kernel of their own, after the update of bodies and sensors.

    Attributes:
        act: ``(common, structs)``: from actions to controls.
        judge: ``(mode, max_age, rows of further groups, common, structs)``: rewards, ends, resets, commands, and observations unless
            they are apart.
        observe: As ``judge``; None unless observations are apart.
        startup: ``(common, structs)``: the startup events; None without any.
        structs: Variables of the structs that each takes, in order.
        source: The source of all of them.
    """

    def __init__(self, plan: KernelPlan, apart: bool) -> None:
        source = Source(plan)
        self.structs = source.structs
        text = [act(source)]
        functions = [group_function(source, group, terms) for group, terms in plan.groups.items()]
        text.append(judge(source, apart))
        if apart:
            text.append(observe(source))
        if happening(plan, "startup"):
            text.append(startup(source))
        self.source = "\n\n".join([*functions, *text])
        found = compiled(self.source, source.scope(), [*map(title, functions)], [*map(title, text)])
        self.act, self.judge = found["act"], found["judge"]
        self.observe, self.startup = found.get("observe"), found.get("startup")


def happening(plan: KernelPlan, when: str) -> list[Bound]:
    """The events at a reset, or at startup."""
    return [
        event.bound for event in plan.events if isinstance(event.bound.term, Event) and event.bound.term.when == when
    ]


def title(text: str) -> str:
    """Name of the function in a source."""
    found = re.match(r"def (\w+)", text)
    assert found
    return found[1]


_COMPILED: dict[tuple[str, tuple[int, ...]], dict[str, Any]] = {}
"""Kernels of this process: a second task with the same source and functions loads nothing again."""


def compiled(text: str, scope: dict[str, Any], functions: list[str], kernels: list[str]) -> dict[str, Any]:
    """Warp kernels of a source, by name."""
    called = [
        f"{each.func.__module__}.{each.func.__qualname__}" for each in scope.values() if is_warp(each) and each.func
    ]
    digest = hashlib.sha256("\n".join([text, *called]).encode()).hexdigest()[:12]
    key = (digest, tuple(id(value) for value in scope.values()))
    if key in _COMPILED:
        return _COMPILED[key]
    # the number tells apart a function and its later version in the same process
    name = f"{digest}-{sum(known[0] == digest for known in _COMPILED)}"
    file = f"<task {name}>"
    # tracebacks and Warp itself find the source here
    linecache.cache[file] = (len(text), None, [f"{line}\n" for line in text.split("\n")], file)
    exec(compile(text, file, "exec"), scope)
    module = wp.get_module(f"muster.task.{name}")
    module.options["enable_backward"] = False
    for function in functions:
        scope[function] = wp.func(scope[function], module=module)
    found = {kernel: wp.kernel(scope[kernel], module=module, enable_backward=False) for kernel in kernels}
    _COMPILED[key] = found
    return found


def act(source: Source) -> str:
    """The kernel from actions to controls."""
    plan = source.plan
    lines = ["world = wp.tid()"]
    if plan.choice:
        lines += calls(source, plan.choice, lambda call: [call])
    for driven in plan.driven:
        action = f"episodes.actions[world, {driven.first} + k]"
        if driven.clip is not None:
            action = f"wp.clamp({action}, numbers[{driven.clip}], numbers[{driven.clip + 1}])"
        value = f"value = {driven.offset.at('k')} + {driven.scale.at('k')} * {action}"
        lines += calls(source, driven.bound, partial(lambda value, call: [value, call], value))
    return kernel("act", COMMON, source, lines)


def judge(source: Source, apart: bool) -> str:
    """The kernel of a step's end: rewards, terminations, statistics, resets, commands, and observations unless they are ``apart``."""
    plan = source.plan
    lines = ["world = wp.tid()", "restart = mode != STEP", "if mode == STEP:"]
    lines += indent(
        [
            "valid = is_sound(worlds, world)",
            *terminations(source),
            "episodes.rewards[world] = 0.0",
            *rewards(source),
            *remember_actions(plan, "episodes.actions[world, k]"),
            "sound = valid and episodes.broken[world] == 0 and wp.isfinite(episodes.rewards[world])",
            "limit = int(max_age)",
            "if cut:",
            "    limit = 0",
            "restart = end_step(episodes, worlds.overflow, world, terminated, valid, limit)",
            *count_ends(plan),
            "if restart:",
            *indent(
                [
                    "if valid:",
                    *[line for group in plan.groups for line in indent(write(source, group, terminal=True))],
                    "else:",
                    *[f"    clear_row({rows_of(group)[1]}, world)" for group in plan.groups],
                    *each(source, plan.curricula),
                ]
            ),
            *running(source),
        ]
    )
    lines += ["if restart:", *indent(reset(source))]
    if not apart:
        lines += [line for group in plan.groups for line in write(source, group)]
    return kernel("judge", own(plan), source, lines)


def own(plan: KernelPlan) -> str:
    """Parameters of the observing kernels: mode, longest age, the rows of groups besides the policy's, and the common ones."""
    rows = [row for group in further(plan) for row in rows_of(group)]
    return "".join(["mode: int, max_age: int, ", *[f"{row}: wp.array2d[wp.float32], " for row in rows], COMMON])


def further(plan: KernelPlan) -> list[str]:
    """The groups besides the policy's."""
    return [group for group in plan.groups if group != "policy"]


def rows_of(group: str) -> tuple[str, str]:
    """A kernel's names for the rows of a group, and for those of episodes that ended."""
    if group == "policy":
        return "episodes.observations", "episodes.terminal_observations"
    return f"group_{group}", f"ended_group_{group}"


def observe(source: Source) -> str:
    """The kernel of the observations alone: worlds that were just reset have age 0."""
    lines = ["world = wp.tid()", "restart = mode != STEP or episodes.ages[world] == 0"]
    lines += [line for group in source.plan.groups for line in write(source, group)]
    return kernel("observe", own(source.plan), source, lines)


def startup(source: Source) -> str:
    """The kernel of the startup events, with random streams of their own."""
    lines = ["world = wp.tid()"]
    for number, bound in enumerate(happening(source.plan, "startup")):
        lines += [f"stream = numbered_stream(episodes, world, {-100_000 - number})"]
        lines += calls(source, bound, lambda call: [call])
    return kernel("startup", COMMON, source, lines)


def terminations(source: Source) -> list[str]:
    """``ended_0``, …, and from them ``terminated`` and ``cut``; no termination counts in a world whose physics failed."""
    bounds = source.plan.in_warp("terminations")
    lines = [f"ended_{number} = bool(False)" for number in range(len(bounds))]
    body = ["terminated = external_end(external, world, 0)", f"cut = external_end(external, world, {TIME_OUT})"]
    for number, bound in enumerate(bounds):
        hit = f"ended_{number} = True"
        body += calls(source, bound, partial(lambda hit, call: [f"if {call}:", f"    {hit}"], hit))
        flag = "cut" if isinstance(bound.term, Termination) and bound.term.time_out else "terminated"
        body += [f"if ended_{number}:", f"    {flag} = True"]
    return ["terminated = bool(False)", "cut = bool(False)", *lines, "if valid:", *indent(body)]


def rewards(source: Source) -> list[str]:
    """Every reward term and metric of a world whose physics did not fail. Terms of the same elements share a loop."""
    first = source.plan.in_warp("rewards")
    bounds = [*first, *source.plan.in_warp("metrics")]
    alive = [bound for bound in bounds if isinstance(bound.term, Reward) and bound.term.unless_terminated]
    always = [bound for bound in bounds if bound not in alive]
    lines = [f"total_{number} = float(0.0)" for number in range(len(bounds))]
    lines += totals(source, bounds, always)
    if alive:
        lines += ["if not terminated:", *indent(totals(source, bounds, alive))]
    for number, bound in enumerate(bounds):
        if isinstance(bound.term, Reward):
            value = f"seconds * total_{number}" if bound.term.per_second else f"total_{number}"
            lines += [f"add_reward(episodes, world, external.rewards[{number}], {value})"]
        else:
            at_end = getattr(bound.term, "at_end", False)
            metric = f"external.metrics[{number - len(first)}]"
            lines += [f"add_metric(episodes, world, {metric}, total_{number}, {at_end})"]
    if source.plan.success is not None:
        lines += [f"episodes.successes[world] = {source.plan.success}"]
    return ["if valid:", *indent([*lines, "judge_external(external, episodes, world, terminated, seconds)"])]


def totals(source: Source, bounds: list[Bound], some: list[Bound]) -> list[str]:
    """``total_0``, …: the sum of each of ``some`` of the terms over its elements."""
    lines: list[str] = []
    shared: dict[Any, list[str]] = {}
    first: dict[Any, Bound] = {}
    for bound in some:
        number = bounds.index(bound)
        is_flag = bound.signature is not None and bound.signature.returns is bool

        def add(call: str, number: int = number, is_flag: bool = is_flag) -> list[str]:
            return [f"if {call}:", f"    total_{number} += 1.0"] if is_flag else [f"total_{number} += float({call})"]

        if bound.elements is None or bound.signature is None:
            lines += calls(source, bound, add)
            continue
        key = (bound.signature.element, tuple(bound.elements))
        first.setdefault(key, bound)
        shared.setdefault(key, []).extend(add(call_of(source, bound)))
    for key, inner in shared.items():
        lines += loop(source, first[key], inner)
    return lines


def remember_actions(plan: KernelPlan, value: str) -> list[str]:
    """Shift the actions of the last steps."""
    count = "episodes.actions.shape[1]"
    return [
        f"for k in range({count}):",
        "    episodes.earlier_actions[world, k] = episodes.last_actions[world, k]",
        f"    episodes.last_actions[world, k] = {value}",
    ]


def count_ends(plan: KernelPlan) -> list[str]:
    """Record and count the cause of the episode's end, if the end counts."""
    lines = []
    for number, _ in enumerate(plan.in_warp("terminations")):
        lines += [f"if ended_{number}:", f"    count_end(episodes, world, external.ends[{number}])"]
    lines += [
        "count_external_ends(external, episodes, world)",
        "if not terminated and not cut and episodes.time_outs[world]:",
        "    wp.atomic_add(episodes.statistics, episodes.statistics.shape[0] - 1, wp.float64(1.0))",
    ]
    return ["if sound and restart:", *indent(lines)]


def running(source: Source) -> list[str]:
    """Commands and interval events of a world whose episode goes on."""
    lines: list[str] = []
    for timed in (*source.plan.commands, *source.plan.events):
        if timed.countdown < 0:
            continue
        column = f"episodes.memory[world, {timed.countdown}]"
        lines += [
            f"{column} = {column} - 1.0",
            f"if {column} < 0.5:",
            *indent(drawn(source, timed)),
            *updated(source, timed),
        ]
    return ["if not restart:", *indent(lines)] if lines else []


def drawn(source: Source, timed: Timed) -> list[str]:
    """Call a term with a random stream of its own, and draw its duration."""
    return [
        "stream = random_stream(episodes, world)",
        *wait(timed),
        *calls(source, timed.bound, lambda call: [call]),
    ]


def updated(source: Source, timed: Timed) -> list[str]:
    """Call a command's update, in every step."""
    if timed.update is None:
        return []
    stream = ["stream = random_stream(episodes, world)"] if timed.update.takes("stream") else []
    return [*stream, *calls(source, timed.update, lambda call: [call])]


def wait(timed: Timed) -> list[str]:
    """Draw a time in control steps, at least one."""
    ends = f"numbers[{timed.seconds}], numbers[{timed.seconds + 1}]"
    return [
        f"episodes.memory[world, {timed.countdown}] = wp.max(1.0, wp.round(wp.randf(stream, {ends}) / seconds))",
    ]


def reset(source: Source) -> list[str]:
    """Begin an episode: events, then commands, then the first waits.

    Joints that no event places take the model's position: a world whose physics failed would otherwise fail again and again.
    """
    plan = source.plan
    lines = ["begin_episode(episodes, world)", "restore_start(worlds, world)"]
    lines += ["for k in range(episodes.actions.shape[1]):"]
    lines += ["    episodes.earlier_actions[world, k] = 0.0", "    episodes.last_actions[world, k] = 0.0"]
    lines += each(source, happening(plan, "reset"))
    for command in plan.commands:
        lines += drawn(source, command) + updated(source, command)
    for event in plan.events:
        if event.countdown >= 0:
            lines += ["stream = random_stream(episodes, world)", *wait(event)]
    return lines


def each(source: Source, bounds: Iterable[Bound]) -> list[str]:
    """One call after the other, with a random stream of its own for each that draws."""
    lines: list[str] = []
    for bound in bounds:
        lines += ["stream = random_stream(episodes, world)"] if bound.takes("stream") else []
        lines += calls(source, bound, lambda call: [call])
    return lines


def write(source: Source, group: str, terminal: bool = False) -> list[str]:
    """Write a group: the next observation, or the last one of the episode that ended."""
    now, ended = rows_of(group)
    out = ended if terminal else now
    fresh, commit = ("False", "False") if terminal else ("restart", "True")
    draws = source.group_draws(group)
    stream = ["stream = random_stream(episodes, world)"] if draws else ["stream = wp.uint32(0)"]
    rest = ", ".join(["numbers", "indices", "past", "external", "seconds", "worlds", "episodes", *source.structs])
    return [*stream, f"observe_{group}(world, {fresh}, {commit}, {out}, {now}, stream, {rest})"]


def kernel(name: str, own: str, source: Source, lines: list[str]) -> str:
    """The source of a kernel."""
    return "\n".join([f"def {name}({own}{parameters_of(source)}):", *indent(lines)])


def indent(lines: Iterable[str]) -> list[str]:
    """Indent lines by one level."""
    return [f"    {line}" for line in lines]
