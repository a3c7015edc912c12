"""What a job writes into its run may be anything, and what a client asks for too much: pages show the rest, and the server stays."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import AsyncIterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from fastapi import Request

from orchestrator.api.errors import ClientError
from orchestrator.api.turns import Turns
from orchestrator.api.http.access import Access
from orchestrator.console.live import Event, stream
from shared_store.files import DamagedFile, open_inside
from shared_store.layout import Store
from tests.support.console.fixtures import Console
from tests.support.orchestrator.jobs import await_status
from tests.support.orchestrator.trained import SPEC

NUMBERS = (
    *("reward", "score", "score_error", "steps_per_second", "iteration_seconds", "time", "env_steps", "slowest_rank"),
    *("slowest_excess", "kl"),
)


def test_no_page_fails_by_what_a_job_wrote_in_place_of_numbers(console: Console) -> None:
    visitor = console.visitor()
    small = {"cpus": 0.1, "memory": "64MiB"}
    spec = {"name": "broken", "train": {**SPEC["train"], "task": "nowhere:Task"}, "resources": small}
    answer = visitor.submit("/submit", yaml=json.dumps(spec))
    assert answer.status_code == 200, answer.text
    job = str(answer.json()["location"].rpartition("/")[2])
    await_status(console.client, job, "FAILED")
    run = Store(console.server.home / "store").run(console.client.get(f"/api/jobs/{job}")["run"])
    run.metrics.mkdir(exist_ok=True)
    paths = (
        *("/", f"/jobs/{job}", "/runs", f"/runs/{run.name}", f"/runs/{run.name}/curves"),
        *(f"/compare?run={run.name}", f"/compare/curves?run={run.name}", "/api/jobs", "/api/runs"),
    )
    wrong: list[Any] = []
    for value in ("text", [1, "x"], {"a": 1}, 10**300, 10**4000):
        records = [{"resumed_from": 0}, *({"iteration": i, **dict.fromkeys(NUMBERS, value)} for i in range(1, 6))]
        (run.metrics / "metrics-e1.jsonl").write_text("".join(json.dumps(each) + "\n" for each in records))
        wrong += [(str(value)[:9], path) for path in paths if visitor.http.get(path).status_code != 200]
    assert not wrong


def test_a_comparison_looks_for_few_patterns(console: Console) -> None:
    answer = console.visitor("reader").http.get(f"/compare?run={'+'.join(['a*'] * 41)}")
    assert answer.status_code == 400 and "40 at most" in answer.text


def test_a_form_searches_for_no_longer_text_than_the_page(console: Console) -> None:
    answer = console.visitor().submit("/jobs/stop", all="yes", search="%" * 70_000)
    assert answer.status_code == 400 and "more than 200 characters" in answer.json()["message"]


def test_one_key_has_a_hundred_streams_at_most_and_another_one_when_one_ends() -> None:
    state = SimpleNamespace(closing=threading.Event(), access=Access())
    request = cast(Request, SimpleNamespace(app=SimpleNamespace(state=state), headers={"authorization": ""}))

    def opened() -> AsyncIterator[bytes]:
        return cast(AsyncIterator[bytes], aiter(stream(request, lambda: [Event("rows", {})]).body_iterator))

    async def story() -> tuple[bytes, bytes]:
        there = [opened() for _ in range(100)]
        for each in there:
            await anext(each)
        another = opened()
        refused = [await anext(another), await anext(another)]
        await cast(Any, there[0]).aclose()
        there[0] = opened()
        again = await anext(there[0])
        for each in there:
            await cast(Any, each).aclose()
        return b"".join(refused), again

    refused, again = asyncio.run(story())
    assert b"event: trouble" in refused and b"100 pages are open" in refused
    assert b"retry: 1000" in again


def test_those_who_wait_for_a_turn_are_few_and_the_others_are_refused_at_once() -> None:
    turns, begun, over = Turns("busy", at_once=1, waiting=1), threading.Event(), threading.Event()

    def work() -> None:
        with turns.turn():
            begun.set()
            over.wait()

    workers = [threading.Thread(target=work) for _ in range(2)]
    workers[0].start()
    begun.wait()
    workers[1].start()
    try:
        while turns._there._value:  # the second one waits
            threading.Event().wait(0.01)
        with pytest.raises(ClientError, match="busy; try again"), turns.turn():
            pass
    finally:
        over.set()
        for each in workers:
            each.join()
    with turns.turn():
        pass


def test_no_directory_on_the_way_to_a_file_may_be_a_link(tmp_path: Path) -> None:
    (tmp_path / "run" / "recordings" / "inner").mkdir(parents=True)
    (tmp_path / "run" / "recordings" / "inner" / "gait.gif").write_bytes(b"GIF89a")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "gait.gif").write_bytes(b"secret")
    with open_inside(tmp_path / "run", ["recordings", "inner", "gait.gif"]) as file:
        assert file.read() == b"GIF89a"
    (tmp_path / "run" / "recordings" / "link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "run" / "recordings" / "gait.gif").symlink_to(tmp_path / "elsewhere" / "gait.gif")
    with pytest.raises(NotADirectoryError):
        open_inside(tmp_path / "run", ["recordings", "link", "gait.gif"])
    with pytest.raises(DamagedFile):
        open_inside(tmp_path / "run", ["recordings", "gait.gif"])
