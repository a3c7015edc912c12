"""The checkpoint that the main rank chooses is that of every rank, whether the others see it in the directory or not."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
import torch
import torch.distributed as dist

from shared_store.volume.layout import Store
from tests.support.orchestrator.trained import add_checkpoint, add_run
from worker.learning.distributed import Gang, RankPlacement
from worker.learning.trained import choose_checkpoint


@pytest.fixture
def gangs() -> list[Gang]:
    """Both ranks of a gang of two, to be called one after the other, the main rank first."""
    store = dist.HashStore()
    return [Gang(RankPlacement(rank=rank, world_size=2), "cpu", store, ["here", "there"]) for rank in (0, 1)]


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """Run ``taught`` with two checkpoints, of weights 3 and 5, and run ``pupil``."""
    store = Store(tmp_path / "store").open()
    for name in ("taught", "pupil"):
        add_run(store, name)
    for iteration in (3, 5):
        file = io.BytesIO()
        torch.save({"algorithm": {"weight": iteration}}, file)
        add_checkpoint(store, "taught", iteration, file.getvalue())
    return store


def test_a_rank_that_does_not_see_the_chosen_checkpoint_yet_names_it_all_the_same(
    store: Store, gangs: list[Gang], tmp_path: Path
) -> None:
    main, other = gangs
    chosen = choose_checkpoint(main, store.run("taught"), None)
    late = Store(tmp_path / "late").open().run("taught")
    assert (chosen.name, choose_checkpoint(other, late, None)) == (
        "00000005-e1",
        type(chosen)(late.checkpoints / "00000005-e1", 5, 1),
    )
