"""CloudWatch Logs over the logs in the store: JSON 1.1 on ``POST /``, the operation in ``X-Amz-Target``.

A stream for every node of every attempt is in ``/aws/batch/job``, or in the group that its container names. Positions are bytes in
the log files, and tokens carry all that is needed to continue, also after a restart.
"""

from __future__ import annotations

import heapq
import json
import re
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from functools import partial
from itertools import chain, islice
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.responses import JSONResponse, Response
from starlette.types import Receive, Scope, Send

from orchestrator.api.batch.service_model import problem_with, service_model
from orchestrator.api.http.answer_streams import Following
from orchestrator.api.http.limits import check_size
from orchestrator.api.logs import filter as log_filter
from orchestrator.api.logs import groups
from orchestrator.api.logs.errors import JSON, LogsError, absent, invalid
from orchestrator.api.logs.live_tail import LiveTail, messages
from orchestrator.api.logs.log_events import LogEvent, event_id, first_and_last
from orchestrator.api.logs.streams import Stream, created_streams, find_stream, newest_streams
from orchestrator.control.controller import Controller
from orchestrator.domain.errors import RequestError, Unavailable
from orchestrator.persistence.batch_models import now
from orchestrator.services.arns import here, log_group_arn
from orchestrator.services.permissions import Actor, Operation, Refusal

SETTLE = 500
"""Milliseconds for which FilterLogEvents keeps back the newest lines of running gangs.

A follower continues from the newest time that it has seen. A node's line must not turn up after a later one of another node was
given out, so a line has this long to get from its node's clock into the file that is read here: hosts' clocks must agree to less
than this, and a shared volume must show what was written within it.
"""
_MOST_EVENTS = 10_000
_MOST_BYTES = 1 << 20
"""Of a page, with 26 for each event, as AWS counts."""
_LONGEST_SEARCH = 2.0
"""Seconds after which FilterLogEvents answers with what it has, and a token to continue."""
_LATE = 3_600_000
"""Milliseconds by which a node's clock may be ahead of the controller's: a stream is searched for lines up to this much
younger than its attempt's end."""
_STREAM_TOKEN = re.compile(r"([fb])/(0|[1-9][0-9]{0,17})")
_SEARCH_TOKEN = re.compile(r"([fb])([0-9]{14})([0-9]{24})([0-9]{18})")
_LIST_TOKEN = re.compile(r"([0-9]{1,15})/(.+)")


async def answer(
    controller: Controller, actor: Actor, ending: threading.Event, target: str, body: Callable[[], Awaitable[Any]]
) -> Response:
    """Answer one request; a refusal is an answer, too.

    Args:
        controller: Whose logs these are.
        ending: Set when the server ends, which ends the streams.
        target: The header ``X-Amz-Target``.
        body: Reads the request's JSON. Raises ClientError.
    """
    try:
        operation = target.partition(".")[2] if target.startswith("Logs_20140328.") else ""
        if operation not in NAMES:
            names = f"supported are {', '.join(NAMES)}"
            instead = next((use for part, use in _INSTEAD.items() if part in operation), names)
            raise invalid(f"{operation or f'X-Amz-Target {target!r}'} is not supported; {instead}")
        actor.check(Operation(operation))
        request = validate(operation, await body())
        if operation == "StartLiveTail":
            return await controller.access.calls.answer(partial(start_live_tail, controller, actor, ending, request))
        if operation in groups.WRITES:
            await run_in_threadpool(groups.write, controller, actor, operation, request)
            return JSONResponse({}, media_type=JSON)
        return await controller.access.calls.answer(
            lambda: JSONResponse(OPERATIONS[operation](controller, actor, request), media_type=JSON)
        )
    except LogsError as error:
        return error.response()
    except Refusal as error:
        return LogsError(error.kind, str(error), error.status).response()
    except RequestError as error:
        return LogsError("InvalidParameterException", str(error), error.status).response()
    except Unavailable as error:
        return LogsError("ServiceUnavailableException", str(error), 503).response()
    except OSError as error:
        return LogsError("ServiceUnavailableException", f"the store can't be read: {error}", 503).response()


def validate(operation: str, request: object) -> dict[str, Any]:
    """The request, checked against AWS's model. Raises LogsError with what is wrong, in one line."""
    if not isinstance(request, dict):
        raise invalid(f"{operation}: expected a JSON object")
    check_size(operation, request)
    try:
        if "\\u0000" in json.dumps(request, ensure_ascii=False).encode().decode():
            raise invalid(f"{operation}: zero bytes are not allowed")
    except (UnicodeEncodeError, RecursionError):
        raise invalid(f"{operation}: not text (half a surrogate pair), or nested too deep") from None
    if problem := problem_with("logs", operation, request):
        raise invalid(problem)
    members = service_model("logs").operation_model(operation).input_shape.members
    for name, value in request.items():
        member = members[name]
        size = value if isinstance(value, int) else len(value)
        most = member.metadata.get("max", 2**63 - 1)  # which botocore leaves to the service
        if size > most:
            raise invalid(f"{name}: {size} is more than {most}")
    return request


# -- operations -------------------------------------------------------------------------------------------------------


def get_log_events(controller: Controller, actor: Actor, request: dict[str, Any]) -> dict[str, Any]:
    """GetLogEvents: a page of one stream, from either end or from a token. Tokens are positions: they never expire."""
    with controller.database.session() as session:
        group = groups.named_by(session, request)
        stream = _named(controller, actor, session, group, request["logStreamName"], Operation.GET_LOG_EVENTS)
    view = stream.file.snapshot()
    since, before = request.get("startTime", 0), request.get("endTime")
    limit = request.get("limit", _MOST_EVENTS)
    token = _STREAM_TOKEN.fullmatch(sent) if (sent := request.get("nextToken")) else None
    if sent and not token:
        raise invalid("The specified nextToken is invalid.")
    forward = token[1] == "f" if token else request.get("startFromHead", False)
    if forward:
        here = int(token[2]) if token else 0
        notices = [view.replaced()] if here > view.end else []
        here = 0 if notices else here
        found = _until(view.forward(since, here), lambda event: before is not None and event.time >= before)
        page = _page(chain(notices, found), limit)
    else:
        here = int(token[2]) if token else view.end
        page = _page(_until(view.backward(before, here), lambda event: event.time < since), limit)[::-1]
    return {
        "events": [{"timestamp": e.time, "message": e.text, "ingestionTime": e.time} for e in page],
        "nextForwardToken": f"f/{page[-1].end if page else here}",
        "nextBackwardToken": f"b/{page[0].offset if page else here}",
    }


def filter_log_events(controller: Controller, actor: Actor, request: dict[str, Any]) -> dict[str, Any]:
    """FilterLogEvents: the matching events of many streams, merged by time; the newest first with startFromHead false.

    A page ends after ``limit`` events, 1 MiB, or two seconds of search. Its token is the id of the last event that was looked at.
    """
    newest = now() - SETTLE  # before anything is looked at
    matches = _pattern(request.get("filterPattern", ""))
    token = _SEARCH_TOKEN.fullmatch(sent) if (sent := request.get("nextToken")) else None
    if sent and not token:
        raise invalid("The specified nextToken is invalid.")
    ascending = token[1] == "f" if token else request.get("startFromHead", True)
    since, before = request.get("startTime", 0), request.get("endTime", 10**14) + 1  # inclusive here, as AWS has it
    streams = _searched(controller, actor, request, since)
    if len(request.get("logStreamNames", ())) != 1 and any(stream.live for stream in streams):
        before = min(before, newest)
    reached = (int(token[2]), int(token[3]), int(token[4])) if token else None
    views = [stream.file.snapshot() for stream in streams]
    events: Iterator[LogEvent]
    if ascending:
        start = max(since, reached[0]) if reached else since
        events = heapq.merge(*(view.forward(start) for view in views))
        events = _until(events, lambda event: event.time >= before)
    else:
        stop = min(before, reached[0] + 1) if reached else before
        events = heapq.merge(*(view.backward(stop) for view in views), reverse=True)
        events = _until(events, lambda event: event.time < since)
    if reached:
        events = (event for event in events if (event[:3] > reached if ascending else event[:3] < reached))
    page, last = _search(events, matches, request.get("limit", _MOST_EVENTS))
    response: dict[str, Any] = {
        "events": [
            {
                "logStreamName": e.stream,
                "timestamp": e.time,
                "message": e.text,
                "ingestionTime": e.time,
                "eventId": e.id,
            }
            for e in page
        ],
        "searchedLogStreams": [],
    }
    if last:
        response["nextToken"] = f"{'f' if ascending else 'b'}{event_id(last.time, last.source, last.offset)}"
    return response


def describe_log_streams(controller: Controller, actor: Actor, request: dict[str, Any]) -> dict[str, Any]:
    """DescribeLogStreams: by name or by the time of the last event, of the newest 1,000 streams that fit."""
    by_time = request.get("orderBy", "LogStreamName") == "LastEventTime"
    if request.get("orderBy", "LogStreamName") not in ("LogStreamName", "LastEventTime"):
        raise invalid(f"orderBy {request['orderBy']!r}: it is LogStreamName or LastEventTime")
    prefix = request.get("logStreamNamePrefix", "")
    if by_time and prefix:
        raise invalid("Cannot order by LastEventTime with a logStreamNamePrefix.")
    token = _LIST_TOKEN.fullmatch(sent) if (sent := request.get("nextToken")) else None
    if sent and not token:
        raise invalid("The specified nextToken is invalid.")
    with controller.database.session() as session:
        group = groups.named_by(session, request)
        streams = newest_streams(session, actor, controller.access.store, (group,), prefix) + created_streams(
            session, group, prefix
        )
    times = {stream.name: first_and_last(stream.path) for stream in streams} if by_time else {}
    keyed = [((known[1] if (known := times.get(s.name)) else 0, s.name), s) for s in streams]
    descending = request.get("descending", False)
    keyed.sort(key=lambda pair: pair[0], reverse=descending)
    if token:
        reached = (int(token[1]), token[2])
        keyed = [pair for pair in keyed if (pair[0] < reached if descending else pair[0] > reached)]
    size = request.get("limit", 50)
    response: dict[str, Any] = {"logStreams": [_describe(stream) for _, stream in keyed[:size]]}
    if len(keyed) > size:
        latest, name = keyed[size - 1][0]
        response["nextToken"] = f"{latest}/{name}"
    return response


OPERATIONS: dict[str, Callable[[Controller, Actor, dict[str, Any]], dict[str, Any]]] = {
    "GetLogEvents": get_log_events,
    "FilterLogEvents": filter_log_events,
    "DescribeLogStreams": describe_log_streams,
    "DescribeLogGroups": groups.describe_log_groups,
    "ListTagsForResource": groups.list_tags_for_resource,
}
NAMES = (*OPERATIONS, *groups.WRITES, "StartLiveTail")
_INSTEAD = {
    "Quer": "search with FilterLogEvents, whose patterns take terms, phrases and regular expressions",
    "PutLogEvents": "streams hold what jobs print",
    "ListLogGroups": "use DescribeLogGroups",
    "ListTagsLogGroup": "use ListTagsForResource",
    "TagLogGroup": "use TagResource",
    "UntagLogGroup": "use UntagResource",
    "MetricFilter": "read GET /metrics, or poll FilterLogEvents",
    "SubscriptionFilter": "follow with StartLiveTail",
    "ExportTask": "read with FilterLogEvents, or copy the files of the run from the store",
}
"""Substitutes for unsupported operations, by a part of their names."""


def start_live_tail(controller: Controller, actor: Actor, ending: threading.Event, request: dict[str, Any]) -> Response:
    """StartLiveTail: an event stream of the lines that are written from now on. Streams need not exist yet."""
    with controller.database.session() as session:
        tailed = [groups.existing(session, identifier) for identifier in request["logGroupIdentifiers"]]
    names, prefixes = request.get("logStreamNames"), request.get("logStreamNamePrefixes")
    if names and prefixes:
        raise invalid("logStreamNames and logStreamNamePrefixes can't be used together.")
    if (names or prefixes) and len(tailed) > 1:
        raise invalid("logStreamNames and logStreamNamePrefixes need exactly one log group in logGroupIdentifiers.")
    matches = _pattern(request.get("logEventFilterPattern", ""))
    chosen = set(names or ())

    def accepts(name: str) -> bool:
        return name in chosen if names else not prefixes or name.startswith(tuple(prefixes))

    start = {"logGroupIdentifiers": [log_group_arn(name) for name in tailed]}
    start |= {"logEventFilterPattern": request.get("logEventFilterPattern", "")}
    start |= {"logStreamNames": names or [], "logStreamNamePrefixes": prefixes or []}
    tail = LiveTail(controller, actor, tailed, accepts, matches)
    return _Session(tail, messages(tail, start, here().id, ending))


class _Session(Following):
    media_type = "application/vnd.amazon.eventstream"

    def __init__(self, tail: LiveTail, stream: AsyncIterator[bytes]) -> None:
        super().__init__(stream)
        self._tail = tail

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        with self._tail:
            await super().__call__(scope, receive, send)

    def refusal(self, message: str) -> Response:
        return LogsError("LimitExceededException", message).response()


# -- parts ------------------------------------------------------------------------------------------------------------


def _named(controller: Controller, actor: Actor, session: Any, group: str, name: str, operation: Operation) -> Stream:
    stream = find_stream(session, actor, controller.access.store, group, name, operation)
    if stream is None:
        raise absent("log stream", name)
    return stream


def _searched(controller: Controller, actor: Actor, request: dict[str, Any], since: int) -> list[Stream]:
    """The streams that a search is about; those named must exist."""
    names, prefix = request.get("logStreamNames"), request.get("logStreamNamePrefix")
    if names and prefix:
        raise invalid("Only one of logStreamNames and logStreamNamePrefix can be used.")
    with controller.database.session() as session:
        group, operation = groups.named_by(session, request), Operation.FILTER_LOG_EVENTS
        if names:
            return [_named(controller, actor, session, group, name, operation) for name in dict.fromkeys(names)]
        return newest_streams(session, actor, controller.access.store, (group,), prefix or "", since - _LATE)


def _pattern(text: str) -> log_filter.Matcher:
    try:
        return log_filter.parse(text)
    except ValueError as error:
        raise invalid(f"Invalid filter pattern: {error}") from None


def _until(events: Iterator[LogEvent], over: Callable[[LogEvent], bool]) -> Iterator[LogEvent]:
    for event in events:
        if over(event):
            return
        yield event


def _size(event: LogEvent) -> int:
    return len(event.text.encode()) + 26


def _page(events: Iterator[LogEvent], limit: int) -> list[LogEvent]:
    """The first events that fit on a page; one at least."""
    page: list[LogEvent] = []
    size = 0
    for event in islice(events, limit):
        size += _size(event)
        if page and size > _MOST_BYTES:
            break
        page.append(event)
    return page


def _search(
    events: Iterator[LogEvent], matches: log_filter.Matcher, limit: int
) -> tuple[list[LogEvent], LogEvent | None]:
    """The matching events of a page, and the last one that was looked at, where there may be more after it."""
    page: list[LogEvent] = []
    size, last = 0, None
    deadline = time.monotonic() + _LONGEST_SEARCH
    for event in events:
        if len(page) == limit or (last and time.monotonic() > deadline):
            return page, last
        if matches(event.text):
            size += _size(event)
            if page and size > _MOST_BYTES:
                return page, last
            page.append(event)
        last = event
    return page, None


def _describe(stream: Stream) -> dict[str, Any]:
    described = {
        "logStreamName": stream.name,
        "creationTime": stream.created,
        "uploadSequenceToken": f"{stream.file.source:056d}",
        "arn": f"{log_group_arn(stream.group)}:log-stream:{stream.name}",
        "storedBytes": 0,
    }
    if known := first_and_last(stream.path):
        first, last, size = known
        described |= {"firstEventTimestamp": first, "lastEventTimestamp": last, "lastIngestionTime": last}
        described["storedBytes"] = size
    return described
