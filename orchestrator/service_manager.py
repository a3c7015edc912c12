"""Messages to a service manager such as systemd: the controller is ready, alive, or stopping (the protocol of sd_notify)."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Callable, MutableMapping

from orchestrator import machine


class ServiceManager:
    """The manager that started this process, by ``NOTIFY_SOCKET``; without one nothing is sent."""

    def __init__(self, environment: MutableMapping[str, str] = os.environ) -> None:
        """Take the manager's variables out of the environment: they are not for the processes of jobs."""
        address = environment.pop("NOTIFY_SOCKET", "")
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        period, process = environment.pop("WATCHDOG_USEC", ""), environment.pop("WATCHDOG_PID", "")
        is_watched = period.isdecimal() and process in ("", str(os.getpid()))
        self.interval = int(period) / 2e6 if is_watched else None
        """Seconds between two heartbeats: half of what the manager allows; None where it expects none."""

    def notify(self, state: str) -> None:
        """Send ``READY=1``, ``WATCHDOG=1`` or ``STOPPING=1``. Nothing happens where the manager is gone."""
        if self._address:
            with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
                sender.setblocking(False)
                sender.sendto(state.encode(), self._address)

    def keep_alive(self, is_alive: Callable[[], bool], wait: Callable[[float], bool]) -> None:
        """Send heartbeats from another thread while ``is_alive``.

        ``wait``: waits so many seconds, and returns True where the controller ends.
        """
        interval = self.interval
        if interval is None or not self._address:
            return

        def watch() -> None:
            while not wait(interval):
                if is_alive():
                    self.notify("WATCHDOG=1")

        machine.thread("watchdog", watch)
