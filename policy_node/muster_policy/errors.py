"""Errors that end the node in one line, and the nearest of several names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class Refused(Exception):
    """The node can't run, or won't; the message is one line that says what differs and what to do."""


def nearest(name: str, names: Iterable[str], what: str = "available") -> str:
    """``did you mean NAME?`` where one is close, else the known names.

    Args:
        name: What was looked for.
        names: The known names.
        what: Begins the list of names.
    """
    known = sorted(names)
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)  # knee: knee_motor
    if close:
        return f"did you mean {close[0]}?"
    return f"{what}: {', '.join(known[:8])}{', …' if len(known) > 8 else ''}" if known else f"{what} none"
