"""A namespace for each car: AWS's simulator drives one car in a process, so that what a reward function remembers is that car's alone.

A file's text is compiled once and run once for each car. Its modules are views: what a function sets on a module stays with its car, and
``random`` and ``numpy.random`` draw from generators of that car. A view refuses modules outside the packages of :data:`MODULES`. It imports
nothing but the standard library.
"""

from __future__ import annotations

import ast
import builtins
import contextvars
import functools
import math
import random
import sys
from collections.abc import Callable, Mapping, Sequence
from types import CodeType, ModuleType
from typing import Any

MODULES = ("math", "random", "numpy", "scipy", "shapely")
"""Packages that may be imported."""
NAMES = frozenset(
    (  # noqa: SIM905
        "open exec eval compile input breakpoint exit quit help globals locals vars dir getattr setattr delattr"
    ).split()
)
"""Built-in functions that may not be used."""
FILES = frozenset(
    (  # noqa: SIM905
        "load save savez savez_compressed savetxt loadtxt fromfile tofile genfromtxt fromregex memmap "
        "open_memmap DataSource dump dumps ctypeslib f2py distutils testing lib datasets system popen"
    ).split()
)
"""Attributes of modules, and methods of arrays, that read or write files or start programs."""
SUBMODULES = frozenset(
    (  # noqa: SIM905
        "scipy.io scipy.datasets scipy.weave numpy.ctypeslib numpy.f2py numpy.lib numpy.testing"
    ).split()
)
"""Modules of these packages that may not be used, for the same reason."""
_OWN = "__modules__"
"""The variable of a namespace that holds its modules; no function may name it."""
Reward = Callable[[dict[str, Any]], Any]


class Forbidden(Exception):
    """A function uses a module, or a function of one, that no reward function may use."""


class Modules:
    """The modules that one car's function sees.

    Args:
        shares: Its numbers come from NumPy's own generator, with the car's state (:class:`Car`), since scipy draws from that one.
    """

    def __init__(self, *, shares: bool = False) -> None:
        self._views: dict[ModuleType, ModuleType] = {}
        self._shares = shares

    def imported(self, name: str, names: Sequence[str]) -> ModuleType:
        """The module of an import statement.

        Args:
            name: Of the module, with its packages.
            names: What is imported from it; none: the statement means the outermost package.

        Raises:
            ImportError: There is no such module, or it is outside the packages.
            Forbidden: It may not be used.
        """
        if name == "__future__":
            return __import__(name)
        if name.partition(".")[0] not in MODULES:
            raise ImportError(f"{name} can't be imported; a reward function may import {', '.join(MODULES)}")
        found = [each for each in names if each not in FILES and each != "*"]
        return self.view(__import__(name, {}, {}, found or ["__name__"] if names else []))

    def view(self, module: ModuleType) -> ModuleType:
        """The car's view of a module. Raises Forbidden for one that may not be used."""
        if module not in self._views:
            if not _is_allowed(module):
                raise Forbidden(f"{module.__name__} can't be used in a reward function")
            view = self._views[module] = ModuleType(module.__name__)
            if module is math:  # small, and called so often that it has to be as fast as the module
                view.__dict__.update(vars(math))
            else:  # a plain module with this function is three times as fast as a subclass
                view.__dict__["__getattr__"] = functools.partial(self._attribute, module, view)
        return self._views[module]

    def _attribute(self, module: ModuleType, view: ModuleType, name: str) -> Any:
        """An attribute that the view does not have yet."""
        if name == "__all__":
            return [each for each in getattr(module, name, dir(module)) if each[0] != "_" and each not in FILES]
        if name in FILES or (name[:1] == "_" and name[:2] != "__"):
            raise Forbidden(f"{module.__name__}.{name} can't be used in a reward function")
        value = getattr(module, name)
        if isinstance(value, ModuleType):
            value = self.view(value)
        elif name[:2] != "__":
            value = self._drawing(module, name, value)
        view.__dict__[name] = value
        return value

    def _drawing(self, module: ModuleType, name: str, value: Any) -> Any:
        """A method of the module's generator as the same one of the car's; anything else as it is."""
        if module is random and getattr(value, "__self__", None) is random._inst:
            return getattr(self.generator, name)
        if module.__name__ in ("numpy.random", "numpy.random.mtrand"):
            if name in ("get_bit_generator", "set_bit_generator"):
                raise Forbidden(f"{module.__name__}.{name} can't be used in a reward function")
            if name in _ALIASES or getattr(value, "__self__", None) is _numpy_generator():
                return getattr(self.numpy_generator, _ALIASES.get(name, name))
        return value

    @functools.cached_property
    def generator(self) -> random.Random:
        """The car's generator of ``random``."""
        return random.Random()

    @functools.cached_property
    def numpy_generator(self) -> Any:
        """The car's generator of ``numpy.random``."""
        return _numpy_generator() if self._shares else type(_numpy_generator())()


_ALIASES: Mapping[str, str] = {"seed": "seed", "sample": "random_sample", "ranf": "random_sample"}
"""Functions of ``numpy.random`` that call methods of its generator, and those methods."""


def _numpy_generator() -> Any:
    return sys.modules["numpy.random.mtrand"].__dict__["_rand"]


@functools.cache
def _is_allowed(module: ModuleType) -> bool:
    """Whether a module belongs to a package of :data:`MODULES`, by the names under which it was imported, whatever it is called here."""
    names = [name for name, each in list(sys.modules.items()) if each is module]
    inside = any(name.partition(".")[0] in MODULES for name in names)
    return inside and not any(name in SUBMODULES or _parent(name) in _WHOLE for name in names)


_WHOLE = SUBMODULES - {"numpy.lib"}
"""Those that may not be used with all that is in them; numpy.emath is a module of numpy.lib."""


def _parent(name: str) -> str:
    """The package two levels deep that has a module."""
    return ".".join(name.split(".")[:2])


class Car:
    """The function of one car.

    Args:
        code: Of its file.
        draws: Whether scipy may draw numbers in it.

    Attributes:
        function: ``reward_function``.
        call: What calls it, with ``params``.

    Raises:
        NameError: The file, when it runs, defines no ``reward_function``.
        TypeError: It can't be called.
    """

    __slots__ = ("_context", "_state", "call", "function")

    def __init__(self, code: CodeType, *, draws: bool) -> None:
        self._context = contextvars.Context()  # holds what numpy.seterr and others set
        self._state: Any = None
        if draws:
            import numpy as np

            self._state = np.random.RandomState().get_state(legacy=False)  # from the system's entropy
        scope: dict[str, Any] = {"__name__": "reward_function", "__builtins__": _BUILTINS, _OWN: Modules(shares=draws)}
        self._run(exec, _copied(code), scope)
        if "reward_function" not in scope:
            raise NameError("the file defines no reward_function when it runs")
        self.function: Reward = scope["reward_function"]
        if not callable(self.function):
            raise TypeError(f"reward_function is a {type(self.function).__name__}, which can't be called")
        run = self._run if draws else self._context.run
        self.call: Reward = functools.partial(run, self.function)

    def _run(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call in the car's context; where scipy may draw numbers, with the car's state in NumPy's generator."""
        if self._state is None:
            return self._context.run(function, *arguments)
        generator = _numpy_generator()
        generator.set_state(self._state)
        try:
            return self._context.run(function, *arguments)
        finally:
            self._state = generator.get_state(legacy=False)


def _copied(code: CodeType) -> CodeType:
    """The same code with the same constants: what the interpreter learns about a function's names is then right for its car."""
    return code.replace(
        co_consts=tuple(_copied(each) if isinstance(each, CodeType) else each for each in code.co_consts)
    )


class RewardProgram:
    """The text of a reward function.

    Args:
        source: Text of its file.
        file: Its name, in tracebacks.
    """

    def __init__(self, source: str, file: str) -> None:
        tree = ast.parse(source, file)
        self._code = compile(tree, file, "exec", dont_inherit=True)
        self._draws = any(_imports_scipy(node) for node in ast.walk(tree))

    def car(self) -> Car:
        """Run the file in a new namespace."""
        return Car(self._code, draws=self._draws)


def _imports_scipy(node: ast.AST) -> bool:
    """Whether a part of a file imports from scipy, of which many functions draw numbers from NumPy's own generator."""
    if isinstance(node, ast.Import):
        return any(alias.name.partition(".")[0] == "scipy" for alias in node.names)
    return isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "scipy"


def _import(
    name: str, scope: Mapping[str, Any], local: object = None, names: Sequence[str] | None = None, level: int = 0
) -> ModuleType:
    """An import statement; it stands in the function's file, so that ``scope`` is the namespace of its car."""
    modules: Modules = scope[_OWN]
    return modules.imported(name, names or ())


_BUILTINS = {name: value for name, value in vars(builtins).items() if name not in NAMES} | {"__import__": _import}
"""What a function finds where neither it nor its file defines a name."""
