"""A copy of a node's log that is elsewhere, each line once."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from shared_store.volume.log_files import LogWriter


class LogCopy:
    """Goes on where the copy before it ended: the first lines that it is given are in the log already."""

    def __init__(self, path: Path, limit: int) -> None:
        """Raises OSError; DamagedFile for a link in the log's place. ``limit``: bytes that are kept."""
        self._writer = LogWriter(path, limit)
        self._skip = self._writer.lines
        self._pending = b""

    @property
    def is_whole(self) -> bool:
        """Whether the log has all that was given."""
        return not self._pending

    def append(self, lines: Iterable[str]) -> None:
        """Add lines with their ends, from the first that was ever copied on. Raises OSError: they are kept, :meth:`flush` tries again."""
        lines = list(lines)
        fresh, self._skip = lines[self._skip :], max(0, self._skip - len(lines))
        self._pending += "".join(fresh).encode(errors="backslashreplace")
        self.flush()

    def flush(self) -> None:
        """Write what is not in the log yet. Raises OSError: the volume has no room, or is away."""
        self._pending = self._pending[self._writer.append(self._pending) :] if self._pending else b""
        if self._pending:
            raise self._writer.error or OSError(f"{self._writer.path}: not written")

    def close(self) -> None:
        self._writer.close()
