"""Worlds beyond memory: reported before anything is built, with what they need and what fits."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from gc import freeze, unfreeze
from typing import Any

import pytest
import torch

from tests.support.worker.loop import alone
from tests.support.worker.point_task import TASK as POINT
from tests.support.worker.point_task import PointConfig
from worker.learning import memory_estimate
from worker.learning.algorithms import find_algorithm
from worker.learning.ppo.fused import PPO
from worker.settings.errors import UserError, is_out_of_memory
from worker.settings.rsl_rl import RslRlConfig
from worker.settings.sac import SACConfig
from worker.tasks.library.cartpole import CartpoleConfig

torch.set_num_threads(1)
HERE = alone()
CONFIG: Any = PointConfig()
"""Of worlds that are built in no time; what an algorithm takes of each is measured as with any others."""
LEARNER = PPO, CONFIG.ppo


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Smaller builds than a rank's; and each collects garbage twice, of which what was there before is no part."""
    monkeypatch.setattr(memory_estimate, "MORE", 512)
    freeze()
    yield
    unfreeze()


def test_fitting_worlds_continue_and_other_errors_are_unchanged() -> None:
    with memory_estimate.within_memory(POINT, CONFIG, LEARNER, 64, HERE):
        pass
    with (
        pytest.raises(RuntimeError, match="something else"),
        memory_estimate.within_memory(POINT, CONFIG, LEARNER, 64, HERE),
    ):
        raise RuntimeError("something else")


FULL = (
    torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB"),
    RuntimeError("Failed to allocate 123 bytes on device 'cuda:0'"),
    RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 27648000000 bytes"),
    MemoryError(),
)


def test_a_failed_allocation_is_reported_as_such(monkeypatch: pytest.MonkeyPatch) -> None:
    assert all(is_out_of_memory(error) for error in FULL)
    assert not is_out_of_memory(RuntimeError("shapes do not fit"))
    assert not is_out_of_memory(ValueError("the memory of a GRU is of no use here"))
    error = FULL[0]
    existing = r"^worlds: 64 worlds of Point on rank 0 need more memory than there is; set fewer"
    with pytest.raises(UserError, match=existing), memory_estimate.within_memory(POINT, CONFIG, LEARNER, 64, HERE):
        raise error  # 64 worlds would fit: another process took it
    monkeypatch.setattr(memory_estimate, "free_bytes", lambda gang: 100_000)
    little = r"than the 0.0 GB that are free: about 0.0 GB. (About \d+ fit|Not even one fits): set "
    with pytest.raises(UserError, match=little), memory_estimate.within_memory(POINT, CONFIG, LEARNER, 64, HERE):
        raise error
    with pytest.raises(type(error)), memory_estimate.within_memory(POINT, CONFIG, LEARNER, 64, HERE, lambda: False):
        raise error  # long after the start: not the worlds' fault, and not the user's


DISTILLATION = RslRlConfig(algorithm={"class_name": "Distillation"}, teacher_checkpoint="taught")
LEARNERS: dict[str, tuple[str, Any]] = {
    "ppo": ("ppo", CartpoleConfig().ppo),
    "sac": ("sac", CartpoleConfig().sac),
    "rsl_rl's PPO": ("rsl_rl", RslRlConfig()),
    "rsl_rl's Distillation": ("rsl_rl", DISTILLATION),
}


@pytest.mark.parametrize("name", LEARNERS)
def test_more_worlds_than_fit_are_refused_before_they_are_built_whatever_learns(name: str) -> None:
    algorithm, settings = LEARNERS[name]
    learner = find_algorithm(algorithm), settings
    existing = (
        r"^worlds: 200,000,000 worlds of Point on rank 0 need more memory than the [\d.]+ GB that are free: "
        r"about [\d,.]+ GB\. About [\d,]+ fit: set `worlds`$"
    )
    with (
        pytest.raises(UserError, match=existing),
        memory_estimate.within_memory(POINT, CONFIG, learner, 200_000_000, HERE),
    ):
        pytest.fail("they are not to be built")


def test_a_batch_of_sac_is_measured_although_the_first_iteration_only_collects() -> None:
    def need(settings: SACConfig) -> memory_estimate.Need:
        return memory_estimate.measure(POINT, CONFIG, (find_algorithm("sac"), settings), HERE)

    sac = dataclasses.replace(CartpoleConfig().sac, updates=2, warm_up=3000)
    few, many = need(sac), need(dataclasses.replace(sac, batch_size=32_768))
    # of each sample of a batch at least what goes through two critics of two layers of 64, and 51 atoms, with gradients
    assert many.fixed - few.fixed > 32_000 * 2 * (64 + 64 + 51) * 4
    assert few.world > 0.0
