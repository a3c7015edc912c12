"""Progress of a command that looks at a policy: on a terminal one line that is overwritten, elsewhere plain lines now and then."""

from __future__ import annotations

import sys
import time

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from shared_store.contract.error_text import counted
from shared_store.volume.layout import Run

_SECONDS = 2.0
"""Between two plain lines of the same activity."""


class Activity:
    """Shows on standard error what goes on, until :meth:`end`."""

    def __init__(self) -> None:
        self._bar: Progress | None = None
        if sys.stderr.isatty():
            console = Console(stderr=True, highlight=False)
            text = TextColumn("{task.description}", markup=False)
            self._bar = Progress(text, BarColumn(bar_width=24), console=console, transient=True)
            self._task = self._bar.add_task("", total=None)
        self._printed, self._printed_at = "", 0.0

    def say(self, text: str) -> None:
        """A new activity of unknown duration."""
        if self._bar is None:
            print(text, file=sys.stderr, flush=True)
            self._printed, self._printed_at = text, time.monotonic()
            return
        self._bar.start()
        self._bar.update(self._task, description=text, total=None)

    def count(self, text: str, done: int, total: int) -> None:
        """``done`` of ``total`` of what ``text`` names, such as ``"recording: step"``."""
        text = f"{text} {done} of {total}"
        if self._bar is not None:
            self._bar.start()
            self._bar.update(self._task, description=text, completed=done, total=total)
        elif text != self._printed and time.monotonic() - self._printed_at >= _SECONDS:
            self.say(text)

    def end(self) -> None:
        """Take the line away: what follows is printed as usual."""
        if self._bar is not None:
            self._bar.stop()

    def __enter__(self) -> Activity:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()


def loading(run: Run, worlds: int) -> str:
    """The message before libraries are imported and worlds are built, which takes seconds."""
    spec = (run.description() or {}).get("spec") or {}
    train = spec.get("train")
    task = str(train.get("task", "the task")) if isinstance(train, dict) else "the task"
    return f"loading {task} in {counted(worlds, 'world')} …"
