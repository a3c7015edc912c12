"""Modules that moved can be imported by their old names, too, with everything in them that a page ever named."""

from __future__ import annotations

import re
from importlib import import_module
from typing import Any

import pytest

import shared_store
import worker
from tests.conftest import REPOSITORY
from tests.support.pages import repository_files

DOCUMENTED = (REPOSITORY / "tests" / "data" / "former" / "names.txt").read_text().split()
"""What pages named before modules moved: modules, and their members behind a colon or a dot."""
IMPORT = re.compile(r"^from ((?:orchestrator|shared_store|worker)[\w.]*) import (\([^)]*\)|.+)$", re.MULTILINE)


@pytest.mark.parametrize(("old", "new"), (shared_store.OLD_NAMES | worker.OLD_NAMES).items())
def test_an_old_name_is_the_module_of_the_new_one(old: str, new: str) -> None:
    module = import_module(old)
    assert module is import_module(new)
    assert module.__spec__ is not None and module.__spec__.name == new


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


def test_what_the_pages_import_today_is_there() -> None:
    named = {
        f"{module}:{name}"
        for page in repository_files("*.md")
        for module, names in IMPORT.findall((REPOSITORY / page).read_text())
        for name in re.findall(r"(\w+)(?: as \w+)?", re.sub(r"#.*", "", names))
    }
    assert len(named) > 50
    for name in named:
        assert find(name) is not None, name
