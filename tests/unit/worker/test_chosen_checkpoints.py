"""The checkpoint that the main rank chooses is that of every rank, whether the others see it in the directory or not."""

from __future__ import annotations

import io
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist

from shared_store.volume.layout import Store
from tests.support.orchestrator.trained import add_checkpoint, add_run
from worker.learning.distributed import Gang, RankPlacement
from worker.learning.job import Job
from worker.learning.loaded_weights import load_teacher
from worker.learning.trained import choose_checkpoint
from worker.settings.errors import UserError


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


class Pupil:
    """An algorithm with a teacher, as far as that matters here."""

    def __init__(self, teacher_checkpoint: str) -> None:
        self.teacher_checkpoint = teacher_checkpoint
        self.learnt: Mapping[str, Any] | None = None

    def load_teacher(self, state: Mapping[str, Any]) -> None:
        self.learnt = state


@pytest.mark.parametrize(("reference", "weight"), [("taught", 5), ("taught@3", 3)])
@pytest.mark.parametrize("copied", [False, True])
def test_every_rank_takes_the_teacher_from_where_the_main_rank_found_it(
    store: Store, gangs: list[Gang], copied: bool, reference: str, weight: int
) -> None:
    run = store.run("pupil")
    if copied:
        shutil.copytree(store.run("taught").path, run.teacher("taught").path)
        shutil.rmtree(store.run("taught").path)
    job = Job({}, store, run, 1, 1, "job", None, None, {})
    pupils = [Pupil(reference) for _ in gangs]
    for gang, pupil in zip(gangs, pupils, strict=True):
        load_teacher(job, gang, pupil, None)
    assert [pupil.learnt for pupil in pupils] == [{"weight": weight}] * 2


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


def test_every_rank_is_refused_a_checkpoint_that_does_not_exist(store: Store, gangs: list[Gang]) -> None:
    for gang in gangs:
        with pytest.raises(UserError, match=r"^run taught has no checkpoint 4; there are: 3, 5$"):
            choose_checkpoint(gang, store.run("taught"), 4)
