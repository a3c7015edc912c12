"""The prelude of the C++: Python's arithmetic, its functions of numbers, its indices and errors in C++.

``at`` is 16 times the line; an error's number is added to it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from racer.rewards.parameters import BY_NAME, NUMBER_COLUMNS, OBJECT_COUNT, TRACK

ERRORS = {
    1: "ZeroDivisionError: division by zero",
    2: "ValueError: math domain error",
    3: "OverflowError: a number is too large",
    4: "IndexError: index out of range",
    5: "the loops of one call went round more than 1,000,000 times",
    6: "the result is not a finite number",
    7: "ValueError: NaN or infinity has no int",
    8: "the power of a negative number is complex",
    9: "UnboundLocalError: a variable has no value yet",
    10: "the function ended without a number: it returned None",
    11: "ValueError: min() or max() of nothing",
    12: "KeyError: no such key",
    13: "ValueError: range() steps by 0",
    14: "the reward is too large",
}
"""Errors of a compiled function: the number in ``errors``, less 16 times the line."""
ZERO, DOMAIN, OVERFLOW, INDEX, LOOP, NOT_FINITE, NO_INT, COMPLEX, UNBOUND, NO_RESULT, EMPTY, KEY, STEP, BEYOND = ERRORS
MOST_ROUNDS = 1_000_000
"""Times that the loops of one call go round at most: a kernel that never ends would take the device with it."""

_HELPERS = """
auto py_fail = [&](int code) { if (!error) error = code; };
auto py_finite = [&](double a) -> bool { return a - a == 0.0; };
auto py_wide = [&](double a, int at) -> bool { if (::fabs(a) > 9.0e18) py_fail(at + OVERFLOW); return ::fabs(a) > 9.0e18; };
auto py_zero = [&](bool zero, int at) -> bool { if (zero) py_fail(at + ZERO); return zero; };
auto py_domain = [&](bool inside, double result, int at) -> double { if (!inside) { py_fail(at + DOMAIN); return 0.0; } return result; };
auto py_exp = [&](double a, double result, int at) -> double { if (py_finite(a) && !py_finite(result)) py_fail(at + OVERFLOW); return result; };
auto py_div = [&](double a, double b, int at) -> double { return py_zero(b == 0.0, at) ? 0.0 : a / b; };
auto py_mod = [&](double a, double b, int at) -> double {
    if (py_zero(b == 0.0, at)) return 0.0;
    double rest = ::fmod(a, b);
    if (rest == 0.0) return b < 0.0 ? -0.0 : 0.0;
    return (b < 0.0) != (rest < 0.0) ? rest + b : rest; };
auto py_floordiv = [&](double a, double b, int at) -> double {
    if (py_zero(b == 0.0, at)) return 0.0;
    double rest = ::fmod(a, b);
    double whole = (a - rest) / b;
    if (rest != 0.0 && (b < 0.0) != (rest < 0.0)) whole -= 1.0;
    double down = ::floor(whole);
    return whole - down > 0.5 ? down + 1.0 : down; };
auto py_imod = [&](long long a, long long b, int at) -> long long {
    if (py_zero(b == 0, at)) return 0;
    long long rest = a % b;
    return rest != 0 && (b < 0) != (rest < 0) ? rest + b : rest; };
auto py_idiv = [&](long long a, long long b, int at) -> long long {
    if (py_zero(b == 0, at)) return 0;
    return a % b != 0 && (b < 0) != (a < 0) ? a / b - 1 : a / b; };
auto py_iadd = [&](long long a, long long b, int at) -> long long { return py_wide((double)a + (double)b, at) ? 0 : a + b; };
auto py_isub = [&](long long a, long long b, int at) -> long long { return py_wide((double)a - (double)b, at) ? 0 : a - b; };
auto py_imul = [&](long long a, long long b, int at) -> long long { return py_wide((double)a * (double)b, at) ? 0 : a * b; };
auto py_ipow = [&](long long a, long long n, int at) -> long long {
    long long result = 1;
    for (long long k = 0; k < n && !error; ++k) result = py_imul(result, a, at);
    return result; };
auto py_pow = [&](double a, double b, int at) -> double {
    if (b == 2.0) return py_exp(a, a * a, at);
    if (py_zero(a == 0.0 && b < 0.0, at)) return 0.0;
    if (a < 0.0 && py_finite(b) && py_finite(a) && b != ::floor(b)) { py_fail(at + COMPLEX); return 0.0; }
    return py_finite(b) ? py_exp(a, ::pow(a, b), at) : ::pow(a, b); };
auto py_index = [&](long long i, long long n, int at) -> long long {
    if (i < 0) i += n;
    if (i < 0 || i >= n) { py_fail(at + INDEX); return 0; }
    return i; };
auto py_int = [&](double a, int at) -> long long {
    if (!py_finite(a)) { py_fail(at + NO_INT); return 0; }
    return py_wide(a, at) ? 0 : (long long)a; };
auto py_round = [&](double a, int digits) -> double {
    double scale = 1.0;
    for (int k = 0; k < digits; ++k) scale *= 10.0;
    if (!py_finite(a) || ::fabs(a) * scale > 4.0e15) return a;
    double wide = a * scale, whole = ::rint(wide);
    if (digits && ::fabs(wide - whole) == 0.5) {
        double high = (double)(float)a, low = a - high;
        double beyond = (high * scale - wide) + low * scale;
        if (beyond != 0.0) whole = beyond > 0.0 ? ::ceil(wide) : ::floor(wide);
    }
    return whole / scale; };
auto py_copysign = [&](double a, double b) -> double {
    return b < 0.0 || (b == 0.0 && 1.0 / b < 0.0) ? -::fabs(a) : ::fabs(a); };
auto py_steps = [&](long long a, long long b, long long by, int at) -> long long {
    if (by == 0) { py_fail(at + STEP); return 0; }
    if (by > 0) return a < b ? (b - a - 1) / by + 1 : 0;
    return a > b ? (a - b - 1) / -by + 1 : 0; };
auto py_number = [&](int column) -> double { return (double)wp::index(race.numbers, world, column); };
auto py_waypoint = [&](long long i, int axis) -> double { return (double)wp::index(race.waypoints, track, (int)i, axis); };
auto py_object = [&](long long i, int column) -> double { return (double)wp::index(race.objects, world, (int)i, column); };
"""

CONSTANTS: Mapping[str, float] = {name: getattr(math, name) for name in ("pi", "e", "tau", "inf", "nan")}
"""Of the modules ``math`` and ``numpy``."""
_BOTH = {
    "degrees": f"({{0}} * {180.0 / math.pi!r})",
    "radians": f"({{0}} * {math.pi / 180.0!r})",
    "isnan": "({0} != {0})",
    "isfinite": "py_finite({0})",
    **{
        name: f"::{name}({{0}})"
        for name in ("sqrt", "sin", "cos", "tan", "tanh", "exp", "log", "log2", "log10", "fabs")
    },
}
FUNCTIONS: Mapping[str, Mapping[str, str]] = {
    "math": {
        **_BOTH,
        **{
            name: f"py_domain(!({{0}} - {{0}} != 0.0 && {{0}} == {{0}}), ::{name}({{0}}), {{at}})"
            for name in ("sin", "cos", "tan")
        },
        **{name: f"py_domain(!(::fabs({{0}}) > 1.0), ::{name}({{0}}), {{at}})" for name in ("asin", "acos")},
        **{name: f"py_domain(!({{0}} <= 0.0), ::{name}({{0}}), {{at}})" for name in ("log", "log2", "log10")},
        **{name: f"py_exp({{0}}, ::{name}({{0}}), {{at}})" for name in ("sinh", "cosh", "exp")},
        **{name: f"py_int(::{name}({{0}}), {{at}})" for name in ("floor", "ceil", "trunc")},
        "sqrt": "py_domain(!({0} < 0.0), ::sqrt({0}), {at})",
        "atan": "::atan({0})",
        "atan2": "::atan2({0}, {1})",
        "pow": "py_pow({0}, {1}, {at})",
        "fmod": "py_domain({1} != 0.0 && {0} - {0} == 0.0, ::fmod({0}, {1}), {at})",
        "copysign": "py_copysign({0}, {1})",
        "isclose": "({0} == {1} || ::fabs({0} - {1}) <= 1e-9 * wp::max(::fabs({0}), ::fabs({1})))",
        "isinf": "({0} == {0} && !py_finite({0}))",
    },
    "numpy": {
        **_BOTH,
        **{name: f"::{name}({{0}})" for name in ("floor", "ceil", "rint")},
        **{f"arc{name}": f"::a{name}({{0}})" for name in ("sin", "cos", "tan")},
        **{name: "::fabs({0})" for name in ("abs", "absolute")},
        "rad2deg": _BOTH["degrees"],
        "deg2rad": _BOTH["radians"],
        "arctan2": "::atan2({0}, {1})",
        "square": "({0} * {0})",
        "sign": "({0} > 0.0 ? 1.0 : {0} < 0.0 ? -1.0 : {0})",
        "maximum": "({0} > {1} || {0} != {0} ? {0} : {1})",
        "minimum": "({0} < {1} || {0} != {0} ? {0} : {1})",
        "clip": "({0} < {1} ? ({1} < {2} ? {1} : {2}) : {0} > {2} ? {2} : {0})",
    },
}
"""Functions of numbers by module and name: ``math`` raises errors, reported at ``{at}``, where ``numpy`` gives NaN."""


def prelude() -> str:
    """C++ lines before a function: helpers, and the numbers of ``params`` as ``p_NAME``, of a pair as ``p_NAME_0`` and ``p_NAME_1``."""
    helpers = re.sub(r"at \+ (\w+)", lambda found: f"at + {globals()[found[1]]}", _HELPERS)
    lines = [
        f"int error = 0, rounds = {MOST_ROUNDS};",
        f"const int track = (int)wp::index(race.numbers, world, {TRACK});",
        helpers.strip(),
        f"const long long count_objects = (long long)py_number({OBJECT_COUNT});",
        "const long long count_waypoints = (long long)wp::index(race.counts, track);",
    ]
    for name, column in NUMBER_COLUMNS.items():
        kind, is_pair = BY_NAME[name].kind, BY_NAME[name].shape == "two"
        for place in range(BY_NAME[name].width):
            end = f"_{place}" if is_pair else ""
            cell = f"py_number({column + place})"
            read = {
                "bool": f"bool p_{name}{end} = {cell} != 0.0",
                "int": f"long long p_{name}{end} = (long long){cell}",
            }
            lines.append(f"const {read.get(kind, f'double p_{name}{end} = {cell}')};")
    return "\n".join(lines)
