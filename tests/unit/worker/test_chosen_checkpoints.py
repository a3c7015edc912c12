"""The checkpoint that the main rank chooses is that of every rank, whether the others see it in the directory or not."""

from __future__ import annotations

from pathlib import Path

import torch.distributed as dist

from shared_store.volume.layout import Store
from tests.support.orchestrator.trained import add_checkpoint, add_run
from worker.learning.distributed import Gang, RankPlacement
from worker.learning.trained import choose_checkpoint


def test_a_rank_that_does_not_see_the_chosen_checkpoint_yet_names_it_all_the_same(tmp_path: Path) -> None:
    store, meeting = Store(tmp_path / "store").open(), dist.HashStore()
    add_run(store, "taught")
    for iteration in (3, 5):
        add_checkpoint(store, "taught", iteration)
    main, other = (Gang(RankPlacement(rank=rank, world_size=2), "cpu", meeting, ["here", "there"]) for rank in (0, 1))
    chosen = choose_checkpoint(main, store.run("taught"), None)
    late = Store(tmp_path / "late").open().run("taught")
    assert chosen.name == "00000005-e1"
    assert choose_checkpoint(other, late, None) == type(chosen)(late.checkpoints / "00000005-e1", 5, 1)
