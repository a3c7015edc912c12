"""Following the logs of running gangs: as ``aws logs tail --follow`` does, and with StartLiveTail, through the real boto3."""

from __future__ import annotations

import json
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.conftest import MAIN_LAST, PATIENCE, Serving, wait_for
from tests.support.conformance.streams import ARN, GROUP, append, client_of, finished, log_of, stream_of, write


class CliTail(threading.Thread):
    """What ``aws logs tail --follow`` does, with a shorter pause: a page, its successors, then from the newest time on."""

    def __init__(self, url: str, **query: Any) -> None:
        super().__init__(daemon=True)
        self.logs, self.query = client_of(url), {"logGroupName": GROUP, "interleaved": True, **query}
        self.seen: list[dict[str, Any]] = []
        self.polls = 0
        self.ending = threading.Event()

    def run(self) -> None:
        known: dict[int, set[str]] = defaultdict(set)
        query = dict(self.query)
        while not self.ending.is_set():
            page = self.logs.filter_log_events(**query)
            for event in page["events"]:
                if event["eventId"] not in known[event["timestamp"]]:
                    known[event["timestamp"]].add(event["eventId"])
                    self.seen.append(event)
            if known:
                known = defaultdict(set, {max(known): known[max(known)]})
            if "nextToken" in page:
                query["nextToken"] = page["nextToken"]
                continue
            query.pop("nextToken", None)
            if known:
                query["startTime"] = max(known)
            self.polls += 1
            self.ending.wait(0.05)


def test_aws_logs_tail_gives_every_line_of_three_nodes_once_and_in_order(shared_server: Serving) -> None:
    script = """
import os, time
for i in range(150): print(os.environ["AWS_BATCH_JOB_NODE_INDEX"], i, sep=":"); time.sleep(0.02)
"""
    tails = [
        CliTail(shared_server.url, startTime=int(time.time() * 1000) - 1000, logStreamNamePrefix="tailed/", **query)
        for query in ({}, {"filterPattern": '":"', "limit": 7})
    ]
    for tail in tails:
        tail.start()
    job = shared_server.gang(script + MAIN_LAST, 3, "tailed")
    shared_server.wait(job)
    for tail in tails:
        own: dict[str, list[str]] = {}

        def complete(tail: CliTail = tail, own: dict[str, list[str]] = own) -> bool:
            for node in range(3):
                name = stream_of(shared_server, job, node)
                own[name] = [e["message"] for e in tail.seen if e["logStreamName"] == name and ":" in e["message"]]
            return all(len([text for text in texts if "ended" not in text]) >= 150 for texts in own.values())

        wait_for(complete, 60, what="all lines")
        tail.ending.set()
        tail.join()
        complete()
        for node, texts in enumerate(own.values()):
            assert [text for text in texts if "ended" not in text] == [f"{node}:{i}" for i in range(150)]
        assert tail.polls > 5 and len({event["eventId"] for event in tail.seen}) == len(tail.seen)


def test_a_line_that_reaches_its_file_late_is_not_lost_to_a_follower(shared_server: Serving) -> None:
    job = shared_server.gang("import time; print('begun'); time.sleep(600)", 2, "late")
    wait_for(lambda: shared_server.log(job).count("begun") == 2)
    files = [log_of(shared_server, job, node) for node in range(2)]
    tail = CliTail(shared_server.url, logStreamNamePrefix="late/", filterPattern="-begun")
    tail.start()
    for tries in range(20):
        stamp, polls = time.time(), tail.polls
        write(files[0], f"{tries} first", seconds=stamp)
        wait_for(lambda polls=polls, stamp=stamp: tail.polls > polls + 1 or time.time() > stamp + 0.1)
        write(files[1], f"{tries} late", seconds=stamp - 0.1)
        if time.time() < stamp + 0.3:
            break  # else this machine was too busy to be late by as little as the server waits for
    wait_for(lambda: any(event["message"] == f"{tries} first" for event in tail.seen))
    assert [event["message"] for event in tail.seen[-2:]] == [f"{tries} late", f"{tries} first"]
    tail.ending.set()
    tail.join()
    client_of(shared_server.url, "batch").terminate_job(jobId=job, reason="enough")


@pytest.mark.parametrize("follow", ["false", "true"])
def test_a_long_log_comes_in_a_few_pieces_whole_and_in_order(shared_server: Serving, follow: str) -> None:
    job = finished(shared_server, "for i in range(20_000): print(i)" + MAIN_LAST, 2, f"pieces-{follow}")
    pieces = []
    with httpx.stream("GET", f"{shared_server.url}/api/jobs/{job}/logs?follow={follow}", timeout=60) as answer:
        pieces = list(answer.iter_raw())
    lines = [json.loads(line) for line in b"".join(pieces).splitlines()]
    for node in range(2):
        texts = [line["text"] for line in lines if line["node"] == node and line["rank"] is not None]
        assert texts == [str(i) for i in range(20_000)]
    assert [line["time"] for line in lines] == sorted(line["time"] for line in lines)
    assert len(pieces) < len(lines) / 50, "a line of its own for each would cost a hand-over between threads each"
    positions = {f"1/{line['node']}": line["position"] for line in lines[: len(lines) // 2]}
    query = {"positions": json.dumps(positions)}
    again = httpx.get(f"{shared_server.url}/api/jobs/{job}/logs", params=query, timeout=60)
    rest = [json.loads(line) for line in again.text.splitlines()]
    # lines of two nodes with one time have no order between them
    order = itemgetter("time", "node", "position")
    assert sorted(rest, key=order) == sorted(lines[len(lines) // 2 :], key=order)
    assert [line["time"] for line in rest] == sorted(line["time"] for line in rest)
    wrong = httpx.get(f"{shared_server.url}/api/jobs/{job}/logs", params={"positions": "[1]"})
    assert wrong.status_code == 400 and "positions: expected a JSON object" in wrong.json()["message"]


# -- StartLiveTail ----------------------------------------------------------------------------------------------------


class Watching:
    """A StartLiveTail session, read by a thread of its own."""

    def __init__(self, url: str, **query: Any) -> None:
        response = client_of(url).start_live_tail(logGroupIdentifiers=[ARN], **query)
        self.stream = response["responseStream"]
        self.start: dict[str, Any] = {}
        self.updates: list[tuple[float, dict[str, Any]]] = []
        self.over = False
        self.thread = threading.Thread(target=self._read, daemon=True)
        self.thread.start()
        wait_for(lambda: self.start)

    def _read(self) -> None:
        try:
            for message in self.stream:
                if "sessionStart" in message:
                    self.start = message["sessionStart"]
                else:
                    self.updates.append((time.time(), message["sessionUpdate"]))
            self.over = True
        except Exception:  # the test closed the connection under it
            pass

    @property
    def results(self) -> list[dict[str, Any]]:
        return [result for _, update in list(self.updates) for result in update["sessionResults"]]

    @property
    def texts(self) -> list[str]:
        return [result["message"] for result in self.results]


@pytest.fixture
def watch(shared_server: Serving) -> Iterator[Any]:
    opened: list[Watching] = []

    def begin(**query: Any) -> Watching:
        opened.append(Watching(shared_server.url, **query))
        return opened[-1]

    yield begin
    for session in opened:
        session.stream.close()


@pytest.fixture(scope="module")
def running(shared_server: Serving) -> Iterator[str]:
    """Two nodes that sleep; the tests write their lines."""
    job = shared_server.gang("import time; print('begun'); time.sleep(3000)", 2, "running")
    wait_for(lambda: shared_server.log(job).count("begun") == 2)
    yield job
    client_of(shared_server.url, "batch").terminate_job(jobId=job, reason="enough")


def test_a_live_tail_sends_new_lines_at_once_and_only_those(shared_server: Serving, watch: Any, running: str) -> None:
    tail = watch(logStreamNamePrefixes=["running/"])
    assert tail.start["sessionId"] and tail.start["logGroupIdentifiers"] == [ARN]
    assert tail.start["logStreamNamePrefixes"] == ["running/"]
    append(shared_server, running, "one", "two")
    append(shared_server, running, "three", node=1)
    wait_for(lambda: len(tail.results) >= 3)
    assert tail.texts == ["one", "two", "three"]
    assert [result["logStreamName"][-6:] for result in tail.results] == ["node-0", "node-0", "node-1"]
    for result in tail.results:
        assert result["timestamp"] == result["ingestionTime"] > (time.time() - 60 * PATIENCE) * 1000
        assert result["logGroupIdentifier"] == "000000000000:/aws/batch/job"


def test_a_live_tail_speaks_every_second(watch: Any) -> None:
    began = time.time()
    tail = watch(logStreamNamePrefixes=["nothing-like-it"])
    wait_for(lambda: len(tail.updates) >= 3)
    assert [update["sessionResults"] for _, update in tail.updates] == [[]] * len(tail.updates)
    assert not any(update["sessionMetadata"]["sampled"] for _, update in tail.updates)
    assert tail.updates[2][0] - began > 1.8, "not more often"


def test_a_live_tail_takes_up_jobs_that_begin_and_end_later_and_filters(shared_server: Serving, watch: Any) -> None:
    everything = watch()
    filtered = watch(logStreamNamePrefixes=["newcomer/", "x"], logEventFilterPattern='%^[02]:% -":1"')
    script = "import os\nfor i in range(5): print(os.environ['AWS_BATCH_JOB_NODE_INDEX'], i, sep=':')"
    job = finished(shared_server, script + MAIN_LAST, 3, "newcomer")
    own = [stream_of(shared_server, job, node) for node in range(3)]
    named = watch(logStreamNames=own)
    wait_for(lambda: len([r for r in everything.results if r["logStreamName"] in own]) >= 15)
    for node, name in enumerate(own):
        texts = [r["message"] for r in everything.results if r["logStreamName"] == name]
        assert [text for text in texts if ":" in text] == [f"{node}:{i}" for i in range(5)]
    wait_for(lambda: len(filtered.texts) >= 8)
    assert sorted(filtered.texts) == [f"{node}:{i}" for node in (0, 2) for i in (0, 2, 3, 4)]
    assert named.texts == []  # all was written before that session began


def test_a_burst_comes_500_at_a_time_above_5000_is_sampled(shared_server: Serving, watch: Any, running: str) -> None:
    tail = watch(logStreamNames=[stream_of(shared_server, running)])
    append(shared_server, running, *(f"burst {i}" for i in range(3000)))
    wait_for(lambda: len(tail.results) >= 3000)
    assert tail.texts == [f"burst {i}" for i in range(3000)]
    append(shared_server, running, *(f"flood {i}" for i in range(40_000)), "after")
    wait_for(lambda: any(update["sessionMetadata"]["sampled"] for _, update in tail.updates))
    wait_for(lambda: tail.texts[-1] == "after")  # the newest line is never left out
    assert max(len(update["sessionResults"]) for _, update in tail.updates) <= 500
    append(shared_server, running, "calm again")
    wait_for(lambda: tail.texts[-1] == "calm again")
    assert not tail.updates[-1][1]["sessionMetadata"]["sampled"]


def test_live_tails_end_with_the_server_and_do_not_hold_it_up(server: Serving) -> None:
    tails = [Watching(server.url) for _ in range(45)]  # more than there are threads for requests
    assert server.client.get("/api/capacity")["engines"] == {"local": "default"}
    began = time.monotonic()
    server.process.terminate()
    server.process.wait(20 * PATIENCE)
    assert time.monotonic() - began < 10 * PATIENCE
    for tail in tails:
        tail.thread.join(20)
        assert tail.over


def test_a_live_tail_whose_client_left_is_over(server: Serving) -> None:
    tail = Watching(server.url)
    sockets = lambda: len([fd for fd in Path(f"/proc/{server.process.pid}/fd").iterdir() if _is_socket(fd)])  # noqa: E731
    before = sockets()
    tail.stream.close()
    wait_for(lambda: sockets() < before, what="the server lets go of the connection")


def _is_socket(descriptor: Path) -> bool:
    try:
        return str(descriptor.readlink()).startswith("socket:")
    except OSError:
        return False
