"""Plug-ins: what an installed package adds to Muster, under the entry point group ``muster.plugins``.

A plug-in names its parts as ``module:name``, and each is imported where it is first needed: the controller imports no task, a rank
no route. docs/plug-ins.md shows one, and the modules that it may import.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from functools import cache
from importlib import import_module

TYPE_CHECKING = False  # the command reads this module for `muster --help`
if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from typing import Any, Protocol

    class EvaluationRules(Protocol):
        """Rules by which a section of a job evaluates a checkpoint: in one episode a world, on one node."""

        count: tuple[str, int]
        """The section's key for the number of episodes, and the number where it is absent."""

        def refusal(self, config: type) -> str | None:
            """Why no run is evaluated so whose task has this configuration, as words that follow the task's name; None: it is."""

        def changes(self, section: Mapping[str, Any]) -> dict[str, Any]:
            """The changes of the run's ``train.config``."""

        def key_of(self, section: Mapping[str, Any], path: tuple[str | int, ...]) -> str:
            """The key of the job from which a value of the changed configuration comes."""

        def lines(self, summary: Mapping[str, Any]) -> Iterator[str]:
            """The result in an evaluation's summary, as lines of text."""


GROUP = "muster.plugins"


class PluginError(Exception):
    """A plug-in can't be used; one line."""


@dataclass(frozen=True)
class Command:
    """A command, or a group of commands, in ``muster --help``.

    Attributes:
        name: As it is typed.
        module: Its function ``register`` adds the command to a Typer application.
        panel: Heading under which the help lists it.
        summary: The first line of the command's own help.
    """

    name: str
    module: str
    panel: str
    summary: str


@dataclass(frozen=True)
class JobSection:
    """A kind of job, by the key of its section in the job YAML, which evaluates a checkpoint of a run.

    Attributes:
        key: Of the section, such as ``race``.
        verb: What such a job does with the run, such as ``races``.
        model: ``module:Class``: the pydantic model of the section, an :class:`orchestrator.spec.sections.OfCheckpoint`.
        rank: Module that the rank runs; it calls :func:`worker.evaluate.main` with the key.
        rules: ``module:name``: :class:`EvaluationRules`. The module imports no torch.
        watcher: ``module:Class``: a :class:`worker.evaluation.evaluation.Watcher` in the rank.
    """

    key: str
    verb: str
    model: str
    rank: str
    rules: str
    watcher: str


@dataclass(frozen=True)
class Plugin:
    """What a package adds. Tasks and algorithms are entry points of ``muster.tasks`` and ``muster.algorithms`` in the same package.

    Attributes:
        operations: ``METHOD /path`` of every route and page below; a route that is not here is refused for every key.
        routers: ``module:router`` of FastAPI, under ``/api``.
        pages: ``module:router`` of pages of the console.
        navigation: Label and path of their entries in the console's navigation.
        templates: Package whose folder ``templates`` holds the pages' Jinja templates.
        forms: ``module:name`` of each :class:`orchestrator.console.submit_fields.TaskForm`.
        commands: Of ``muster``.
        options: Name of a command of Muster, and ``module:name`` of its :class:`orchestrator.cli.catalogue.FurtherOptions`.
        sections: Kinds of jobs.
        folders: In the store, beside ``runs`` and ``models``.
        run_folders: In a run.
        references: ``module:function``: from a store to the runs and jobs that the plug-in's folders need, see
            :mod:`shared_store.volume.references`.
        bundle_parts: ``module:function``: from a task to further JSON documents of an exported bundle, by the names of their files.
    """

    operations: tuple[str, ...] = ()
    routers: tuple[str, ...] = ()
    pages: tuple[str, ...] = ()
    navigation: tuple[tuple[str, str], ...] = ()
    templates: str = ""
    forms: tuple[str, ...] = ()
    commands: tuple[Command, ...] = ()
    options: tuple[tuple[str, str], ...] = ()
    sections: tuple[JobSection, ...] = ()
    folders: tuple[str, ...] = ()
    run_folders: tuple[str, ...] = ()
    references: str = ""
    bundle_parts: str = ""


def load(place: str) -> Any:
    """What ``module:name`` names. Raises PluginError where it can't be imported."""
    module, _, name = place.partition(":")
    try:
        return getattr(import_module(module), name)
    except Exception as error:  # of somebody's code, which may do anything
        raise PluginError(
            f"plug-in: {place} can't be imported ({error}); install its package again, or remove it"
        ) from error


@cache
def plugins() -> Mapping[str, Plugin]:
    """The plug-ins of all installed packages, by their names. Raises PluginError."""
    found = {name: load(place) for name, place in sorted(_places())}
    for name, plugin in found.items():
        if not isinstance(plugin, Plugin):
            raise PluginError(
                f"plug-in {name}: its entry point is no Plugin of {__name__}; install another version of it"
            )
    return found


@cache
def sections() -> Mapping[str, JobSection]:
    """The kinds of jobs that plug-ins add, by their keys. Raises PluginError."""
    return {section.key: section for plugin in plugins().values() for section in plugin.sections}


def evaluating() -> tuple[str, ...]:
    """The keys of all kinds of jobs that evaluate a checkpoint. Raises PluginError."""
    return ("evaluate", *sections())


def _places() -> set[tuple[str, str]]:
    """Name and place of each plug-in. importlib.metadata has them, too, but its import takes a seventh of ``muster --help``."""
    found: dict[str, str] = {}
    for folder in sys.path:
        try:
            entries = os.listdir(folder or ".")
        except OSError:
            continue
        for entry in entries:
            if entry.endswith((".dist-info", ".egg-info")):
                for name, place in _declared(os.path.join(folder, entry, "entry_points.txt")):
                    found.setdefault(name, place)
    return set(found.items())


def _declared(path: str) -> Iterator[tuple[str, str]]:
    """The lines of the group in a package's entry points."""
    try:
        with open(path, encoding="utf-8") as file:
            text = file.read()
    except OSError:
        return
    if GROUP in text:
        _, _, rest = text.partition(f"[{GROUP}]")
        for line in rest.partition("\n[")[0].splitlines():
            name, separator, place = line.partition("=")
            if separator:
                yield name.strip(), place.strip()
