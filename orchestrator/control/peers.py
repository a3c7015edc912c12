"""The peers of a controller, which use the same store: each leaves a heartbeat there, and reads those of the others.

Controllers of several homes may share a store, each with jobs of its own; a run that one of them writes is not started by another.
Heartbeats are advice: what keeps two gangs apart is the epoch (:mod:`shared_store.volume.epoch`).
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import socket
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from orchestrator import machine
from orchestrator.domain.reasons import short_id
from shared_store.volume.epoch import read_claim, read_epoch
from shared_store.volume.files import read_json, write_json
from shared_store.volume.layout import NAME, Run, Store

log = logging.getLogger("muster.controller")

BEAT = 5.0
"""Seconds between two heartbeats."""
GONE = 30.0
"""Seconds without a new heartbeat after which a controller counts as gone."""
_OUTDATED = 3600.0
"""Age [s] from which a heartbeat does not count at first sight, whatever the difference between the machines' clocks."""
_LONGEST_NAME = 256


@dataclass(frozen=True)
class Peer:
    """A controller, as its heartbeat describes it."""

    home: str
    host: str
    pid: int
    beat: int
    """Grows with every heartbeat."""
    time: float
    """Unix time [s] of the heartbeat, by that controller's clock."""

    def __str__(self) -> str:
        return f"the controller of {self.home} on {self.host} (pid {self.pid})"


class Peers:
    """This controller's heartbeat, in a thread of its own, and those of the others."""

    def __init__(self, store: Store, home: Path, check: Callable[[], None] = lambda: None) -> None:
        """``check``: raises OSError where another volume is in the store's place."""
        self.store, self._check = store, check
        self.id = hashlib.sha256(f"{socket.gethostname()}\0{home}".encode()).hexdigest()[:16]
        self._home, self._directory = home, store.path / "controllers"
        self._lock = threading.Lock()
        self._seen: dict[str, tuple[Peer, float | None]] = {}
        """By id: the newest heartbeat, and when it came (monotonic [s]); None where it was outdated at first sight."""
        self._beat = 0
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Leave the first heartbeat; log a warning for each other controller that is present, now and later."""
        self._poll()
        self._thread = machine.thread("peers", self._loop)

    def close(self) -> None:
        """Withdraw the heartbeat."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join(BEAT)
        with contextlib.suppress(OSError):  # an unavailable volume: the heartbeat goes out of date
            self._path.unlink(missing_ok=True)

    def writer(self, run: Run) -> str | None:
        """The attempt of another controller that writes the run now, in words; None where there is none.

        Raises:
            OSError, ValueError: The store can't be read, or the run's ``EPOCH`` is damaged.
        """
        claim = read_claim(run, read_epoch(run))
        if claim is None or claim.controller == self.id or not NAME.fullmatch(claim.controller):
            return None
        if claim.controller not in self._seen and (found := self._read(claim.controller)):
            self._note(claim.controller, found)  # it started after the last look
        with self._lock:
            peer, seen_at = self._seen.get(claim.controller, (None, None))
        if peer is None or seen_at is None or machine.monotonic() - seen_at >= GONE:
            return None
        return f"job {short_id(claim.job)} (attempt {claim.attempt}) of {peer}"

    @property
    def _path(self) -> Path:
        return self._directory / f"{self.id}.json"

    def _loop(self) -> None:
        while not self._ending.wait(BEAT):
            self._poll()

    def _poll(self) -> None:
        """Leave a heartbeat and read the others'; where the store is unavailable, the next heartbeat makes up for it."""
        self._beat += 1
        own = Peer(str(self._home), socket.gethostname(), os.getpid(), self._beat, machine.wall())
        try:
            self._check()
            write_json(self._path, asdict(own))
            names = [name.removesuffix(".json") for name in os.listdir(self._directory)]
        except OSError:
            return
        for name in names:
            if name != self.id and NAME.fullmatch(name) and (peer := self._read(name)):
                self._note(name, peer)

    def _read(self, name: str) -> Peer | None:
        try:
            value = read_json(self._directory / f"{name}.json") or {}
            home, host = str(value["home"])[:_LONGEST_NAME], str(value["host"])[:_LONGEST_NAME]
            return Peer(home, host, int(value["pid"]), int(value["beat"]), float(value["time"]))
        except (OSError, ValueError, KeyError, TypeError, OverflowError):
            return None

    def _note(self, name: str, peer: Peer) -> None:
        """Any thread may call."""
        with self._lock:
            before, seen_at = self._seen.get(name, (None, None))
            if before == peer:
                return
            outdated = before is None and abs(machine.wall() - peer.time) > _OUTDATED
            self._seen[name] = peer, None if outdated else machine.monotonic()
        if outdated:  # left by one that was killed; one that lives writes it again
            with contextlib.suppress(OSError):
                (self._directory / f"{name}.json").unlink(missing_ok=True)
        elif seen_at is None:
            log.warning(
                "%s uses the store %s too: each runs jobs of its own, and neither starts a run that the other is writing",
                peer,
                self.store.path,
            )
