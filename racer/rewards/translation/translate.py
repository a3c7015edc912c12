"""The translation of a whole reward function to C++."""

from __future__ import annotations

import ast
from dataclasses import dataclass

from racer.rewards.parameters import TRACK
from racer.rewards.problems import LARGEST_REWARD, out_of_range
from racer.rewards.translation.body import Body
from racer.rewards.translation.expression_values import C_TYPES, Outside, Thing, described
from racer.rewards.translation.prelude import BEYOND, ERRORS, MOST_ROUNDS, NOT_FINITE, used
from racer.rewards.translation.program import Program


@dataclass(frozen=True)
class Translated:
    """A reward function as Warp can compile it.

    Attributes:
        snippet: C++ text: the body of a function of ``world`` and ``race`` (:class:`racer.rewards.compiled_function.RaceArrays`).
        notes: What was left out, a line each.
    """

    snippet: str
    notes: tuple[str, ...] = ()


def translate(source: str) -> Translated:
    """Translate a reward function.

    Args:
        source: Text of its file, which the guard found valid.

    Raises:
        Outside: It is outside the subset; the message names the line and the reason.
    """
    try:
        return _translate(ast.parse(source))
    except RecursionError as error:
        raise Outside(1, "a function that is nested too deeply") from error


def _translate(tree: ast.Module) -> Translated:
    program = Program(tree)
    main = program.names.get("reward_function")
    if not isinstance(main, Thing) or main.kind != "function":
        raise Outside(getattr(main, "node", None) or 1, "a reward_function that is no plain function")
    call = ast.parse("lambda params: reward_function(params)", mode="eval").body
    assert isinstance(call, ast.Lambda)
    ast.increment_lineno(call, main.node.lineno - 1)
    body = Body(program, call, {"params": Thing("params", "params")}, None)
    if body.result not in ("int", "float"):
        found = "nothing" if body.result is None else described(body.result)
        raise Outside(main.node, f"a reward_function that returns {found}")
    text = "\n".join([*program.functions, *body.text])
    structs = [
        f"struct {name} {{ {' '.join(f'{C_TYPES[kind]} a{place};' for place, kind in enumerate(kinds))} }};"
        for kinds, name in program.structs.items()
    ]
    reads_track = "waypoint" in text  # py_waypoint, count_waypoints
    track = [
        f"const int track = (int)wp::index(race.numbers, world, {TRACK});",
        "const long long count_waypoints = (long long)wp::index(race.counts, track);",
    ]
    lines = [
        "int error = 0;",
        f"int rounds = {MOST_ROUNDS};",
        *(track if reads_track else []),
        *program.prologue(),
        *structs,
        *(declaration for _, declaration in program.tables.values()),
        *used(text),
        *program.functions,
        f"auto reward_function = [&]() -> {body.returns} {{",
        *body.text,
        "};",
        "const double reward = (double)reward_function();",
        f"if (!py_finite(reward)) py_fail({NOT_FINITE});",
        f"if (::fabs(reward) > {LARGEST_REWARD!r}) {{ py_fail({BEYOND}); wp::index(race.values, world) = (float)reward; }}",
        "if (error) { wp::index(race.errors, world, 0) = error; wp::index(race.errors, world, 1) += 1; return (float)NAN; }",
        "return (float)reward;",
    ]
    return Translated("\n".join(lines) + "\n", tuple(program.notes))


def failure_message(code: int, value: float) -> str:
    """The meaning of an entry of ``errors``, in one line; ``value`` is that of the reward, where it was too large."""
    line, kind = divmod(code, 16)
    if kind == BEYOND:
        return out_of_range(value)
    return f"line {line}: {ERRORS[kind]}" if line else ERRORS[kind]
