"""How long a rank took to start: every second of it belongs to a part."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import pytest

from worker.learning import startup
from worker.learning.startup import Startup


def test_the_parts_of_a_start_add_up_and_are_printed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([101.25, 101.5, 103.0])
    monkeypatch.setattr(startup, "_own_start", lambda: 100.0)
    monkeypatch.setattr(startup.time, "clock_gettime", lambda clock: next(times))
    lines: list[str] = []
    loop: Any = SimpleNamespace(gang=SimpleNamespace(is_main=True), say=lines.append)
    start = Startup()
    start.mark("torch")
    start.mark("worlds")
    start.begin(loop)
    for _ in range(2):
        start.iteration({})
    assert lines == ["started in 3.00 s: torch 1.25 s, worlds 0.25 s, first iteration 1.50 s"]


def test_a_start_begins_with_the_process_and_only_the_main_rank_prints_it() -> None:
    lines: list[str] = []
    for is_main in (False, True):
        start = Startup()
        start.mark("all")
        loop: Any = SimpleNamespace(gang=SimpleNamespace(is_main=is_main), say=lines.append)
        start.begin(loop)
        start.iteration({})
    (line,) = lines
    found = re.fullmatch(r"started in ([\d.]+) s: all ([\d.]+) s, first iteration 0.0\d s", line)
    assert found and 0.1 < float(found[1]) < 100_000
