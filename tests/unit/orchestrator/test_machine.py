"""Pools of threads for calls that may hang."""

from __future__ import annotations

import threading
from concurrent.futures import wait

import pytest

from orchestrator import machine
from orchestrator.machine import ThreadPool
from tests.support.waiting import wait_for


def threads(name: str) -> int:
    return sum(thread.name == name for thread in threading.enumerate())


def test_idle_threads_end_and_later_calls_are_carried_out_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "_IDLE", 0.05)
    pool, at_once = ThreadPool("a pool that idles", 8, None), threading.Barrier(8)
    for _ in range(2):
        calls = [pool.submit(lambda: at_once.wait(10)) for _ in range(8)]
        assert sorted(call.result(10) for call in calls) == list(range(8))
        wait_for(lambda: threads("a pool that idles") == 0, 10, "that the threads end")
    pool.close()


def test_a_thread_that_works_does_not_end_and_no_call_is_lost_beside_threads_that_do(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(machine, "_IDLE", 0.0)  # a thread ends at every moment at which no call is there
    pool, answers = ThreadPool("a busy pool", 3, None), threading.Event()
    held = pool.submit(lambda: answers.wait(10))
    done = []
    for number in range(500):
        done.append(pool.submit(lambda number=number: number))
        if number % 7 == 0:
            wait(done)
    assert [call.result(10) for call in done] == list(range(500))
    assert pool.busy_since is not None and not held.done()
    answers.set()
    assert held.result(10)
    wait_for(lambda: threads("a busy pool") == 0, 10, "that the threads end")
    assert pool.busy_since is None
    pool.close(1.0)
