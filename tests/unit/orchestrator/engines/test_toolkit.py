"""What engines share: the environment of what they start, and waiting with an end."""

from __future__ import annotations

import pytest

from orchestrator.engines.toolkit.environment import PRIVATE, inherited
from orchestrator.engines.toolkit.waiting import wait_until


def test_what_is_started_inherits_all_but_the_controller_s_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "os.environ", {name: "secret" for name in PRIVATE} | {"HOME": "/root", "PGHOST": "db", "A": "1"}
    )
    assert inherited() == {"HOME": "/root", "PGHOST": "db", "A": "1"}
    assert inherited(["A"], ("PG",), kept=["RAY_AUTH_TOKEN"]) == {"HOME": "/root", "RAY_AUTH_TOKEN": "secret"}
    assert inherited(["A"], ("PG",), kept=["PGHOST"]) == {"HOME": "/root", "PGHOST": "db"}


def test_waiting_ends_when_the_condition_holds_or_the_time_is_over() -> None:
    looks = iter([False, False, True])
    assert wait_until(lambda: next(looks), 60.0, 0.0) and next(looks, None) is None
    assert not wait_until(lambda: False, 0.0)
    assert wait_until(lambda: True, 0.0), "it looks once at least"
