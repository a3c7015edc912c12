"""Requests that use a run and the one that deletes it keep each other out."""

from __future__ import annotations

import threading

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
