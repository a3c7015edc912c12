"""URLs of databases: which one a home directory has, how it is shown, and how it is connected to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sqlalchemy import URL


def database_url(home: Path, other: str | None = None) -> str:
    """URL of the SQLite file of a home directory, or of the ``other`` database: a URL, or the path of an SQLite file."""
    if other and "://" in other:
        return other
    return f"sqlite:///{Path(other).expanduser().absolute() if other else home / 'muster.db'}"


def shown(url: str) -> str:
    """The URL without its password."""
    scheme, sign, rest = url.partition("://")
    return f"{scheme}{sign}{rest.rpartition('@')[2]}"


def is_in_memory(url: URL) -> bool:
    return url.get_backend_name() == "sqlite" and url.database in (None, "", ":memory:")


def connect_args(url: URL) -> dict[str, Any]:
    """Options that reveal a vanished PostgreSQL server within seconds; options in the URL take precedence."""
    if url.get_backend_name() != "postgresql":
        return {}
    defaults = {"connect_timeout": 10, "keepalives_idle": 5, "keepalives_interval": 2, "keepalives_count": 3}
    return {name: value for name, value in {**defaults, "tcp_user_timeout": 10_000}.items() if name not in url.query}
