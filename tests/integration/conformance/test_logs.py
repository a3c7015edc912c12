"""CloudWatch Logs through the real boto3, on a real server whose gangs really print."""

from __future__ import annotations

import time
from typing import Any

import httpx
import pytest
from botocore.exceptions import ClientError

from shared_store.volume.logs import REPLACED, format_line
from tests.conftest import MAIN_LAST, Serving
from tests.support.conformance.streams import ARN, GROUP, append, client_of, finished, log_of, messages, stream_of


@pytest.fixture(scope="module")
def logs(shared_server: Serving) -> Any:
    return client_of(shared_server.url)


@pytest.fixture(scope="module")
def counted(shared_server: Serving) -> str:
    """A job that is over and has printed ``line 0000`` … ``line 2499``."""
    return finished(shared_server, "for i in range(2500): print(f'line {i:04d}')", name="counted")


@pytest.fixture
def quiet(shared_server: Serving) -> str:
    """A job that is over and printed one line; its supervisor's last line is not part of the stream."""
    return finished(shared_server, "print('quiet')", name="quiet")


def searched(logs: Any, **query: Any) -> list[dict[str, Any]]:
    """The events of all pages of a search: a page ends after two seconds, too."""
    pages = logs.get_paginator("filter_log_events").paginate(**query)
    return [event for page in pages for event in page["events"]]


# -- GetLogEvents -----------------------------------------------------------------------------------------------------


def test_the_stream_of_a_job_has_both_outputs_and_not_the_supervisors_end(shared_server: Serving, logs: Any) -> None:
    job = finished(shared_server, "import sys; print('to out'); sys.stdout.flush(); print('to err', file=sys.stderr)")
    described = client_of(shared_server.url, "batch").describe_jobs(jobs=[f"{job}#0"])["jobs"][0]
    name = described["container"]["logStreamName"]
    assert name == stream_of(shared_server, job)
    page = logs.get_log_events(logGroupName=GROUP, logStreamName=name, startFromHead=True)
    assert sorted(messages(page)) == ["to err", "to out"]
    assert shared_server.log(job)[-1] == "node 0 ended: done", "`muster logs` shows it"
    times = [event["timestamp"] for event in page["events"]]
    assert times == sorted(times) == [event["ingestionTime"] for event in page["events"]]
    assert described["createdAt"] <= times[0] <= described["stoppedAt"] + 1000


def test_at_the_end_the_same_token_comes_back_until_lines_arrive(shared_server: Serving, logs: Any, quiet: str) -> None:
    query = {"logGroupName": GROUP, "logStreamName": stream_of(shared_server, quiet)}
    first = logs.get_log_events(**query)
    assert messages(first) == ["quiet"]
    token = first["nextForwardToken"]
    for _ in range(2):
        end = logs.get_log_events(**query, nextToken=token, startFromHead=True)
        assert end["events"] == [] and end["nextForwardToken"] == token
    append(shared_server, quiet, "a", "b")
    later = logs.get_log_events(**query, nextToken=token)
    assert messages(later) == ["a", "b"] and later["nextForwardToken"] != token
    before = logs.get_log_events(**query, nextToken=later["nextBackwardToken"])
    assert messages(before) == ["quiet"]


def test_a_line_that_is_still_being_written_is_not_given_out(shared_server: Serving, logs: Any, quiet: str) -> None:
    path = log_of(shared_server, quiet)
    query = {"logGroupName": GROUP, "logStreamName": stream_of(shared_server, quiet), "startFromHead": True}
    line = format_line(time.time(), 0, "o", "whole")
    with open(path, "a") as file:
        file.write(line[:-3])
        file.flush()
        half = logs.get_log_events(**query)
        file.write(line[-3:])
    assert messages(half) == ["quiet"]
    assert messages(logs.get_log_events(**query, nextToken=half["nextForwardToken"])) == ["whole"]


@pytest.mark.parametrize("forward", [True, False])
def test_pages_either_way_give_every_line_once(shared_server: Serving, logs: Any, counted: str, forward: bool) -> None:
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
    assert page["events"] == [] and [len(each) for each in pages] == [700, 700, 700, 400]
    lines = [line for each in (pages if forward else pages[::-1]) for line in each]
    assert lines == [f"line {i:04d}" for i in range(2500)]


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


def test_times_never_fall_when_a_clock_steps_back(shared_server: Serving, logs: Any, quiet: str) -> None:
    high = int(time.time()) - 100
    log_of(shared_server, quiet).write_bytes(b"")
    append(shared_server, quiet, "before", seconds=high)
    append(shared_server, quiet, *(f"{'x' * 100} {i}" for i in range(1000)), "after", seconds=high - 8)
    name = stream_of(shared_server, quiet)
    whole = searched(logs, logGroupName=GROUP, logStreamNames=[name])
    assert [event["timestamp"] for event in whole] == [high * 1000] * 1002
    # whoever had seen "before" asks from its time on, which begins deep in the file, and must find the same events
    assert searched(logs, logGroupName=GROUP, logStreamNames=[name], startTime=high * 1000) == whole
    last = logs.get_log_events(logGroupName=GROUP, logStreamName=name, limit=1)["events"]
    assert last == [{"timestamp": high * 1000, "ingestionTime": high * 1000, "message": "after"}]


@pytest.mark.parametrize("token", ["x", "f/", "f/-1", "f/01", "b/1x", "g/5", "f/" + "9" * 40, "f/１"])
def test_a_malformed_token_is_an_invalid_parameter(shared_server: Serving, logs: Any, counted: str, token: str) -> None:
    with pytest.raises(logs.exceptions.InvalidParameterException, match="nextToken is invalid"):
        logs.get_log_events(logGroupName=GROUP, logStreamName=stream_of(shared_server, counted), nextToken=token)


def test_a_token_inside_a_line_or_beyond_the_end_is_understood(shared_server: Serving, logs: Any, counted: str) -> None:
    name = stream_of(shared_server, counted)
    page = logs.get_log_events(logGroupName=GROUP, logStreamName=name, nextToken="f/5", limit=1)
    assert messages(page) == ["line 0001"]
    past = logs.get_log_events(logGroupName=GROUP, logStreamName=name, nextToken="f/99999999999")
    assert messages(past)[:2] == [REPLACED, "line 0000"]  # the file was longer once


# -- FilterLogEvents --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trio(shared_server: Serving) -> str:
    """A job that is over, of three nodes that printed ``<node>:<i>``, 60 lines each, at the same time."""
    script = """
import os, time
for i in range(60): print(os.environ["AWS_BATCH_JOB_NODE_INDEX"], i, sep=":"); time.sleep(0.005)
"""
    return finished(shared_server, script + MAIN_LAST, 3, "trio")


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
    backwards = {"startFromHead": False, "PaginationConfig": {"PageSize": 70}}
    reverse = logs.get_paginator("filter_log_events").paginate(**query, **backwards)
    assert [event for page in reverse for event in page["events"]] == events[::-1]
    names = [stream_of(shared_server, trio, node) for node in (2, 0)]
    named = searched(logs, logGroupName=GROUP, logStreamNames=names, filterPattern=query["filterPattern"])
    assert named == [event for event in events if event["logStreamName"] in names]


def test_without_a_stream_the_whole_group_is_searched(logs: Any, trio: str, counted: str) -> None:
    found = searched(logs, logGroupName=GROUP, filterPattern='?"2:59" ?"line 0042"')
    assert {f"trio/{trio}/1/node-2", f"counted/{counted}/1/node-0"} <= {event["logStreamName"] for event in found}
    assert {event["message"] for event in found} == {"2:59", "line 0042"}


def test_event_ids_are_the_same_after_a_restart_and_from_any_start(server: Serving) -> None:
    job = finished(server, "for i in range(3000): print('text of line', i)")
    query = {"logGroupName": GROUP, "logStreamNames": [stream_of(server, job)]}
    before = searched(client_of(server.url), **query)
    server.kill()
    server.start()
    logs = client_of(server.url)
    since = before[2500]["timestamp"]
    assert searched(logs, **query, startTime=since) == [e for e in before if e["timestamp"] >= since]
    assert searched(logs, **query) == before and len(before) == 3000


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
        ("%a{5,2}%", "invalid repetition size"),
        ("%a% %b% %c%", "more than 2"),
        ("%" + ".{999}" * 150 + "%", "pattern too large"),
        ("x" * 1025, "1024"),
    ],
)
def test_bad_patterns_are_invalid_parameters_that_say_why(logs: Any, pattern: str, message: str) -> None:
    with pytest.raises(logs.exceptions.InvalidParameterException, match=message):
        logs.filter_log_events(logGroupName=GROUP, filterPattern=pattern)
    with pytest.raises(ClientError, match=message) as caught:
        logs.start_live_tail(logGroupIdentifiers=[ARN], logEventFilterPattern=pattern)
    assert caught.value.response["Error"]["Code"] == "InvalidParameterException"


# -- rules and refusals -----------------------------------------------------------------------------------------------


def test_names_prefix_and_two_names_of_the_group_exclude_others(
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


# -- describing -------------------------------------------------------------------------------------------------------


def test_streams_are_listed_by_name_page_by_page(shared_server: Serving, logs: Any, trio: str) -> None:
    prefix = f"trio/{trio}"
    paginator = logs.get_paginator("describe_log_streams")
    pages = list(paginator.paginate(logGroupName=GROUP, logStreamNamePrefix=prefix, PaginationConfig={"PageSize": 2}))
    assert [len(page["logStreams"]) for page in pages] == [2, 1]
    streams = [stream for page in pages for stream in page["logStreams"]]
    assert [stream["logStreamName"] for stream in streams] == [f"{prefix}/1/node-{node}" for node in range(3)]
    for stream in streams:
        name = stream["logStreamName"]
        events = logs.get_log_events(logGroupName=GROUP, logStreamName=name, startFromHead=True)["events"]
        assert stream["firstEventTimestamp"] == events[0]["timestamp"]
        assert stream["lastEventTimestamp"] == stream["lastIngestionTime"] == events[-1]["timestamp"]
        assert stream["creationTime"] <= stream["firstEventTimestamp"]
        assert stream["arn"] == f"{ARN}:log-stream:{stream['logStreamName']}"
        assert stream["uploadSequenceToken"] and stream["storedBytes"] > 60 * 30
    for narrower, count in ((f"{prefix}/1/node-1", 1), (prefix[:-3], 3), (f"{prefix}/2", 0), ("tri", 3)):
        found = logs.describe_log_streams(logGroupName=GROUP, logStreamNamePrefix=narrower)["logStreams"]
        assert len(found) == count and all(stream in streams for stream in found)
    backwards = logs.describe_log_streams(logGroupIdentifier=ARN, logStreamNamePrefix=prefix, descending=True)
    assert backwards["logStreams"] == streams[::-1] and "nextToken" not in backwards


def test_streams_are_listed_by_their_last_event(shared_server: Serving, logs: Any, trio: str, counted: str) -> None:
    append(shared_server, counted, "the newest of all")
    paginator = logs.get_paginator("describe_log_streams")
    for descending in (True, False):
        query = {"logGroupName": GROUP, "orderBy": "LastEventTime", "descending": descending}
        pages = paginator.paginate(**query, PaginationConfig={"PageSize": 2})
        streams = [stream for page in pages for stream in page["logStreams"]]
        times = [stream.get("lastEventTimestamp", 0) for stream in streams]
        assert times == sorted(times, reverse=descending)
        names = [stream["logStreamName"] for stream in streams]
        assert len(set(names)) == len(names) and f"trio/{trio}/1/node-1" in names
        assert names[0 if descending else -1] == f"counted/{counted}/1/node-0"
    with pytest.raises(logs.exceptions.InvalidParameterException, match="LastEventTime"):
        logs.describe_log_streams(logGroupName=GROUP, orderBy="LastEventTime", logStreamNamePrefix="trio")


def test_jobs_have_a_log_group_that_is_found_by_the_start_and_by_a_part_of_its_name(logs: Any, trio: str) -> None:
    [group] = logs.describe_log_groups(logGroupNamePrefix=GROUP)["logGroups"]
    assert (group["logGroupName"], group["arn"], group["logGroupArn"]) == (GROUP, f"{ARN}:*", ARN)
    part = GROUP[1:]  # others, which other tests create, do not have it
    assert [g["logGroupName"] for g in logs.describe_log_groups(logGroupNamePattern=part)["logGroups"]] == [GROUP]
    classed = {"logGroupNamePrefix": GROUP, "logGroupClass": "DELIVERY"}
    for nothing in ({"logGroupNamePrefix": part}, {"logGroupNamePattern": part.upper()}, classed):
        assert logs.describe_log_groups(**nothing)["logGroups"] == []


# -- malformed requests, here and of Batch: never an internal error ---------------------------------------------------

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


@pytest.mark.parametrize("operation", ["GetLogEvents", "FilterLogEvents", "DescribeLogStreams", "StartLiveTail", "No"])
def test_no_malformed_request_is_a_server_error(shared_server: Serving, operation: str) -> None:
    for body in BODIES:
        headers = {"X-Amz-Target": f"Logs_20140328.{operation}"}
        answer = httpx.post(shared_server.url, content=body, headers=headers)
        assert answer.status_code == 400, (body, answer.text)
        kind = answer.json()["__type"]
        assert kind in ("InvalidParameterException", "ResourceNotFoundException") and answer.json()["message"]
        assert "\n" not in answer.json()["message"] and answer.headers["content-type"] == "application/x-amz-json-1.1"


@pytest.mark.parametrize("target", [None, "", "Logs_20140328.", "Logs_20140328.__class__"])
def test_a_request_without_a_known_target_is_refused(shared_server: Serving, target: str | None) -> None:
    headers = {} if target is None else {"X-Amz-Target": target}
    answer = httpx.post(shared_server.url, content=b"{}", headers=headers)
    assert answer.status_code == 400 and "supported are" in answer.json()["message"]
