"""Job definitions: each revision is its owner's, and several may use one name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import select

from orchestrator.domain.gang import GangSpec
from orchestrator.persistence.batch_models import JobDefinition
from orchestrator.services.context import Context
from orchestrator.services.permissions import Operation
from orchestrator.services.texts import check_texts


def revision(
    context: Context,
    name: str,
    document: Mapping[str, Any],
    gang: GangSpec,
    tags: Mapping[str, str] | None = None,
    *,
    again: bool = True,
) -> JobDefinition:
    """A revision of a definition, to be added to the session.

    Args:
        context: The call.
        name: Of the definition.
        document: The request of RegisterJobDefinition, without tags.
        gang: What the document asks for.
        tags: Of the definition.
        again: Whether a document that is the newest revision already becomes a revision of its own, as on AWS.

    Raises:
        ClientError: The store lacks a text that the document names.
        StoreNeeded: Something has to be read of the store first (:func:`.context.with_store`).
    """
    context.actor.check(Operation.REGISTER_JOB_DEFINITION)
    check_texts(context, gang)
    of_name = select(JobDefinition).where(JobDefinition.name == name).order_by(JobDefinition.revision.desc()).limit(1)
    if not again:
        own = context.session.scalars(of_name.where(JobDefinition.owner == context.actor.name)).first()
        if own and own.status == "ACTIVE" and own.document == document and own.tags == (tags or {}):
            return own
    newest = context.session.scalars(of_name).first()
    return JobDefinition(
        name=name,
        revision=newest.revision + 1 if newest else 1,
        document=dict(document),
        owner=context.actor.name,
        status="ACTIVE",
        tags=dict(tags or {}),
    )
