"""CloudWatch Logs through the real boto3, on a real server whose gangs really print."""

from __future__ import annotations

import random
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import boto3
import httpx
import pytest
from botocore.config import Config
from botocore.exceptions import ClientError

from orchestrator.api import log_events
from orchestrator.api.log_events import LogFile
from orchestrator.api.log_filter import parse
from shared_store.logs import format_line
from tests.conftest import PATIENCE, Serving, wait_for

GROUP = "/aws/batch/job"
ARN = f"arn:aws:logs:us-east-1:000000000000:log-group:{GROUP}"


def client_of(url: str, service: str = "logs") -> Any:
    return boto3.client(
        service,
        endpoint_url=url,
        region_name="us-east-1",
        aws_access_key_id="any",
        aws_secret_access_key="any",
        config=Config(retries={"max_attempts": 0}, inject_host_prefix=False, read_timeout=60),
    )


@pytest.fixture(scope="module")
def logs(shared_server: Serving) -> Any:
    return client_of(shared_server.url)


def stream_of(server: Serving, job: str, node: int = 0) -> str:
    return f"{server.detail(job)['name']}/{job}/1/node-{node}"


def log_of(server: Serving, job: str, node: int = 0) -> Path:
    return Path(server.detail(job)["attempts"][0]["nodes"][node]["log"])


def append(server: Serving, job: str, *texts: str, node: int = 0, seconds: float | None = None) -> None:
    """Write lines as the node's supervisor would, at Unix time ``seconds`` (now)."""
    lines = "".join(format_line(time.time() if seconds is None else seconds, 0, "o", text) for text in texts)
    with open(log_of(server, job, node), "ab", buffering=0) as file:  # in one go
        file.write(lines.encode())


def finished(server: Serving, script: str, nodes: int = 1, name: str = "logs") -> str:
    job = server.gang(script, nodes, name)
    server.wait(job)
    return job


@pytest.fixture(scope="module")
def counted(shared_server: Serving) -> str:
    """A job that is over and has printed ``line 0000`` … ``line 2499``."""
    return finished(shared_server, "for i in range(2500): print(f'line {i:04d}')", name="counted")


@pytest.fixture
def quiet(shared_server: Serving) -> str:
    """A job that is over and printed nothing; only its supervisor did."""
    return finished(shared_server, "pass", name="quiet")


def messages(page: dict[str, Any]) -> list[str]:
    return [event["message"] for event in page["events"]]


# -- GetLogEvents -----------------------------------------------------------------------------------------------------


def test_the_stream_that_describe_jobs_names_has_both_outputs_and_the_supervisors_lines(
    shared_server: Serving, logs: Any
) -> None:
    job = finished(shared_server, "import sys; print('to out'); sys.stdout.flush(); print('to err', file=sys.stderr)")
    described = client_of(shared_server.url, "batch").describe_jobs(jobs=[f"{job}#0"])["jobs"][0]
    name = described["container"]["logStreamName"]
    assert name == stream_of(shared_server, job)
    page = logs.get_log_events(logGroupName=GROUP, logStreamName=name, startFromHead=True)
    assert sorted(messages(page)) == ["node 0 ended: done", "to err", "to out"]
    times = [event["timestamp"] for event in page["events"]]
    assert times == sorted(times) == [event["ingestionTime"] for event in page["events"]]
    assert described["createdAt"] <= times[0] <= described["stoppedAt"] + 1000


def test_at_the_end_the_same_token_comes_back_and_goes_on_when_lines_arrive(
    shared_server: Serving, logs: Any, quiet: str
) -> None:
    query = {"logGroupName": GROUP, "logStreamName": stream_of(shared_server, quiet)}
    first = logs.get_log_events(**query)
    assert messages(first) == ["node 0 ended: done"]
    token = first["nextForwardToken"]
    for _ in range(2):
        end = logs.get_log_events(**query, nextToken=token, startFromHead=True)
        assert end["events"] == [] and end["nextForwardToken"] == token
    append(shared_server, quiet, "a", "b")
    later = logs.get_log_events(**query, nextToken=token)
    assert messages(later) == ["a", "b"] and later["nextForwardToken"] != token
    before = logs.get_log_events(**query, nextToken=later["nextBackwardToken"])
    assert messages(before) == ["node 0 ended: done"]


def test_a_line_that_is_still_being_written_is_not_given_out(shared_server: Serving, logs: Any, quiet: str) -> None:
    path = log_of(shared_server, quiet)
    query = {"logGroupName": GROUP, "logStreamName": stream_of(shared_server, quiet), "startFromHead": True}
    line = format_line(time.time(), 0, "o", "whole")
    with open(path, "a") as file:
        file.write(line[:-3])
        file.flush()
        half = logs.get_log_events(**query)
        file.write(line[-3:])
    assert messages(half) == ["node 0 ended: done"]
    assert messages(logs.get_log_events(**query, nextToken=half["nextForwardToken"])) == ["whole"]


@pytest.mark.parametrize("forward", [True, False])
def test_pages_in_either_direction_give_every_line_once(
    shared_server: Serving, logs: Any, counted: str, forward: bool
) -> None:
    query = {"logGroupName": GROUP, "logStreamName": stream_of(shared_server, counted), "limit": 700}
    key = "nextForwardToken" if forward else "nextBackwardToken"
    page = logs.get_log_events(**query, startFromHead=forward)
    pages, token = [messages(page)], page[key]
    while True:
        page = logs.get_log_events(**query, nextToken=token, startFromHead=forward)
        if page[key] == token:
            break
        pages.append(messages(page))
        token = page[key]
    assert page["events"] == [] and [len(each) for each in pages] == [700, 700, 700, 401]
    lines = [line for each in (pages if forward else pages[::-1]) for line in each]
    assert lines == [f"line {i:04d}" for i in range(2500)] + ["node 0 ended: done"]


def test_a_page_holds_at_most_a_megabyte(shared_server: Serving, logs: Any, quiet: str) -> None:
    append(shared_server, quiet, *(f"{i}" + "x" * 60_000 for i in range(40)))
    query = {"logGroupName": GROUP, "logStreamName": stream_of(shared_server, quiet), "startFromHead": True}
    pages = [logs.get_log_events(**query)]
    while not pages[-1]["events"] or "39x" not in messages(pages[-1])[-1][:3]:
        pages.append(logs.get_log_events(**query, nextToken=pages[-1]["nextForwardToken"]))
    sizes = [sum(len(text) + 26 for text in messages(page)) for page in pages]
    assert max(sizes) <= 1 << 20 and len(pages) == 3
    assert sum(len(page["events"]) for page in pages) == 41


def test_a_time_range_has_its_start_and_not_its_end(shared_server: Serving, logs: Any, quiet: str) -> None:
    begin = int(time.time()) - 100
    log_of(shared_server, quiet).write_bytes(b"")
    for i in range(5):
        append(shared_server, quiet, f"second {i}", seconds=begin + i)
    query = {"logGroupName": GROUP, "startTime": begin * 1000 + 1000, "endTime": begin * 1000 + 3000}
    name = stream_of(shared_server, quiet)
    for head in (True, False):
        page = logs.get_log_events(**query, logStreamName=name, startFromHead=head)
        assert messages(page) == ["second 1", "second 2"]
    # FilterLogEvents leaves out what is *later* than its end
    assert messages(logs.filter_log_events(**query, logStreamNames=[name])) == ["second 1", "second 2", "second 3"]


def test_times_never_fall_when_a_clock_steps_back_and_nothing_is_lost(
    shared_server: Serving, logs: Any, quiet: str
) -> None:
    high = int(time.time()) - 100
    log_of(shared_server, quiet).write_bytes(b"")
    append(shared_server, quiet, "before", seconds=high)
    append(shared_server, quiet, *(f"{'x' * 100} {i}" for i in range(1000)), "after", seconds=high - 8)
    name = stream_of(shared_server, quiet)
    whole = logs.filter_log_events(logGroupName=GROUP, logStreamNames=[name])["events"]
    assert [event["timestamp"] for event in whole] == [high * 1000] * 1002
    # whoever had seen "before" asks from its time on, which begins deep in the file, and must find the same events
    assert logs.filter_log_events(logGroupName=GROUP, logStreamNames=[name], startTime=high * 1000)["events"] == whole
    last = logs.get_log_events(logGroupName=GROUP, logStreamName=name, limit=1)["events"]
    assert last == [{"timestamp": high * 1000, "ingestionTime": high * 1000, "message": "after"}]


@pytest.mark.parametrize("token", ["x", "f/", "f/-1", "f/01", "b/1x", "g/5", "f/" + "9" * 40, "f/１"])
def test_a_malformed_token_is_an_invalid_parameter(shared_server: Serving, logs: Any, counted: str, token: str) -> None:
    with pytest.raises(logs.exceptions.InvalidParameterException, match="nextToken is invalid"):
        logs.get_log_events(logGroupName=GROUP, logStreamName=stream_of(shared_server, counted), nextToken=token)


def test_a_token_from_inside_a_line_goes_on_with_the_next_one(shared_server: Serving, logs: Any, counted: str) -> None:
    name = stream_of(shared_server, counted)
    page = logs.get_log_events(logGroupName=GROUP, logStreamName=name, nextToken="f/5", limit=1)
    assert messages(page) == ["line 0001"]
    past = logs.get_log_events(logGroupName=GROUP, logStreamName=name, nextToken="f/99999999999")
    assert past["events"] == [] and past["nextForwardToken"] == "f/99999999999"


# -- FilterLogEvents --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trio(shared_server: Serving) -> str:
    """A job that is over, of three nodes that printed ``<node>:<i>``, 60 lines each, at the same time."""
    script = """
import os, time
for i in range(60): print(os.environ["AWS_BATCH_JOB_NODE_INDEX"], i, sep=":"); time.sleep(0.005)
"""
    return finished(shared_server, script, 3, "trio")


def test_streams_are_merged_by_time_and_pages_are_the_same_as_one(shared_server: Serving, logs: Any, trio: str) -> None:
    query = {"logGroupIdentifier": ARN, "logStreamNamePrefix": f"trio/{trio}/", "filterPattern": '":"  -ended'}
    whole = logs.filter_log_events(**query, interleaved=True)
    events = whole["events"]
    assert "nextToken" not in whole and whole["searchedLogStreams"] == [] and len(events) == 180
    times = [event["timestamp"] for event in events]
    assert times == sorted(times) == [event["ingestionTime"] for event in events]
    ids = [event["eventId"] for event in events]
    assert ids == sorted(set(ids)) and all(len(each) == 56 and each.isdigit() for each in ids)
    for node in range(3):
        of_node = [event["message"] for event in events if event["logStreamName"].endswith(f"node-{node}")]
        assert of_node == [f"{node}:{i}" for i in range(60)]
    pages = list(logs.get_paginator("filter_log_events").paginate(**query, PaginationConfig={"PageSize": 50}))
    assert [event for page in pages for event in page["events"]] == events
    assert [len(page["events"]) for page in pages] == [50, 50, 50, 30]
    reverse = logs.get_paginator("filter_log_events").paginate(
        **query, startFromHead=False, PaginationConfig={"PageSize": 70}
    )
    assert [event for page in reverse for event in page["events"]] == events[::-1]
    named = logs.filter_log_events(
        logGroupName=GROUP, logStreamNames=[stream_of(shared_server, trio, node) for node in (2, 0)], filterPattern=":"
    )
    assert named["events"] == [e for e in events if not e["logStreamName"].endswith("node-1")] + named["events"][120:]


def test_without_a_stream_the_whole_group_is_searched(logs: Any, trio: str, counted: str) -> None:
    found = logs.filter_log_events(logGroupName=GROUP, filterPattern='?"2:59" ?"line 0042"')["events"]
    assert {f"trio/{trio}/1/node-2", f"counted/{counted}/1/node-0"} <= {event["logStreamName"] for event in found}
    assert {event["message"] for event in found} == {"2:59", "line 0042"}


def test_event_ids_are_the_same_after_a_restart_and_from_any_start(server: Serving) -> None:
    job = finished(server, "for i in range(3000): print('text of line', i)")
    query = {"logGroupName": GROUP, "logStreamNames": [stream_of(server, job)]}
    before = client_of(server.url).filter_log_events(**query)["events"]
    server.kill()
    server.start()
    logs = client_of(server.url)
    since = before[2500]["timestamp"]
    assert logs.filter_log_events(**query, startTime=since)["events"] == [e for e in before if e["timestamp"] >= since]
    assert logs.filter_log_events(**query)["events"] == before and len(before) == 3001


LINES = ["ERROR 404 in trainer", "ERROR in loader", "WARN: loss is nan", "iteration 12/300", 'said "hi" at 50%', "",
         "Fehler: größer"]  # fmt: skip


@pytest.mark.parametrize(
    ("pattern", "matching"),
    [
        ("", range(7)),
        ("ERROR", [0, 1]),
        ("error", []),
        ("ERR", [0, 1]),
        ("ERROR loader", [1]),
        ("loader ERROR", [1]),
        ('"ERROR in"', [1]),
        ('"loader ERROR"', []),
        ("ERROR -404", [1]),
        ('-ERROR -"loss is" -"" ', []),
        ("?nan ?404", [0, 2]),
        ('ERROR ?trainer ?"loss is"', [0]),
        (r'"\"hi\""', [4]),
        ("50%", [4]),
        ("größer", [6]),
        (r"%\d{3}%", [0, 3]),
        (r"%iteration \d+/\d+$%", [3]),
        (r"%^in%", []),
        (r"%^(ERROR)%", None),
        (r"%^ERROR|nan$%", [0, 1, 2]),
        (r"%[Ee]rr?or|[^a-z]rr%", []),
        (r"%[A-Z]{5}% -%\d%", [1]),
        (r"%lo+s{1,2} .*n%", [2]),
        (r"%^$%", [5]),
        (r"%x*%", range(7)),
    ],
)
def test_filter_patterns(pattern: str, matching: Any) -> None:
    if matching is None:
        with pytest.raises(ValueError):
            parse(pattern)
    else:
        matches = parse(pattern)
        assert [i for i, line in enumerate(LINES) if matches(line)] == list(matching)


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("{ $.level = ERROR }", "JSON"),
        ("[ip, user]", "not supported"),
        ('"open', "no partner"),
        ("%open", "no partner"),
        ("%[z-a]%", "regular expression"),
        (r"%(a+)+%", "can't be read"),
        (r"%a\b%", "can't be read"),
        ("%a{5,2}%", "ends before"),
        ("%a{999}%", "too long"),
        ("%a% %b% %c%", "more than 2"),
        ("%" + "[ab]{99}" * 9 + "%", "too long"),
        ("x" * 1025, "1024"),
    ],
)
def test_bad_patterns_are_invalid_parameters_that_say_why(logs: Any, pattern: str, message: str) -> None:
    with pytest.raises(logs.exceptions.InvalidParameterException, match=message):
        logs.filter_log_events(logGroupName=GROUP, filterPattern=pattern)
    with pytest.raises(ClientError, match=message) as caught:
        logs.start_live_tail(logGroupIdentifiers=[ARN], logEventFilterPattern=pattern)
    assert caught.value.response["Error"]["Code"] == "InvalidParameterException"


def test_no_regex_can_stop_the_server() -> None:
    matches = parse("%.*a*a*a*a*a*a*a*b.*c.*d%")  # Python's re needs longer than the universe has
    began = time.monotonic()
    assert not matches("a" * 20_000)
    assert time.monotonic() - began < PATIENCE


def test_a_poll_near_the_end_reads_only_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "node-0.log"
    path.write_text("".join(format_line(1e9 + i / 100, 0, "o", f"line {i} {'x' * 80}") for i in range(100_000)))
    file, read = LogFile(path, "s"), []
    genuine = log_events._read

    def counting(path: Path, offset: int, size: int) -> bytes:
        read.append(size)
        return genuine(path, offset, size)

    monkeypatch.setattr(log_events, "_read", counting)
    view = file.look()
    found = [event.text.split()[1] for event in view.forward(since=int(1e12) + 999_900)]
    assert found == [str(i) for i in range(99_990, 100_000)]
    assert sum(read) < 70_000 < view.end // 100


def test_any_start_and_any_look_give_the_same_events(tmp_path: Path) -> None:
    """Against the plain definition, on a file that grows, with torn lines, long ones and a clock that jumps."""
    dice, path, clock = random.Random(7), tmp_path / "node-0.log", 1e9
    file, written = LogFile(path, "s"), b""
    for _ in range(60):
        for _ in range(dice.randrange(80)):
            clock += dice.choice([0.0, 0.0004, 0.01, 2.0, -1.5 if dice.random() < 0.1 else 0.0])
            text = "t" * dice.choice([0, 3, 50, 200, 40_000 if dice.random() < 0.02 else 7])
            line = format_line(clock, dice.choice([None, 0, 12]), "e", text)
            written += dice.choice([b"torn\n", b"\n", b"\xff\x00 o \n"]) if dice.random() < 0.02 else line.encode()
        path.write_bytes(written + b"2026-01-01T00:00:0")
        file.look()
    view, expected, offset, top = file.look(), [], 0, 0
    for raw in written.splitlines(keepends=True):
        if match := log_events._LINE.fullmatch(raw[:-1]):
            top = max(top, log_events._milliseconds(match[1]))
            expected.append((top, offset, offset + len(raw)))
        offset += len(raw)
    assert view.end == len(written) and view.top == top and len(view.marks) > 5
    for _ in range(300):
        since, start = dice.choice(expected)[0] + dice.randrange(-1, 2), dice.randrange(len(written) + 9)
        fresh = dice.choice([view, LogFile(path, "s").look()])
        found = [(e.time, e.offset, e.end) for e in fresh.forward(since, start)]
        assert found == [e for e in expected if e[0] >= since and e[1] >= start]
        back = [(e.time, e.offset, e.end) for e in fresh.backward(since, start)]
        assert back == [e for e in expected if e[0] < since and e[1] < start][::-1]


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


def test_aws_logs_tail_gives_every_line_of_three_nodes_once_and_in_order(shared_server: Serving, logs: Any) -> None:
    script = """
import os, time
for i in range(150): print(os.environ["AWS_BATCH_JOB_NODE_INDEX"], i, sep=":"); time.sleep(0.02)
"""
    tails = [
        CliTail(shared_server.url, startTime=int(time.time() * 1000) - 1000, **query)
        for query in ({"logStreamNamePrefix": "tailed/"}, {"filterPattern": '":"', "limit": 7})
    ]
    for tail in tails:
        tail.start()
    job = shared_server.gang(script, 3, "tailed")
    shared_server.wait(job)
    for tail in tails:
        own: dict[str, list[str]] = {}

        def complete(tail: CliTail = tail, own: dict[str, list[str]] = own) -> bool:
            for node in range(3):
                name = stream_of(shared_server, job, node)
                own[name] = [e["message"] for e in tail.seen if e["logStreamName"] == name and ":" in e["message"]]
            return all(len([text for text in texts if "ended" not in text]) >= 150 for texts in own.values())

        wait_for(complete, 20, what="all lines")
        tail.ending.set()
        tail.join()
        complete()
        for node, texts in enumerate(own.values()):
            assert [text for text in texts if "ended" not in text] == [f"{node}:{i}" for i in range(150)]
        assert tail.polls > 5 and len({event["eventId"] for event in tail.seen}) == len(tail.seen)


def test_a_line_that_reaches_its_file_late_is_not_lost_to_a_follower(shared_server: Serving) -> None:
    job = shared_server.gang("import time; time.sleep(600)", 2, "late")
    shared_server.wait(job, "RUNNING")
    wait_for(lambda: all(Path(n["log"]).exists() for n in shared_server.detail(job)["attempts"][0]["nodes"]))
    tail = CliTail(shared_server.url, logStreamNamePrefix="late/")
    tail.start()
    stamp, polls = time.time(), tail.polls
    append(shared_server, job, "first", seconds=stamp)
    wait_for(lambda: tail.polls > polls + 1 or time.time() > stamp + 0.1)
    append(shared_server, job, "late", node=1, seconds=stamp - 0.1)
    wait_for(lambda: len(tail.seen) >= 2)
    assert [event["message"] for event in tail.seen] == ["late", "first"]
    tail.ending.set()
    tail.join()
    client_of(shared_server.url, "batch").terminate_job(jobId=job, reason="enough")


# -- rules and refusals -----------------------------------------------------------------------------------------------


def test_names_and_prefix_and_the_two_ways_to_name_the_group_exclude_each_other(
    shared_server: Serving, logs: Any, counted: str
) -> None:
    name, refused = stream_of(shared_server, counted), logs.exceptions.InvalidParameterException
    with pytest.raises(refused, match="logStreamNamePrefix"):
        logs.filter_log_events(logGroupName=GROUP, logStreamNames=[name], logStreamNamePrefix="counted")
    with pytest.raises(refused, match="logStreamNames: 101"):
        logs.filter_log_events(logGroupName=GROUP, logStreamNames=[name] * 101)
    for operation in (logs.filter_log_events, logs.describe_log_streams):
        for groups in ({}, {"logGroupName": GROUP, "logGroupIdentifier": ARN}):
            with pytest.raises(refused, match="Exactly one of logGroupName and logGroupIdentifier"):
                operation(**groups)
    with pytest.raises(refused, match="limit: 10001 is more than 10000"):
        logs.get_log_events(logGroupName=GROUP, logStreamName=name, limit=10001)
    with pytest.raises(refused, match="nextToken is invalid"):
        logs.filter_log_events(logGroupName=GROUP, nextToken="x")


def test_unknown_groups_and_streams_do_not_exist(shared_server: Serving, logs: Any, counted: str) -> None:
    missing = logs.exceptions.ResourceNotFoundException
    for name in (
        f"other/{counted}/1/node-0",
        f"counted/{counted}/2/node-0",
        f"counted/{counted}/1/node-1",
        f"counted/{counted}/1/node-00",
        f"counted/{counted}/1/node-{'9' * 30}",
        f"counted/{counted[:-1]}/1/node-0",
        "../../etc/passwd",
        "counted",
    ):
        with pytest.raises(missing, match="log stream does not exist") as caught:
            logs.get_log_events(logGroupName=GROUP, logStreamName=name)
        assert caught.value.response["ResponseMetadata"]["HTTPStatusCode"] == 400
        with pytest.raises(missing):
            logs.filter_log_events(logGroupName=GROUP, logStreamNames=[stream_of(shared_server, counted), name])
    with pytest.raises(missing, match="log group does not exist"):
        logs.get_log_events(logGroupName="/aws/batch/other", logStreamName=stream_of(shared_server, counted))
    with pytest.raises(missing, match="log group does not exist"):
        logs.start_live_tail(logGroupIdentifiers=[ARN, f"{ARN}2"])
    assert logs.filter_log_events(logGroupName=GROUP, logStreamNamePrefix="nothing-like-it/")["events"] == []


def test_a_stream_without_a_file_yet_is_empty(shared_server: Serving, logs: Any, quiet: str) -> None:
    log_of(shared_server, quiet).unlink()
    name = stream_of(shared_server, quiet)
    page = logs.get_log_events(logGroupName=GROUP, logStreamName=name)
    assert page["events"] == [] and page["nextForwardToken"] == "f/0" and page["nextBackwardToken"] == "b/0"
    assert logs.filter_log_events(logGroupName=GROUP, logStreamNames=[name])["events"] == []
    described = logs.describe_log_streams(logGroupName=GROUP, logStreamNamePrefix=name)["logStreams"][0]
    assert described["storedBytes"] == 0 and "lastEventTimestamp" not in described


def test_other_operations_are_named(logs: Any) -> None:
    with pytest.raises(
        logs.exceptions.InvalidParameterException, match=r"StopQuery is not supported; .*FilterLogEvents"
    ):
        logs.stop_query(queryId="x")


BODIES = [
    b"", b"[]", b"{", b"null", b'"x"', b"\xff\xfe", b"[" * 5000, b'{"a":' * 5000, b'{"logGroupName": 3}',
    b'{"logGroupName": "/aws/batch/job", "logStreamName": "\\ud800", "logStreamNamePrefix": "\\ud800"}',
    b'{"logGroupName": "/aws/batch/job", "logStreamNamePrefix": "a\\u0000"}',
    b'{"logGroupName": "/aws/batch/job", "startTime": ' + b"9" * 60 + b"}",
    b'{"logGroupName": "/aws/batch/job", "logStreamName": "a/b/1/node-0", "startTime": -1}',
    b'{"logGroupName": "/aws/batch/job", "logStreamName": "a/b/1/node-0", "limit": 1e3}',
    b'{"logGroupName": "/aws/batch/job", "logStreamName": "a/b/1/node-0", "limit": null}',
    b'{"logGroupName": "/aws/batch/job", "nextToken": "f%s", "limit": 0}' % (b"9" * 56),
    b'{"logGroupName": "/aws/batch/job", "orderBy": "x", "logStreamNames": [null], "descending": "yes"}',
    b'{"logGroupName": "/aws/batch/job", "nextToken": "/", "logStreamNames": {}}',
    b'{"logGroupIdentifiers": []}', b'{"logGroupIdentifiers": ["/aws/batch/job"], "logStreamNames": []}',
    b'{"logGroupIdentifiers": ["/aws/batch/job"], "logStreamNames": ["a"], "logStreamNamePrefixes": ["a"]}',
    b'{"logGroupNamePrefix": "a", "logGroupNamePattern": "b"}', b'{"nextToken": "x"}',
]  # fmt: skip


@pytest.mark.parametrize(
    "operation", ["GetLogEvents", "FilterLogEvents", "DescribeLogStreams", "StartLiveTail", "Nope"]
)
def test_no_malformed_request_is_a_server_error(shared_server: Serving, operation: str) -> None:
    for body in BODIES:
        headers = {"X-Amz-Target": f"Logs_20140328.{operation}"}
        answer = httpx.post(shared_server.url, content=body, headers=headers)
        assert answer.status_code == 400, (body, answer.text)
        kind = answer.json()["__type"]
        assert kind in ("InvalidParameterException", "ResourceNotFoundException") and answer.json()["message"]
        assert "\n" not in answer.json()["message"] and answer.headers["content-type"] == "application/x-amz-json-1.1"


@pytest.mark.parametrize("target", [None, "", "Logs_20140328.", "Other_2014.GetLogEvents", "Logs_20140328.__class__"])
def test_a_request_without_a_known_target_is_refused(shared_server: Serving, target: str | None) -> None:
    answer = httpx.post(
        shared_server.url, content=b"{}", headers={"X-Amz-Target": target} if target is not None else {}
    )
    assert answer.status_code == 400 and "supported are" in answer.json()["message"]


# -- describing -------------------------------------------------------------------------------------------------------


def test_streams_are_listed_by_name_page_by_page(shared_server: Serving, logs: Any, trio: str) -> None:
    prefix = f"trio/{trio}"
    paginator = logs.get_paginator("describe_log_streams")
    pages = list(paginator.paginate(logGroupName=GROUP, logStreamNamePrefix=prefix, PaginationConfig={"PageSize": 2}))
    assert [len(page["logStreams"]) for page in pages] == [2, 1]
    streams = [stream for page in pages for stream in page["logStreams"]]
    assert [stream["logStreamName"] for stream in streams] == [f"{prefix}/1/node-{node}" for node in range(3)]
    for stream in streams:
        events = logs.get_log_events(logGroupName=GROUP, logStreamName=stream["logStreamName"], startFromHead=True)[
            "events"
        ]
        assert stream["firstEventTimestamp"] == events[0]["timestamp"]
        assert stream["lastEventTimestamp"] == stream["lastIngestionTime"] == events[-1]["timestamp"]
        assert stream["creationTime"] <= stream["firstEventTimestamp"]
        assert stream["arn"] == f"{ARN}:log-stream:{stream['logStreamName']}"
        assert stream["uploadSequenceToken"] and stream["storedBytes"] > 60 * 30
    backwards = logs.describe_log_streams(logGroupIdentifier=ARN, logStreamNamePrefix=prefix, descending=True)
    assert backwards["logStreams"] == streams[::-1] and "nextToken" not in backwards


def test_streams_are_listed_by_their_last_event(shared_server: Serving, logs: Any, trio: str, counted: str) -> None:
    append(shared_server, counted, "the newest of all")
    paginator = logs.get_paginator("describe_log_streams")
    for descending in (True, False):
        pages = paginator.paginate(
            logGroupName=GROUP, orderBy="LastEventTime", descending=descending, PaginationConfig={"PageSize": 2}
        )
        streams = [stream for page in pages for stream in page["logStreams"]]
        times = [stream.get("lastEventTimestamp", 0) for stream in streams]
        assert times == sorted(times, reverse=descending)
        names = [stream["logStreamName"] for stream in streams]
        assert len(set(names)) == len(names) and f"trio/{trio}/1/node-1" in names
        assert names[0 if descending else -1] == f"counted/{counted}/1/node-0"
    with pytest.raises(logs.exceptions.InvalidParameterException, match="LastEventTime"):
        logs.describe_log_streams(logGroupName=GROUP, orderBy="LastEventTime", logStreamNamePrefix="trio")


def test_there_is_one_group(logs: Any, trio: str) -> None:
    [group] = logs.describe_log_groups(logGroupNamePrefix="/aws/")["logGroups"]
    assert (group["logGroupName"], group["arn"], group["logGroupArn"]) == (GROUP, f"{ARN}:*", ARN)
    assert [g["logGroupName"] for g in logs.describe_log_groups(logGroupNamePattern="batch")["logGroups"]] == [GROUP]
    for nothing in ({"logGroupNamePrefix": "batch"}, {"logGroupNamePattern": "Batch"}, {"logGroupClass": "DELIVERY"}):
        assert logs.describe_log_groups(**nothing)["logGroups"] == []


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
    tail = watch(logStreamNamePrefixes=["nothing-like-it"])
    wait_for(lambda: len(tail.updates) >= 3)
    assert [update["sessionResults"] for _, update in tail.updates] == [[]] * len(tail.updates)
    assert not any(update["sessionMetadata"]["sampled"] for _, update in tail.updates)
    assert 1.8 < tail.updates[2][0] - tail.updates[0][0] < 3 * PATIENCE


def test_a_live_tail_takes_up_jobs_that_begin_and_end_later_and_filters(shared_server: Serving, watch: Any) -> None:
    everything = watch()
    filtered = watch(logStreamNamePrefixes=["newcomer/", "x"], logEventFilterPattern='%^[02]:% -":1"')
    script = "import os\nfor i in range(5): print(os.environ['AWS_BATCH_JOB_NODE_INDEX'], i, sep=':')"
    job = finished(shared_server, script, 3, "newcomer")
    own = [stream_of(shared_server, job, node) for node in range(3)]
    named = watch(logStreamNames=own)
    wait_for(lambda: len([r for r in everything.results if r["logStreamName"] in own]) >= 18)
    for node, name in enumerate(own):
        texts = [r["message"] for r in everything.results if r["logStreamName"] == name]
        assert [text for text in texts if ":" in text and "ended" not in text] == [f"{node}:{i}" for i in range(5)]
    wait_for(lambda: len(filtered.texts) >= 8)
    assert sorted(filtered.texts) == [f"{node}:{i}" for node in (0, 2) for i in (0, 2, 3, 4)]
    assert named.texts == []  # all was written before that session began


def test_a_burst_comes_in_updates_of_500_and_above_5000_is_sampled(
    shared_server: Serving, watch: Any, running: str
) -> None:
    tail = watch(logStreamNames=[stream_of(shared_server, running)])
    append(shared_server, running, *(f"burst {i}" for i in range(3000)))
    wait_for(lambda: len(tail.results) >= 3000)
    assert tail.texts == [f"burst {i}" for i in range(3000)]
    append(shared_server, running, *(f"flood {i}" for i in range(40_000)), "after")
    wait_for(lambda: any(update["sessionMetadata"]["sampled"] for _, update in tail.updates))
    assert max(len(update["sessionResults"]) for _, update in tail.updates) <= 500
    append(shared_server, running, "calm again")
    wait_for(lambda: tail.texts[-1] == "calm again")
    assert not tail.updates[-1][1]["sessionMetadata"]["sampled"]


def test_live_tails_end_with_the_server_and_do_not_hold_it_up(server: Serving) -> None:
    tails = [Watching(server.url) for _ in range(45)]  # more than there are threads for requests
    assert server.client.get("/api/capacity")["engine"] == "local"
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
