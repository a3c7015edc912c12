"""The pages of all terms, and of their names in mjlab and Isaac Lab, written from signatures and docstrings."""

from __future__ import annotations

import inspect
import re
from importlib import import_module
from types import ModuleType
from typing import Any

import warp as wp

from worker.tasks import terms
from worker.tasks.terms import more
from worker.tasks.terms.aliases import ELSEWHERE, LIBRARIES, all_terms, meaning_and_names

FILLED = ("world", "stream", "value", "terminated", "seconds")
"""Parameters that the task fills, not the declaration."""
SHARED = ("WorldArrays", "EpisodeArrays", "BodyArrays", "TerrainArrays")
"""Structs of which a task has exactly one."""
REFERENCE = """\
# Terms

The functions of `worker.tasks.terms`. A task names them, such as
`Reward(terms.joint_velocity_squared, joints="*_knee")`; [porting.md](porting.md) maps mjlab's and Isaac Lab's terms to
them. `python -m docs.tools` writes this page from the functions' docstrings.

- **Parameters** are those that a declaration sets: `joints`, `bodies`, `sites` are patterns, and the function is
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

The names in `worker.tasks.terms` of the terms of mjlab 1.6 and Isaac Lab. A task may also use theirs: `terms.mjlab.joint_vel_l2` and
`terms.isaaclab.joint_vel_l2` are our `terms.joint_velocity_squared`. Where several terms have one name, the alias is the one without a remark. A name
without a term here is refused with the row below that says what to use instead. [terms.md](terms.md) gives meanings and
parameters, which are ours under either name, and [ports.md](ports.md) compares a whole task of each with ours. `python -m docs.tools`
writes this page from the functions' docstrings. Randomisation of physics, mjlab's `dr.*` and Isaac Lab's `randomize_*`, is not a
term here but a `Randomize`: [their names](randomization.md#names-of-mjlab-and-isaac-lab). What else has no term here is at
[the end](#names-without-a-term-here). Three differences hold everywhere:

- Quaternions are xyzw here, and wxyz there.
- A function for one joint, body or foot gives one number, and rewards are summed over them: mjlab's `joint_vel_l2` is
  `joint_velocity_squared` of all joints.
- Isaac Lab uses velocities of the centre of mass where mjlab uses those of the frame's origin; the table names the exact equivalent.
"""

ELSEWHERE_HEAD = """\
## Names without a term here

| their name | library | here |
|---|---|---|
"""


def reference() -> str:
    """The page of all terms."""
    parts = [REFERENCE]
    for group in [*terms.GROUPS, *(group for group in more.GROUPS if group not in terms.GROUPS)]:
        head, _, rest = (_module(group).__doc__ or "").strip().partition("\n\n")
        rows = [
            f"| `{name}` | {_parameters(function)} | {_returns(function)} | {_cell(_plain(meaning_and_names(function)[0]))} |"
            for found, name, function in all_terms()
            if found == group
        ]
        paragraph = f"\n\n{_plain(rest)}" if rest else ""
        table = "\n".join(["| term | parameters | returns | meaning |", "|---|---|---|---|", *rows])
        parts.append(f"## {head.rstrip('.').partition(':')[0]}\n\n{head}{paragraph}\n\n{table}\n")
    return "\n".join(parts)


def porting() -> str:
    """The page of mjlab's and Isaac Lab's names, each sorted by their names."""
    parts = [PORTING]
    for library, title in LIBRARIES.items():
        rows = [
            (theirs, f"| `{theirs}` | `{name}` | {_cell(remark)} |")
            for _, name, function in all_terms()
            for theirs, remark in meaning_and_names(function)[1][library]
        ]
        rows.sort(key=lambda row: row[0].lower())
        table = ["| their name | ours | differences, owner |", "|---|---|---|", *(row for _, row in rows)]
        parts.append(f"## {title}\n\n" + "\n".join(table) + "\n")
    elsewhere = (f"| `{name}` | {LIBRARIES[library]} | {instead} |\n" for name, (library, instead) in ELSEWHERE.items())
    return "\n".join([*parts, ELSEWHERE_HEAD + "".join(elsewhere)])


def _module(group: str) -> ModuleType:
    return import_module(f"{(terms if group in terms.GROUPS else more).__name__}.{group}")


def _parameters(function: wp.Function) -> str:
    return ", ".join(filter(None, map(_parameter, _signature(function).parameters.values())))


def _signature(function: wp.Function) -> inspect.Signature:
    assert function.func is not None
    return inspect.signature(function.func)


def _returns(function: wp.Function) -> str:
    returns = _signature(function).return_annotation
    return "" if returns is inspect.Signature.empty else _kind(returns)


def _kind(annotation: Any) -> str:
    return str(annotation).removeprefix("wp.")


def _parameter(parameter: inspect.Parameter) -> str:
    """A parameter as a declaration gives it; empty if the task fills it."""
    name, kind = parameter.name, _kind(parameter.annotation)
    if name in (*FILLED, "action", "memory") or kind in SHARED:
        return ""
    if kind.endswith("Arrays"):
        return "" if name == "robot" else f"`{name}`: {kind}"
    plural = {"joint": "joints", "body": "bodies", "site": "sites", "index": "size", "command": "command"}
    if name in plural:
        return f"`{plural[name]}`"
    default = parameter.default
    if default is inspect.Parameter.empty:
        return f"`{name}`: {kind}"
    shown = default if isinstance(default, bool | float | int) else f"({', '.join(f'{each:g}' for each in default)})"
    return f"`{name}`: {kind} = {shown}"


def _plain(text: str) -> str:
    """A docstring's text in Markdown, on one line."""
    return " ".join(re.sub(r":func:`(\w+)`", r"``\1``", text).replace("``", "`").split())


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
