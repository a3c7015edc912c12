"""What is installed, read once for the tests of a module."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import pytest

from orchestrator.spec import model, settings, values


@pytest.fixture(scope="module")
def installed_once() -> Iterator[None]:
    """Most of the time of a validation is the look at all installed packages."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (model, settings, values):
            patch.setattr(module, "entry_points", cache(module.entry_points))
        yield
