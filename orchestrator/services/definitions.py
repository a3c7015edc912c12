"""Job definitions: whose name it is, and the next revision."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import select

from orchestrator.domain.gang import GangSpec
from orchestrator.persistence.models import JobDefinition
from orchestrator.services.context import Context
from orchestrator.services.permissions import Operation
from orchestrator.services.texts import check_texts


def register(
    context: Context,
    name: str,
    document: Mapping[str, Any],
    gang: GangSpec,
    tags: Mapping[str, str] | None = None,
    *,
    again: bool = True,
) -> JobDefinition:
    """Register a definition; nothing is committed.

    Args:
        context: The call.
        name: Of the definition.
        document: The request of RegisterJobDefinition, without tags.
        gang: What the document asks for.
        tags: Of the definition.
        again: Whether a document that is the newest revision already becomes a revision of its own, as on AWS.

    Raises:
        ClientError: The name is another's, or the store keeps a text not that the document names.
        StoreNeeded: Something has to be read of the store first (:func:`.context.with_store`).
    """
    check_owner(context, name, Operation.REGISTER_JOB_DEFINITION)
    check_texts(context, gang)
    query = select(JobDefinition).where(JobDefinition.name == name).order_by(JobDefinition.revision.desc()).limit(1)
    newest = context.session.scalars(query).first()
    if (
        newest
        and not again
        and newest.status == "ACTIVE"
        and newest.document == document
        and newest.tags == (tags or {})
    ):
        return newest
    added = JobDefinition(
        name=name,
        revision=newest.revision + 1 if newest else 1,
        document=dict(document),
        # the name stays its owner's when a key with all queues adds a revision
        owner=(newest.owner if newest else None) or context.actor.name,
        status="ACTIVE",
        tags=dict(tags or {}),
    )
    context.session.add(added)
    return added


def check_owner(context: Context, name: str, operation: Operation) -> None:
    """Refuse a name that another key has registered: jobs are submitted by the bare name."""
    caller = context.actor.name
    foreign = select(JobDefinition).where(JobDefinition.name == name, JobDefinition.owner.is_distinct_from(caller))
    context.actor.check(operation, *context.session.scalars(foreign.limit(1)))
