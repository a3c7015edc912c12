"""Starting without modules that a rank does not use, although what it imports imports them: they take longer than all others together.

Such a module is imported when one of its names is used. Until then each of its names is a stand-in, which can be called, subclassed
and tested against. A module whose names stand in Warp kernels or functions does not belong here: Warp reads them as they are.
"""

from __future__ import annotations

import importlib
import sys
import types
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from typing import Any

_COMPILER = "torch._dynamo"
_SHAPES = "torch.fx.experimental.symbolic_shapes"
_META = "torch._meta_registrations"
"""Operators on tensors without data, which torch's compiler and exporter alone use."""
DEFERRED = frozenset(
    (
        *(_COMPILER, _SHAPES, _META, "torch.export"),
        # loggers of rsl_rl's runner, which import those of wandb, neptune and TensorBoard
        *("rsl_rl.utils.wandb_log_writer", "rsl_rl.utils.neptune_log_writer"),
        # windows and viewers; with the extra `viz` these import rerun
        *("glfw", "newton._src.viewer"),
        # Newton's own collisions and couplings: MuJoCo-Warp does the physics
        *("newton._src.sim.collide", "newton._src.geometry.narrow_phase", "newton._src.geometry.particle_surface"),
        *("newton._src.geometry.sdf_hydroelastic", "newton._src.geometry.sdf_contact"),
        *("newton._src.solvers.coupled.solver_coupled", "newton._src.solvers.coupled.solver_coupled_admm"),
        "newton._src.solvers.coupled.solver_coupled_proxy",
        # USD files, whose library is large, and starts a thread
        *("newton._src.usd.utils", "newton_usd_schemas"),
    )
)


_FIRST = {_COMPILER: (_META, _SHAPES), "pxr.Usd": ("newton_usd_schemas",)}
"""Modules that are of no use without others, which have to be imported before them."""


class _Deferred(types.ModuleType):
    """A module of which no name was used yet."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # whoever looks through all modules
            raise AttributeError(name)
        return _StandIn(self.__name__, name)


class _DeferredCompiler(_Deferred):
    """``torch._dynamo`` as far as eager code needs it: ``import tensordict`` and the first step of any optimizer import it only to name
    functions that it need not look at. They are passed on when it is imported."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.noted: list[tuple[str, Any]] = []
        self.trace_rules = _NoRules()

    def allow_in_graph(self, function: Any) -> Any:
        self.noted.append(("allow_in_graph", function))
        return function

    def assume_constant_result(self, function: Any) -> Any:
        self.noted.append(("assume_constant_result", function))
        return function

    def disable(self, fn: Any = None, *options: Any, **named: Any) -> Any:
        return _load(_COMPILER).disable(fn, *options, **named) if fn is None else fn

    def graph_break(self, *options: Any, **named: Any) -> None:
        """Nothing is being traced."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(_load(_COMPILER), name)


class _DeferredShapes(_Deferred):
    """``torch.fx.experimental.symbolic_shapes`` as far as the backward pass needs it, to compare the shapes of gradients: numbers."""

    def sym_eq(self, first: Any, second: Any) -> Any:
        are_numbers = all(type(each) is int for shape in (first, second) if isinstance(shape, tuple) for each in shape)
        if are_numbers and isinstance(first, tuple) and isinstance(second, tuple):
            return first == second
        return _load(_SHAPES).sym_eq(first, second)

    def expect_true(self, condition: Any, *options: Any) -> Any:
        return condition if isinstance(condition, bool) else _load(_SHAPES).expect_true(condition, *options)


class _NoRules:
    """``torch._dynamo.trace_rules`` as far as a process group needs it, which clears them."""

    def clear_lru_cache(self) -> None:
        """Nothing was traced."""

    def __getattr__(self, name: str) -> Any:
        return getattr(_load(_COMPILER).trace_rules, name)


class _StandIn:
    """A name of a deferred module."""

    def __init__(self, module: str, name: str) -> None:
        self._place = module, name

    def _real(self) -> Any:
        module, name = self._place
        return getattr(_load(module), name)

    def __call__(self, *values: Any, **named: Any) -> Any:
        return self._real()(*values, **named)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._real(), name)

    def __mro_entries__(self, bases: tuple[Any, ...]) -> tuple[Any, ...]:
        return (self._real(),)

    def __or__(self, other: Any) -> Any:
        return self._real() | other

    __ror__ = __or__

    def __instancecheck__(self, instance: object) -> bool:
        is_used = not isinstance(sys.modules.get(self._place[0]), _Deferred)
        return is_used and isinstance(instance, self._real())


_KINDS: dict[str, type[_Deferred]] = {_COMPILER: _DeferredCompiler, _SHAPES: _DeferredShapes}


def _load(name: str) -> Any:
    """The module itself."""
    deferred = sys.modules.get(name)
    if not isinstance(deferred, _Deferred):
        return importlib.import_module(name)
    for each in _FIRST.get(name, ()):
        _load(each)
    _Finder.left.discard(name)
    del sys.modules[name]
    module = importlib.import_module(name)
    for kind, function in vars(deferred).get("noted", ()):
        getattr(module, kind)(function)
    return module


class _Finder:
    """Finds the modules that are still to be deferred."""

    left: set[str] = set()

    @classmethod
    def find_spec(cls, name: str, path: Sequence[str] | None, target: object = None) -> ModuleSpec | None:
        is_left = name in cls.left
        for other in () if is_left else (name.rpartition(".")[0], *_FIRST.get(name, ())):
            if isinstance(sys.modules.get(other), _Deferred):
                _load(other)
        if not is_left and name not in sys.modules:
            return None
        spec = PathFinder.find_spec(name, path)
        if spec is not None:
            spec.loader = cls  # type: ignore[assignment]
        return spec

    @staticmethod
    def create_module(spec: ModuleSpec) -> types.ModuleType:
        """A deferred module, or the one that :func:`_load` has just imported."""
        return sys.modules.get(spec.name) or _KINDS.get(spec.name, _Deferred)(spec.name)

    @staticmethod
    def exec_module(module: types.ModuleType) -> None:
        """It waits for its first use."""
        if module.__name__ == _META:  # without this part of it there are no generators
            importlib.import_module("torch._prims.rng_prims")


def defer_imports() -> None:
    """Import the modules of :data:`DEFERRED` that are not imported yet when they are first used."""
    if _Finder not in sys.meta_path:
        sys.meta_path.insert(0, _Finder)
    _Finder.left |= DEFERRED - sys.modules.keys()
