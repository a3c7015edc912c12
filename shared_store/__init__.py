"""What both sides of Muster share: the volume, the processes of a node, and the contracts between the two.

Both sides import this package (``orchestrator`` → ``shared_store`` ← ``worker``); it imports neither of them, and no torch. Only
this package and the environment variables of :mod:`shared_store.contract.node` cross between the two.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.machinery import ModuleSpec

TYPE_CHECKING = False  # a node's shim imports this package, and typing takes longer than the rest of its start
if TYPE_CHECKING:
    from collections.abc import Mapping
    from types import CodeType, ModuleType
    from typing import Any

__version__ = "0.1.0"


class _OldNames:
    """Finder and loader of modules under the names that they had before they moved."""

    def __init__(self, names: Mapping[str, str], members: Mapping[str, str]) -> None:
        self._names, self._members = names, members
        self._specs: dict[str, ModuleSpec | None] = {}

    def _new(self, name: str) -> str | None:
        """The name that a module has now; one that is not in the table is still in its package, if that moved."""
        if name in self._names:
            return self._names[name]
        package, _, module = name.rpartition(".")
        moved = self._new(package) if package else None
        return moved and f"{moved}.{module}"

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        if (new := self._new(name)) is None:
            return None
        from importlib.util import find_spec  # few processes need it

        try:
            found = find_spec(new)
        except ModuleNotFoundError:  # the package in which it is now is not installed
            return None
        spec = found and ModuleSpec(name, self, origin=found.origin)  # type: ignore[arg-type]
        if spec and found:
            spec.submodule_search_locations, spec.loader_state = found.submodule_search_locations, found
        return spec

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = import_module(spec.loader_state.name)
        self._specs[spec.name] = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """The module has run already; it keeps its own spec, which the import has just replaced, and gets the members that left it."""
        assert module.__spec__ is not None
        old = module.__spec__.name
        module.__spec__ = self._specs[old]
        for member, new in self._members.items():
            if member.rpartition(".")[0] == old:
                home, _, name = new.rpartition(".")
                setattr(module, member.rpartition(".")[2], getattr(import_module(home), name))

    def get_code(self, name: str) -> CodeType | None:
        """For ``python -m`` with an old name."""
        spec = self.find_spec(name)
        loader: Any = spec and spec.loader_state.loader
        code: CodeType | None = loader and loader.get_code(spec and spec.loader_state.name)
        return code


def keep_old_names(names: Mapping[str, str], members: Mapping[str, str] | None = None) -> None:
    """Let modules be imported, and run with ``python -m``, by their old names, too, since tasks, engines and jobs of others hold these.

    Args:
        names: Old name → new name. A package stands for all of its modules that are not named themselves.
        members: The same of members that moved out of a module of ``names``, with the names of the modules in front.
    """
    sys.meta_path.insert(0, _OldNames(names, members or {}))


OLD_NAMES = {
    "orchestrator.engines.toolkit.endings": "orchestrator.engines.toolkit.statuses",
    "orchestrator.engines.toolkit.stopping": "orchestrator.engines.toolkit.waiting",
    "shared_store.cgroups": "shared_store.process.cgroups",
    "shared_store.checkpoints": "shared_store.volume.checkpoints",
    "shared_store.file_fields": "shared_store.contract.file_fields",
    "shared_store.layout": "shared_store.volume.layout",
    "shared_store.leagues": "racer.store.leagues",
    "shared_store.nodes": "shared_store.process.node_processes",
    "shared_store.policy_contract": "shared_store.contract.policy",
    "shared_store.ports": "shared_store.process.ports",
    "shared_store.processes": "shared_store.process.processes",
    "shared_store.races": "racer.store.races",
    "shared_store.standings": "racer.store.standings",
    "shared_store.tracks": "racer.store.tracks",
}
"""Names in the documentation before the modules moved into rooms; and those that a running shim of before loads when its node ends."""
OLD_MEMBERS = {"shared_store.policy_contract.differences": "shared_store.contract.policy_changes.differences"}
keep_old_names(OLD_NAMES, OLD_MEMBERS)
