"""The nodes of an attempt are rows of their own instead of a JSON list."""

import json
from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"

_AT_ONCE = 1000
_KEYS = {
    "host": "host",
    "gpus": "gpus",
    "cpus": "cpus",
    "memory": "memory",
    "address": "address",
    "devices": "devices",
    "exit_code": "exitCode",
    "reason": "reason",
    "error": "error",
    "stopped_at": "stoppedAt",
    "status_reason": "statusReason",
    "met": "met",
}
"""Columns, and the keys of the JSON that had the same."""
_DEFAULTS: dict[str, Any] = {"gpus": [], "cpus": 0.0, "memory": 0, "met": False}
"""Of nodes of older versions, which did not say them."""
_KINDS: dict[str, Any] = {
    "cpus": float | int,
    "memory": int,
    "exit_code": int,
    "stopped_at": int,
    "met": bool,
    "gpus": list,
    "devices": list,
}
"""Of their values; all others are text."""
_LISTS = ("gpus", "devices")
_ATTEMPTS = sa.table(
    "attempts", sa.column("job_id", sa.String), sa.column("number", sa.BigInteger), sa.column("nodes", sa.JSON)
)


def upgrade() -> None:
    nodes = op.create_table(
        "nodes",
        sa.Column("job_id", sa.String(), primary_key=True),
        sa.Column("attempt", sa.BigInteger(), primary_key=True, autoincrement=False),
        sa.Column("node_index", sa.BigInteger(), primary_key=True, autoincrement=False),
        sa.Column("host", sa.String(), nullable=False),
        sa.Column("gpus", sa.String(), nullable=False),
        sa.Column("cpus", sa.Double(), nullable=False),
        sa.Column("memory", sa.BigInteger(), nullable=False),
        sa.Column("address", sa.String()),
        sa.Column("devices", sa.String()),
        sa.Column("exit_code", sa.BigInteger()),
        sa.Column("reason", sa.String()),
        sa.Column("error", sa.String()),
        sa.Column("stopped_at", sa.BigInteger()),
        sa.Column("status_reason", sa.String()),
        sa.Column("met", sa.Boolean(), nullable=False),
        sa.ForeignKeyConstraint(["job_id", "attempt"], ["attempts.job_id", "attempts.number"]),
    )
    connection = op.get_bind()
    # as text: a damaged list is that of its attempt alone, which then has no nodes
    text = sa.select(_ATTEMPTS.c.job_id, _ATTEMPTS.c.number, sa.cast(_ATTEMPTS.c.nodes, sa.String))
    for attempts in connection.execute(text).partitions(_AT_ONCE):
        if rows := [row for job, number, document in attempts for row in _rows(job, number, document)]:
            connection.execute(sa.insert(nodes), rows)
    with op.batch_alter_table("attempts") as table:
        table.drop_column("nodes")


def _rows(job: str, number: int, document: str) -> list[dict[str, Any]]:
    """The nodes of an attempt; none where one of them is damaged."""
    try:
        told = json.loads(document)
        rows = [{**_row(entry), "job_id": job, "attempt": number, "node_index": entry["index"]} for entry in told]
        whole = [row["node_index"] for row in rows] == list(range(len(rows)))
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
        return []
    return rows if whole else []


def _row(entry: dict[str, Any]) -> dict[str, Any]:
    """Raises TypeError for a value that is not of its column's type, KeyError for a node without a host."""
    said = {"host": entry["host"], **{column: entry.get(key) for column, key in _KEYS.items()}}
    row: dict[str, Any] = {column: _DEFAULTS.get(column) if value is None else value for column, value in said.items()}
    for column, value in row.items():
        if not isinstance(value, _KINDS.get(column, str)) and (value is not None or column == "host"):
            raise TypeError(column)
    row |= {name: ",".join(row[name]) for name in _LISTS if row[name] is not None}
    return row | {name: _storable(row[name]) for name in ("reason", "error", "status_reason")}


def _storable(text: str | None) -> str | None:
    """JSON can hold a zero byte and half of a character, a column of text can't."""
    return None if text is None else text.replace("\0", "\\x00").encode(errors="backslashreplace").decode()
