"""The policy contract of a task: :class:`shared_store.contract.policy.Contract`, made from its declaration and its interface."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from shared_store import __version__
from shared_store.contract.policy import Command, Contract, Group, Image, RobotModel, State, Term
from worker.settings.camera import CameraConfig
from worker.tasks.compile.contract import described, range_of
from worker.tasks.compile.measured import frame_of, is_library
from worker.tasks.compile.tables import settings

if TYPE_CHECKING:
    from worker.tasks.compile.plan import KernelPlan, Seen
    from worker.tasks.run.task import Task


class Exported(Protocol):
    """A policy as a function of tensors, as far as its contract says something of it."""

    @property
    def sample(self) -> Any: ...
    @property
    def inputs(self) -> Any: ...
    @property
    def states(self) -> Sequence[str]: ...


def policy_contract(task: Task, name: str, exported: Exported | None = None) -> Contract:
    """The contract of a policy of ``task``: inputs, outputs and recurrent state.

    Args:
        task: The task, with its worlds.
        name: Name of the task in a job's YAML.
        exported: The policy as a function of tensors, with its input groups and its recurrent state. Without it, the contract has all
            groups of the task and no state.
    """
    groups = {name: tuple(tensor.shape[1:]) for name, tensor in task.groups.items()}
    inputs = {group: group for group in groups}
    states: list[State] = []
    if exported is not None:
        inputs = dict(zip(map(str, exported.sample.keys()), exported.inputs, strict=False))
        states = [State(each, f"{each}_out", tuple(exported.inputs[each].shape[1:])) for each in exported.states]
    return Contract(
        task=name,
        muster=__version__,
        control_hz=float(task.config.control_hz),
        groups=tuple(_group(task, group, each, groups[group]) for group, each in inputs.items()),
        actions=task.interface().actions,
        action_names=tuple(task.action_names),
        commands=_commands(task.plan),
        states=tuple(states),
        discrete=bool(task.discrete),
        robots=robots_of(task),
        normalizer="unknown" if exported is None else "inside",
    )


def robots_of(task: Task) -> tuple[RobotModel, ...]:
    """The robots of a task as they were loaded."""
    return tuple(dataclasses.replace(reading.identity, name=name) for name, reading in task.readings.items())


def _group(task: Task, name: str, input_name: str, shape: tuple[int, ...]) -> Group:
    if len(shape) > 1:
        return Group(name, input_name, shape, "uint8", image=_image(task, name))
    terms = _terms(task, name)
    fits = sum(term.size for term in terms) == shape[0]
    return Group(name, input_name, shape, "float32", terms=terms if fits else ())


def _image(task: Task, group: str) -> Image | None:
    camera: dict[str, Any] = dict(images_of(task).get(group, {}))
    if not camera:
        return None
    frames, channels = int(camera.pop("frames", 1)), camera.pop("channels")
    return Image(tuple(channels[: len(channels) // frames]), frames, _texts(camera))  # it names those of all frames


def _texts(value: Any) -> Any:
    """Settings as plain values, since JSON has neither tuples nor classes."""
    if isinstance(value, Mapping):
        return {str(key): _texts(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_texts(each) for each in value]
    return value if isinstance(value, bool | int | float | str | None) else str(value)


def _terms(task: Task, group: str) -> tuple[Term, ...]:
    """The terms of a group of numbers; none if unknown."""
    plan = task.plan
    # if the policy sees only an image, the plan has the critic's terms in its place
    source = "policy" if group == "critic" and (group not in plan.groups or "policy" in plan.images) else group
    first, found = 0, []
    for seen in plan.groups.get(source, ()):
        found.append(_term(plan, seen, first))
        first += found[-1].size
    return tuple(found)


def _term(plan: KernelPlan, seen: Seen, first: int) -> Term:
    columns, bound, term = described(plan, seen), seen.bound, seen.term
    signature = bound.signature
    places = plan.numbers.places
    numbers = {name: places[f"{bound.place}.{name}"] for name in (signature.numbers() if signature else ())}
    command = ""
    if bound.takes("command"):
        command = str(term.parameters.get("command") or next(iter(plan.declaration.commands)))
    sensors = [value.removeprefix("sensor_") for value in bound.arguments.values() if value.startswith("sensor_")]
    return Term(
        name=bound.name,
        kind=columns[0].kind,
        first=first,
        names=tuple(column.name for column in columns),
        units=tuple(column.unit for column in columns),
        scale=tuple(column.scale for column in columns),
        offset=tuple(column.offset for column in columns),
        clip=columns[0].clip,
        ranges=tuple(column.range for column in columns) if columns[0].kind == "command" else (),
        history=term.history,
        delay=(term.delay[0], term.delay[-1]) if seen.past >= 0 else (0, 0),
        quantity=term.function_name,
        parameters={name: tuple(plan.numbers.values[at : at + count]) for name, (at, count) in numbers.items()},
        robot=term.robot,
        element=(signature.element or "") if signature else "",
        elements=tuple(bound.element_names) if bound.elements is not None else (),
        sensors={name: _sensor(plan.declaration.sensors[name]) for name in sensors},
        command=command,
        library=is_library(term),
        frame=frame_of(plan, term, sensors),
    )


def _sensor(declared: Any) -> str:
    """A sensor in one line, such as ``ImuSensor, site imu``, or its ``meaning`` if it has one."""
    if meaning := getattr(declared, "meaning", ""):
        return str(meaning)
    return ", ".join(filter(None, (type(declared).__name__, settings(declared))))


def _commands(plan: KernelPlan) -> tuple[Command, ...]:
    found = []
    for timed in plan.commands:
        name, command = timed.bound.name, plan.declaration.commands[timed.bound.name]
        ranges: Sequence[Any] = [range_of(plan, name, command, column) for column in command.names]
        drawn = (plan.numbers.pair(timed.seconds), command.function_name, is_library(command))
        found.append(Command(name, command.names, tuple(command.units), tuple(ranges), *drawn))
    return tuple(found)


def same_policy(contract: Contract, of: Contract) -> Contract:
    """``contract`` with the algorithm's parts (inputs and recurrent state) of ``of``.

    A task alone doesn't know these parts. They can't differ, since they follow from the settings with which a policy is loaded.
    """
    groups = []
    for former in of.groups:
        group = contract.group(former.name)
        if group is not None:
            groups.append(dataclasses.replace(group, input=former.input))
    return dataclasses.replace(contract, groups=tuple(groups), states=of.states, normalizer=of.normalizer)


def images_of(task: Task) -> dict[str, dict[str, Any]]:
    """Description of each image group, as plain values: the camera's settings, and the names of the channels."""
    plan, found = task.plan, {}
    for group, name in plan.images.items():
        sensor, setting = plan.declaration.sensors[name], getattr(task.config, name, None)
        # a camera of the configuration is described by its settings alone
        settings = {} if isinstance(setting, CameraConfig) else {"sensor": name}
        described = dataclasses.asdict(setting if isinstance(setting, CameraConfig) else sensor)
        found[group] = {**settings, **described, "channels": sensor.rows(plan.views)}
    return found
