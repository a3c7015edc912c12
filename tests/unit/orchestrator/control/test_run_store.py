"""Calls on the store for attempts that are closed before these return."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

from orchestrator.control.peers import Peers
from orchestrator.control.run_store import Errands, RunStore, StoreUnavailable
from shared_store.volume.epoch import Claim, read_claim, read_epoch
from shared_store.volume.layout import Store
from tests.support.orchestrator.slow_pool import SlowPool


class Attempts:
    """Two attempts on a run: the first one is closed while its call is under way."""

    def __init__(self, home: Path) -> None:
        self.pool, store = SlowPool(), Store(home)
        self.run = store.run("run")
        self.runs = RunStore(store, Peers(store, home))
        self.errands = Errands(self.pool, str(home), lambda _: None)

    def claim(self, number: int, after: int) -> int | None:
        claim = Claim(self.runs.peers.id, "job", number)
        return self.errands.result(("job", number), "claim", partial(self.runs.claim, "run", {}, after, claim))

    def close(self, number: int, epoch: int | None = None) -> None:
        self.errands.forget(("job", number), "run", partial(self.runs.release, "run"), epoch)


@pytest.fixture
def attempts(tmp_path: Path) -> Attempts:
    return Attempts(tmp_path)


def test_the_next_attempt_on_a_run_waits_for_the_call_of_the_one_before(attempts: Attempts) -> None:
    attempts.claim(1, 0)
    attempts.errands.await_earlier("run")  # its own calls do not hold up an attempt
    attempts.close(1)
    attempts.errands.await_earlier("another run")
    with pytest.raises(
        StoreUnavailable, match=r": can't read run run now \(it has not answered the attempt before yet"
    ):
        attempts.errands.await_earlier("run")
    attempts.pool.carry_out()
    attempts.errands.await_earlier("run")
    attempts.claim(2, read_epoch(attempts.run))
    while attempts.pool.calls:
        attempts.pool.carry_out()
    assert attempts.claim(2, 1) == 2 == read_epoch(attempts.run)
    attempts.close(2, 2)
    attempts.pool.carry_out()
    assert read_claim(attempts.run, 2) is None and not attempts.pool.calls
    assert not attempts.errands.pause(("job", 2))


def test_a_late_claim_that_fails_leaves_nothing_to_release(attempts: Attempts) -> None:
    attempts.run.path.mkdir(parents=True)
    (attempts.run.path / "EPOCH").write_text("damaged")
    attempts.claim(1, 0)
    attempts.close(1)
    attempts.pool.carry_out()
    assert not attempts.pool.calls
    attempts.errands.await_earlier("run")
