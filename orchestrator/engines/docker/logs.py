"""Logs of containers without a supervisor: copied into the run's while they are written."""

from __future__ import annotations

import logging
import re
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from datetime import datetime
from pathlib import Path

import requests
from docker.models.containers import Container
from urllib3.exceptions import HTTPError

from orchestrator.engines.toolkit.log_copy import LogCopy
from shared_store.volume.logs import format_line

_TIME = re.compile(rb"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d+)?Z) ")
_AGAIN = 1.0
"""Seconds from a copy that failed to the next."""
_ENDING = 1.0
"""Seconds that a container may still count as running after its log has ended."""

log = logging.getLogger("muster.engines")


class FollowedLog:
    """Appends what a container prints to a log until it ends, in a thread. What is there already is not copied twice."""

    def __init__(self, container: Container, path: Path, limit: int, before: FollowedLog | None) -> None:
        """Args:
        container: What prints.
        path: The log; nothing else may write it.
        limit: Bytes of it that are kept.
        before: The copy that failed, and that this one goes on from.
        """
        self.trouble: Exception | None = None
        """Why it ended before its container: a store that is full, a Docker Engine that went away."""
        self._container, self._path, self._limit, self._ended = container, path, limit, 0.0
        self._known = str(before.trouble) if before is not None else ""
        self._thread = threading.Thread(target=self._run, name=f"log {container.name}", daemon=True)
        self._thread.start()

    @property
    def is_due_again(self) -> bool:
        """It failed, and may be made anew: what it could not copy is still there."""
        return self.trouble is not None and time.monotonic() - self._ended > _AGAIN

    def wait(self, seconds: float | None = None) -> bool:
        """Whether it has ended, by itself or by an error, within that time."""
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            last = _copy(self._container, self._path, self._limit, follow=True)
            self._check_ended()
            if last != self._container.logs(tail=1, timestamps=True):
                # Docker Engine 20.10 may end a followed log early where it is read slowly; it gives the whole log afterwards
                _copy(self._container, self._path, self._limit, follow=False)
        except Exception as error:
            if isinstance(error, struct.error):  # half a frame's head
                error = requests.ConnectionError(f"the log of container {self._container.name} was cut off")
            self._ended, self.trouble = time.monotonic(), error
            # of an engine that went away its observer speaks
            if not isinstance(error, requests.RequestException | HTTPError) and self._known != str(error):
                log.warning("log of container %s: not copied now (%s); trying again", self._container.name, error)

    def _check_ended(self) -> None:
        """Raises requests.ConnectionError where the log ended before its container: the engine went away in between."""
        deadline = time.monotonic() + _ENDING
        while True:
            self._container.reload()
            if self._container.status not in ("running", "paused", "restarting"):
                return
            if time.monotonic() > deadline:
                raise requests.ConnectionError(f"the log of container {self._container.name} was cut off")
            time.sleep(0.05)


def _copy(container: Container, path: Path, limit: int, follow: bool) -> bytes | None:
    """Append the lines that are not in the log yet; returns what was read last, None where that was not a whole line.

    Raises OSError where the log can't be written.
    """
    last: bytes | None = b""
    with closing(LogCopy(path, limit)) as copy:
        for chunk, lines in _lines(container, follow):
            last = chunk if chunk.endswith(b"\n") else None
            copy.append(format_line(at, 0, "o", line) for at, line in lines)
    return last


def _lines(container: Container, follow: bool) -> Iterator[tuple[bytes, list[tuple[float, str]]]]:
    """Each chunk that Docker sends, with the lines that it completes and when each was printed [Unix s].

    Docker remembers that time, so a line is never dated anew. A last line without a line end comes only from a log that is not
    followed: a followed one may have been cut off there.
    """
    rest, at = b"", 0.0
    for sent in container.logs(stream=True, follow=follow, timestamps=True):
        chunk = sent
        # one write of the container, or 16 KiB of a longer one, each with its time
        if found := _TIME.match(chunk):
            began, chunk = datetime.fromisoformat(found[1].decode()).timestamp(), chunk[found.end() :]
        else:
            began = time.time()
        at = at if rest else began
        *whole, rest = (rest + chunk).split(b"\n")
        times = [at, *[began] * len(whole)]
        yield sent, [(when, line.decode(errors="backslashreplace")) for when, line in zip(times, whole, strict=False)]
        at = began if whole else at
    if rest and not follow:
        yield rest, [(at, rest.decode(errors="backslashreplace"))]
