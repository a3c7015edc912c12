"""Plug-ins: what an installed package adds to Muster, under the entry point group ``muster.plugins``.

A plug-in names its parts as ``module:name``, and each is imported where it is first needed: the controller imports no task, a rank
no route. docs/plug-ins.md shows one, and the modules that it may import.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, reduce
from importlib import import_module

TYPE_CHECKING = False  # the command reads this module for `muster --help`
if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Any, ClassVar, Protocol

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
OF_STORE = frozenset({"runs", "models", "texts", "trash", "controllers", "code"})
"""Folders that Muster itself has in the store."""
OF_RUN = frozenset(
    {
        *("checkpoints", "metrics", "evaluations", "exports", "recordings", "telemetry", "tracking", "texts", "logs"),
        *("outcomes", "parent", "teachers", "incidents", "replays", "EPOCH"),
    }
)
"""What Muster itself has in a run, beside files with a suffix."""


class PluginError(Exception):
    """A plug-in can't be used; one line."""


_Form = tuple[re.Pattern[str], str]
"""What a text of a declaration has to match, and that in words."""
_DOTTED = r"[^\W\d]\w*(\.[^\W\d]\w*)*"
_TEXT: _Form = re.compile(r"\S.*"), "a line of text"
_NAME: _Form = re.compile(r"[a-z][a-z0-9-]*"), "a name of lower-case letters, digits and '-'"
_KEY: _Form = re.compile(r"[a-z][a-z0-9_]*"), "a key of lower-case letters, digits and '_'"
_MODULE: _Form = re.compile(_DOTTED), "a module, such as package.module"
_PLACE: _Form = re.compile(f"{_DOTTED}:{_DOTTED}"), "module:name"
_PATH: _Form = re.compile(r"/\S*"), "a path that begins with /"
_OPERATION: _Form = (
    re.compile(r"(GET|POST|PUT|PATCH|DELETE) /\S*"),
    "METHOD /path, such as GET /api/notes",
)
_FOLDER: _Form = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*"), "the name of a folder, of letters, digits, '_' and '-'"


def _check(where: str, value: object, *forms: _Form | type) -> None:
    """Raises PluginError for anything but a text of the form, an object of the class, or, of several forms, a tuple of such texts."""
    form = forms[0]
    if len(forms) > 1:
        if not isinstance(value, tuple) or len(value) != len(forms):
            raise PluginError(f"{where}: expected tuples of {len(forms)} texts, found {value!r:.80}")
        for text, each in zip(value, forms, strict=True):
            _check(where, text, each)
    elif isinstance(form, type):
        if not isinstance(value, form):
            raise PluginError(f"{where}: expected {form.__name__}(…), found {value!r:.80}")
    elif not isinstance(value, str) or not form[0].fullmatch(value):
        raise PluginError(f"{where}: expected {form[1]}, found {value!r:.80}")


class _Declaration:
    """Base of dataclasses whose fields have the forms of ``FORMS``, each of them where the default is a tuple."""

    FORMS: ClassVar[Mapping[str, tuple[_Form | type, ...]]]

    def __post_init__(self) -> None:
        """Raises PluginError for a field of another form."""
        owner = "" if isinstance(self, Plugin) else f"{type(self).__name__}."
        for name, forms in self.FORMS.items():
            value, default = getattr(self, name), getattr(type(self), name, None)
            if default != ():
                if value != "" or default != "":
                    _check(f"{owner}{name}", value, *forms)
                continue
            if not isinstance(value, tuple):
                raise PluginError(f"{owner}{name}: expected a tuple, found {value!r:.80}")
            for each in value:
                _check(f"{owner}{name}", each, *forms)


@dataclass(frozen=True)
class Command(_Declaration):
    """A command, or a group of commands, in ``muster --help``.

    Attributes:
        name: As it is typed.
        module: Its function ``register`` adds the command to a Typer application.
        panel: Heading under which the help lists it.
        summary: The first line of the command's own help.
    """

    FORMS = {"name": (_NAME,), "module": (_MODULE,), "panel": (_TEXT,), "summary": (_TEXT,)}

    name: str
    module: str
    panel: str
    summary: str


@dataclass(frozen=True)
class JobSection(_Declaration):
    """A kind of job, by the key of its section in the job YAML, which evaluates a checkpoint of a run.

    Attributes:
        key: Of the section, such as ``race``.
        verb: What such a job does with the run, such as ``races``.
        model: ``module:Class``: the pydantic model of the section, an :class:`orchestrator.spec.sections.OfCheckpoint`.
        rank: Module that the rank runs; it calls :func:`worker.evaluate.main` with the key.
        rules: ``module:name``: :class:`EvaluationRules`. The module imports no torch.
        watcher: ``module:Class``: a :class:`worker.evaluation.evaluation.Watcher` in the rank.
    """

    FORMS = {
        **{"key": (_KEY,), "verb": (_TEXT,), "rank": (_MODULE,)},
        **dict.fromkeys(("model", "rules", "watcher"), (_PLACE,)),
    }

    key: str
    verb: str
    model: str
    rank: str
    rules: str
    watcher: str


@dataclass(frozen=True)
class Plugin(_Declaration):
    """What a package adds. Tasks and algorithms are entry points of ``muster.tasks`` and ``muster.algorithms`` in the same package.

    A field of another form raises PluginError where it is declared, which every command does.

    Attributes:
        operations: ``METHOD /path`` of every route and page below, with ``/api`` for a route; one that is not here is refused for every
            key.
        routers: ``module:router`` of FastAPI, under ``/api``.
        pages: ``module:router`` of pages of the console.
        navigation: Label and path of their entries in the console's navigation.
        templates: Package whose folder ``templates`` holds the pages' Jinja templates.
        forms: ``module:name`` of each :class:`orchestrator.console.submit_fields.TaskForm`.
        commands: Of ``muster``.
        options: Name of a command of Muster, and ``module:name`` of its :class:`orchestrator.cli.catalogue.FurtherOptions`.
        sections: Kinds of jobs.
        folders: In the store, beside :data:`OF_STORE`.
        run_folders: In a run, beside :data:`OF_RUN`.
        references: ``module:function``: from a store to the runs and jobs that the plug-in's folders need, see
            :mod:`shared_store.volume.references`.
        bundle_parts: ``module:function``: from a task to further JSON documents of an exported bundle, by the names of their files.
    """

    FORMS = {
        "operations": (_OPERATION,),
        "navigation": (_TEXT, _PATH),
        "templates": (_MODULE,),
        "commands": (Command,),
        "options": (_NAME, _PLACE),
        "sections": (JobSection,),
        **dict.fromkeys(("folders", "run_folders"), (_FOLDER,)),
        **dict.fromkeys(("routers", "pages", "forms", "references", "bundle_parts"), (_PLACE,)),
    }

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

    def __post_init__(self) -> None:
        """Raises PluginError for a field of another form, and for a folder that is Muster's own."""
        super().__post_init__()
        for field, own in (("folders", OF_STORE), ("run_folders", OF_RUN)):
            if taken := sorted(own.intersection(getattr(self, field))):
                raise PluginError(f"{field}: {taken[0]} is a folder of Muster's own; choose another name")


def load(place: str, kind: Any = object) -> Any:
    """What ``module:name`` of a plug-in's declaration names, or the module where it is one.

    Raises PluginError, which names the plug-in and the field: it can't be imported, or is no ``kind``.
    """
    try:
        found = _imported(place)
    except PluginError as error:
        raise PluginError(f"{_declared_in(place)}: {error}") from error
    if not isinstance(found, kind):
        raise PluginError(f"{_declared_in(place)}: {place} is {type(found).__name__}, and no {kind.__name__}")
    return found


@contextmanager
def blamed(place: str) -> Iterator[None]:
    """A context in which a plug-in's part is called. Raises PluginError, which names the plug-in, for any error of its code."""
    try:
        yield
    except PluginError:
        raise
    except Exception as error:  # of a user's code, which may do anything
        raise failed(place, error) from error


def failed(place: str, error: BaseException) -> PluginError:
    """The error of a plug-in's part that raised another one than it may."""
    return PluginError(
        f"{_declared_in(place)}: {place} failed ({_words(error)}); tell the plug-in's author, or remove it"
    )


def _imported(place: str) -> Any:
    module, _, name = place.partition(":")
    try:
        return reduce(getattr, filter(None, name.split(".")), import_module(module))
    except PluginError:  # of a declaration, which the module makes
        raise
    except (Exception, SystemExit) as error:  # of a user's code, which may do anything
        raise PluginError(
            f"{place} can't be imported ({_words(error)}); install its package again, or remove it"
        ) from error


def _words(error: BaseException) -> str:
    """An error in one line."""
    if isinstance(error, SystemExit):
        return f"it exits with {error.code!r:.80}"
    return " ".join(str(error).split())[:300] or type(error).__name__


def _declared_in(place: str) -> str:
    """The plug-in and the field that name a part, for errors."""
    quoted = repr(place), repr(place.removesuffix(":register"))
    for name, plugin in plugins().items():
        for field, value in vars(plugin).items():
            if any(each in repr(value) for each in quoted):  # a text, or one of those in it
                return f"plug-in {name}: {field}"
    return "plug-in"


@cache
def plugins() -> Mapping[str, Plugin]:
    """The plug-ins of all installed packages, by their names.

    Raises PluginError: one can't be imported, declares something of another form, or two of them have the same name, folder, command,
    or key of a section.
    """
    found: dict[str, Plugin] = {}
    owners: dict[str, str] = {}
    for name, place, package in sorted(_places()):
        if name in found:
            raise PluginError(f"plug-in {name}: {_both(owners[name], package)} bring one of this name; {_REMEDY}")
        try:
            _check("its entry point", place, _PLACE)
            plugin = _imported(place)
            if not isinstance(plugin, Plugin):
                raise PluginError(f"{place} is not a Plugin of {__name__}")
        except PluginError as error:
            raise PluginError(f"plug-in {name} of the package {package}: {error}") from error
        found[name], owners[name] = plugin, package
    taken: dict[tuple[str, str], str] = {}
    for name, plugin in found.items():
        for each in _names(plugin):
            if each in taken:
                raise PluginError(
                    f"plug-in {name}: the {' '.join(each)} is there twice, in {_both(owners[taken[each]], owners[name])}; {_REMEDY}"
                )
            taken[each] = name
    return found


_REMEDY = "remove one of them (pip uninstall)"


def _both(one: str, other: str) -> str:
    return f"the packages {one} and {other}" if one != other else f"the package {one}"


def _names(plugin: Plugin) -> Iterator[tuple[str, str]]:
    """The names that no two plug-ins may share, with what they are."""
    yield from (("folder", each) for each in plugin.folders)
    yield from (("folder of runs", each) for each in plugin.run_folders)
    yield from (("command", each.name) for each in plugin.commands)
    yield from (("section", each.key) for each in plugin.sections)


@cache
def sections() -> Mapping[str, JobSection]:
    """The kinds of jobs that plug-ins add, by their keys. Raises PluginError."""
    return {section.key: section for plugin in plugins().values() for section in plugin.sections}


def rules_of(key: str) -> EvaluationRules | None:
    """The rules by which a section evaluates; None of one that is not a plug-in's. Raises PluginError."""
    if (section := sections().get(key)) is None:
        return None
    rules: EvaluationRules = load(section.rules)
    if missing := [each for each in ("count", "refusal", "changes", "key_of", "lines") if not hasattr(rules, each)]:
        raise PluginError(
            f"{_declared_in(section.rules)}: {section.rules} is not an EvaluationRules: it has no {missing[0]}"
        )
    return rules


def evaluating() -> tuple[str, ...]:
    """The keys of all kinds of jobs that evaluate a checkpoint. Raises PluginError."""
    return ("evaluate", *sections())


def _places() -> Iterator[tuple[str, str, str]]:
    """Name, place and package of each plug-in. importlib.metadata has them, too, but its import takes a seventh of ``muster --help``.

    As there, of two copies of a package the one counts that comes first on the path.
    """
    seen: set[str] = set()
    for folder in sys.path:
        try:
            entries = sorted(os.listdir(folder or "."))
        except OSError:
            continue
        for entry in entries:
            if entry.endswith((".dist-info", ".egg-info")):
                package = re.sub(r"[-_.]+", "-", entry.rpartition(".")[0].partition("-")[0]).lower()
                if package not in seen:
                    seen.add(package)
                    for name, place in _declared(os.path.join(folder, entry, "entry_points.txt")):
                        yield name, place, package


def _declared(path: str) -> Iterator[tuple[str, str]]:
    """The lines of the group in a package's entry points."""
    try:
        with open(path, encoding="utf-8") as file:
            text = file.read()
    except (OSError, ValueError):
        return
    group = ""
    for line in map(str.strip, text.splitlines() if GROUP in text else ()):
        name, separator, place = line.partition("=")
        if line.startswith("["):
            group = line.strip("[]").strip()
        elif group == GROUP and separator and not line.startswith(("#", ";")):
            yield name.strip(), place.partition("[")[0].strip()
