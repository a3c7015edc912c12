"""The variant of a task, with other parts than the one that it extends: other terms, other defaults of its settings."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, get_type_hints

from shared_store.contract.error_text import nearest
from worker.settings.overrides import Refused, configured, training_sections
from worker.settings.task import TaskConfig, default_rewards, reward_weights
from worker.tasks.declare.declaration import Choice, Declaration, Image, Reward, a_type

if TYPE_CHECKING:
    from worker.tasks.run.sketch import TaskSketch


def check_parts(task: type[TaskSketch], parts: Mapping[str, Any]) -> None:
    """Raise ValueError for a section that a declaration does not have, and for one that is not a mapping of parts by name."""
    known = [item.name for item in dataclasses.fields(Declaration)]
    for section, part in parts.items():
        where = f"{task.__name__}.with_"
        if section not in known:
            raise ValueError(f"{where}: a declaration has no part {section}; {nearest(section, known)}")
        if section == "success" or (section == "actions" and isinstance(part, Choice)):
            continue
        if not isinstance(part, Mapping):
            raise ValueError(
                f"{where}: {section} is {a_type(part)}; give parts by name, such as {section}={{'name': …}}"
            )
        for group, terms in part.items() if section == "observations" else ():
            if not isinstance(terms, Mapping | Image | None):
                raise ValueError(
                    f"{where}: observations.{group} is {a_type(terms)}; observations are by group, such as "
                    "observations={'policy': {'name': …}}"
                )


def changed(declaration: Declaration, parts: Mapping[str, Any]) -> Declaration:
    """The declaration with other parts; None removes one.

    Raises:
        ValueError: A part to remove does not exist, or one is not what its section takes.
    """
    found: dict[str, Any] = {}
    for section, new in parts.items():
        old = declaration.by_group if section == "observations" else getattr(declaration, section)
        if section == "observations":
            groups = {name: each for name, each in old.items() if isinstance(each, Mapping)}
            merged = {
                group: _merged(f"observations.{group}", groups.get(group, {}), each)
                if isinstance(each, Mapping)
                else each
                for group, each in new.items()
            }
            found[section] = _merged(section, old, merged)
        else:
            both = isinstance(old, Mapping) and isinstance(new, Mapping)
            found[section] = _merged(section, old, new) if both else new
    for name, term in found.get("rewards", {}).items():
        former = declaration.rewards.get(name)
        if isinstance(term, Reward) and term.weight is None and former is not None:  # its weight stays
            found["rewards"][name] = copy.copy(term)
            found["rewards"][name].weight = former.weight
    return dataclasses.replace(declaration, **found)


def _merged(where: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    for name in new:
        if new[name] is None and name not in old:
            raise ValueError(f"{where}.{name}: there is nothing of this name to remove; {nearest(name, old)}")
    return {name: part for name, part in {**old, **new}.items() if part is not None}


def changed_settings(
    task: type[TaskSketch], config: Mapping[str, Any], rewards: Mapping[str, Any], where: str = "config"
) -> type[TaskConfig]:
    """The settings of a task with new defaults, and with new weights of rewards that the settings weigh.

    Args:
        task: The task.
        config: New defaults by field; of a field with settings of training, such as ``ppo``, also a mapping of some of them.
        rewards: New reward terms by name; None removes one.
        where: The place of ``config``, for errors.

    Raises:
        ValueError: A field does not exist, or its value is invalid.
    """
    base = task.config_type
    weights, members = dict(default_rewards(base)), dict[str, Any]()
    for name in weights.keys() & rewards.keys():
        weight = getattr(rewards[name], "weight", None)
        if rewards[name] is None:
            del weights[name]
        elif weight is not None:
            weights[name] = float(weight)
    if weights != default_rewards(base):
        members["rewards"] = reward_weights(**weights)
    training = training_sections() & config.keys()
    try:
        made: Any = configured(base, {name: value for name, value in config.items() if name not in training})
    except Refused as error:
        raise ValueError(f"task {task.__name__}: {where}.{'.'.join(map(str, error.path))}: {error.words}") from error
    for name, value in config.items():
        new = getattr(made, name)
        if name in training:
            new = dataclasses.replace(new, **value) if isinstance(value, Mapping) else value
        members[name] = dataclasses.field(default_factory=partial(_same, new))
    if not members:
        return base
    hints = get_type_hints(base, include_extras=True)
    members["__annotations__"] = {name: hints[name] for name in members}
    members |= {"__module__": base.__module__, "__doc__": base.__doc__}
    metaclass: Any = type(base)
    kind: type[TaskConfig] = dataclasses.dataclass(frozen=True)(metaclass(base.__name__, (base,), members))
    return kind


def _same(value: Any) -> Any:
    return value
