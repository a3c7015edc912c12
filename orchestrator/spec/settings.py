"""Settings of the installed algorithms and tasks: classes that the installation names and that are imported without torch.

Algorithms (entry-point group ``muster.settings``): pydantic dataclasses. A job's YAML gives some of the fields; the others are the
task's own. Each field is checked by itself; where the class of the task's configuration is installed, all of them together, too.

Tasks (entry-point group ``muster.task_settings``): the class of a task's whole configuration, by the name of the task. It has all
defaults, so that it is made here as the rank will make it.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from dataclasses import fields
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from pydantic import BaseModel, Field, ValidationError, create_model
from pydantic.dataclasses import is_pydantic_dataclass

from shared_store.contract.error_text import explain


def settings_classes() -> dict[str, Any]:
    """The settings class of each installed algorithm, by its name. One that can't be imported is left out: its rank will say why."""
    found = {entry.name: _loaded(entry) for entry in entry_points(group="muster.settings")}
    return {name: found[name] for name in sorted(found) if is_pydantic_dataclass(found[name])}


def task_config(task: str) -> Any | None:
    """The class of an installed task's configuration (``worker.settings.task.TaskConfig``), imported when it is asked for.

    None of a task that names none, that is not installed (``module:Class``), or whose class can't be imported: its rank checks.
    """
    found = map(_loaded, entry_points(group="muster.task_settings", name=task))
    return next((each for each in found if hasattr(each, "problem_with")), None)


def _loaded(entry: EntryPoint) -> Any:
    """What an entry point names; None where that can't be imported."""
    try:
        return entry.load()
    except Exception:
        return None


def effective_problem(
    settings: Any, name: str, config: Any, overrides: Mapping[str, Any]
) -> tuple[tuple[str | int, ...], str] | None:
    """The first problem of an algorithm's settings as its rank puts them together; None where there is none.

    Args:
        settings: Class of the settings.
        name: Of the algorithm.
        config: The task's configuration, whose field of that name has the task's own settings.
        overrides: By the job, in place of the task's.

    Returns:
        Keys to the value, and one line.
    """
    own = getattr(config, name, None)
    base = {item.name: getattr(own, item.name) for item in fields(own) if item.init} if own is not None else {}
    try:
        made = settings(**{**base, **overrides})
        if hasattr(made, "check_observations"):
            made.check_observations(config.observation_groups)
        if hasattr(made, "check_actions"):
            made.check_actions(config.chooses)
    except ValidationError as error:
        first: Any = error.errors(include_url=False)[0]
        if first["loc"]:
            return first["loc"], explain(first)
        return _named(str(first["ctx"]["error"]) if "ctx" in first else first["msg"], settings)
    except ValueError as error:
        return _named(str(error), settings)
    return None


def _named(words: str, settings: Any) -> tuple[tuple[str, ...], str]:
    """A rule over several fields begins its words with the name of one: that is the key."""
    found = re.match(r"([\w.]+): ", words)
    if found and (path := tuple(found[1].split(".")))[0] in settings.__pydantic_fields__:
        return path, words[found.end() :]
    return (), words


def section_of(name: str, settings: Any, base: type[BaseModel]) -> type[BaseModel]:
    """A section of the YAML with the fields of ``settings``, each of which may be left out."""
    fields: dict[str, Any] = {}
    for key, field in settings.__pydantic_fields__.items():
        optional = copy.copy(field)
        optional.default, optional.default_factory = None, None
        fields[key] = (field.annotation | None, optional)
    doc = f"Overrides of the task's own settings of {name}; what is not given stays as the task has it."
    return create_model(f"Settings_{name}", __base__=base, __doc__=doc, **fields)


def train_section(base: type[BaseModel], sections: dict[str, type[BaseModel]]) -> type[BaseModel]:
    """The ``train`` section of the YAML: ``base`` with a section for each algorithm."""
    fields: dict[str, Any] = {name: (section, Field(default_factory=section)) for name, section in sections.items()}
    return create_model("Train", __base__=base, __doc__=base.__doc__, **fields)
