"""The wizard's fields, made of the published schema; and the YAML made of the filled fields."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import yaml
from fastapi import Request

from orchestrator.console.forms import Form
from orchestrator.spec import strict_yaml
from orchestrator.spec.json_schema import schema
from orchestrator.spec.model import ALGORITHMS
from orchestrator.spec.settings import task_config
from orchestrator.spec.values import known_tasks
from shared_store.contract.file_fields import kept_files
from shared_store.contract.plugins import load, plugins

_JOB = ("name", "queue", "nodes", "resources.cpus", "resources.gpus", "resources.memory")
_TRAINING = ("train.worlds", "train.iterations", "train.seed", "train.algorithm")
_MORE = (
    *("checkpoint.every", "checkpoint.keep", "evaluation.every", "evaluation.episodes", "retry.attempts"),
    *("on_child_failure", "timeout", "stall_timeout", "priority", "share", "preemptible", "image"),
)
_FIRST = {"nodes": "1", "resources.cpus": "1", "train.worlds": "128", "train.iterations": "100"}
"""Values with which the wizard begins."""
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+")
"""A number that YAML takes for a text."""


@dataclass(frozen=True)
class Field:
    """A field of the wizard; the YAML leaves empty ones out."""

    name: str
    """The key path in the YAML."""
    kind: Literal["text", "value", "choice", "code", "names"] = "value"
    """``text``: as it stands; ``value``: read as YAML; ``choice``: one of the options; ``code``: a text of several lines; ``names``: names,
    one a line."""
    options: tuple[str, ...] = ()
    value: str = ""
    placeholder: str = ""
    hint: str = ""
    required: bool = False
    is_text: bool = False
    """Whether an option is a text, and not a value of YAML."""
    file: str = ""
    """The name of the file whose text a ``code`` is; empty where it is a value of YAML."""
    picture: str = ""
    """Address of a name's picture, in which ``{}`` is the name."""

    @property
    def label(self) -> str:
        return self.name.rpartition(".")[2]


@dataclass(frozen=True)
class FieldGroup:
    """Fields under one heading."""

    title: str
    fields: tuple[Field, ...]
    is_open: bool = False
    algorithm: str = ""
    """The algorithm without which the group is left out; empty for all."""
    hint: str = ""


@dataclass(frozen=True)
class TaskForm:
    """The part of the wizard that a plug-in adds for its tasks."""

    title: str
    """Of these tasks, where one is chosen."""
    includes: Callable[[str], bool]
    """Whether a task is one of them."""
    groups: Callable[[str], list[FieldGroup]]
    """Further fields of a task, which stand before those of its schema."""
    keys: frozenset[str]
    """The keys of the task's configuration that they give."""
    names: Callable[[Request], tuple[list[str], str]]
    """What a field of kind ``names`` chooses from; where there is none, the reason."""


def form_of(task: str) -> TaskForm | None:
    """The form that a plug-in has for a task."""
    return next((form for form in forms() if form.includes(task)), None)


@cache
def forms() -> Sequence[TaskForm]:
    """Those of all plug-ins. Raises PluginError."""
    return [load(place, TaskForm) for plugin in plugins().values() for place in plugin.forms]


@cache
def job_schema() -> dict[str, Any]:
    """The schema that the installation publishes."""
    return schema()


def plain(about: Mapping[str, Any]) -> Mapping[str, Any]:
    """A part of the schema without references, and without null as a value of optional fields."""
    while True:
        kinds = [each for each in about.get("anyOf", ()) if each.get("type") != "null"]
        if "$ref" in about:
            named = job_schema()["$defs"][about["$ref"].rpartition("/")[2]]
            about = {**named, **{key: value for key, value in about.items() if key != "$ref"}}
        elif len(kinds) == 1:
            about = {**kinds[0], **{key: value for key, value in about.items() if key != "anyOf"}}
        else:
            return about


def config_schema(task: str) -> Mapping[str, Any] | None:
    """JSON schema of a task's ``train.config``; None for a task that declares none."""
    for each in job_schema()["$defs"]["Train"]["allOf"]:
        if each["if"]["properties"]["task"]["const"] == task:
            found: Mapping[str, Any] = each["then"]["properties"]["config"]
            return found
    return None


@cache
def tasks() -> Mapping[str, str]:
    """The installed tasks, and a sentence about each."""
    about = {name: (config_schema(name) or {}).get("description", "") for name in known_tasks()}
    return {name: _sentence(text) for name, text in about.items()}


def _sentence(text: str) -> str:
    """The first line of a docstring, without its markup."""
    line = re.sub(r":\w+:|`|(?<=\w)Config\b", "", text.partition("\n")[0])
    return line.partition(" Rewards: see")[0]


def groups(task: str, queues: Sequence[str]) -> list[FieldGroup]:
    """The wizard's fields for a task. ``queues``: those to which the caller may submit."""
    form = form_of(task)
    named = {"name": re.sub(r"[^A-Za-z0-9_-]", "-", task).strip("-").lower(), **_FIRST}
    own = {"queue": tuple(queues), "train.algorithm": tuple(ALGORITHMS)}
    chosen = {"queue": "default" if "default" in queues else next(iter(queues), ""), "train.algorithm": "ppo"}

    def job(*names: str) -> tuple[Field, ...]:
        found = [_field(name, _at(name)) for name in names]
        return tuple(
            replace(each, kind="choice", options=own[each.name], is_text=True, value=chosen[each.name], required=True)
            if each.name in own
            else replace(each, value=named.get(each.name, ""), required=each.name in named)
            for each in found
        )

    found = [FieldGroup("Job", job(*_JOB), True), FieldGroup("Training", job(*_TRAINING), True)]
    found += form.groups(task) if form else []
    config = config_schema(task)
    if config is None:
        hint = "This task publishes no schema; its ranks check the settings."
        found.append(FieldGroup("Configuration of the task", (Field("train.config", hint="YAML"),), hint=hint))
    else:
        left_out = {*kept_files(task_config(task)), *(form.keys if form else ())}
        found += _groups("Task", config["properties"], "train.config", left_out)
    for name in ALGORITHMS:
        section = job_schema()["$defs"][f"Settings_{name}"]
        hint = "Empty fields keep the task's own values."
        found += _groups(f"Algorithm {name}", section["properties"], f"train.{name}", (), name, hint)
    return [*found, FieldGroup("More", job(*_MORE))]


def _at(path: str) -> Mapping[str, Any]:
    """The part of the schema for a key path of sections."""
    about: Mapping[str, Any] = job_schema()
    for key in path.split("."):
        about = plain(about)["properties"][key]
    return about


def _groups(
    title: str, properties: Mapping[str, Any], prefix: str, without: Any, algorithm: str = "", hint: str = ""
) -> Iterator[FieldGroup]:
    """A group of the plain fields of a section, then one for each section in it."""
    own: list[Field] = []
    inner: list[FieldGroup] = []
    for key, about in properties.items():
        if key in without:
            continue
        if sections := plain(about).get("properties"):
            inner += _groups(f"{title}: {key}", sections, f"{prefix}.{key}", (), algorithm)
        else:
            own.append(_field(f"{prefix}.{key}", about))
    if own:
        yield FieldGroup(title, tuple(own), algorithm=algorithm, hint=hint)
    yield from inner


def _field(name: str, about: Mapping[str, Any]) -> Field:
    about = plain(about)
    default = about.get("default")
    placeholder = "" if default is None else default if isinstance(default, str) else json.dumps(default)
    hint = "; ".join(filter(None, (about.get("description", ""), bounds(about))))
    if about.get("type") == "boolean" or "enum" in about:
        values = about.get("enum", [True, False])
        options = tuple(each if isinstance(each, str) else json.dumps(each) for each in values)
        is_text = all(isinstance(each, str) for each in values)
        return Field(name, "choice", options, "", placeholder, hint, is_text=is_text)
    kind: Literal["text", "value"] = "text" if about.get("type") == "string" else "value"
    return Field(name, kind, (), "", placeholder, hint)


def bounds(about: Mapping[str, Any]) -> str:
    """The type of a value and its limits, in words."""
    words = {"integer": "whole number", "number": "number", "array": "list, such as [1, 2]", "object": "mapping"}
    limits = {
        "minimum": "from {}",
        "exclusiveMinimum": "above {}",
        "maximum": "up to {}",
        "exclusiveMaximum": "below {}",
    }
    told = [text.format(str(about[key])) for key, text in limits.items() if key in about]
    return " ".join(filter(None, (words.get(str(about.get("type")), ""), *told)))


def filled(form: Form, found: Sequence[FieldGroup]) -> list[FieldGroup]:
    """The groups with the values of a form that was sent."""
    return [
        replace(
            group,
            fields=tuple(
                replace(each, value="\n".join(form.every(each.name)) if each.kind == "names" else _given(form, each))
                for each in group.fields
            ),
        )
        for group in found
    ]


def _given(form: Form, field: Field) -> str:
    return form.one(field.name).replace("\r\n", "\n")


def document(task: str, found: Sequence[FieldGroup]) -> dict[str, Any]:
    """The job described by filled groups."""
    result: dict[str, Any] = {}
    algorithm = next((each.value for group in found for each in group.fields if each.name == "train.algorithm"), "")
    for group in found:
        for field in group.fields:
            if field.value.strip() and group.algorithm in ("", algorithm):
                _put(result, field.name.split("."), _value(field))
    train = result.pop("train", {})
    more = {key: result.pop(key) for key in list(result) if key not in ("name", "queue", "nodes", "resources")}
    return {**result, "train": {"task": task, **train}, **more}


def _value(field: Field) -> Any:
    text = field.value
    if field.kind == "names":
        names = [line.strip() for line in text.splitlines() if line.strip()]
        return names[0] if len(names) == 1 else names
    if field.file:
        return {"file": field.file, "text": text if text.endswith("\n") else text + "\n"}
    if field.kind == "text" or field.is_text:
        return text.strip()
    if _NUMBER.fullmatch(text.strip()):
        return float(text)
    try:
        return strict_yaml.load(text)[0]
    except strict_yaml.YamlError:
        return text.strip()  # the spec's own check says what was expected


def _put(target: dict[str, Any], path: Sequence[str], value: Any) -> None:
    for key in path[:-1]:
        target = target.setdefault(key, {})
    target[path[-1]] = value


class _Dumper(yaml.SafeDumper):
    """Texts of several lines as they are, and short lists on one line."""


def _text(dumper: yaml.SafeDumper, value: str) -> yaml.Node:
    return dumper.represent_scalar("tag:yaml.org,2002:str", value, "|" if "\n" in value else None)


def _list(dumper: yaml.SafeDumper, value: list[Any]) -> yaml.Node:
    is_flat = not any(isinstance(each, dict) for each in value)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", value, flow_style=is_flat)


_Dumper.add_representer(str, _text)
_Dumper.add_representer(list, _list)


def written(job: Mapping[str, Any]) -> str:
    """A job as YAML."""
    text: str = yaml.dump(dict(job), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120)
    return text
