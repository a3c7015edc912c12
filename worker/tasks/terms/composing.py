"""Composed terms: the shapes of rewards and terminations, and the decorator that applies them to a measurement.

>>> @composed(likeness, tilt_squared)
... def upright(std: float):
...     \"\"\"exp(-sin(tilt)^2 / std^2).\"\"\"
"""

from __future__ import annotations
import __future__

import inspect
import linecache
from collections.abc import Callable
from itertools import islice
from typing import Any

import warp as wp

from worker.tasks.declare.term_needs import needs, needs_of

wp.set_module_options({"enable_backward": False})


@wp.func
def squared(value: float) -> float:
    """Square of a number."""
    return value * value


@wp.func
def magnitude(value: float) -> float:
    """Magnitude of a number."""
    return wp.abs(value)


@wp.func
def length(vector: wp.vec3) -> float:
    """Length of a vector."""
    return wp.length(vector)


@wp.func
def length_squared(vector: wp.vec3) -> float:
    """Square of the length of a vector."""
    return wp.length_sq(vector)


@wp.func
def planar_length(vector: wp.vec3) -> float:
    """Length of a vector's part along x and y."""
    return wp.length(wp.vec2(vector[0], vector[1]))


@wp.func
def planar_squared(vector: wp.vec3) -> float:
    """Square of the length of a vector's part along x and y."""
    return vector[0] * vector[0] + vector[1] * vector[1]


@wp.func
def vertical(vector: wp.vec3) -> float:
    """Part of a vector along z."""
    return vector[2]


@wp.func
def difference(value: float, target: float) -> float:
    """A number minus its target."""
    return value - target


@wp.func
def excess(value: float, limit: float) -> float:
    """Excess of a number over a limit, 0 below it."""
    return wp.max(value - limit, 0.0)


@wp.func
def likeness(error: float, std: float) -> float:
    """exp(-error / std^2) of a squared error: 1 without an error."""
    return wp.exp(-error / (std * std))


@wp.func
def likeness_of_mean(total: float, count: int, std: float) -> float:
    """exp(-mean / std^2) of ``count`` squared errors, whose sum is ``total``."""
    return wp.exp(-total / (float(count) * std * std))


@wp.func
def mean(total: float, count: int) -> float:
    """Mean of ``count`` numbers, whose sum is ``total``."""
    return total / float(count)


@wp.func
def nearness(distance: float, std: float) -> float:
    """1 - tanh(distance / std): 1 at distance 0, 0 far away."""
    return 1.0 - wp.tanh(distance / std)


@wp.func
def above(value: float, limit: float) -> bool:
    """Whether a number is above a limit."""
    return value > limit


@wp.func
def below(value: float, limit: float) -> bool:
    """Whether a number is below a limit."""
    return value < limit


@wp.func
def outside(value: float, bounds: wp.vec2) -> bool:
    """Whether a number is below the first or above the second of two bounds."""
    return value < bounds[0] or value > bounds[1]


@wp.func
def flag(condition: bool) -> float:
    """1 where a condition holds, else 0."""
    return wp.where(condition, 1.0, 0.0)


def composed(*functions: Any, sum_over: str = "", **filled: Any) -> Callable[[Callable[..., Any]], Any]:
    """Make a term of other functions: ``composed(f, g)`` is f(g(...)).

    The term has the parameters of the last function, then those of the decorated one, whose body is never run: these are the further
    parameters of the functions before the last, from the last to the first. It has the needs of the last function.

    Args:
        functions: Warp functions, each applied to the result of the next.
        sum_over: An array, such as ``motion.bodies``: the term is the first function of the sum of the others over its elements, and of their
            number. The element is the parameter ``index`` or ``joint`` of the last function.
        **filled: Parameters of the last function that other functions compute, which give the term their own parameters instead.
    """

    def make(declared: Callable[..., Any]) -> Any:
        scope: dict[str, Any] = {}
        for function in (*functions, *filled.values()):
            scope |= function.func.__globals__
        scope |= declared.__globals__ | {f"of_{each.func.__name__}": each for each in (*functions, *filled.values())}
        parameters: dict[str, inspect.Parameter] = {}
        arguments: list[str] = []
        for name, parameter in _parameters(functions[-1]).items():
            if name in filled:
                parameters |= {
                    each: known for each, known in _parameters(filled[name]).items() if each not in parameters
                }
                arguments.append(_call(filled[name], _parameters(filled[name])))
            elif not (sum_over and name in ("index", "joint")):
                parameters[name] = parameter
            arguments += [] if name in filled else [name]
        own = iter(inspect.signature(declared).parameters.items())
        call, lines = _call(functions[-1], arguments), []
        for position, function in reversed([*enumerate(functions[:-1])]):
            values = [call]
            if sum_over and position == 0:
                element = "joint" if "joint" in arguments else "index"
                lines = ["total = float(0.0)", f"for {element} in range({sum_over}.shape[0]):", f"    total += {call}"]
                values = ["total", f"{sum_over}.shape[0]"]
            more = dict(islice(own, len(_parameters(function)) - len(values)))
            parameters |= more
            call = _call(function, [*values, *more])
        return _function(declared, parameters, [*lines, call], scope, functions)

    return make


def _parameters(function: Any) -> dict[str, inspect.Parameter]:
    return dict(inspect.signature(function.func).parameters)


def _call(function: Any, arguments: Any) -> str:
    return f"of_{function.func.__name__}({', '.join(arguments)})"


def _function(
    declared: Callable[..., Any],
    parameters: dict[str, inspect.Parameter],
    lines: list[str],
    scope: dict[str, Any],
    functions: tuple[Any, ...],
) -> Any:
    """The Warp function with these lines as its body; its source depends on nothing else, so that Warp finds it in its cache."""
    returns = inspect.signature(functions[0].func).return_annotation
    result = "" if returns is inspect.Signature.empty else f" -> {returns}"
    lines[-1] = f"return {lines[-1]}" if result else lines[-1]
    head = ", ".join(f"{name}: {each.annotation}" for name, each in parameters.items())
    text = [f"def {declared.__name__}({head}){result}:\n", *(f"    {line}\n" for line in lines)]
    file = f"<term {declared.__module__}.{declared.__name__}>"
    linecache.cache[file] = (sum(map(len, text)), None, text, file)  # Warp and tracebacks find the source here
    exec(compile("".join(text), file, "exec", __future__.annotations.compiler_flag), scope)
    function = scope.pop(declared.__name__)
    defaults = [each.default for each in parameters.values() if each.default is not inspect.Parameter.empty]
    function.__defaults__, function.__doc__ = tuple(defaults), declared.__doc__
    return needs(**vars(needs_of(functions[-1])))(wp.func(function))
