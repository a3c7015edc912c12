"""One controller a home directory, and who waits for whom."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from orchestrator.home import ControllerRuns, HomeLock

URL = "http://127.0.0.1:9"


@pytest.fixture
def holder(tmp_path: Path) -> HomeLock:
    return HomeLock(tmp_path)


def while_it_waits(monkeypatch: pytest.MonkeyPatch, happens: Callable[[], object]) -> list[float]:
    """What happens in the first pause of who waits; returns its pauses."""
    pauses: list[float] = []

    def sleep(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) == 1:
            happens()

    monkeypatch.setattr(time, "sleep", sleep)
    return pauses


@pytest.mark.parametrize("temporary", [False, True])
def test_who_comes_while_another_starts_or_ends_gets_the_lock_when_that_is_gone(
    holder: HomeLock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, temporary: bool
) -> None:
    pauses = while_it_waits(monkeypatch, holder.release)
    HomeLock(tmp_path, temporary).release()
    assert len(pauses) == 1


def test_a_server_waits_for_a_command_s_controller_and_not_for_a_server(
    holder: HomeLock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pauses = while_it_waits(monkeypatch, holder.release)
    holder.publish(URL, True, "us-east-1", "sqlite:///d")
    HomeLock(tmp_path).release()
    assert len(pauses) == 1
    server = HomeLock(tmp_path)
    server.publish(URL, False, "us-east-1", "sqlite:///d")
    with pytest.raises(ControllerRuns, match=f"already served by a controller .*{URL}"):
        HomeLock(tmp_path)
    assert len(pauses) == 1


def test_a_command_waits_for_another_controller_until_that_listens(
    holder: HomeLock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pauses = while_it_waits(monkeypatch, lambda: holder.publish(URL, True, "us-east-1", "sqlite:///d"))
    with pytest.raises(ControllerRuns, match=URL):
        HomeLock(tmp_path, temporary=True)
    assert len(pauses) == 1


def test_nobody_waits_without_end(holder: HomeLock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    holder.publish(URL, True, "us-east-1", "sqlite:///d")
    now = time.monotonic()
    pauses = while_it_waits(monkeypatch, lambda: monkeypatch.setattr(time, "monotonic", lambda: now + 60.0))
    with pytest.raises(ControllerRuns, match=URL):
        HomeLock(tmp_path)
    assert len(pauses) == 1
