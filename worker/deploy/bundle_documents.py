"""The further documents of a bundle: what the task and the plug-ins say besides, each in a JSON file of its own."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from shared_store.contract.error_text import shown
from shared_store.contract.plugins import PluginError, load, plugins
from shared_store.volume.bundles import CONTRACT, MANIFEST, REPORT
from worker.settings.errors import UserError
from worker.tasks.run.task import Task

if TYPE_CHECKING:
    from worker.tasks.run.task import Task

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._+-]{0,194}\.json")
_TAKEN = (CONTRACT, MANIFEST, REPORT)
"""Files of this form that every bundle has."""


def bundle_documents(task: Task, algorithm: str) -> dict[str, Mapping[str, Any]]:
    """The further documents of the bundle of a policy that ``algorithm``, a name, trained; by the names of their files.

    Raises UserError, which names the task or the plug-in: the documents can't be made, are no JSON objects, or have a name that is
    not a plain one, is that of a file of every bundle, or is another's.
    """
    found: dict[str, Mapping[str, Any]] = {}
    by: dict[str, str] = {}
    for who, documents in _sources(task, algorithm):
        for name, document in documents.items():
            if not isinstance(name, str) or not _NAME.fullmatch(name):
                raise UserError(
                    f"{who}: {shown(name)} can't be a file of a bundle; use a plain name such as notes.json"
                )
            if name in _TAKEN:
                raise UserError(f"{who}: {name} is a file of every bundle; give the document another name")
            if name in by:
                raise UserError(
                    f"{who}: {by[name]} puts {name} into bundles, too; give one of the two documents another name"
                )
            try:
                is_object = isinstance(document, Mapping) and bool(json.dumps(dict(document)))
            except (TypeError, ValueError):
                is_object = False
            if not is_object:
                raise UserError(f"{who}: {name} is not a JSON object; return a mapping of texts to JSON values")
            found[name], by[name] = document, who
    return found


def _sources(task: Task, algorithm: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    if isinstance(task, Task):
        yield f"task {type(task).__name__}: bundle_documents", task.bundle_documents(algorithm)
    for name, plugin in plugins().items():
        if plugin.bundle_parts:
            yield f"plug-in {name}: bundle_parts", _made(name, plugin.bundle_parts, task)


def _made(name: str, place: str, task: Task) -> Mapping[str, Any]:
    """What a plug-in's function returns. Raises UserError."""
    try:
        made = load(place)(task)
    except PluginError as error:
        raise UserError(str(error)) from error
    except Exception as error:  # of somebody's code, which may do anything
        words = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise UserError(
            f"plug-in {name}: bundle_parts: {place} failed ({words}); install another version of it"
        ) from error
    if not isinstance(made, Mapping):
        raise UserError(
            f"plug-in {name}: bundle_parts: {place} returned {shown(made)}; return documents by their names"
        )
    return made
