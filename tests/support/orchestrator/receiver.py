"""A receiver of webhooks: a real HTTP server that answers as a test says and keeps what it was sent."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

SECRET = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"
"""The example of Standard Webhooks."""


class Receiver(ThreadingHTTPServer):
    """Answers with the next of ``answers``, then with 204; while ``gate`` is closed it does not answer."""

    daemon_threads = True

    def __init__(self, port: int = 0) -> None:
        super().__init__(("127.0.0.1", port), _Handler)
        self.answers: list[int] = []
        self.messages: list[tuple[dict[str, str], bytes]] = []
        self.gate = threading.Event()
        self.gate.set()
        self.drip: threading.Event | None = None
        """Where it is set to an event: an answer comes a byte every 0.1 s; the event is set once the sender has gone."""

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/hooks/a-path-that-is-secret"

    def of(self, job: str) -> list[tuple[dict[str, str], bytes]]:
        """The messages about a job."""
        return [each for each in self.messages if json.loads(each[1])["data"].get("job") == job]


class _Handler(BaseHTTPRequestHandler):
    server: Receiver

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["content-length"]))
        self.server.messages.append(({name.lower(): value for name, value in self.headers.items()}, body))
        self.server.gate.wait()
        if self.server.drip is not None:
            self._drip(self.server.drip)
            return
        self.send_response(self.server.answers.pop(0) if self.server.answers else 204)
        self.send_header("location", "http://127.0.0.1:1/elsewhere")
        self.end_headers()

    def _drip(self, gone: threading.Event) -> None:
        try:
            for byte in b"HTTP/1.1 204 No Content\r\nx-long: " + 200 * b"x" + b"\r\n\r\n":
                self.wfile.write(bytes([byte]))
                time.sleep(0.1)
        except OSError:
            gone.set()

    def log_message(self, *_: Any) -> None:
        """Nothing on the test's output."""


@contextmanager
def receiving(port: int = 0) -> Iterator[Receiver]:
    """A receiver that listens."""
    receiver = Receiver(port)
    thread = threading.Thread(target=receiver.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    try:
        yield receiver
    finally:
        receiver.gate.set()
        receiver.shutdown()
        receiver.server_close()


def write_webhooks(path: Path, **webhooks: dict[str, Any]) -> str:
    """The file of ``--webhooks``; each has the example's secret."""
    path.write_text(json.dumps({name: {"secret": SECRET, **each} for name, each in webhooks.items()}))
    path.chmod(0o600)
    return str(path)
