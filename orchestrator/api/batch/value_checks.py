"""Checks of single values of a request, as AWS makes them; each raises ClientError, in one line."""

from __future__ import annotations

import re
from collections.abc import Mapping

from orchestrator.domain.errors import ClientError

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,127}")
_MOST_TAGS = 50


def check_range(what: str, value: float | None, least: float, most: float) -> None:
    """A number from ``least`` to ``most``; None passes."""
    if value is not None and not least <= value <= most:
        raise ClientError(f"{what} is {value}; it must be {least} to {most}")


def check_choice(what: str, value: str, *choices: str) -> None:
    """One of these texts."""
    if value not in choices:
        raise ClientError(f"{what} is {value[:50]!r}; it is {' or '.join([', '.join(choices[:-1]), choices[-1]])}")


def check_name(key: str, name: str) -> None:
    """A name as AWS takes it: letters, digits, hyphens, underscores, a letter or digit first, at most 128."""
    if not _NAME.fullmatch(name):
        raise ClientError(
            f"{key} {name[:200]!r}: up to 128 letters, digits, hyphens and underscores, a letter or digit first"
        )


def check_tags(tags: Mapping[str, str]) -> None:
    """At most 50 tags, keys of 1 to 128 characters that do not begin with ``aws:``, values of at most 256."""
    if len(tags) > _MOST_TAGS:
        raise ClientError(f"{len(tags)} tags; a resource has at most {_MOST_TAGS}")
    for key, value in tags.items():
        if not 1 <= len(key) <= 128 or key.lower().startswith("aws:") or len(value) > 256:
            raise ClientError(
                f"tag {key[:130]!r}: keys have 1 to 128 characters and don't begin with aws:, values have at most 256"
            )
