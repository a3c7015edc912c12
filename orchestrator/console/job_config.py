"""The configuration and the code of a job, and their differences from the job before it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from difflib import SequenceMatcher
from typing import Any

import yaml
from sqlalchemy import select

from orchestrator.control.controller import Controller
from orchestrator.control.run_store import facts_of
from orchestrator.domain.errors import ClientError
from orchestrator.persistence.batch_models import Job
from orchestrator.services import runs
from orchestrator.services.context import permitted_run
from orchestrator.services.damaged_rows import reading
from orchestrator.services.permissions import Actor, Operation
from orchestrator.services.texts import with_texts
from shared_store.volume.files import DamagedFile

_ABSENT = object()
_LONGEST = 300
"""Characters of a value in the table of differences."""
_MOST_LINES = 1000
"""Lines of a text that is compared line by line: the time grows with their square."""


def code_of(spec: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Name and text of each file that the job holds, such as a reward function."""
    found: list[tuple[str, str]] = []
    for value in spec.values():
        if isinstance(value, Mapping):
            file, text = value.get("file"), value.get("text")
            found += [(file, text)] if isinstance(file, str) and isinstance(text, str) else code_of(value)
    return found


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Each key whose values differ, with the old and the new one as text; an absent value is empty."""
    before, after = dict(_flattened(old)), dict(_flattened(new))
    pairs = ((key, before.get(key, _ABSENT), after.get(key, _ABSENT)) for key in after | before)
    return [(key, *_both(was, now)) for key, was, now in pairs if was != now]


def _both(was: Any, now: Any) -> tuple[str, str]:
    """Two different values; of texts of several lines those that differ, with their numbers."""
    if isinstance(was, str) and isinstance(now, str) and "\n" in was.strip() + now.strip():
        before, after = was.splitlines(), now.splitlines()
        if max(len(before), len(after)) <= _MOST_LINES:
            changes = SequenceMatcher(None, before, after, autojunk=False).get_opcodes()
            spans = [each[1:] for each in changes if each[0] != "equal"]
            removed = [f"{i + 1}: {before[i]}" for start, stop, _, _ in spans for i in range(start, stop)]
            added = [f"{i + 1}: {after[i]}" for _, _, start, stop in spans for i in range(start, stop)]
            return "\n".join(removed), "\n".join(added)
    return _shown(was), _shown(now)


def _flattened(value: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, each in value.items():
        if isinstance(each, Mapping) and each:
            yield from _flattened(each, f"{prefix}{key}.")
        elif each not in (None, {}, []):
            yield f"{prefix}{key}", each


def _shown(value: Any) -> str:
    if value is _ABSENT:
        return ""
    text = value if isinstance(value, str) else yaml.safe_dump(value, default_flow_style=True, width=10_000)
    text = text.removesuffix("\n").removesuffix("\n...")
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} …"


def before_it(
    controller: Controller, actor: Actor, detail: Mapping[str, Any]
) -> tuple[str, str, Mapping[str, Any]] | None:
    """The other side of the configuration's comparison: a title, an address and a spec; None where there is none.

    That is the job before it in its run, else the run whose weights a clone began with.
    """
    queues, parent = actor.queues, ((detail["results"] or {}).get("parent") or {}).get("run")
    with controller.database.session() as session:
        query = select(Job).where(
            Job.run == detail["run"], Job.created_at < detail["createdAt"], Job.id != detail["id"]
        )
        if queues is not None:
            query = query.where(Job.queue.in_(queues))
        earlier = session.scalars(query.order_by(Job.created_at.desc()).limit(1)).first()
        if earlier is not None and not detail["runIsReplaced"]:
            with reading(earlier):
                spec = earlier.gang.spec
            if spec:
                spec = with_texts(controller, detail["run"], spec)
                return f"the job before it, {earlier.name}", f"/jobs/{earlier.id}", actor.shown(spec)
    if not isinstance(parent, str):
        return None
    try:
        run = facts_of(permitted_run(controller, actor, parent, Operation.READ_RUN))
        with controller.database.session() as session:
            found = runs.spec_of(session, actor, run)
    except (ClientError, DamagedFile, OSError):
        return None  # deleted, or another's
    if not found:
        return None
    return f"its parent {parent}", f"/runs/{parent}", actor.shown(with_texts(controller, parent, found))
