"""The translation of a whole reward function to C++."""

from __future__ import annotations

import ast
from dataclasses import dataclass

from racer.rewards.problems import LARGEST_REWARD, out_of_range
from racer.rewards.translation.body import Module
from racer.rewards.translation.expression_values import PARAMS, Function, Outside, described, kind_of
from racer.rewards.translation.prelude import BEYOND, ERRORS, NOT_FINITE, prelude


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
    module = Module(tree)
    main = module.names.get("reward_function")
    if not isinstance(main, Function):
        raise Outside(getattr(main, "line", 1), "a reward_function that is not a plain function")
    reward = module.apply(main, [PARAMS], {}, main.node)
    if kind_of(reward) not in ("int", "float"):
        raise Outside(main.node, f"a reward_function that returns {described(reward)}")
    lines = [
        prelude(),
        *(text.format(name) for text, name in module.tables.items()),
        *module.functions,
        *module.lines,
        f"const double reward = (double){reward.code};",
        f"if (!py_finite(reward)) py_fail({NOT_FINITE});",
        f"if (::fabs(reward) > {LARGEST_REWARD!r}) {{ py_fail({BEYOND}); wp::index(race.values, world) = (float)reward; }}",
        "if (error) { wp::index(race.errors, world, 0) = error; wp::index(race.errors, world, 1) += 1; return (float)NAN; }",
        "return (float)reward;",
    ]
    return Translated("\n".join(lines) + "\n", tuple(module.notes))


def failure_message(code: int, value: float) -> str:
    """The meaning of an entry of ``errors``, in one line; ``value`` is that of the reward, where it was too large."""
    line, kind = divmod(code, 16)
    if kind == BEYOND:
        return out_of_range(value)
    return f"line {line}: {ERRORS[kind]}" if line else ERRORS[kind]
