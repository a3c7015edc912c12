"""The environment that an engine's processes inherit from the controller."""

from __future__ import annotations

import os
from collections.abc import Collection

PRIVATE = (
    *("MUSTER_TOKEN", "MUSTER_URL", "MUSTER_KILL_AT", "MUSTER_DATABASE", "PGPASSWORD", "PGPASSFILE"),
    *("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "AWS_SECURITY_TOKEN"),
    *("AWS_CONTAINER_AUTHORIZATION_TOKEN", "RAY_AUTH_TOKEN"),
)
"""Variables of the controller that jobs don't get: its credentials for the database and the engines."""


def inherited(
    withheld: Collection[str] = (), prefixes: tuple[str, ...] = (), kept: Collection[str] = ()
) -> dict[str, str]:
    """This process's variables without its private ones.

    Args:
        withheld: Names that are left out, too.
        prefixes: So is what begins with one of these.
        kept: Names that stay all the same.
    """
    return {
        name: value
        for name, value in os.environ.items()
        if name in kept or not (name in PRIVATE or name in withheld or name.startswith(prefixes))
    }
