"""The long texts that a job names by their digests: kept before the job is, and again where the run that it continues has them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from orchestrator.control.controller import Controller
from orchestrator.control.kept_texts import references_of
from orchestrator.domain.errors import ClientError
from orchestrator.domain.gang import GangSpec
from orchestrator.persistence.batch_models import now
from orchestrator.persistence.own_models import KeptText
from orchestrator.services.context import Context
from orchestrator.services.permissions import Actor
from shared_store.volume.layout import Run
from shared_store.volume.texts import Reference, TextError, beside, read, references, resolved_spec


def check_texts(context: Context, gang: GangSpec) -> None:
    """Check that the store keeps the texts that a definition or a job names, and keep them longer. Raises ClientError, StoreNeeded."""
    rows = [_kept(context, reference) for reference in references_of(gang)]
    for row in rows:
        row.used_at = now()


def keep_again(controller: Controller, actor: Actor, run: Run, spec: Mapping[str, Any] | None) -> None:
    """Keep the texts of a job that continues or clones a run, where the store has them not or no more. On a thread of the store.

    Raises TextRefused, Unavailable. What the run lacks, too, is refused when the job is submitted.
    """
    short, long = beside(spec or {})
    for text in long.values():  # beside a change it has no room in the definition any more
        controller.texts.keep(text.encode(), actor.name)
    for reference in references(short):
        with controller.database.session() as session:
            source = controller.texts.source(session, reference)
            is_known = session.get(KeptText, reference.sha256) is not None
        if is_known and _exists(source, reference):
            controller.texts.prolong(reference.sha256)
            continue
        try:
            text = read(run.texts, reference)
        except (TextError, OSError):
            continue
        controller.texts.keep(text.encode(), actor.name)


def with_texts(controller: Controller, run: str, spec: Mapping[str, Any]) -> dict[str, Any]:
    """The spec of a job of that run with its long texts, to be shown. On a thread of the store."""
    with controller.database.session() as session:
        folders = [controller.texts.source(session, reference) for reference in references(spec)]
    return resolved_spec(spec, controller.access.store.run(run).texts, *folders)


def _kept(context: Context, reference: Reference) -> KeptText:
    row = context.session.get(KeptText, reference.sha256)
    source = context.controller.texts.source(context.session, reference)
    if row is None or not context.read(("text", reference.sha256), partial(_exists, source, reference)):
        raise ClientError(
            f"{reference}: the store keeps no such text; submit the job with the file itself, or upload it first: "
            f"PUT /api/texts/{reference.sha256}"
        )
    return row


def _exists(folder: Path, reference: Reference) -> bool:
    return (folder / reference.sha256).is_file()
