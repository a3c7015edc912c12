"""The epoch of a run only grows, and an attempt that it left behind is told so."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared_store.epoch import StaleEpoch, check_epoch, raise_epoch, read_epoch
from shared_store.layout import Run
from tests.shared_store.crashes import killed_at_every_step


def take_over(root: Path) -> None:
    raise_epoch(Run(root), 8)


def test_a_run_that_was_never_attempted_has_epoch_zero(tmp_path: Path) -> None:
    assert read_epoch(Run(tmp_path / "run")) == 0
    check_epoch(Run(tmp_path / "run"), 1)


def test_a_raised_epoch_is_read_back(tmp_path: Path) -> None:
    run = Run(tmp_path / "run")
    raise_epoch(run, 1)
    raise_epoch(run, 12)
    assert read_epoch(run) == 12
    assert (run.path / "EPOCH").read_text() == "12\n"


@pytest.mark.parametrize("epoch", [4, 5])
def test_an_epoch_never_goes_back_and_is_never_given_twice(tmp_path: Path, epoch: int) -> None:
    run = Run(tmp_path / "run")
    raise_epoch(run, 5)
    with pytest.raises(StaleEpoch, match=f"run run: epoch {epoch} does not follow 5"):
        raise_epoch(run, epoch)
    assert read_epoch(run) == 5


def test_the_owner_passes_and_the_attempt_before_it_does_not(tmp_path: Path) -> None:
    run = Run(tmp_path / "run")
    raise_epoch(run, 5)
    check_epoch(run, 5)
    with pytest.raises(StaleEpoch, match="run run: this attempt has epoch 4, the run now belongs to epoch 5"):
        check_epoch(run, 4)


def test_a_controller_killed_while_it_raises_the_epoch_leaves_the_old_or_the_new_one(tmp_path: Path) -> None:
    raise_epoch(Run(tmp_path / "prepared"), 7)
    left = killed_at_every_step(take_over, tmp_path / "prepared", tmp_path / "work")
    epochs = [read_epoch(Run(path)) for path in left]
    assert epochs == sorted(epochs)
    assert set(epochs) == {7, 8}


@pytest.mark.parametrize("content", ["", "seven", "1.5", "-1"])
def test_a_damaged_epoch_is_named_with_what_was_found(tmp_path: Path, content: str) -> None:
    (tmp_path / "EPOCH").write_text(content)
    with pytest.raises(ValueError, match=f"^{tmp_path}/EPOCH: expected a whole number, found '{content}'$"):
        read_epoch(Run(tmp_path))
