"""The epoch of a run only grows, and an attempt that it left behind is refused."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from shared_store.volume import epoch as module
from shared_store.volume.epoch import (
    LARGEST_EPOCH,
    Claim,
    StaleEpoch,
    check_epoch,
    close_claim,
    find_epoch,
    raise_epoch,
    read_claim,
    read_epoch,
    take_epoch,
)
from shared_store.volume.files import DamagedFile, write_atomic
from shared_store.volume.layout import Run, StoreError
from tests.support.shared_store.at_once import at_once
from tests.support.shared_store.crashes import killed_at_every_step
from tests.support.shared_store.operations import durable_operations


@pytest.fixture
def run(tmp_path: Path) -> Run:
    (tmp_path / "run").mkdir()
    return Run(tmp_path / "run")


def take_over(root: Path) -> None:
    raise_epoch(Run(root), 8)


def test_an_epoch_grows_from_zero_and_is_never_given_twice(run: Run) -> None:
    assert read_epoch(run) == 0
    check_epoch(run, 1)
    raise_epoch(run, 1)
    raise_epoch(run, 12)
    assert read_epoch(run) == 12 and (run.path / "EPOCH").read_text() == "12\n"
    for epoch in (11, 12):
        with pytest.raises(StaleEpoch, match=f"run run: epoch {epoch} does not follow 12"):
            raise_epoch(run, epoch)
    assert read_epoch(run) == 12
    check_epoch(run, 12)
    with pytest.raises(StaleEpoch, match="run run: this attempt has epoch 11, the run now belongs to epoch 12"):
        check_epoch(run, 11)


def test_a_controller_killed_while_it_raises_the_epoch_leaves_the_old_or_the_new_one(tmp_path: Path) -> None:
    raise_epoch(Run(tmp_path / "prepared"), 7)
    left = killed_at_every_step(take_over, tmp_path / "prepared", tmp_path / "work")
    epochs = [read_epoch(Run(path)) for path in left]
    assert epochs == sorted(epochs) and set(epochs) == {7, 8}


@pytest.mark.parametrize("content", ["", "seven", "1.5", "-1", "9" * 16, "9" * 30, "1\n2", "9" * 10_000_000])
def test_a_damaged_epoch_is_named_with_its_value(run: Run, content: str) -> None:
    (run.path / "EPOCH").write_text(content)
    with pytest.raises(ValueError) as refused:
        read_epoch(run)
    found = repr(content[:32])
    assert str(refused.value) == f"{run.path}/EPOCH: expected an integer of at most 15 digits, found {found}"


def test_no_epoch_follows_the_largest(run: Run) -> None:
    raise_epoch(run, LARGEST_EPOCH)
    with pytest.raises(ValueError, match=f"EPOCH: no epoch is left after {LARGEST_EPOCH}"):
        take_epoch(run, LARGEST_EPOCH, Claim("a", "job", 1))
    assert read_epoch(run) == LARGEST_EPOCH


def take_thirty(path: str, controller: str) -> list[int]:
    run, taken = Run(Path(path)), list[int]()
    while len(taken) < 30:
        try:
            taken.append(take_epoch(run, read_epoch(run), Claim(controller, "job", len(taken))))
        except StaleEpoch:
            pass
    return taken


def test_controllers_that_take_epochs_at_once_never_get_the_same(run: Run) -> None:
    taken = [epoch for each in at_once(take_thirty, [(str(run.path), name) for name in "abc"]) for epoch in each]
    assert len(taken) == len(set(taken)) == 90 and read_epoch(run) in taken
    claims = {int(path.suffix[1:]) for path in run.path.glob("EPOCH.*")}
    assert max(claims) >= max(taken) and min(claims) >= read_epoch(run) - 64, "old claims are cleared away"


def claimed(run: Run, controller: str) -> None:
    """Epoch 5, which is not published."""
    raise_epoch(run, 4)
    (run.path / "EPOCH.5").write_text(f'{{"controller": "{controller}", "job": "job", "attempt": 1}}')


@pytest.mark.parametrize(("controller", "seconds"), [("b", 0.01), ("a", 600.0)])
def test_an_epoch_that_is_not_published_in_time_is_passed_over_and_one_of_before_a_crash_at_once(
    run: Run, monkeypatch: pytest.MonkeyPatch, controller: str, seconds: float
) -> None:
    monkeypatch.setattr("shared_store.volume.epoch._PUBLICATION", seconds)
    claimed(run, controller)
    with pytest.raises(StaleEpoch, match="another attempt has epoch 5"):
        raise_epoch(run, 5)
    assert take_epoch(run, 4, Claim("a", "job", 1)) == 6 == read_epoch(run)


def test_a_controller_that_claims_second_leaves_the_run_to_the_first(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shared_store.volume.epoch._PUBLICATION", 600.0)
    claimed(run, "b")
    first = threading.Timer(0.05, lambda: write_atomic(run.path / "EPOCH", b"5\n"))
    first.start()
    with pytest.raises(StaleEpoch, match=r"another controller has just taken run .* with epoch 5"):
        take_epoch(run, 4, Claim("a", "job", 1))
    first.join()
    assert read_epoch(run) == 5
    with pytest.raises(StaleEpoch, match="has just taken"):
        take_epoch(run, 4, Claim("a", "job", 1))  # decided before the other controller had published


def test_of_two_that_publish_at_the_same_instant_one_alone_owns_the_run(run: Run) -> None:
    raise_epoch(run, 5)
    raise_epoch(run, 6)
    (run.path / "EPOCH").write_text("5\n")  # written by a controller that had looked before 6 was published
    check_epoch(run, 5)
    with pytest.raises(StaleEpoch, match="this attempt has epoch 6, the run now belongs to epoch 5"):
        check_epoch(run, 6)


def test_a_claim_names_the_attempt_until_it_is_closed_and_its_number_stays_taken(run: Run) -> None:
    claim = Claim("controller", "job", 3)
    assert take_epoch(run, 7, claim) == 8
    assert read_claim(run, 8) == claim
    close_claim(run, 8)
    close_claim(run, 7)  # never made: nothing to close
    assert read_claim(run, 8) is None and read_claim(run, 7) is None
    with pytest.raises(StaleEpoch):
        raise_epoch(run, 8)
    for damage in (b"{", b"[1]", b"[" * 5000, b'{"controller": 1}', b"\xff"):
        (run.path / "EPOCH.8").write_bytes(damage)
        assert read_claim(run, 8) is None


def test_a_node_starts_on_the_volume_on_which_its_epoch_is_published(run: Run) -> None:
    raise_epoch(run, 5)
    find_epoch(run, 5, patience=0)
    with pytest.raises(StaleEpoch, match="this attempt has epoch 4, the run now belongs to epoch 5"):
        find_epoch(run, 4, patience=0)
    with pytest.raises(StoreError, match="is not the controller's: run run has epoch 5 there, not 6") as caught:
        find_epoch(run, 6, patience=0)
    assert str(caught.value).startswith(f"store {run.path.parent.parent} on ")


def test_a_node_looks_again_at_the_directories_until_its_epoch_is_there(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    listed: list[Path] = []

    def sleep(seconds: float) -> None:
        assert 0 < seconds < 1
        raise_epoch(run, 7)

    monkeypatch.setattr(module.time, "sleep", sleep)
    monkeypatch.setattr(module.os, "listdir", lambda path: listed.append(path) or [])
    find_epoch(run, 7)
    assert listed[:2] == [run.path.parent, run.path]


def test_the_last_64_claims_are_kept_and_other_files(run: Run) -> None:
    for number in (1, 35, 36, 99):
        (run.path / f"EPOCH.{number}").touch()
    (run.path / "EPOCH.1.old").touch()
    raise_epoch(run, 100)
    kept = {"EPOCH", "EPOCH.1.old", "EPOCH.36", "EPOCH.99", "EPOCH.100"}
    assert set(os.listdir(run.path)) == kept


def test_a_number_is_durable_before_it_is_used(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = durable_operations(monkeypatch)
    raise_epoch(run, 3, Claim("a", "job", 2))
    claim, directory = ("fsync", str(run.path / "EPOCH.3")), ("fsync", str(run.path))
    assert seen.index(claim) < seen.index(directory) < seen.index(("rename", str(run.path / "EPOCH")))
    assert read_claim(run, 3) == Claim("a", "job", 2)
    seen.clear()
    close_claim(run, 3)
    assert seen == [claim] and read_claim(run, 3) is None


def test_a_run_that_is_a_link_is_neither_read_nor_claimed(run: Run, tmp_path: Path) -> None:
    raise_epoch(run, 1)
    link = Run(tmp_path / "link")
    link.path.symlink_to(run.path)
    for act in (
        lambda: read_epoch(link),
        lambda: raise_epoch(link, 2),
        lambda: close_claim(link, 1),
        lambda: take_epoch(link, 2, Claim("a", "job", 1)),
    ):
        with pytest.raises(DamagedFile):
            act()
