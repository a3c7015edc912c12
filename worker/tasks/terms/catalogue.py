"""The catalogue of all terms, with parameters, meanings, and names in mjlab and Isaac Lab, read from signatures and docstrings."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import warp as wp

GROUPS = (
    "joints",
    "root",
    "bodies",
    "actions",
    "commands",
    "events",
    "episode",
    "locomotion",
    "tolerances",
    "contacts",
    "sensing",
    "ground",
    "footing",
    "manipulation",
    "selecting",
    "tracking",
    "following",
)
"""Modules of terms, in the order of the page."""
FILLED = ("world", "stream", "value", "terminated", "seconds")
"""Parameters that the task fills, not the declaration."""
SHARED = ("WorldArrays", "EpisodeArrays", "BodyArrays", "TerrainArrays")
"""Structs of which a task has exactly one."""
_NAMES = re.compile(r"^ *mjlab: (.*?)\.\s+Isaac Lab: (.*)\.$", re.DOTALL | re.MULTILINE)


@dataclass(frozen=True)
class TermEntry:
    """A term, read from its docstring and signature.

    Attributes:
        name: Name, as in ``terms.NAME``.
        group: Name of its module.
        given: Parameters from the declaration, with types and defaults.
        returns: Type of its result; empty without one.
        meaning: Formula, unit and meaning of the numbers, in Markdown.
        mjlab: Its name in mjlab, ``-`` without an equivalent.
        isaac_lab: Its name in Isaac Lab, ``-`` without an equivalent.
    """

    name: str
    group: str
    given: str
    returns: str
    meaning: str
    mjlab: str
    isaac_lab: str


def entries() -> Iterator[TermEntry]:
    """All terms, module by module in the order of their source."""
    for group in GROUPS:
        module = importlib.import_module(f"worker.tasks.terms.{group}")
        for name, function in vars(module).items():
            if isinstance(function, wp.Function) and function.func.__module__ == module.__name__:
                found = _entry(name, group, function)
                if found is not None:
                    yield found


def _entry(name: str, group: str, function: Any) -> TermEntry | None:
    text = inspect.getdoc(function.func) or ""
    names = _NAMES.search(text)
    if names is None:  # a function shared by terms
        return None
    meaning = re.sub(r":func:`(\w+)`", r"``\1``", text[: names.start()].strip()).replace("``", "`")
    mjlab, isaac_lab = (" ".join(each.split()) for each in names.groups())
    parameters = inspect.signature(function.func).parameters.values()
    given = ", ".join(filter(None, map(_shown, parameters)))
    returns = inspect.signature(function.func).return_annotation
    shown = "" if returns is inspect.Signature.empty else _kind(returns)
    return TermEntry(name, group, given, shown, " ".join(meaning.split()), mjlab, isaac_lab)


def _kind(annotation: Any) -> str:
    return str(annotation).removeprefix("wp.")


def _shown(parameter: inspect.Parameter) -> str:
    """A parameter as a declaration gives it; empty if the task fills it."""
    name, kind = parameter.name, _kind(parameter.annotation)
    if name in FILLED or kind in SHARED:
        return ""
    if kind.endswith("Arrays"):
        return "" if name == "robot" else f"`{name}`: {kind}"
    if name in ("joint", "body", "site"):
        return {"joint": "`joints`", "body": "`bodies`", "site": "`sites`"}[name]
    if name == "index":
        return "`size`"
    if name in ("action", "memory"):
        return ""
    if name == "command":
        return "`command`"
    if parameter.default is inspect.Parameter.empty:
        return f"`{name}`: {kind}"
    return f"`{name}`: {kind} = {_default(parameter.default)}"


def _default(value: Any) -> str:
    if isinstance(value, bool | float | int):
        return str(value)
    return f"({', '.join(f'{each:g}' for each in value)})"


REFERENCE = """\
# Terms

The functions of `worker.tasks.terms`. A declared task names them, such as
`Reward(terms.joint_velocity_squared, joints="*_knee")`; [porting.md](porting.md) maps mjlab's and Isaac Lab's terms to
them. `python -m worker.tasks.terms` writes this page from the functions' docstrings.

- **Given** lists the parameters from the declaration: `joints`, `bodies`, `sites` are patterns, and the function is
  called for each match; `size` is the number of calls, with `index` from 0, by default one for each column of its
  sensor; `command` names a command. A parameter of a type `...Arrays` takes the name of a sensor or, for `RobotArrays`,
  of a robot or object; it may be omitted if only one fits. All others are numbers in the unit that the meaning gives;
  those with `=` have a default.
- `robot=` names the robot or object that a function applies to, `"robot"` by default.
- A function that is called for several elements gives the sum over them as a reward or metric, one column after the other as
  an observation, and ends an episode if it is true for any.
- Quaternions are xyzw. All units are SI: a policy's scales are in the declaration, not here.
"""

PORTING = """\
# Term names of mjlab and Isaac Lab

The names in `worker.tasks.terms` of the terms of mjlab 1.6 and Isaac Lab. [terms.md](terms.md) gives their meanings and
parameters, and [ports.md](ports.md) compares a whole task of each with ours. `python -m worker.tasks.terms porting`
writes this page from the functions' docstrings. Randomisation of physics, mjlab's `dr.*` and Isaac Lab's `randomize_*`, is not a
term here but a `Randomize`: [their names](randomization.md#names-of-mjlab-and-isaac-lab). What else is no term here is at
[the end](#names-that-are-no-terms-here). Three differences hold everywhere:

- Quaternions are xyzw here, and wxyz there.
- A function for one joint, body or foot gives one number, and rewards are summed over them: mjlab's `joint_vel_l2` is
  `joint_velocity_squared` of all joints.
- Isaac Lab uses velocities of the centre of mass where mjlab uses those of the frame's origin; the table names the exact equivalent.
"""

ELSEWHERE = """\
## Names that are no terms here

| theirs | whose | here |
|---|---|---|
| `commands_vel` | mjlab | of Go1 and G1: `command_forward`, `command_left`, `command_turn` of the configuration, stages by iteration (mjlab's steps / 24); in a task of your own: [`begin_iteration`](../own-task.md#numbers-and-curricula-of-a-job) sets the numbers of the command, since a curriculum gives both ends of a range the same value |
| `reward_curriculum` | mjlab | [`train.config.curriculum`](../tasks.md#curriculum): a weight by the term's name, another number as `rewards.TERM.NUMBER`; by iteration instead of step, and interpolated: for a jump give two points one iteration apart |
| `modify_reward_weight` | Isaac Lab | the same |
| `termination_curriculum` | mjlab | the same, `terminations.TERM.NUMBER`; whether it is a `time_out` stays |
| `modify_env_param`, `modify_term_cfg` | Isaac Lab | the same for a number of the declaration; other rules in [`begin_iteration`](../own-task.md#numbers-and-curricula-of-a-job) |
| `camera_rgb` | mjlab | [`Image`](cameras.md) of a `CameraSensor(kind="color")`, an observation group of its own; bytes, which networks take as -0.5 to 0.5 instead of 0 to 1 |
| `camera_depth` | mjlab | `Image` of a `CameraSensor(kind="depth")`, `near`: min_depth, `far`: cutoff_distance; 0 is at `near`, theirs at the camera |
| `camera_segmentation` | mjlab | `Image` of a `CameraSensor(kind="segmentation")`: one channel for each robot, object and the ground, instead of numbers of geoms |
| `dr.geom_rgba` | mjlab | [`train.config.randomize.colors`](../tasks.md#randomisation): of all shapes, around their own colours, once for each world |
| `TendonLengthAction`, `TendonVelocityAction`, `TendonEffortAction` | mjlab | nothing like it: actions drive joints, or a frame with `move_frame` |
| `SiteEffortAction` | mjlab | nothing like it as an action; `apply_wrench`, an event, pushes bodies |
| `reset_root_state_from_flat_patches` | mjlab | nothing like it: no flat places are looked for; `reset_root_on_terrain` places robots around the middle of their patch |
| `reset_root_state_from_terrain` | Isaac Lab | nothing like it, as above |
| `reset_nodal_state_uniform` | Isaac Lab | nothing like it: there are no soft bodies |
| `OperationalSpaceControllerAction`, `NonHolonomicAction`, `SurfaceGripperBinaryAction` | Isaac Lab | nothing like it |
"""


def reference() -> str:
    """The page of all terms."""
    parts = [REFERENCE]
    for group in GROUPS:
        found = [entry for entry in entries() if entry.group == group]
        head, _, rest = (_module(group).__doc__ or "").strip().partition("\n\n")
        parts.append(f"## {head.rstrip('.').partition(':')[0]}\n\n{head}{_paragraph(rest)}\n")
        rows = [f"| `{each.name}` | {each.given} | {each.returns} | {_cell(each.meaning)} |" for each in found]
        parts.append("\n".join(["| term | given | returns | meaning |", "|---|---|---|---|", *rows]) + "\n")
    return "\n".join(parts)


def porting() -> str:
    """The page of mjlab's and Isaac Lab's names, each sorted by their names."""
    parts = [PORTING]
    for title, field in (("mjlab", "mjlab"), ("Isaac Lab", "isaac_lab")):
        rows = []
        for entry in entries():
            for theirs in split(getattr(entry, field)):
                name, _, note = theirs.partition(" ")
                rows.append((name, f"| `{name}` | `{entry.name}` | {_cell(note.strip('()'))} |"))
        rows.sort(key=lambda row: row[0].lower())
        table = ["| theirs | ours | differences, owner |", "|---|---|---|", *(row for _, row in rows)]
        parts.append(f"## {title}\n\n" + "\n".join(table) + "\n")
    parts.append(ELSEWHERE)
    return "\n".join(parts)


def split(names: str) -> list[str]:
    """The names in a list such as ``a (b, c), d``; none of ``-``."""
    if names == "-":
        return []
    return [each.strip() for each in re.split(r",(?![^(]*\))", names)]


def _module(group: str) -> ModuleType:
    return importlib.import_module(f"worker.tasks.terms.{group}")


def _paragraph(text: str) -> str:
    text = re.sub(r":func:`(\w+)`", r"``\1``", text).replace("``", "`")
    return "\n\n" + " ".join(text.split()) if text else ""


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
