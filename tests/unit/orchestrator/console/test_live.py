"""Streams of the console: what is sent of a table, how a stream begins and ends, and values that many pages share."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from fastapi import Request

from orchestrator.api.http.access import Access
from orchestrator.console import curves, live
from orchestrator.console.curves import NewIterations
from orchestrator.console.live import Recent, ServerSentEvent, stream
from orchestrator.domain.errors import ClientError
from orchestrator.services.permissions import CONTROLLER
from shared_store.volume.layout import Run, Store
from shared_store.volume.metrics import MetricsWriter, sampled


def request_of(**headers: str) -> Request:
    state = SimpleNamespace(closing=threading.Event(), access=Access())
    request = SimpleNamespace(
        headers=headers, app=SimpleNamespace(state=state), state=SimpleNamespace(actor=CONTROLLER)
    )
    return cast(Request, request)


def written(reads: Sequence[Callable[[], Sequence[ServerSentEvent] | None]]) -> list[str]:
    """The blocks of a stream whose looks find these."""
    left: Iterator[Callable[[], Any]] = iter(reads)

    async def read() -> str:
        answer = stream(request_of(authorization="Bearer x"), lambda: next(left)(), interval=0)
        return "".join([bytes(cast(bytes, each)).decode() async for each in answer.body_iterator])

    return asyncio.run(read()).split("\n\n")[:-1]


def test_no_text_can_end_an_event_or_begin_another() -> None:
    event = ServerSentEvent("rows", {"x": "a\n\ndata: b\r\nevent: c\u2028\x00"}, "7")
    (_, block) = written([lambda: [event], lambda: None])[:2]
    lines = block.split("\n")
    assert lines[0] == "event: rows" and lines[2] == "id: 7" and len(lines) == 3
    assert json.loads(lines[1].removeprefix("data: ")) == event.data


def test_a_look_that_fails_is_reported_and_the_stream_goes_on_to_its_end() -> None:
    def failing() -> Sequence[ServerSentEvent]:
        raise ClientError("the run is gone")

    blocks = written([failing, lambda: [ServerSentEvent("a", 1)], lambda: None])
    assert [block.split("\n")[0] for block in blocks[1:]] == [
        "event: trouble",
        "event: trouble",
        "event: a",
        "event: end",
    ]
    assert 'data: ""' in blocks[2], "the trouble is over"
    assert "the run is gone" in blocks[1]


def test_a_value_that_takes_long_is_computed_for_a_fifth_of_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, recent = [100.0], Recent(0.5)
    monkeypatch.setattr(live, "time", SimpleNamespace(monotonic=lambda: clock[0]))

    def takes(seconds: float, value: int) -> int:
        clock[0] += seconds
        return value

    assert recent.get("key", lambda: takes(0.1, 1)) == 1  # until 100.5
    clock[0] = 100.4
    assert recent.get("key", lambda: takes(1.0, 2)) == 1
    clock[0] = 100.5
    assert recent.get("key", lambda: takes(1.0, 2)) == 2  # until 101.5 + 4.0
    clock[0] = 105.4
    assert recent.get("key", lambda: takes(1.0, 3)) == 2
    clock[0] = 105.5
    assert recent.get("key", lambda: takes(0.0, 3)) == 3


def test_a_value_that_many_want_at_once_is_computed_once() -> None:
    recent, computed, gate = Recent(60), list[int](), threading.Event()

    def compute() -> int:
        gate.wait(10)
        computed.append(1)
        return len(computed)

    found = list[int]()
    threads = [threading.Thread(target=lambda: found.append(recent.get("key", compute))) for _ in range(8)]
    for each in threads:
        each.start()
    gate.set()
    for each in threads:
        each.join()
    assert found == [1] * 8 and computed == [1]
    assert recent.get("other", compute) == 2
    assert Recent(0).get("key", compute) == 3
    for key in range(200):
        recent.get(key, lambda: 0)
    assert recent.get("key", lambda: 9) == 9 and recent.get("key", lambda: 1) == 9, "nobody asked for it any more"


def test_an_iteration_that_is_written_between_two_looks_at_the_run_is_sent_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Store(tmp_path).run("run")
    run.path.mkdir(parents=True)
    with MetricsWriter(run, 1, 0) as metrics:
        metrics.write({"iteration": 1})

        def sampled_then_written(run: Run, most: int) -> list[dict[str, Any]]:
            found = sampled(run, most)
            metrics.write({"iteration": found[-1]["iteration"] + 1})
            return found

        monkeypatch.setattr(curves, "sampled", sampled_then_written)
        new = NewIterations(run, 0)
        sent = [event.data["iterations"] for _ in range(3) for event in new.changes()]
    assert sent == [[1, 2], [3, 4]]
