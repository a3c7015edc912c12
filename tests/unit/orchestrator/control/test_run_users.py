"""Requests that use a run and the one that deletes it keep each other out."""

from __future__ import annotations

import gc
import threading
import tracemalloc

from orchestrator.control.run_users import RunInUse, RunUsers


def test_requests_and_passes_at_once_never_share_a_run() -> None:
    users = RunUsers()
    taken, used = set[str](), set[str]()
    wrong: list[str] = []
    ending = threading.Event()

    def take() -> None:
        while not ending.is_set():
            for name in ("a", "b"):
                if users.take(name):
                    taken.add(name)
                    if name in used:
                        wrong.append(name)
                    taken.discard(name)
                    users.let_go(name)

    def use(name: str) -> None:
        for _ in range(3000):
            try:
                with users.using(name):
                    used.add(name)
                    if name in taken:
                        wrong.append(name)
                    used.discard(name)
            except RunInUse:
                pass

    taker = threading.Thread(target=take)
    taker.start()
    threads = [threading.Thread(target=use, args=(name,)) for name in "ab"]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    ending.set()
    taker.join()
    assert wrong == [] and users._users == {}


def test_a_deletion_changes_the_version_of_its_run_and_leaves_nothing_in_memory() -> None:
    users = RunUsers()
    users.take("warm")
    users.let_go("warm")
    gc.collect()
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for number in range(20_000):
            version = users.version(f"r{number}")
            assert users.take(f"r{number}") and users.version(f"r{number}") != version
            users.let_go(f"r{number}")
        assert tracemalloc.get_traced_memory()[0] - before < 20_000
    finally:
        tracemalloc.stop()
