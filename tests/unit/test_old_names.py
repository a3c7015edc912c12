"""Modules that moved can be imported by their old names, too, with everything in them that a page ever named."""

from __future__ import annotations

import re
import sys
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import pytest

import shared_store
import worker
from tests.conftest import REPOSITORY

NAMES = {
    **{old: new for old, new in (shared_store.OLD_NAMES | worker.OLD_NAMES).items() if not new.startswith("racer.")},
    "worker.tasks.configs.camera": "worker.settings.camera",
}
DOCUMENTED = [
    name
    for name in (REPOSITORY / "tests" / "data" / "former" / "names.txt").read_text().split()
    if find_spec("racer") or not name.startswith("worker.racer")
]
"""What pages named before modules moved: modules, and their members behind a colon or a dot."""


@pytest.mark.parametrize(("old", "new"), NAMES.items())
def test_an_old_name_is_the_module_of_the_new_one(old: str, new: str) -> None:
    module = import_module(old)
    assert module is import_module(new)
    assert module.__spec__ is not None and module.__spec__.name == new


def test_what_moved_out_of_what_is_installed_is_not_found_by_its_old_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """As without the racer: the error names what was asked for."""
    from shared_store import _OldNames

    monkeypatch.setattr(sys, "meta_path", [_OldNames({"worker.gone": "nowhere.gone"}, {}), *sys.meta_path])
    with pytest.raises(ModuleNotFoundError, match=r"^No module named 'worker\.gone'$"):
        import_module("worker.gone")
    with pytest.raises(ModuleNotFoundError, match=r"^No module named 'worker\.tasks\.configs\.nothing'$"):
        import_module("worker.tasks.configs.nothing")


def kept(name: str) -> str:
    """The present name of a module that is still found by ``name``, itself or in a package that is."""
    known = shared_store.OLD_NAMES | worker.OLD_NAMES
    package, _, module = name.rpartition(".")
    return known.get(name) or (f"{kept(package)}.{module}" if package else "")


def test_the_page_of_moved_modules_has_the_kept_names_with_the_present_ones() -> None:
    page = (REPOSITORY / "docs" / "moved-modules.md").read_text()
    rows = re.findall(r"^\| `([\w.]+)` \| `([\w.]+)` \|$", page, re.M)
    for old, new in rows:
        place = REPOSITORY / new.replace(".", "/")
        assert place.with_suffix(".py").is_file() or place.is_dir() or new.startswith("racer."), (old, new)
    assert {*shared_store.OLD_NAMES, *worker.OLD_NAMES} <= {old for old, _ in rows}
    assert [old for old, new in rows if kept(old) != new] == []


def find(name: str) -> Any:
    """What a dotted name means. Raises ImportError, AttributeError."""
    module, _, rest = name.replace(":", ".").rpartition(".")
    try:
        return import_module(f"{module}.{rest}" if module else rest)
    except ModuleNotFoundError:
        return getattr(find(module), rest)


@pytest.mark.parametrize("name", DOCUMENTED)
def test_what_a_page_once_named_is_there(name: str) -> None:
    assert find(name) is not None
