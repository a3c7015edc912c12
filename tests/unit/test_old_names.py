"""Modules that moved can be imported by their old names, too."""

from __future__ import annotations

from importlib import import_module

import pytest

import shared_store
import worker


@pytest.mark.parametrize(("old", "new"), (shared_store.OLD_NAMES | worker.OLD_NAMES).items())
def test_an_old_name_is_the_module_of_the_new_one(old: str, new: str) -> None:
    module = import_module(old)
    assert module is import_module(new)
    assert module.__spec__ is not None and module.__spec__.name == new
