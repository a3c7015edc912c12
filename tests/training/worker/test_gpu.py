"""What only a GPU shows: capture, silence of the host, and that a graph does what the same code does eagerly."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Any

import pytest
import torch
import warp as wp
from torch import nn

from tests.support.worker.on_device import has_a_row_for_each_step, iterates_without_waiting, training_of
from worker.learning.cuda_graph import CudaGraphFunction
from worker.learning.host_copies import HostCopies
from worker.learning.ppo import linear_layers as linear
from worker.settings.cartpole import CartpoleConfig
from worker.tasks.library.cartpole import Cartpole
from worker.tasks.run.task import Task

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "Cartpole": ("Cartpole", {}),
    "Ant": ("Ant", {}),
    "images": ("CartpolePixels", {}),
    "a camera on a body": ("tests.support.worker.seeing:SeeingDepth", {}),
    "a critic of its own": (
        "Cartpole",
        {
            "config": {"randomize": {"observation_noise": 0.02}},
            "ppo": {"critic_observations": "critic", "critic_hidden_sizes": [40]},
        },
    ),
    "AdamW": ("Cartpole", {"ppo": {"optimizer": "adamw", "weight_decay": 0.01, "schedule": "fixed"}}),
    "sac": ("Cartpole", {"algorithm": "sac"}),
}


def runner(store: Path, case: str):
    task, train = CASES[case]
    return training_of(store, task, train)


@pytest.mark.parametrize("case", CASES)
def test_an_iteration_is_a_few_graphs_and_never_waits_for_the_device(tmp_path: Path, case: str) -> None:
    iterates_without_waiting(tmp_path, *CASES[case])


@pytest.mark.parametrize("case", ["Cartpole", "a critic of its own", "AdamW", "sac"])
def test_a_graph_computes_what_the_same_code_computes_eagerly(tmp_path: Path, case: str) -> None:
    """Over few iterations: what differs in the last bits grows. Without contacts, whose order on a GPU is another in each run."""
    found = []
    for eager in (False, True):
        training = runner(tmp_path / str(eager), case)
        if eager:
            for part in (training._collecting, *training.algorithm.graphs):
                part._cuda = False
        for _ in range(5):
            record = training._iterate()[0]
        figures = torch.tensor([value for name, value in record.items() if name.endswith("_loss")])
        weights = training.algorithm.policy().state_dict().values()
        found.append((figures, torch.cat([each.detach().double().flatten() for each in weights])))
    torch.testing.assert_close(found[0][0], found[1][0], rtol=5e-3, atol=1e-4)
    torch.testing.assert_close(found[0][1], found[1][1], rtol=5e-3, atol=5e-4)


def test_no_garbage_is_collected_while_a_graph_is_recorded() -> None:
    found = []
    part = CudaGraphFunction(lambda: found.append(gc.isenabled()), "cuda:0", "part")
    for _ in range(3):
        part()
    assert found == [True, False] and part.captured and gc.isenabled()


@pytest.mark.parametrize(("inputs", "outputs"), [(35, 8), (40, 1)])
def test_padded_products_and_their_gradients_are_those_of_the_network(inputs: int, outputs: int) -> None:
    torch.manual_seed(0)
    mlp = nn.Sequential(nn.Linear(inputs, 64), nn.ELU(), nn.Linear(64, outputs)).to("cuda:0", torch.float64)
    x = torch.randn(512, inputs, device="cuda:0", dtype=torch.float64)
    wide = torch.zeros(512, linear.padded(inputs, "cuda:0"), device="cuda:0", dtype=torch.float64)
    wide[:, :inputs] = x
    weights = torch.randn(512, outputs, device="cuda:0", dtype=torch.float64)
    expected = mlp(x)
    (expected * weights).sum().backward()
    gradients = [parameter.grad for parameter in mlp.parameters()]
    for parameter in mlp.parameters():
        parameter.grad = torch.full_like(parameter, 7.0)  # what was there is written over
    found = linear.forward(mlp, wide, torch.ones(512, device="cuda:0", dtype=torch.float64))
    (found * weights).sum().backward()
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(linear.forward(mlp, wide), expected)
    for parameter, gradient in zip(mlp.parameters(), gradients, strict=True):
        torch.testing.assert_close(parameter.grad, gradient)


def test_a_task_has_its_weights_however_late_warps_own_stream_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clearing a buffer there after torch had filled it left one training in ten without rewards."""
    allocate, rows = Task._allocate, wp.zeros(1 << 28, dtype=wp.float32, device="cuda:0")

    def behind(self: Task) -> None:
        for _ in range(200):
            rows.fill_(1.0)
        allocate(self)

    monkeypatch.setattr(Task, "_allocate", behind)
    with torch.cuda.stream(torch.cuda.Stream()):
        task = Cartpole(CartpoleConfig(), 8, seed=0, device="cuda:0")
        assert torch.equal(task._weights.cpu(), torch.tensor(list(task.config.rewards.values())))
        assert float(task.level) == 1.0


def test_copies_are_of_the_moment_they_were_taken_whatever_the_device_does_afterwards(tmp_path: Path) -> None:
    state = {
        "weights": torch.arange(7.0, device="cuda"),
        "transposed": torch.arange(6.0, device="cuda").view(2, 3).t(),
        "flags": torch.tensor([True, False, True], device="cuda"),
        "count": torch.tensor(5, device="cuda", dtype=torch.int64),
        "half": torch.full((3, 2), 0.5, device="cuda", dtype=torch.bfloat16),
        "none": torch.empty(0, 4, device="cuda"),
        "here": [torch.ones(2), 3, "name"],
    }
    expected = {name: value.cpu().clone() for name, value in state.items() if name != "here"}
    copies, work = HostCopies(), torch.zeros(4096, 4096, device="cuda")
    for _ in range(20):  # the device is behind the host
        work @ work
    copied = copies.take(state)
    for name in expected:
        state[name].zero_()
    copies.wait()
    torch.save(copied, tmp_path / "all.pt")
    torch.save({"count": copied["count"]}, tmp_path / "one.pt")
    loaded = torch.load(tmp_path / "all.pt", weights_only=True)
    assert loaded["here"][1:] == [3, "name"] and torch.equal(loaded["here"][0], torch.ones(2))
    for name, value in expected.items():
        assert loaded[name].dtype == value.dtype and torch.equal(loaded[name], value), name
    assert (tmp_path / "one.pt").stat().st_size < 2000, "a file holds its own tensors alone"


def test_copies_of_a_state_that_grows_and_shrinks_are_right() -> None:
    copies = HostCopies()
    for length in (3, 1000, 10):
        state = {"replay": torch.rand(length, 5, device="cuda"), "place": torch.tensor(length, device="cuda")}
        copied = copies.take(state)
        copies.wait()
        assert torch.equal(copied["replay"], state["replay"].cpu()) and int(copied["place"]) == length


def test_each_control_step_of_a_rollout_is_one_row_however_late_the_device_is(tmp_path: Path) -> None:
    has_a_row_for_each_step(tmp_path, *CASES["Cartpole"])
