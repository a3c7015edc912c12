"""Connections before authentication: limits on their number, and on the time that each may take to send a request.

uvicorn bounds the time between two requests and nothing else. Here a connection that does not send its request in time is closed,
and so is one that takes nothing of its answer for a minute. When there are too many, those that have waited longest for their
client give way. A client that reads its answer is never cut off: a log may be followed for days.
"""

from __future__ import annotations

import asyncio
import json
import logging
import resource
import socket
import time
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from orchestrator.api.http.callers import Caller

HEADER_TIMEOUT = 10.0
"""Seconds from the opening of a connection, or from the last answer, to the end of the next request's headers."""
BODY_TIMEOUT = 60.0
"""Seconds from there to the end of its body."""
_FLUSH_TIMEOUT = 60.0
"""Seconds without any progress after which a connection that has something to send is cut off."""
_UNSENT = 128 << 10
"""Bytes of answers that the kernel keeps for a client that does not read; by itself it would keep MBs."""
_BACKLOG = 128
"""Connections that the kernel keeps until they are accepted; so many are accepted at once, at most."""
_PIECE = 16 << 10
"""Bytes that are parsed at once. A head of more than h11's limit (64 KiB) and one piece is always refused."""
_MOST_DESCRIPTORS = 65_536
_MOST_CONNECTIONS = 4096
_QUIET = 60.0
"""Seconds between two lines about the same trouble."""

log = logging.getLogger("muster.api")


def raise_descriptor_limit() -> int:
    """Raise this process's limit of open files as far as it may, at most to 65,536; returns the limit."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    target = _MOST_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, _MOST_DESCRIPTORS)
    if soft != resource.RLIM_INFINITY and soft < target:
        resource.setrlimit(resource.RLIMIT_NOFILE, (target, hard))
        return target
    return _MOST_DESCRIPTORS if soft == resource.RLIM_INFINITY else soft


class Connections:
    """The open connections of one server; used in its event loop only."""

    def __init__(self, descriptors: int) -> None:
        """``descriptors``: the limit of open files. Half are for connections; the rest starts jobs and serves the database.

        A burst exceeds the half for a moment. asyncio accepts ``backlog`` connections in a turn of its loop, counts them two turns
        later, and closes those that give way a turn after that. So four times ``backlog`` are at most a quarter of ``descriptors``.
        """
        self.most = max(16, min(descriptors // 2, _MOST_CONNECTIONS))
        self.backlog = max(4, min(descriptors // 16, _BACKLOG))
        self.most_of_a_peer = self.most * 3 // 4
        self._peers: dict[str, int] = {}
        self._waiting: dict[str, dict[Connection, None]] = {}
        """By peer, the longest first: those whose request is not complete, or whose answer is not read."""
        self._count, self._logged = 0, -_QUIET

    def admit(self, connection: Connection) -> bool:
        """Count a new connection; where there are too many, another gives way. False where none can."""
        peer = connection.peer
        victim: Connection | None = None
        if self._peers.get(peer, 0) >= self.most_of_a_peer:
            victim = next(iter(self._waiting.get(peer, ())), None)
        elif self._count >= self.most:
            greatest = max(self._waiting.values(), key=len, default={})
            victim = next(iter(greatest), None)
        else:
            self._add(connection)
            return True
        if time.monotonic() - self._logged > _QUIET:
            self._logged = time.monotonic()
            log.warning(
                "%d connections are open, %d of them from %s; those that have waited for their client longest are closed first",
                *(self._count, self._peers.get(peer, 0), peer),
            )
        if victim is None:
            return False
        self.remove(victim)
        victim.give_way()
        self._add(connection)
        return True

    def _add(self, connection: Connection) -> None:
        self._count += 1
        self._peers[connection.peer] = self._peers.get(connection.peer, 0) + 1
        connection.counted = True

    def remove(self, connection: Connection) -> None:
        """It is closed, or about to be."""
        if not connection.counted:
            return
        connection.counted = False
        self.has_request(connection)
        self._count -= 1
        self._peers[connection.peer] -= 1
        if not self._peers[connection.peer]:
            del self._peers[connection.peer]

    def awaits_client(self, connection: Connection) -> None:
        """From now on it may be closed in favour of others."""
        if connection.counted:
            self._waiting.setdefault(connection.peer, {})[connection] = None

    def has_request(self, connection: Connection) -> None:
        """It is being answered, and is not closed in favour of others."""
        waiting = self._waiting.get(connection.peer, {})
        waiting.pop(connection, None)
        if not waiting:
            self._waiting.pop(connection.peer, None)


class Connection(H11Protocol):
    """One connection of uvicorn's, with deadlines for the client's input."""

    def __init__(self, connections: Connections, **uvicorns: Any) -> None:
        super().__init__(**uvicorns)
        self._connections = connections
        self._phase = ""
        self._deadline: asyncio.TimerHandle | None = None
        self._unread: asyncio.TimerHandle | None = None
        """Cuts the connection off while its client takes nothing."""
        self.peer = ""
        self.counted = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.peer = self.client[0] if self.client else ""
        connection = transport.get_extra_info("socket")
        is_local = connection.family == socket.AF_UNIX
        caller = Caller.of_unix_socket(connection) if is_local else Caller(self.client, self.server)  # type: ignore[arg-type]
        self.app_state = {**self.app_state, "caller": caller}  # in the state of each of its requests
        if not self._connections.admit(self):
            self._refuse()
            return
        if not is_local:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, _UNSENT)
        self._poll()

    def connection_lost(self, exc: Exception | None) -> None:
        self._set_deadline(None)
        self._read_on()
        self._connections.remove(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        # h11 checks the size of a request's head only while the head is incomplete: one that arrives at once would pass at any size
        for start in range(0, len(data), _PIECE):
            if not self.transport.is_closing():
                super().data_received(data[start : start + _PIECE])
        self._poll()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._poll()

    def pause_writing(self) -> None:
        """The client has stopped reading its answer, such as a pager at rest: it may stay for a minute, or until others need the place."""
        super().pause_writing()
        self._connections.awaits_client(self)
        self._await_reader(self.transport.get_write_buffer_size() + 1)

    def resume_writing(self) -> None:
        super().resume_writing()
        if not self.transport.is_closing():  # else the rest must still be sent
            self._read_on()
        if self._phase == "answer":
            self._connections.has_request(self)

    def _await_reader(self, before: int) -> None:
        left = self.transport.get_write_buffer_size()
        if left < before:
            self._unread = self.loop.call_later(_FLUSH_TIMEOUT, self._await_reader, left)
        else:
            self.transport.abort()

    def _read_on(self) -> None:
        if self._unread is not None:
            self._unread.cancel()
        self._unread = None

    def give_way(self) -> None:
        """Close, since others need the place."""
        self._set_deadline(None)
        self.transport.abort()

    def _poll(self) -> None:
        """Which phase the connection is in; a deadline runs from the beginning of a phase, whatever trickles in."""
        if self.transport.is_closing():
            return
        answering = self.cycle is not None and not self.cycle.response_complete
        phase = "header" if not answering else "body" if self.cycle.more_body else "answer"
        if phase == self._phase:
            return
        self._phase = phase
        if phase == "answer":
            self._set_deadline(None)
            self._connections.has_request(self)
        else:
            self._set_deadline(HEADER_TIMEOUT if phase == "header" else BODY_TIMEOUT)
            self._connections.awaits_client(self)

    def _set_deadline(self, seconds: float | None) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = None if seconds is None else self.loop.call_later(seconds, self._expire)

    def _expire(self) -> None:
        if self._phase == "header" and self.transport.get_write_buffer_size():
            self._set_deadline(HEADER_TIMEOUT)  # the last answer is not all sent: its reader may be slow
            return
        self._close()

    def _close(self) -> None:
        """Close when all is sent, or when nothing has been sent for a while."""
        self._read_on()
        self.transport.close()
        self._await_reader(self.transport.get_write_buffer_size() + 1)

    def _refuse(self) -> None:
        message = "too many connections are open; close some, or try again later"
        body = json.dumps({"__type": "ServiceUnavailableException", "message": message}).encode()
        head = "HTTP/1.1 503 Service Unavailable\r\nconnection: close\r\nretry-after: 1\r\ncontent-type: application/json\r\n"
        self.transport.write(f"{head}content-length: {len(body)}\r\n\r\n".encode() + body)
        self._close()

    def _should_upgrade(self) -> bool:
        return False  # the server takes no websockets, and uvicorn would log each attempt


class Serving(uvicorn.Server):
    """uvicorn's server; asyncio has one number for the connections accepted at once and for those that the kernel keeps."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        for each in sockets or ():
            each.listen(_BACKLOG)


class Seldom(logging.Filter):
    """Logs the same message once a minute, without a traceback: any client can cause it at any rate."""

    def __init__(self, *messages: str) -> None:
        super().__init__()
        self._logged = dict.fromkeys(messages, -_QUIET)

    def filter(self, record: logging.LogRecord) -> bool:
        message = next((each for each in self._logged if each in str(record.msg)), None)
        if message is None:
            return True
        record.exc_info = record.exc_text = None
        record.msg, record.args = str(record.msg).splitlines()[0], ()
        now = time.monotonic()
        if now - self._logged[message] < _QUIET:
            return False
        self._logged[message] = now
        return True
