"""Modules that moved can be imported by their old names, too."""

from __future__ import annotations

import sys
from importlib import import_module

import pytest

import shared_store
import worker

NAMES = {
    **{old: new for old, new in (shared_store.OLD_NAMES | worker.OLD_NAMES).items() if not new.startswith("racer.")},
    "worker.tasks.configs.camera": "worker.settings.camera",
}


@pytest.mark.parametrize(("old", "new"), NAMES.items())
def test_an_old_name_is_the_module_of_the_new_one(old: str, new: str) -> None:
    module = import_module(old)
    assert module is import_module(new)
    assert module.__spec__ is not None and module.__spec__.name == new


def test_what_moved_out_of_what_is_installed_is_not_found_by_its_old_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """As without the racer: the error names what was asked for."""
    from shared_store import _OldNames

    monkeypatch.setattr(sys, "meta_path", [_OldNames({"worker.gone": "nowhere.gone"}), *sys.meta_path])
    with pytest.raises(ModuleNotFoundError, match=r"^No module named 'worker\.gone'$"):
        import_module("worker.gone")
    with pytest.raises(ModuleNotFoundError, match=r"^No module named 'worker\.tasks\.configs\.nothing'$"):
        import_module("worker.tasks.configs.nothing")
