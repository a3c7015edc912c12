"""The engines that are installed: each an entry point of the group ``muster.engines``, Muster's own ones too."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points

from orchestrator.engines.api import Engine, EngineError, EngineType, Option, Setting, Traits
from orchestrator.engines.toolkit.statuses import observing_several
from shared_store.contract.entry_points import clash
from shared_store.contract.error_text import nearest

GROUP = "muster.engines"
_ORDER = ("local", "docker", "ray", "slurm", "aws-batch")
"""In which Muster's own are named; those of others follow."""

_COMMON = (
    Option("engine", "the engine whose hosts it has"),
    Option("hosts", "names of hosts, with commas between"),
    Option("images", "whether an image that would not be run is refused", values=("refuse",)),
)
"""Tags of compute environments that mean the same on every engine."""
_OF_A_QUEUE = ("images",)
"""Those of them that a queue may have, too."""


def _found() -> Mapping[str, EntryPoint]:
    points = {point.name: point for point in entry_points(group=GROUP)}
    place = {name: number for number, name in enumerate(_ORDER)}
    return dict(sorted(points.items(), key=lambda item: (place.get(item[0], len(_ORDER)), item[0])))


_POINTS = _found()
ENGINES = tuple(_POINTS)
"""Names of all engines that are installed."""


@cache
def engine_type(name: str) -> EngineType:
    """The engine's type. Raises EngineError where there is none of this name, two packages give it, or it can't be imported."""
    if name not in _POINTS:
        available = ", ".join(ENGINES) or "none: install Muster again (pip install -e .)"
        raise EngineError(f"there is no engine {name!r}; available: {available}")
    if words := clash(entry_points(group=GROUP), name):
        raise EngineError(f"engine {name}: {words}")
    try:
        found = _POINTS[name].load()
    except (ImportError, AttributeError) as error:
        raise EngineError(f"engine {name}: {_POINTS[name].value} can't be imported: {error}") from error
    if not isinstance(found, EngineType):
        raise EngineError(f"engine {name}: {_POINTS[name].value} is not an EngineType (orchestrator.engines.api)")
    return found


def traits_of(name: str) -> Traits:
    """Those of the engine called ``name``; the most careful ones where it is not installed here."""
    try:
        return engine_type(name).traits
    except EngineError:
        return Traits()


def make_engine(name: str, setting: Setting) -> Engine:
    """The engine called ``name``. Raises EngineError: there is none, it is not installed, or it does not answer; one line with what to do."""
    return observing_several(engine_type(name).make(setting))


def check_tags(tags: Mapping[str, str], engines: Iterable[str], *, of_a_queue: bool = False) -> None:
    """Look at the tags ``muster:…`` of a compute environment or a queue.

    Args:
        tags: All of its tags.
        engines: The engine of the compute environment, or those of the queue's.
        of_a_queue: Whether it is a queue.

    Raises:
        ValueError: One is misspelt, has a value of a wrong kind, or is none of these engines'; one line with the nearest name.
        EngineError: An engine can't be imported.
    """
    named = list(dict.fromkeys(engines))
    common = [option for option in _COMMON if not of_a_queue or option.name in _OF_A_QUEUE]
    known = {option.name: option for option in common}
    for engine in named:
        known |= {option.name: option for option in engine_type(engine).options}
    for tag, value in tags.items():
        if not tag.startswith("muster:"):
            continue
        option = known.get(tag.removeprefix("muster:"))
        if option is None:
            where = "a queue" if of_a_queue else "a compute environment"
            hint = nearest(tag.removeprefix("muster:"), known)
            raise ValueError(f"tag {tag[:130]}: {where} of the {' or '.join(named)} engine has no such option; {hint}")
        option.check(value)
