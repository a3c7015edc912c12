"""What most of these tests begin with."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared_store.volume.layout import Run, Store


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store").open()


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Of which there is nothing yet."""
    return Run(tmp_path)
