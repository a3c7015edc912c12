"""Starting without torch's compiler: nothing here uses it, and its import takes as long as half of all other imports together.

``import tensordict`` and the first step of any optimizer import ``torch._dynamo`` only to tell it which functions it need not look
at. Until something really needs it (``torch.compile``, an export), a stand-in takes these notes down.
"""

from __future__ import annotations

import importlib
import sys
import types
from typing import Any

import torch

_NAME = "torch._dynamo"


class _Deferred(types.ModuleType):
    """``torch._dynamo`` as far as eager code needs it; anything else loads the real one and passes these notes on."""

    def __init__(self) -> None:
        super().__init__(_NAME)
        self._noted: list[tuple[str, Any]] = []

    def allow_in_graph(self, function: Any) -> Any:
        self._noted.append(("allow_in_graph", function))
        return function

    def assume_constant_result(self, function: Any) -> Any:
        self._noted.append(("assume_constant_result", function))
        return function

    def disable(self, fn: Any = None, *options: Any, **named: Any) -> Any:
        if fn is None:
            return self.__getattr__("disable")(fn, *options, **named)
        return fn

    def graph_break(self, *options: Any, **named: Any) -> None:
        """Nothing is being traced."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__path__":  # whoever looks through all modules
            raise AttributeError(name)
        if sys.modules.get(_NAME) is self:
            del sys.modules[_NAME]
            real = importlib.import_module(_NAME)
            torch._dynamo = real
            for kind, function in self._noted:
                getattr(real, kind)(function)
        return getattr(sys.modules[_NAME], name)


def defer_compiler() -> None:
    """Leave ``torch._dynamo`` out until it is needed, unless it is imported already."""
    if _NAME not in sys.modules:
        sys.modules[_NAME] = torch._dynamo = _Deferred()
