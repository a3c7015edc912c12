"""Clients that mean harm, class by class: what each does to a server, and that it may not hurt anybody else.

Bounded: every connection is closed when its class is over, and all of it goes to a server on loopback.
"""

from __future__ import annotations

import contextlib
import json
import random
import socket
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import httpx

LEVELS = 9
"""Of an alias bomb: eight times as many values each."""
HEAD = b"POST /v1/listjobs HTTP/1.1\r\nHost: 127.0.0.1\r\n"


@dataclass(frozen=True)
class Target:
    """A server, a token that may do everything, a run that can be resumed, and a definition (type container)."""

    host: str
    port: int
    token: str
    run: str
    definition: str

    @property
    def authorization(self) -> bytes:
        return b"Authorization: Bearer " + self.token.encode() + b"\r\n"


@contextlib.contextmanager
def connections(target: Target, count: int) -> Iterator[list[socket.socket]]:
    """As many connections as the server takes, ``count`` at most."""
    opened: list[socket.socket] = []
    with contextlib.ExitStack() as stack:
        for _ in range(count):
            with contextlib.suppress(OSError):
                opened.append(stack.enter_context(socket.create_connection((target.host, target.port), timeout=10)))
        yield opened


def _send(connection: socket.socket, data: bytes) -> None:
    with contextlib.suppress(OSError):  # a server that refuses closes the connection
        connection.sendall(data)


Class = Callable[[Target, int, random.Random, Callable[[], None]], int]
"""Called with a target, how many to send, random numbers, and what to do while its connections are open; returns how many."""


def _silent(data: Callable[[Target, random.Random], bytes]) -> Class:
    """Connections that send this and fall silent: the server waits for more, or for a reader of its answers."""

    def send(target: Target, count: int, rng: random.Random, meanwhile: Callable[[], None]) -> int:
        with connections(target, count) as opened:
            for each in opened:
                each.setblocking(False)
                _send(each, data(target, rng))
            meanwhile()
        return count

    return send


def _half_a_body(target: Target, rng: random.Random) -> bytes:
    """With a token or without."""
    token = target.authorization if rng.random() < 0.5 else b""
    return HEAD + token + b"Content-Length: 1000000\r\n\r\n" + b" " * rng.randrange(5000)


def _questions(target: Target, rng: random.Random) -> bytes:
    """For much, again and again."""
    request = b"GET /api/openapi.json HTTP/1.1\r\nHost: 127.0.0.1\r\n" + target.authorization + b"\r\n"
    return request * rng.randrange(1, 20)


def hang_up(target: Target, count: int, rng: random.Random, meanwhile: Callable[[], None]) -> int:
    """Connections that are reset in the middle of a request or of its answer."""
    whole = HEAD + target.authorization + b'Content-Length: 24\r\n\r\n{"jobQueue": "default"  }'
    for _ in range(count):
        with connections(target, 1) as opened:
            for each in opened:
                _send(each, whole[: rng.randrange(1, len(whole) + 1)])
                each.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # a reset, not an end
    meanwhile()
    return count


def alias_bomb(levels: int) -> str:
    """YAML whose value has 8 to the power of ``levels`` parts."""
    parts = ["a0: &a0 [x,x,x,x,x,x,x,x]"]
    parts += [f"a{n}: &a{n} [{','.join([f'*a{n - 1}'] * 8)}]" for n in range(1, levels)]
    return "train.config={" + ", ".join(parts) + "}"


def references(definition: str, count: int) -> dict[str, Any]:
    """A SubmitJob whose command would be ``count`` times 14,000 bytes long once its parameter is substituted."""
    submission = {"jobName": "references", "jobQueue": "default", "jobDefinition": definition}
    override = {"command": ["echo", "Ref::a " * count]}
    return {**submission, "containerOverrides": override, "parameters": {"a": "x" * 14_000}}


def _bodies(target: Target, rng: random.Random) -> Iterator[tuple[str, Any]]:
    """Paths with bodies that grow when they are read or answered."""
    deep = "[" * rng.choice((50, 5_000, 100_000))
    while True:
        yield f"/api/runs/{target.run}/resume", json.dumps({"set": [alias_bomb(rng.randrange(2, LEVELS))]})
        yield "/v1/describejobs", json.dumps({"jobs": ["0"] * rng.choice((101, 10_000, 200_000))})
        yield "/v1/submitjob", json.dumps({"jobName": "x" * rng.choice((200, 500_000))})
        yield "/v1/submitjob", json.dumps(references(target.definition, rng.choice((1_000, 2_000))))
        yield "/v1/terminatejob", json.dumps({"jobId": "0", "reason": "\x1b]0;x\x07" * rng.choice((1, 100_000))})
        yield "/v1/listjobs", deep
        yield "/v1/listjobs", '{"jobQueue": ' + "9" * rng.choice((5_000, 900_000)) + "}"
        yield f"/api/runs/{target.run}/resume", json.dumps({"set": ["name=" + "x" * 400_000]})
        yield "/v1/registerjobdefinition", json.dumps({"jobDefinitionName": "a", "parameters": {"k": {}}, "type": deep})


def expansion(target: Target, count: int, rng: random.Random, meanwhile: Callable[[], None]) -> int:
    """Small or odd bodies that grow when they are read; no answer may be longer than 64 KiB."""
    url, bodies = f"http://{target.host}:{target.port}", _bodies(target, rng)
    with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {target.token}"}, timeout=60) as http:
        for path, body in (next(bodies) for _ in range(count)):
            answer = http.post(path, content=body, headers={"Content-Type": "application/json"})
            assert 400 <= answer.status_code < 500, (path, body[:200], answer.status_code, answer.text[:500])
            assert len(answer.content) < 1 << 16, (path, body[:200], len(answer.content))
    meanwhile()
    return count


def foreign_services(target: Target, count: int, rng: random.Random, meanwhile: Callable[[], None]) -> int:
    """Requests for services of AWS that are not here."""
    sent: tuple[tuple[str, str, dict[str, str], str], ...] = (
        ("GET", "/bucket?list-type=2", {}, ""),
        (
            "POST",
            "/",
            {"Content-Type": "application/x-www-form-urlencoded"},
            "Action=GetCallerIdentity&Version=2011-06-15",
        ),
        ("POST", "/", {"X-Amz-Target": "DynamoDB_20120810.ListTables"}, "{}"),
        ("PUT", "/bucket/key", {}, "data"),
    )
    with httpx.Client(base_url=f"http://{target.host}:{target.port}", timeout=60) as http:
        for _ in range(count):
            method, path, headers, body = rng.choice(sent)
            supplied = {**headers, "Authorization": f"Bearer {target.token}"}
            assert 400 <= http.request(method, path, headers=supplied, content=body).status_code < 500
    meanwhile()
    return count


CLASSES: Mapping[str, Class] = {
    "half a request line": _silent(lambda target, rng: b"GET /healthz HT"[: rng.randrange(16)]),
    "half a header": _silent(lambda target, rng: HEAD + b"X: " + b"y" * rng.randrange(1000)),
    "half a body": _silent(_half_a_body),
    "never reads": _silent(_questions),
    "hangs up": hang_up,
    "expansion": expansion,
    "services that are not here": foreign_services,
}
