"""The order of the tests, and what runs beside what.

Processes of pytest-xdist take one file after the other. All files that start a whole cluster or a browser are one lane: one
process works through them, while the others have the rest, and helps with the rest when it is done.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from xdist.scheduler import LoadScopeScheduling

TESTS = Path(__file__).parents[2]
TIERS = ("cluster", "console", "long", "training", "integration", "robots", "unit")
"""The folders of the tests, and the marker of each one's tests, in their order: what takes long first, so that no process is
left with a long file at the end."""
ALONE = ("tests/cluster/", "tests/console/")
"""No two tests of these folders run at once: they use fixed ports, Docker's networks, or most of a core."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark each test with its tier, and put the tiers in their order."""
    tiers = {item: next((n for n in TIERS if item.path.is_relative_to(TESTS / n)), None) for item in items}
    for item, tier in tiers.items():
        if tier is not None:
            item.add_marker(tier)
    items.sort(key=lambda item: TIERS.index(tier) if (tier := tiers[item]) else len(TIERS))


class _Lanes(LoadScopeScheduling):  # type: ignore[misc]  # xdist has no types
    """Files, in the order of their collection; the folders in :data:`ALONE` together are as one file."""

    def _split_scope(self, nodeid: str) -> str:
        return "alone" if nodeid.startswith(ALONE) else nodeid.split("::", 1)[0]


def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> LoadScopeScheduling:
    config.option.loadscopereorder = False
    return _Lanes(config, log)
