"""Free space of the volumes that the controller writes to: below a minimum nothing new is started or accepted there."""

from __future__ import annotations

import os
import re
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

_UNITS = {"KiB": 2**10, "MiB": 2**20, "GiB": 2**30, "TiB": 2**40, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
_AGE = 1.0
"""Seconds for which an answer of the volumes is kept."""


@dataclass(frozen=True)
class MinFree:
    """How much of a volume must be free; the lesser of the two where both are given."""

    size: int | None = None
    """Bytes."""
    share: float | None = None
    """Of the volume, from 0 to 1."""

    @classmethod
    def parse(cls, text: str) -> MinFree:
        """``512MiB``, ``5%`` or ``0``. Raises ValueError."""
        match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(%|[KMGT]i?B)?", text.strip())
        if not match or (match[2] is None and float(match[1])) or (match[2] == "%" and float(match[1]) > 100):
            raise ValueError("expected a size such as 1GiB, a share such as 5%, or 0")
        if match[2] == "%":
            return cls(share=float(match[1]) / 100)
        return cls(size=int(float(match[1]) * _UNITS.get(match[2], 1)))

    def of(self, total: int) -> int:
        """Bytes of a volume of ``total`` bytes."""
        shares = [] if self.share is None else [int(self.share * total)]
        sizes = [] if self.size is None else [self.size]
        return min(shares + sizes, default=0)


DEFAULT = MinFree(size=1 << 30, share=0.05)


class Disk:
    """Watches volumes by what lies on them. Any thread may ask."""

    def __init__(self, volumes: Mapping[str, Path], minimum: MinFree = DEFAULT) -> None:
        """``volumes``: a directory on each volume, by what the volume is for, such as ``store``."""
        self._volumes, self._minimum = volumes, minimum
        self._lock = threading.Lock()
        self._asked = -_AGE
        self._short: dict[str, str] = {}

    def shortage(self, purpose: str | None = None) -> str | None:
        """Which volume has less than the minimum, and what to do; None where all have enough, or the one for ``purpose`` has."""
        with self._lock:
            if time.monotonic() - self._asked >= _AGE:
                self._short = {name: said for name, path in self._volumes.items() if (said := self._look(name, path))}
                self._asked = time.monotonic()
            if purpose is not None:
                return self._short.get(purpose)
            return next(iter(self._short.values()), None)

    def _look(self, name: str, path: Path) -> str | None:
        try:
            volume = os.statvfs(path)
        except OSError:  # whoever needs it says so
            return None
        free, least = volume.f_bavail * volume.f_frsize, self._minimum.of(volume.f_blocks * volume.f_frsize)
        if free >= least:
            return None
        return (
            f"the volume of the {name} ({path}) has {free / 1e6:,.0f} MB free, less than {least / 1e6:,.0f} MB (--min-free): "
            "no new gang starts until there is room"
        )
