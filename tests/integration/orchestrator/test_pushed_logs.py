"""Logs that real nodes push to those who follow them."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from orchestrator.client import Client
from orchestrator.control import log_tail
from orchestrator.server import Server
from shared_store.volume import log_files
from tests.conftest import submit_gang, wait_for

SAYS = """
import os, sys, time
done, path = 0, sys.argv[1] if sys.argv[1:] else {path!r}
while True:
    lines = open(path).read().splitlines() if os.path.exists(path) else []
    for line in lines[done:]: print(os.environ["AWS_BATCH_JOB_NODE_INDEX"], line, sep=":", flush=True)
    done = len(lines)
    if "end" in lines: break
    time.sleep(0.02)
if os.environ["AWS_BATCH_JOB_NODE_INDEX"] == "0": time.sleep(1)
"""
"""Each node prints the lines of a file as they come."""


class Talk:
    """A job of two nodes that prints what it is given, and those who follow it."""

    def __init__(self, server: Server, path: Path) -> None:
        self.server, self.path = server, path
        self.client = Client(server.url)
        self.job = submit_gang(self.client, SAYS.format(path=str(path)), 2)
        self.threads: list[threading.Thread] = []
        self.output: list[str] = []

    def say(self, *texts: str) -> None:
        with open(self.path, "a") as file:
            file.writelines(f"{text}\n" for text in texts)
        self.output += texts

    def follow(self) -> list[str]:
        """The texts that a new follower gets, which grow."""
        texts: list[str] = []

        def read() -> None:
            with httpx.stream("GET", f"{self.server.url}/api/jobs/{self.job}/logs?follow=true", timeout=60) as answer:
                texts.extend(json.loads(line)["text"] for line in answer.iter_lines() if line)

        self.threads.append(threading.Thread(target=read, daemon=True))
        self.threads[-1].start()
        return texts

    def has_all(self, texts: list[str]) -> bool:
        return all([each for each in texts if each.startswith(f"{node}:")] == self._of(node) for node in range(2))

    def _of(self, node: int) -> list[str]:
        return [f"{node}:{text}" for text in self.output]

    def is_pushed(self) -> bool:
        """Whether the nodes push all that they print, and nobody looks at a file."""
        followed = self.server.controller.logs._followed.get(self.job)
        return followed is not None and followed.logs.delivers() and not followed.is_polled


@pytest.fixture
def talk(tmp_path: Path) -> Iterator[Talk]:
    server = Server(tmp_path / "home", cpus=2)
    server.start()
    talk = Talk(server, tmp_path / "talk")
    try:
        yield talk
    finally:
        server.close()
        talk.client.close()


def test_lines_come_by_push_alone_while_the_bus_delivers(talk: Talk, monkeypatch: pytest.MonkeyPatch) -> None:
    everyone = [talk.follow() for _ in range(5)]
    talk.say("first")
    wait_for(lambda: all(map(talk.has_all, everyone)) and talk.is_pushed())
    polls: list[Any] = []
    genuine: Callable[..., Any] = log_tail.read_log
    for module in (log_tail, log_files):
        monkeypatch.setattr(module, "read_log", lambda *supplied: (polls.append(supplied), genuine(*supplied))[1])
    monkeypatch.setattr(log_tail, "FRESH", 3600.0)  # the machine may be busy for longer than the node's word counts
    for number in range(30):
        talk.say(f"line {number}")
        wait_for(lambda: all(map(talk.has_all, everyone)))
    assert not polls
    talk.say("end")
    for thread in talk.threads:
        thread.join(120)
    assert all(map(talk.has_all, everyone)) and not talk.server.controller.logs._followed
    assert all(texts[-1].startswith("node ") for texts in everyone), "the last lines are the supervisors'"
