"""Worlds beyond memory: told before anything is built, with what they need and what fits."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import pytest
import torch

from worker.distributed import Gang, Placement
from worker.errors import UserError, is_out_of_memory
from worker.learning import memory
from worker.learning.algorithms import find_algorithm
from worker.learning.ppo.fused import PPO
from worker.learning.rsl.settings import RslRlConfig
from worker.learning.sac.settings import SACConfig
from worker.tasks.cartpole import Cartpole, CartpoleConfig
from worker.tasks.config import Randomization

HERE = Gang(Placement(), "cpu", None, ["here"])
CONFIG = CartpoleConfig()
LEARNER = PPO, CONFIG.ppo


def test_too_many_worlds_are_refused_before_they_are_built() -> None:
    free = memory.free_bytes(HERE)
    with pytest.raises(UserError) as refusal, memory.within_memory(Cartpole, CONFIG, LEARNER, 200_000_000, HERE):
        pytest.fail("they are not to be built")
    found = re.fullmatch(
        r"worlds: 200,000,000 worlds of Cartpole on rank 0 need more memory than the ([\d.]+) GB that are free: about ([\d,.]+) GB. "
        r"About ([\d,]+) fit: set `worlds`",
        str(refusal.value),
    )
    assert found, refusal.value
    assert float(found[1]) == pytest.approx(free / 1e9, rel=0.2)
    # a rollout of 16 steps alone has 16 x (4 states twice, their latents, noise, samples, ...) floats: 1 to 40 KB a world,
    # and what the allocator of a process of many tests holds besides
    assert 200 < float(found[2].replace(",", "")) < 16_000
    fit = int(found[3].replace(",", ""))
    assert fit == pytest.approx(0.9 * free / (float(found[2].replace(",", "")) * 1e9 / 200e6), rel=0.25)


def test_fitting_worlds_continue_and_other_errors_are_unchanged() -> None:
    with memory.within_memory(Cartpole, CONFIG, LEARNER, 64, HERE):
        pass
    with pytest.raises(RuntimeError, match="something else"), memory.within_memory(Cartpole, CONFIG, LEARNER, 64, HERE):
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
    there = r"^worlds: 64 worlds of Cartpole on rank 0 need more memory than there is; set fewer"
    with pytest.raises(UserError, match=there), memory.within_memory(Cartpole, CONFIG, LEARNER, 64, HERE):
        raise error  # 64 worlds would fit: somebody else took it
    monkeypatch.setattr(memory, "free_bytes", lambda gang: 100_000)
    little = r"than the 0.0 GB that are free: about 0.0 GB. (About \d+ fit|Not even one fits): set "
    with pytest.raises(UserError, match=little), memory.within_memory(Cartpole, CONFIG, LEARNER, 64, HERE):
        raise error
    with pytest.raises(type(error)), memory.within_memory(Cartpole, CONFIG, LEARNER, 64, HERE, lambda: False):
        raise error  # long after the start: not the worlds' fault, and not the user's


DISTILLATION = RslRlConfig(algorithm={"class_name": "Distillation"}, teacher_checkpoint="taught")
LEARNERS: dict[str, tuple[str, Any]] = {
    "ppo": ("ppo", CONFIG.ppo),
    "sac": ("sac", CONFIG.sac),
    "rsl_rl's PPO": ("rsl_rl", RslRlConfig()),
    "rsl_rl's Distillation": ("rsl_rl", DISTILLATION),
}


@pytest.mark.parametrize("name", LEARNERS)
def test_the_memory_of_worlds_is_measured_for_every_algorithm(name: str) -> None:
    algorithm, settings = LEARNERS[name]
    there = r"About [\d,]+ fit: set `worlds`$"
    learner = find_algorithm(algorithm), settings
    with pytest.raises(UserError, match=there), memory.within_memory(Cartpole, CONFIG, learner, 200_000_000, HERE):
        pytest.fail("they are not to be built")


def test_a_batch_of_sac_is_measured_although_the_first_iteration_only_collects() -> None:
    def need(settings: SACConfig) -> memory.Need:
        return memory.measure(Cartpole, CONFIG, (find_algorithm("sac"), settings), HERE)

    few = need(dataclasses.replace(CONFIG.sac, updates=2, warm_up=3000))
    many = need(dataclasses.replace(CONFIG.sac, updates=2, warm_up=3000, batch_size=65_536))
    # of each sample of a batch at least what goes through two critics of two layers of 64, and 51 atoms, with gradients
    assert many.fixed - few.fixed > 65_000 * 2 * (64 + 64 + 51) * 4
    # 1024 steps of 2 x 4 states, an action and 3 outcomes
    assert few.world == pytest.approx(1024 * 12 * 4, rel=0.5) and many.world < 3 * few.world


def test_constant_memory_leaves_less_for_the_worlds() -> None:
    told = memory._explain(Cartpole, 1000, HERE, 10_000_000, memory.Need(4.5e6, 9_000.0))
    assert told.endswith("than the 0.0 GB that are free: about 0.0 GB. About 500 fit: set `worlds`")
    told = memory._explain(Cartpole, 1000, HERE, 10_000_000, memory.Need(9e6, 9_000.0))
    assert told.endswith("Not even one fits: set smaller networks or batches")


def test_settings_that_cannot_be_are_the_users_error_here_too() -> None:
    pushed = {"push_interval": 1.0, "push_velocity": 1.0}
    refused = dataclasses.replace(CONFIG, randomize=Randomization(**pushed))
    with (
        pytest.raises(UserError, match="the robot is fixed"),
        memory.within_memory(Cartpole, refused, LEARNER, 9000, HERE),
    ):
        pytest.fail("nothing is to be built")
