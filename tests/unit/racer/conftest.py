"""What most of these tests begin with."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared_store.volume.layout import Store


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store").open()
