"""Excerpts for messages: an error about a request, a file or a program stays short, however long their text is."""

from __future__ import annotations

LONGEST_REASON = 1024
"""Characters of a status reason."""
LONGEST_ERROR = 2000
"""Characters of the text of an error answer."""
_LEFT_OUT = " … ({} more characters)"


def excerpt(text: str, most: int) -> str:
    """``text`` in at most ``most`` characters; where it is longer, its beginning and how many characters were left out."""
    if len(text) <= most:
        return text
    kept = max(0, most - len(_LEFT_OUT.format(len(text))))
    return text[:kept] + _LEFT_OUT.format(len(text) - kept)
