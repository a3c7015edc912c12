"""The tests that every engine passes."""

from __future__ import annotations

from tests.support.engines.every_engine import EveryEngine
from tests.support.engines.fixtures import sites
from tests.support.engines.sites import SITES

site = sites(*(name for name in SITES if name != "ray"))  # whose cluster takes a minute to start: see tests/cluster


class TestEveryEngine(EveryEngine):
    pass
