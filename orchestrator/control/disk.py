"""Free disk space of the volumes that the controller writes to: below a minimum nothing new is started or accepted there."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from orchestrator import machine
from orchestrator.domain.units import BYTES, amount

_INTERVAL = 0.5
"""Seconds between two examinations of a volume."""
_PATIENCE = 5.0
"""Seconds after which a volume counts as not answering."""


@dataclass(frozen=True)
class MinFree:
    """The part of a volume that must be free; the lesser of the two where both are given."""

    size: int | None = None
    """Bytes."""
    share: float | None = None
    """Of the volume, from 0 to 1."""

    @classmethod
    def parse(cls, text: str) -> MinFree:
        """``512MiB``, ``5%`` or ``0``. Raises ValueError."""
        expected = "a size such as 1GiB, a share such as 5%, or 0"
        if text.strip() == "0":
            return cls(size=0)
        if not text.strip().endswith("%"):
            return cls(size=int(amount(text, BYTES, expected)))
        if (percent := amount(text, {"%": 1}, expected)) > 100:
            raise ValueError(f"expected {expected}")
        return cls(share=percent / 100)

    def of(self, total: int) -> int:
        """Bytes of a volume of ``total`` bytes."""
        shares = [] if self.share is None else [int(self.share * total)]
        sizes = [] if self.size is None else [self.size]
        return min(shares + sizes, default=0)


DEFAULT = MinFree(size=1 << 30, share=0.05)


@dataclass
class _Volume:
    """One volume, and the result of its last examination."""

    name: str
    path: Path
    short: str | None = None
    absent: str | None = None
    began: machine.Moment | None = None
    """Start of the examination under way."""


class Disk:
    """Watches volumes by directories on them. Any thread may ask, and none ever waits for a volume."""

    def __init__(
        self,
        volumes: Mapping[str, Path],
        minimum: MinFree = DEFAULT,
        checks: Mapping[str, Callable[[], str | None]] | None = None,
    ) -> None:
        """Examine each volume once. ``volumes``: a directory on each, by the purpose of the volume, such as ``store``.

        ``checks``: by purpose, what says that another volume is in its place; may hang.
        """
        self._volumes, self._minimum = [_Volume(*each) for each in volumes.items()], minimum
        self._checks = checks or {}
        self._ended = threading.Event()
        for volume in self._volumes:
            volume.short = self._examine(volume)

    @property
    def names(self) -> list[str]:
        """Names of the volumes, such as ``store``."""
        return [volume.name for volume in self._volumes]

    def start(self) -> None:
        """Examine each volume about once a second, in a thread of its own: one that hangs keeps no other waiting."""
        for volume in self._volumes:
            machine.thread(f"volume {volume.name}", partial(self._watch, volume))

    def close(self) -> None:
        """Stop; an examination that hangs is abandoned."""
        self._ended.set()

    def shortage(self, purpose: str | None = None) -> str | None:
        """A line about a volume that does not answer or has less than the minimum; None where there is no such volume.

        ``purpose``: of the volume for this alone.
        """
        of = (volume for volume in self._volumes if purpose in (None, volume.name))
        return next((why for volume in of if (why := self._silence(volume) or volume.absent or volume.short)), None)

    def unavailable(self, purpose: str) -> str | None:
        """Why the volume of this purpose can't be read: it has not answered for a while, or is not there; None where it can, as far as was seen."""
        return next((self._silence(each) or each.absent for each in self._volumes if each.name == purpose), None)

    def absent(self, purpose: str) -> str | None:
        """Why the volume of this purpose is not there; None where it is, as far as was seen."""
        return next((volume.absent for volume in self._volumes if volume.name == purpose), None)

    @staticmethod
    def _silence(volume: _Volume) -> str | None:
        began = volume.began
        if began is None or began.passed < _PATIENCE:
            return None
        return (
            f"the volume of the {volume.name} ({volume.path}) has not answered since {began}: no new gang starts until it does; "
            "see whether its server can be reached"
        )

    def _watch(self, volume: _Volume) -> None:
        while not self._ended.wait(_INTERVAL):
            volume.began = machine.moment()
            volume.short = self._examine(volume)
            volume.began = None

    def _examine(self, volume: _Volume) -> str | None:
        """How much too little space is free; notes whether another volume is in its place."""
        check = self._checks.get(volume.name)
        volume.absent = check() if check else None
        try:
            found = os.statvfs(volume.path)
        except OSError:  # an operation that needs it says so
            return None
        free, least = found.f_bavail * found.f_frsize, self._minimum.of(found.f_blocks * found.f_frsize)
        if free >= least:
            return None
        return (
            f"the volume of the {volume.name} ({volume.path}) has {free / 1e6:,.0f} MB free, less than {least / 1e6:,.0f} MB "
            "(--min-free): no new gang starts until there is room"
        )
