"""The further documents of a bundle: what the task and the plug-ins say besides, each in a JSON file of its own."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from shared_store.contract.error_text import shown
from shared_store.contract.plugins import blamed, load, plugins
from shared_store.volume.bundles import CONTRACT, MANIFEST, REPORT
from worker.settings.errors import UserError
from worker.tasks.run.declared import DeclaredTask

if TYPE_CHECKING:
    from worker.tasks.run.task import Task

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._+-]{0,194}\.json")
_TAKEN = (CONTRACT, MANIFEST, REPORT)
"""Files of this form that every bundle has."""


def bundle_documents(task: Task, algorithm: str) -> dict[str, Mapping[str, Any]]:
    """The further documents of the bundle of a policy that ``algorithm``, a name, trained; by the names of their files.

    Raises UserError, which names the task or the plug-in: the documents are no JSON objects, or have a name that is not a plain one, is
    that of a file of every bundle, or is another's. Raises PluginError where a plug-in can't make them.
    """
    found: dict[str, Mapping[str, Any]] = {}
    by: dict[str, str] = {}
    for source, documents in _sources(task, algorithm):
        for name, document in documents.items():
            if not isinstance(name, str) or not _NAME.fullmatch(name):
                problem = f"{shown(name)} can't be a file of a bundle; use a plain name such as notes.json"
            elif name in _TAKEN:
                problem = f"{name} is a file of every bundle; give the document another name"
            elif name in by:
                problem = f"{by[name]} puts {name} into bundles, too; give one of the two documents another name"
            elif not _is_object(document):
                problem = f"{name} is not a JSON object; return a mapping of texts to JSON values"
            else:
                found[name], by[name] = document, source
                continue
            raise UserError(f"{source}: {problem}")
    return found


def _is_object(document: object) -> bool:
    try:
        return isinstance(document, Mapping) and bool(json.dumps(dict(document)))
    except (TypeError, ValueError):
        return False


def _sources(task: Task, algorithm: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    if isinstance(task, DeclaredTask):
        yield f"task {type(task).__name__}: bundle_documents", task.bundle_documents(algorithm)
    for name, plugin in plugins().items():
        if place := plugin.bundle_parts:
            with blamed(place):
                documents = load(place)(task)
            source = f"plug-in {name}: bundle_parts"
            if not isinstance(documents, Mapping):
                raise UserError(f"{source}: {place} returned {shown(documents)}; return documents by their names")
            yield source, documents
