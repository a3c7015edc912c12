"""Functions of numbers in ``math``, which raise errors, and in ``numpy``, which give NaN."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from racer.rewards.translation.expression_values import Number


@dataclass(frozen=True)
class Function:
    """A function of floats.

    Attributes:
        make: From the arguments' C++ texts and what helpers get of the line to the result.
        counts: How many arguments it may have.
        may_fail: Whether it may report an error.
    """

    make: Callable[[Sequence[str], str], Number]
    counts: tuple[int, ...] = (1,)
    may_fail: bool = False


def _plain(name: str, count: int = 1) -> Function:
    return Function(lambda values, at: Number("float", f"::{name}({', '.join(values)})"), (count,))


def _checked(code: str, inside: str, count: int = 1) -> Function:
    """A function with a domain; both texts name the arguments ``{0}`` and ``{1}``."""
    return Function(
        lambda values, at: Number("float", f"py_domain({inside.format(*values)}, {code.format(*values)}, {at})"),
        (count,),
        True,
    )


def _growing(name: str) -> Function:
    """A function whose result may be too large."""
    return Function(lambda values, at: Number("float", f"py_exp({values[0]}, ::{name}({values[0]}), {at})"), (1,), True)


def _whole(name: str) -> Function:
    return Function(lambda values, at: Number("int", f"py_int(::{name}({values[0]}), {at})"), (1,), True)


def _float(code: str, count: int = 1) -> Function:
    return Function(lambda values, at: Number("float", code.format(*values)), (count,))


def _truth(code: str) -> Function:
    return Function(lambda values, at: Number("bool", code.format(*values)))


def _logarithm(values: Sequence[str], at: str) -> Number:
    parts = [f"py_domain({value} > 0.0 || {value} != {value}, ::log({value}), {at})" for value in values]
    return Number("float", parts[0] if len(parts) == 1 else f"py_div({parts[0]}, {parts[1]}, {at})")


_DEGREES, _RADIANS = f"({{0}} * {180.0 / math.pi!r})", f"({{0}} * {math.pi / 180.0!r})"
_FINITE = "!({0} - {0} != 0.0 && {0} == {0})"  # NaN passes through, as in Python; infinity is an error

FUNCTIONS: Mapping[str, Function] = {
    "sqrt": _checked("::sqrt({0})", "!({0} < 0.0)"),
    "sin": _checked("::sin({0})", _FINITE),
    "cos": _checked("::cos({0})", _FINITE),
    "tan": _checked("::tan({0})", _FINITE),
    "asin": _checked("::asin({0})", "!(::fabs({0}) > 1.0)"),
    "acos": _checked("::acos({0})", "!(::fabs({0}) > 1.0)"),
    "atan": _plain("atan"),
    "atan2": _plain("atan2", 2),
    "sinh": _growing("sinh"),
    "cosh": _growing("cosh"),
    "tanh": _plain("tanh"),
    "exp": _growing("exp"),
    "log": Function(_logarithm, (1, 2), True),
    "log2": _checked("::log2({0})", "!({0} <= 0.0)"),
    "log10": _checked("::log10({0})", "!({0} <= 0.0)"),
    "pow": Function(lambda values, at: Number("float", f"py_pow({values[0]}, {values[1]}, {at})"), (2,), True),
    "fmod": _checked("::fmod({0}, {1})", "({1} != 0.0 && {0} - {0} == 0.0)", 2),
    "fabs": _plain("fabs"),
    "floor": _whole("floor"),
    "ceil": _whole("ceil"),
    "trunc": _whole("trunc"),
    "copysign": _float("py_copysign({0}, {1})", 2),
    "degrees": _float(_DEGREES),
    "radians": _float(_RADIANS),
    "isclose": Function(
        lambda values, at: Number(
            "bool", "({0} == {1} || ::fabs({0} - {1}) <= 1e-9 * wp::max(::fabs({0}), ::fabs({1})))".format(*values)
        ),
        (2,),
    ),
    "isnan": _truth("({0} != {0})"),
    "isfinite": _truth("py_finite({0})"),
    "isinf": _truth("({0} == {0} && !py_finite({0}))"),
}
"""Of ``math``."""
QUIET: Mapping[str, Function] = {
    **{
        name: _plain(name)
        for name in ("sqrt", "sin", "cos", "tan", "tanh", "exp", "log", "log2", "log10", "floor", "ceil", "rint")
    },
    "arcsin": _plain("asin"),
    "arccos": _plain("acos"),
    "arctan": _plain("atan"),
    "arctan2": _plain("atan2", 2),
    "abs": _plain("fabs"),
    "fabs": _plain("fabs"),
    "absolute": _plain("fabs"),
    "square": _float("({0} * {0})"),
    "sign": _float("({0} > 0.0 ? 1.0 : {0} < 0.0 ? -1.0 : {0})"),
    "maximum": _float("({0} > {1} || {0} != {0} ? {0} : {1})", 2),
    "minimum": _float("({0} < {1} || {0} != {0} ? {0} : {1})", 2),
    "clip": _float("({0} < {1} ? ({1} < {2} ? {1} : {2}) : {0} > {2} ? {2} : {0})", 3),
    "degrees": _float(_DEGREES),
    "rad2deg": _float(_DEGREES),
    "radians": _float(_RADIANS),
    "deg2rad": _float(_RADIANS),
    "isnan": _truth("({0} != {0})"),
    "isfinite": _truth("py_finite({0})"),
}
"""Of ``numpy``, for numbers one at a time."""
