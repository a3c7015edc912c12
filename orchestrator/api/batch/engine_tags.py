"""Tags ``muster:…`` of compute environments and queues: options of their engines, and the rule of retention of a queue."""

from __future__ import annotations

from orchestrator.control.compute_environments import ENGINE_TAG, engine_named_by, environments_of
from orchestrator.domain.errors import ClientError
from orchestrator.domain.retention import TAG, rule_of
from orchestrator.engines.api import EngineError
from orchestrator.engines.installed import ENGINES, check_tags
from orchestrator.persistence.batch_models import ComputeEnvironment, JobQueue
from orchestrator.services.context import Context
from shared_store.contract.error_text import nearest


def check_engine_tags(context: Context, resource: object, tags: dict[str, str]) -> None:
    """Raises ClientError where the resource can't have these tags, for an option that is misspelt or has a wrong value."""
    first = context.controller.engines.names[0]
    if isinstance(resource, ComputeEnvironment):
        engines = [engine_named_by(tags, first)]
    elif isinstance(resource, JobQueue):
        if (rule := tags.get(TAG)) is not None:
            tags = {tag: value for tag, value in tags.items() if tag != TAG}
            try:
                rule_of(rule)
            except ValueError as error:
                raise ClientError(f"tag {TAG}: {error}") from None
        engines = [engine_named_by(each.tags, first) for each in environments_of(context.session, resource)]
    else:
        return
    if not any(tag.startswith("muster:") for tag in tags):
        return
    if isinstance(resource, ComputeEnvironment) and engines[0] not in (*ENGINES, *context.controller.engines.names):
        raise ClientError(
            f"tag {ENGINE_TAG} is {engines[0][:100]!r}: there is no such engine; {nearest(engines[0], ENGINES)}"
        )
    try:
        check_tags(tags, [each for each in engines if each in ENGINES], of_a_queue=isinstance(resource, JobQueue))
    except (ValueError, EngineError) as error:
        raise ClientError(str(error)) from None
