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
    kind: Literal["text", "value", "code", "names"] = "value"
    """``text``: as it stands; ``value``: read as YAML; ``code``: a text of several lines; ``names``: names, one a line."""
    options: tuple[str, ...] = ()
    """From which one is chosen; empty for any value."""
    value: str = ""
    placeholder: str = ""
    hint: str = ""
    required: bool = False
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
    """The installed tasks, and a sentence about each: the first line of its docstring, without its markup."""
    about = {name: (config_schema(name) or {}).get("description", "").partition("\n")[0] for name in known_tasks()}
    return {
        name: re.sub(r":\w+:|`|(?<=\w)Config\b", "", text).partition(" Rewards: see")[0] for name, text in about.items()
    }


def groups(task: str, queues: Sequence[str]) -> list[FieldGroup]:
    """The wizard's fields for a task. ``queues``: those to which the caller may submit."""
    form = form_of(task)
    first = {"name": re.sub(r"[^A-Za-z0-9_-]", "-", task).strip("-").lower(), **_FIRST, "train.algorithm": "ppo"}
    first["queue"] = "default" if "default" in queues else next(iter(queues), "")
    options = {"queue": tuple(queues), "train.algorithm": tuple(ALGORITHMS)}

    def job(*names: str) -> tuple[Field, ...]:
        fields = [_field(name, _at(name)) for name in names]
        fields = [
            replace(each, kind="text", options=options[each.name]) if each.name in options else each for each in fields
        ]
        return tuple(replace(each, value=first.get(each.name, ""), required=each.name in first) for each in fields)

    found = [FieldGroup("Job", job(*_JOB), True), FieldGroup("Training", job(*_TRAINING), True)]
    found += form.groups(task) if form else []
    config = config_schema(task)
    if config is None:
        hint = "This task publishes no schema; its ranks check the settings."
        found.append(FieldGroup("Configuration of the task", (Field("train.config", hint="YAML"),), hint=hint))
    else:
        without = {*kept_files(task_config(task)), *(form.keys if form else ())}
        found += _groups("Task", {k: v for k, v in config["properties"].items() if k not in without}, "train.config")
    for name in ALGORITHMS:
        section = job_schema()["$defs"][f"Settings_{name}"]
        hint = "Empty fields keep the task's own values."
        found += _groups(f"Algorithm {name}", section["properties"], f"train.{name}", name, hint)
    return [*found, FieldGroup("More", job(*_MORE))]


def _at(path: str) -> Mapping[str, Any]:
    """The part of the schema for a key path of sections."""
    about: Mapping[str, Any] = job_schema()
    for key in path.split("."):
        about = plain(about)["properties"][key]
    return about


def _groups(
    title: str, properties: Mapping[str, Any], prefix: str, algorithm: str = "", hint: str = ""
) -> Iterator[FieldGroup]:
    """A group of the plain fields of a section, then one for each section in it."""
    inner = {key: nested for key, about in properties.items() if (nested := plain(about).get("properties"))}
    if fields := tuple(_field(f"{prefix}.{key}", about) for key, about in properties.items() if key not in inner):
        yield FieldGroup(title, fields, algorithm=algorithm, hint=hint)
    for key, nested in inner.items():
        yield from _groups(f"{title}: {key}", nested, f"{prefix}.{key}", algorithm)


def _field(name: str, about: Mapping[str, Any]) -> Field:
    about = plain(about)
    default, values = about.get("default"), about.get("enum", [True, False] if about.get("type") == "boolean" else [])
    is_text = about.get("type") == "string" or (values and all(isinstance(each, str) for each in values))
    return Field(
        name,
        "text" if is_text else "value",
        tuple(each if isinstance(each, str) else json.dumps(each) for each in values),
        placeholder="" if default is None else default if isinstance(default, str) else json.dumps(default),
        hint="; ".join(filter(None, (about.get("description", ""), bounds(about)))),
    )


_KINDS = {"integer": "integer", "number": "number", "array": "list, such as [1, 2]", "object": "mapping"}
_LIMITS = {"minimum": "from", "exclusiveMinimum": "above", "maximum": "up to", "exclusiveMaximum": "below"}


def bounds(about: Mapping[str, Any]) -> str:
    """The type of a value and its limits, in words."""
    limits = [f"{words} {about[key]}" for key, words in _LIMITS.items() if key in about]
    return " ".join(filter(None, (_KINDS.get(str(about.get("type")), ""), *limits)))


def filled(form: Form, found: Sequence[FieldGroup]) -> list[FieldGroup]:
    """The groups with the values of a form that was sent."""

    def value(field: Field) -> str:
        return "\n".join(form.every(field.name)[0 if field.kind == "names" else -1 :]).replace("\r\n", "\n")

    return [replace(group, fields=tuple(replace(each, value=value(each)) for each in group.fields)) for group in found]


def document(task: str, found: Sequence[FieldGroup]) -> dict[str, Any]:
    """The job described by filled groups."""
    result: dict[str, Any] = {}
    fields = {each.name: each for group in found for each in group.fields}
    algorithm = fields["train.algorithm"].value
    for group in found:
        for field in group.fields:
            if field.value.strip() and group.algorithm in ("", algorithm):
                target, (*path, key) = result, field.name.split(".")
                for part in path:
                    target = target.setdefault(part, {})
                target[key] = _value(field)
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
    if field.kind == "text":
        return text.strip()
    if _NUMBER.fullmatch(text.strip()):
        return float(text)
    try:
        return strict_yaml.load(text)[0]
    except strict_yaml.YamlError:
        return text.strip()  # the spec's own check says what was expected


class _Dumper(yaml.SafeDumper):
    """Texts of several lines as they are, and short lists on one line."""


_Dumper.add_representer(
    str, lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", text, "|" if "\n" in text else None)
)
_Dumper.add_representer(
    list,
    lambda dumper, values: dumper.represent_sequence(
        "tag:yaml.org,2002:seq", values, flow_style=not any(isinstance(each, dict) for each in values)
    ),
)


def written(job: Mapping[str, Any]) -> str:
    """A job as YAML."""
    text: str = yaml.dump(dict(job), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120)
    return text
