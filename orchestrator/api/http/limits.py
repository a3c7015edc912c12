"""Limits of clients: bytes per request, requests per second."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from typing import Any

from starlette.requests import ClientDisconnect
from starlette.types import Message, Receive

from orchestrator.domain.errors import ClientError
from orchestrator.domain.gang import LARGEST_DEFINITION

LARGEST_BODY = 1 << 20
"""Bytes of any request's body."""
LARGEST = {"submitjob": 30 << 10, "registerjobdefinition": LARGEST_DEFINITION}
"""Bytes of the body of these operations (lower case), as on AWS."""
LARGEST_COMMANDS = 64 << 10
"""Bytes of the commands of all node ranges of a job, with its parameters substituted."""
MOST_VALUES = 10_000
"""Texts, numbers, lists and objects of a request."""
DEEPEST = 50
"""Levels of lists and objects of a request."""
LARGEST_NUMBER = 2**63 - 1
MOST = {
    ("DescribeJobs", "jobs"): 100,
    ("TerminateJobs", "jobs"): 50,
    ("CancelJobs", "jobs"): 50,
    ("DescribeJobDefinitions", "jobDefinitions"): 100,
    ("DescribeJobQueues", "jobQueues"): 100,
    ("DescribeComputeEnvironments", "computeEnvironments"): 100,
    ("DescribeSchedulingPolicies", "arns"): 100,
    ("UntagResource", "tagKeys"): 50,
}
"""Entries of these lists of a request, as on AWS."""
RATE = 1000
"""Requests per second that one client may send for long, unless `muster serve` sets another rate."""
FAILURES = 50
"""Requests per second with a wrong token, key or signature that one address may send for long, twice as many at once."""
_SUBMISSIONS = ("submitjob", "POST /api/jobs")
"""Operations that the rate of submissions bounds."""
_FULL = 2.0
"""Seconds after which a bucket that nobody took from is full again, and need not be kept."""
_SWEEP = 10.0
"""Seconds between two looks for such buckets."""


def parse(text: str) -> Any:
    """The value of a request's JSON. Raises ClientError where it is not JSON or beyond a limit."""
    try:
        return json.loads(text, parse_int=_whole)
    except RecursionError:
        raise ClientError(f"the request is nested deeper than {DEEPEST} levels") from None
    except ValueError:
        raise ClientError("the request is not JSON") from None


def _whole(digits: str) -> int:
    if len(digits) > 20 or abs(int(digits)) > LARGEST_NUMBER:
        raise ClientError(f"a number of the request ({digits[:30]}…) is larger than {LARGEST_NUMBER}")
    return int(digits)


def check_size(operation: str, request: Mapping[str, Any]) -> None:
    """Refuse a request beyond a limit before anything else is done with it: checking its size costs next to nothing.

    Raises ClientError, naming the limit.
    """
    for (limited, member), most in MOST.items():
        entries = request.get(member) if limited == operation else None
        if isinstance(entries, list) and len(entries) > most:
            raise ClientError(f"{operation} takes at most {most} {member}, not {len(entries)}")
    count, level = 0, [request]
    for _ in range(DEEPEST):
        count += len(level)
        if count > MOST_VALUES:
            raise ClientError(f"{operation}: the request has more than {MOST_VALUES} values")
        if any(isinstance(each, float) and not math.isfinite(each) for each in level):
            raise ClientError(f"{operation}: a number of the request is too large")
        nested = [each for each in level if isinstance(each, dict | list)]
        if not nested:
            return
        level = [inner for each in nested for inner in (each.values() if isinstance(each, dict) else each)]
    raise ClientError(f"{operation}: the request is nested deeper than {DEEPEST} levels")


def _too_large(operation: str, limit: int) -> ClientError:
    shorten = "; shorten its environment and commands" if operation in LARGEST else ""
    return ClientError(f"{operation}: the request has more than {limit} bytes{shorten}", 413)


class RequestBody:
    """The body of an HTTP request: read whole within its limit, then handed to the application as if it were just coming."""

    def __init__(self, receive: Receive, declared: str | None, operation: str) -> None:
        """``declared``: the Content-Length, where there is one. ``operation``: in lower case; some have a limit of their own."""
        self._receive, self._declared, self._operation = receive, declared, operation
        self._limit = LARGEST.get(operation, LARGEST_BODY)
        self._whole: bytes | None = None
        self._delivered = False

    async def read(self) -> bytes:
        """All of it. Raises ClientError where it is too large (and keeps no more than the limit), ClientDisconnect."""
        if self._whole is None:
            length = self._declared or ""
            if length.isascii() and length.isdigit() and (len(length) > 9 or int(length) > self._limit):
                raise _too_large(self._operation, self._limit)
            parts: list[bytes] = []
            size = 0
            more = True
            while more:
                message = await self._receive()
                if message["type"] == "http.disconnect":
                    raise ClientDisconnect
                parts.append(message.get("body", b""))
                size += len(parts[-1])
                if size > self._limit:
                    raise _too_large(self._operation, self._limit)
                more = message.get("more_body", False)
            self._whole = b"".join(parts)
        return self._whole

    async def receive(self) -> Message:
        """For the application: the body in one message, then the client's further messages (its disconnect)."""
        if self._whole is None or self._delivered:
            return await self._receive()
        self._delivered = True
        return {"type": "http.request", "body": self._whole, "more_body": False}


class RateLimit:
    """A token bucket for each client: ``rate`` requests per second for long, twice as many at once. 0 means no limit.

    ``submit_rate`` bounds submissions on top of that (AWS: 50 per second).
    """

    def __init__(self, rate: int = RATE, submit_rate: int = 0) -> None:
        self.rate, self.submit_rate = rate, submit_rate
        self._buckets: dict[tuple[str, str], tuple[float, float]] = {}
        """(client, "" or operation) → tokens, and when they were counted (monotonic seconds)."""
        self._swept = 0.0

    def refusal(self, client: str, operation: str) -> str | None:
        """Count a request; None where it may pass, else why not. ``operation``: lower case."""
        if not self._take((client, ""), self.rate):
            return f"Too Many Requests: {client} may send {self.rate} requests per second; wait and try again"
        if operation in _SUBMISSIONS and not self._take((client, "submissions"), self.submit_rate):
            return f"Too Many Requests: {client} may submit {self.submit_rate} jobs per second; wait and try again"
        return None

    def refusal_of_failures(self, address: str) -> str | None:
        """Count a request whose token, key or signature is wrong; None where it is answered as such, else why not."""
        if self._take((address, "failures"), FAILURES):
            return None
        return f"Too Many Requests: {address} sends more than {FAILURES} requests per second with a wrong token or key"

    def fails_too_often(self, address: str) -> bool:
        """Whether :meth:`refusal_of_failures` would have a reason now; counts nothing."""
        return self._tokens((address, "failures"), FAILURES, time.monotonic()) < 1

    def _tokens(self, bucket: tuple[str, str], rate: int, now: float) -> float:
        tokens, counted = self._buckets.get(bucket, (2.0 * rate, now))
        return min(2.0 * rate, tokens + (now - counted) * rate)

    def _take(self, bucket: tuple[str, str], rate: int) -> bool:
        if rate <= 0:
            return True
        now = time.monotonic()
        tokens = self._tokens(bucket, rate, now)
        allowed = tokens >= 1
        self._buckets[bucket] = (tokens - 1 if allowed else tokens, now)
        if now - self._swept > _SWEEP:
            self._swept = now
            self._buckets = {key: entry for key, entry in self._buckets.items() if now - entry[1] < _FULL}
        return allowed
