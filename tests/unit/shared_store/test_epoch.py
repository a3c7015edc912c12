"""The epoch of a run only grows, and an attempt that it left behind is told so."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from shared_store.epoch import (
    LARGEST_EPOCH,
    Claim,
    StaleEpoch,
    check_epoch,
    close_claim,
    raise_epoch,
    read_claim,
    read_epoch,
    take_epoch,
)
from shared_store.files import write_atomic
from shared_store.layout import Run
from tests.conftest import PATIENCE, REPOSITORY
from tests.support.shared_store.crashes import killed_at_every_step


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


def test_the_owner_passes_the_fence_and_the_previous_attempt_does_not(tmp_path: Path) -> None:
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


@pytest.mark.parametrize("content", ["", "seven", "1.5", "-1", "9" * 16, "9" * 30, "1\n2"])
def test_a_damaged_epoch_is_named_with_its_value(tmp_path: Path, content: str) -> None:
    (tmp_path / "EPOCH").write_text(content)
    with pytest.raises(ValueError) as refused:
        read_epoch(Run(tmp_path))
    assert str(refused.value) == f"{tmp_path}/EPOCH: expected a whole number of at most 15 digits, found {content!r}"


def test_an_epoch_of_any_length_is_read_in_part(tmp_path: Path) -> None:
    (tmp_path / "EPOCH").write_bytes(b"9" * 10_000_000)
    with pytest.raises(ValueError, match=f"found '{'9' * 32}'$"):
        read_epoch(Run(tmp_path))


def test_no_epoch_follows_the_largest(tmp_path: Path) -> None:
    run = Run(tmp_path)
    raise_epoch(run, LARGEST_EPOCH)
    with pytest.raises(ValueError, match=f"EPOCH: no epoch is left after {LARGEST_EPOCH}"):
        take_epoch(run, LARGEST_EPOCH, Claim("a", "job", 1))
    assert read_epoch(run) == LARGEST_EPOCH


TAKE = """
import sys
from pathlib import Path
from shared_store.epoch import Claim, StaleEpoch, read_epoch, take_epoch
from shared_store.layout import Run
run = Run(Path(sys.argv[1]))
sys.stdin.readline()
taken = 0
while taken < 30:
    try:
        print(take_epoch(run, read_epoch(run), Claim(sys.argv[2], "job", taken)), flush=True)
        taken += 1
    except StaleEpoch:
        pass
"""


def test_controllers_that_take_epochs_at_once_never_get_the_same(tmp_path: Path) -> None:
    takers = [
        subprocess.Popen(
            [sys.executable, "-c", TAKE, str(tmp_path / "run"), name],
            cwd=REPOSITORY,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for name in ("a", "b", "c")
    ]
    for taker in takers:
        assert taker.stdin is not None
        taker.stdin.write("go\n")
        taker.stdin.flush()
    taken = [int(line) for taker in takers for line in taker.communicate(timeout=60 * PATIENCE)[0].split()]
    assert len(taken) == len(set(taken)) == 90
    run = Run(tmp_path / "run")
    assert read_epoch(run) in taken
    claims = {int(path.suffix[1:]) for path in run.path.glob("EPOCH.*")}
    assert max(claims) >= max(taken) and min(claims) >= read_epoch(run) - 64, "old claims are cleared away"


def test_an_epoch_that_another_controller_claimed_but_did_not_publish_is_passed_over(tmp_path: Path) -> None:
    run = Run(tmp_path)
    raise_epoch(run, 4)
    (tmp_path / "EPOCH.5").touch()
    with pytest.raises(StaleEpoch, match="another attempt has epoch 5"):
        raise_epoch(run, 5)
    assert take_epoch(run, 4, Claim("a", "job", 1)) == 6
    assert read_epoch(run) == 6


def test_a_controller_that_claims_second_leaves_the_run_to_the_first(tmp_path: Path) -> None:
    run = Run(tmp_path)
    raise_epoch(run, 4)
    (tmp_path / "EPOCH.5").write_text('{"controller": "b", "job": "job", "attempt": 1}')
    first = threading.Timer(0.2, lambda: write_atomic(tmp_path / "EPOCH", b"5\n"))
    first.start()
    with pytest.raises(StaleEpoch, match=r"another controller has just taken run .* with epoch 5"):
        take_epoch(run, 4, Claim("a", "job", 1))
    first.join()
    assert read_epoch(run) == 5
    with pytest.raises(StaleEpoch, match="has just taken"):
        take_epoch(run, 4, Claim("a", "job", 1))  # decided before the other controller had published


def test_an_own_claim_of_before_a_crash_is_passed_over_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shared_store.epoch._PUBLICATION", 600.0)
    run, claim = Run(tmp_path), Claim("a", "job", 1)
    raise_epoch(run, 4)
    (tmp_path / "EPOCH.5").write_text('{"controller": "a", "job": "other", "attempt": 1}')
    assert take_epoch(run, 4, claim) == 6


def test_of_two_that_publish_at_the_same_instant_one_alone_owns_the_run(tmp_path: Path) -> None:
    run = Run(tmp_path)
    raise_epoch(run, 5)
    raise_epoch(run, 6)
    (tmp_path / "EPOCH").write_text("5\n")  # written by a controller that had looked before 6 was published
    check_epoch(run, 5)
    with pytest.raises(StaleEpoch, match="this attempt has epoch 6, the run now belongs to epoch 5"):
        check_epoch(run, 6)


def test_a_claim_names_the_attempt_until_it_is_closed_and_its_number_stays_taken(tmp_path: Path) -> None:
    run = Run(tmp_path)
    claim = Claim("controller", "job", 3)
    assert take_epoch(run, 7, claim) == 8
    assert read_claim(run, 8) == claim
    close_claim(run, 8)
    close_claim(run, 7)  # never made: nothing to close
    assert read_claim(run, 8) is None and read_claim(run, 7) is None
    with pytest.raises(StaleEpoch):
        raise_epoch(run, 8)
    for damage in (b"{", b"[1]", b"[" * 5000, b'{"controller": 1}', b"\xff"):
        (tmp_path / "EPOCH.8").write_bytes(damage)
        assert read_claim(run, 8) is None
