"""References to runs in the store: from models, clones, policies that imitate a teacher, and what plug-ins keep."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Literal, NamedTuple

from shared_store.contract.plugins import PluginError, failed, load, plugins
from shared_store.volume import models
from shared_store.volume.bundles import DamagedBundle
from shared_store.volume.files import DamagedFile, path_exists, read_json
from shared_store.volume.layout import LARGEST_DESCRIPTION, Run, Store, names_in
from shared_store.volume.models import Model, ModelError
from shared_store.volume.plugin_folders import orphans


class Needed(NamedTuple):
    """Something needs a run or a job."""

    kind: Literal["run", "job"]
    name: str
    by: str
    """What needs it, as a clause: ``model ant@2 is of it``."""


class Unreadable(NamedTuple):
    """What can't be read, and so may need any run that has results."""

    why: str
    """One clause that names it and says why."""
    whole: bool = False
    """Whether it may need any run and any job; so is everything of a plug-in that can't be read."""


Found = Iterator[Needed | Unreadable]
_READING = (DamagedBundle, DamagedFile, ModelError, OSError)


def references(store: Store) -> tuple[list[Needed], list[Unreadable]]:
    """All that in the store needs a run or a job, and what could not be read."""
    found = [*read("models", _of_models, store), *read("runs", _of_runs, store)]
    of_plugins = [*read("plugins.json", lambda: map(Unreadable, orphans(store)))]
    for name, plugin in plugins().items():
        if plugin.references:
            of_plugins += read(f"plug-in {name}", _of_plugin, plugin.references, store)
    found += [each._replace(whole=True) if isinstance(each, Unreadable) else each for each in of_plugins]
    needed = [each for each in found if isinstance(each, Needed)]
    return needed, [each for each in found if isinstance(each, Unreadable)]


def read(what: str, referrer: Callable[..., Found], *arguments: Any) -> Found:
    """What a function finds, with what it can't read: ``what`` names that, such as ``model ant``."""
    try:
        yield from referrer(*arguments)
    except (DamagedBundle, PluginError) as error:  # which names the model, or the plug-in
        yield Unreadable(str(error))
    except _READING as error:
        yield Unreadable(f"{what} can't be read ({error})")


def _of_models(store: Store) -> Found:
    """Runs of models, with those from which their weights began."""
    for name in names_in(store.models):
        yield from read(f"model {name}", _of_versions, store, name)


def _of_versions(store: Store, name: str) -> Found:
    for model in models.versions(store, name):
        yield from read(f"model {model.reference}", _of_model, model)


def _of_model(model: Model) -> Found:
    facts = model.facts()
    yield from needed_run(facts.get("run"), f"model {model.reference} is of it")
    yield from needed_run(part(facts.get("parent"), "run"), f"model {model.reference} began with its weights")


def _of_runs(store: Store) -> Found:
    """Runs that began with the weights of another, and those that hold the weights of a teacher."""
    for name in names_in(store.path / "runs"):
        yield from read(f"run {name}", _of_run, store.run(name))


def _of_run(run: Run) -> Found:
    if path_exists(run.parent):
        described = read_json(run.path / "run.json", LARGEST_DESCRIPTION) or {}
        yield from needed_run(part(described.get("parent"), "run"), f"run {run.name} is a clone of it")
    if path_exists(run.path / "teachers"):
        for teacher in names_in(run.path / "teachers"):
            yield from needed_run(teacher, f"it is the teacher of run {run.name}")


def _of_plugin(place: str, store: Store) -> Found:
    """What a plug-in's folders need. Raises PluginError: its function can't be imported, fails, or yields something else."""
    function = load(place, Callable)
    try:
        for each in function(store):
            if not isinstance(each, Needed | Unreadable):
                raise TypeError(f"it yields {each!r:.80}, which is neither Needed nor Unreadable")
            yield each
    except _READING:
        raise
    except Exception as error:  # of a user's code, which may do anything
        raise failed(place, error) from error


def part(value: Any, key: str) -> Any:
    """A value of a mapping that anybody may have written; None where there is none."""
    return value.get(key) if isinstance(value, dict) else None


def needed_run(name: Any, by: str) -> Found:
    """The run of this name, if it is a name; ``by``: as :attr:`Needed.by`."""
    if isinstance(name, str):
        yield Needed("run", name, by)
