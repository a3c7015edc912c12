"""Log groups of users: which nodes log there, and the rows of those that exist."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from orchestrator.domain.errors import RequestError
from orchestrator.domain.gang import LOG_GROUP
from orchestrator.persistence.batch_models import Job, Node
from orchestrator.persistence.own_models import LogGroup

MOST = 1000
"""Log groups of a key."""


def check_room(session: Session, names: Collection[str], owner: str | None) -> None:
    """Raise RequestError where those of the groups that do not exist yet would be too many for their owner, a key."""
    if not (more := _missing(session, names)):
        return
    present = session.scalar(select(func.count()).where(LogGroup.owner == owner)) or 0
    if present + len(more) > MOST:
        raise RequestError(f"{owner} has {present} log groups, and may have {MOST}; delete some, or log to {LOG_GROUP}")


def add_missing(session: Session, names: Collection[str], owner: str | None) -> None:
    """Create those of the groups that do not exist yet."""
    session.add_all(LogGroup(name=name, owner=owner) for name in sorted(_missing(session, names)))


def _missing(session: Session, names: Collection[str]) -> set[str]:
    if not names:
        return set()
    added = {each.name for each in session.new if isinstance(each, LogGroup)}
    return set(names) - added - set(session.scalars(select(LogGroup.name).where(LogGroup.name.in_(names))))


def record_logs(session: Session, job: Job, nodes: Sequence[Node]) -> None:
    """Record with the nodes of a new attempt where they log; a group that was deleted since the submission is created again."""
    for node, spec in zip(nodes, job.gang.nodes, strict=False):  # an elastic gang may start with fewer
        node.log_group, node.log_prefix = spec.log_group, spec.log_prefix
    add_missing(session, {node.log_group for node in nodes if node.log_group}, job.owner)
