"""The comparison of two runs: it sees every bit, and names the first that differs."""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.layout import Run, Store
from shared_store.volume.metrics import read_metrics
from tests.support.worker.ranks import training
from tests.support.worker.runs import train
from worker import bitwise_diff
from worker.learning.shards import Shards
from worker.settings.errors import UserError


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with three short runs: ``one`` and ``twin`` of the same seed, ``other`` of another."""
    store = tmp_path_factory.mktemp("store")
    for run, seed in (("one", 3), ("twin", 3), ("other", 4)):
        train(training(store, run=run, iterations=3, seed=seed))
    return store


@pytest.fixture
def store(trained: Path, tmp_path: Path) -> Path:
    """The same, to be damaged."""
    return Path(shutil.copytree(trained, tmp_path / "store"))


def run(store: Path, name: str) -> Run:
    return Store(store).run(name)


def say(store: Path, first: str, second: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Exit code and output of the command."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["bitwise_diff", *(str(run(store, name).path) for name in (first, second))])
        return bitwise_diff.main(), capsys.readouterr().out


def test_twins_are_equal_and_another_seed_is_not(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, output = say(trained, "one", "twin", capsys)
    assert code == 0 and re.search(r"^equal: \d+ tensors, 3 iterations\n$", output, re.MULTILINE)
    code, output = say(trained, "one", "other", capsys)
    number = r"-?\d+\.\d+(e-\d+)?"
    line = rf"different: learner.pt: algorithm\.\S+: at \[[\d, ]*\]: {number} and {number} \(\d+ of \d+ elements differ\)\n"
    assert code == 1 and re.search(line, output), output


@pytest.mark.parametrize("name", ["learner.pt", "rank-0.pt"])
def test_one_bit_of_one_element_is_found(store: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = list_checkpoints(run(store, "twin"))[-1].path / name
    content = torch.load(path, weights_only=True)
    tensors = {key: value for key, value in bitwise_diff._flatten(content) if isinstance(value, torch.Tensor)}
    key, victim = next(pair for pair in tensors.items() if pair[1].dtype == torch.float32 and pair[1].dim())
    victim.view(torch.int32).view(-1)[-1] ^= 1
    torch.save(content, path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("shared_store.volume.checkpoints.Checkpoint.verify", lambda _: None)
        code, output = say(store, "one", "twin", capsys)
    last = [size - 1 for size in victim.shape]
    assert code == 1 and f"{key.rpartition('.')[2]}: at {last}: " in output and "(1 of " in output, output


@pytest.mark.parametrize(
    ("one", "two", "difference"),
    [
        (torch.tensor([0.0, 0.0]), torch.tensor([0.0, -0.0]), "at [1]: 0.0 and -0.0"),
        (torch.tensor([[1, 2], [3, 4]]), torch.tensor([[1, 2], [5, 4]]), "at [1, 0]: 3 and 5 (1 of 4 elements differ)"),
        (torch.zeros(2), torch.zeros(3), "torch.float32 [2] and torch.float32 [3]"),
        (1, 1.0, "1 and 1.0"),
        (None, {"a": 1}, "only one of the two has it"),
        ({"a": [1, {"b": 2}]}, {"a": [1, {"b": 3}]}, "a.1.b: 2 and 3"),
    ],
)
def test_differing_values_are_reported(one: Any, two: Any, difference: str) -> None:
    with pytest.raises(bitwise_diff.Difference, match=re.escape(difference)):
        bitwise_diff._compare_values("file", one, two)


def test_not_a_number_equals_itself() -> None:
    values = {"a": torch.tensor([float("nan")]), "b": float("nan"), "c": None, "d": []}
    assert bitwise_diff._compare_values("file", values, {**values, "a": values["a"].clone(), "b": float("nan")}) == 1


def test_metrics_are_compared_but_not_times(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = run(store, "twin").metrics / "metrics-e1.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert any(line.get("steps_per_second") for line in lines)
    lines[2] |= {"time": 1.0, "iteration_seconds": 9.0, "steps_per_second": 2.0}
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert say(store, "one", "twin", capsys)[0] == 0
    lines[2]["kl"] += 1e-12
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    code, output = say(store, "one", "twin", capsys)
    assert code == 1 and f"different: metrics of iteration {lines[2]['iteration']}: kl: " in output
    path.write_text("".join(json.dumps(line) + "\n" for line in lines if line.get("iteration") != 2))
    code, output = say(store, "one", "twin", capsys)
    assert code == 1 and "run twin has 2 of 3 iterations (look at 2)" in output
    assert len(read_metrics(run(store, "twin"))) == 2


def test_worlds_are_compared_by_global_index_whatever_shards_they_lie_in(
    store: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The worlds of one rank, split over two by hand."""
    checkpoint = list_checkpoints(run(store, "twin"))[-1]
    content = torch.load(checkpoint.path / "rank-0.pt", weights_only=True)
    for rank, (first, last) in enumerate(((0, 3), (3, 8))):
        state = {name: tensor[first:last].clone() for name, tensor in content["worlds"]["state"].items()}
        torch.save({**content, "worlds": {"state": state}}, checkpoint.path / f"rank-{rank}.pt")
    manifest = {**checkpoint.manifest, "shards": [[0, 3], [3, 5]], "world_size": 2}
    (checkpoint.path / "manifest.json").write_text(json.dumps(manifest))
    monkeypatch.setattr("shared_store.volume.checkpoints.Checkpoint.verify", lambda _: None)
    code, output = say(store, "one", "twin", capsys)
    assert code == 0 and "generators are not compared: 1 rank saved them in one run, 2 in the other" in output, output
    some = Shards(list_checkpoints(run(store, "twin"))[-1]).worlds(2, 4)
    assert all(torch.equal(tensor, content["worlds"]["state"][name][2:6]) for name, tensor in some.items())


def test_files_that_cannot_be_compared_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUSTER_STORE", raising=False)
    with pytest.raises(UserError, match="run some: set MUSTER_STORE"):
        bitwise_diff.find_run("some")
    monkeypatch.setenv("MUSTER_STORE", str(tmp_path))
    with pytest.raises(UserError, match="run some does not exist"):
        bitwise_diff.find_run("some")
    (tmp_path / "runs" / "some" / "checkpoints").mkdir(parents=True)
    with pytest.raises(UserError, match="run some has no checkpoint in"):
        bitwise_diff.compare(bitwise_diff.find_run("some"), bitwise_diff.find_run(str(tmp_path / "runs" / "some")))
