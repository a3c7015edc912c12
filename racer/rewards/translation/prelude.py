"""The prelude of the C++ code, Python's arithmetic: checked division, remainders and powers with Python's signs, rounding, indices.

Each entry is a lambda of the generated function. ``at`` is 16 times the line; :data:`ERRORS` has what is added to it.
"""

from __future__ import annotations

import re

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

_WIDE = "9.0e18"
FUNCTIONS = {
    "py_fail": "auto py_fail = [&](int code) { if (!error) error = code; };",
    "py_finite": "auto py_finite = [&](double a) -> bool { return a - a == 0.0; };",
    "py_div": f"auto py_div = [&](double a, double b, int at) -> double {{ if (b == 0.0) {{ py_fail(at + {ZERO}); return 0.0; }} return a / b; }};",
    "py_mod": f"""auto py_mod = [&](double a, double b, int at) -> double {{
    if (b == 0.0) {{ py_fail(at + {ZERO}); return 0.0; }}
    double rest = ::fmod(a, b);
    if (rest == 0.0) return b < 0.0 ? -0.0 : 0.0;
    return (b < 0.0) != (rest < 0.0) ? rest + b : rest; }};""",
    "py_floordiv": f"""auto py_floordiv = [&](double a, double b, int at) -> double {{
    if (b == 0.0) {{ py_fail(at + {ZERO}); return 0.0; }}
    double rest = ::fmod(a, b);
    double whole = (a - rest) / b;
    if (rest != 0.0 && (b < 0.0) != (rest < 0.0)) whole -= 1.0;
    double down = ::floor(whole);
    return whole - down > 0.5 ? down + 1.0 : down; }};""",
    "py_imod": f"""auto py_imod = [&](long long a, long long b, int at) -> long long {{
    if (b == 0) {{ py_fail(at + {ZERO}); return 0; }}
    long long rest = a % b;
    return rest != 0 && (b < 0) != (rest < 0) ? rest + b : rest; }};""",
    "py_idiv": f"""auto py_idiv = [&](long long a, long long b, int at) -> long long {{
    if (b == 0) {{ py_fail(at + {ZERO}); return 0; }}
    long long whole = a / b;
    return a % b != 0 && (b < 0) != (a < 0) ? whole - 1 : whole; }};""",
    "py_iadd": f"auto py_iadd = [&](long long a, long long b, int at) -> long long {{ if (::fabs((double)a + (double)b) > {_WIDE}) {{ py_fail(at + {OVERFLOW}); return 0; }} return a + b; }};",
    "py_isub": f"auto py_isub = [&](long long a, long long b, int at) -> long long {{ if (::fabs((double)a - (double)b) > {_WIDE}) {{ py_fail(at + {OVERFLOW}); return 0; }} return a - b; }};",
    "py_imul": f"auto py_imul = [&](long long a, long long b, int at) -> long long {{ if (::fabs((double)a * (double)b) > {_WIDE}) {{ py_fail(at + {OVERFLOW}); return 0; }} return a * b; }};",
    "py_ipow": """auto py_ipow = [&](long long a, long long n, int at) -> long long {
    long long result = 1;
    for (long long k = 0; k < n && !error; ++k) { result = py_imul(result, a, at); if (result == 0 || result == 1) { if (a == 0 || a == 1) break; } }
    return result; };""",
    "py_pow": f"""auto py_pow = [&](double a, double b, int at) -> double {{
    if (b == 2.0) {{ double square = a * a; if (!py_finite(square) && py_finite(a)) py_fail(at + {OVERFLOW}); return square; }}
    if (a == 0.0 && b < 0.0) {{ py_fail(at + {ZERO}); return 0.0; }}
    if (a < 0.0 && py_finite(b) && py_finite(a) && b != ::floor(b)) {{ py_fail(at + {COMPLEX}); return 0.0; }}
    double result = ::pow(a, b);
    if (!py_finite(result) && py_finite(a) && py_finite(b)) py_fail(at + {OVERFLOW});
    return result; }};""",
    "py_index": f"""auto py_index = [&](long long i, long long n, int at) -> long long {{
    if (i < 0) i += n;
    if (i < 0 || i >= n) {{ py_fail(at + {INDEX}); return 0; }}
    return i; }};""",
    "py_int": f"""auto py_int = [&](double a, int at) -> long long {{
    if (!py_finite(a)) {{ py_fail(at + {NO_INT}); return 0; }}
    if (::fabs(a) > {_WIDE}) {{ py_fail(at + {OVERFLOW}); return 0; }}
    return (long long)a; }};""",
    "py_round": """auto py_round = [&](double a, int digits, int at) -> double {
    double scale = 1.0;
    for (int k = 0; k < digits; ++k) scale *= 10.0;
    if (!py_finite(a) || ::fabs(a) * scale > 4.0e15) return a;
    double wide = a * scale, whole = ::rint(wide);
    if (digits && ::fabs(wide - whole) == 0.5) {
        double high = (double)(float)a, low = a - high;
        double beyond = (high * scale - wide) + low * scale;
        if (beyond != 0.0) whole = beyond > 0.0 ? ::ceil(wide) : ::floor(wide);
    }
    return whole / scale; };""",
    "py_domain": f"auto py_domain = [&](bool inside, double result, int at) -> double {{ if (!inside) {{ py_fail(at + {DOMAIN}); return 0.0; }} return result; }};",
    "py_exp": f"auto py_exp = [&](double a, double result, int at) -> double {{ if (py_finite(a) && !py_finite(result)) py_fail(at + {OVERFLOW}); return result; }};",
    "py_copysign": "auto py_copysign = [&](double a, double b) -> double { double size = ::fabs(a); return b < 0.0 || (b == 0.0 && 1.0 / b < 0.0) ? -size : size; };",
    "py_steps": f"""auto py_steps = [&](long long a, long long b, long long by, int at) -> long long {{
    if (by == 0) {{ py_fail(at + {STEP}); return 0; }}
    if (by > 0) return a < b ? (b - a - 1) / by + 1 : 0;
    return a > b ? (a - b - 1) / -by + 1 : 0; }};""",
    "py_waypoint": "auto py_waypoint = [&](long long i, int axis) -> double { return (double)wp::index(race.waypoints, track, (int)i, axis); };",
    "py_object": "auto py_object = [&](long long i, int column) -> double { return (double)wp::index(race.objects, world, (int)i, column); };",
}
"""By name; a function may use those above it."""


def used(text: str) -> list[str]:
    """Definitions of all functions that a text needs, in their order."""
    needed: set[str] = set()
    waiting = {"py_fail", "py_finite"} | set(re.findall(r"\bpy_\w+", text))
    while waiting:
        name = waiting.pop()
        if name in FUNCTIONS and name not in needed:
            needed.add(name)
            waiting |= set(re.findall(r"\bpy_\w+", FUNCTIONS[name])) - needed
    return [definition for name, definition in FUNCTIONS.items() if name in needed]
