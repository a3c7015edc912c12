"""Aliases of terms: their names in mjlab 1.6 and Isaac Lab, from the docstrings of ours, and what to use instead of the others.

A docstring ends with its term's names, such as ``mjlab: foot_height (on flat ground). Isaac Lab: base_pos_z, other.``; a remark in
brackets says how theirs differs.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from importlib import import_module

import warp as wp

from shared_store.contract.error_text import nearest
from worker.tasks import terms
from worker.tasks.terms import more

LIBRARIES = {"mjlab": "mjlab", "isaaclab": "Isaac Lab"}
"""Libraries by the names of their modules here."""
_NO_FLAT_PLACES = "nothing like it: flat places are not searched for; `reset_root_on_terrain` places robots around the middle of their patch"
ELSEWHERE = {
    "commands_vel": (
        "mjlab",
        "of Go1 and G1: `command_forward`, `command_left`, `command_turn` of the configuration, stages by iteration (mjlab's steps / 24); in a task of your own: [`begin_iteration`](../own-task.md#numbers-and-curricula-of-a-job) sets the numbers of the command, since a curriculum gives both ends of a range the same value",
    ),
    "reward_curriculum": (
        "mjlab",
        "[`train.config.curriculum`](../tasks.md#curriculum): a weight by the term's name, another number as `rewards.TERM.NUMBER`; by iteration instead of step, and interpolated: for a jump give two points one iteration apart",
    ),
    "modify_reward_weight": (
        "isaaclab",
        "[`train.config.curriculum`](../tasks.md#curriculum), as for mjlab's `reward_curriculum`",
    ),
    "termination_curriculum": (
        "mjlab",
        "[`train.config.curriculum`](../tasks.md#curriculum) of `terminations.TERM.NUMBER`; whether it is a `time_out` stays",
    ),
    "modify_env_param": (
        "isaaclab",
        "[`train.config.curriculum`](../tasks.md#curriculum) of a number of the declaration; other rules in [`begin_iteration`](../own-task.md#numbers-and-curricula-of-a-job)",
    ),
    "modify_term_cfg": (
        "isaaclab",
        "[`train.config.curriculum`](../tasks.md#curriculum) of a number of the declaration; other rules in [`begin_iteration`](../own-task.md#numbers-and-curricula-of-a-job)",
    ),
    "camera_rgb": (
        "mjlab",
        '[`Image`](cameras.md) of a `CameraSensor(kind="color")`, an observation group of its own; bytes, which networks take as -0.5 to 0.5 instead of 0 to 1',
    ),
    "camera_depth": (
        "mjlab",
        '`Image` of a `CameraSensor(kind="depth")`, `near`: min_depth, `far`: cutoff_distance; 0 is at `near`, theirs at the camera',
    ),
    "camera_segmentation": (
        "mjlab",
        '`Image` of a `CameraSensor(kind="segmentation")`: one channel for each robot, object and the ground, instead of numbers of geoms',
    ),
    "dr.geom_rgba": (
        "mjlab",
        "[`train.config.randomize.colors`](../tasks.md#randomisation): of all shapes, around their own colours, once for each world",
    ),
    "TendonLengthAction": ("mjlab", "nothing like it: actions drive joints, or a frame with `move_frame`"),
    "TendonVelocityAction": ("mjlab", "nothing like it: actions drive joints, or a frame with `move_frame`"),
    "TendonEffortAction": ("mjlab", "nothing like it: actions drive joints, or a frame with `move_frame`"),
    "SiteEffortAction": ("mjlab", "nothing like it as an action; `apply_wrench`, an event, pushes bodies"),
    "reset_root_state_from_flat_patches": ("mjlab", _NO_FLAT_PLACES),
    "reset_root_state_from_terrain": ("isaaclab", _NO_FLAT_PLACES),
    "reset_nodal_state_uniform": ("isaaclab", "nothing like it: there are no soft bodies"),
    "OperationalSpaceControllerAction": ("isaaclab", "nothing like it"),
    "NonHolonomicAction": ("isaaclab", "nothing like it"),
    "SurfaceGripperBinaryAction": ("isaaclab", "nothing like it"),
}
"""Names that are not terms here: their library, by its module here, and what to use instead, in Markdown."""
_NAMES = re.compile(r"(?:^|(?<=\.)|(?<=\n))\s*(mjlab|mjlab, Isaac Lab|Isaac Lab): (.*)\.\s*$", re.DOTALL)


def all_terms() -> Iterator[tuple[str, str, wp.Function]]:
    """The group and name of every term, and its function: those of shipped tasks first."""
    for package in (terms, more):
        for group in package.GROUPS:
            for name, function in terms.terms_of(import_module(f"{package.__name__}.{group}")).items():
                yield group, name, function


def meaning_and_names(function: wp.Function) -> tuple[str, dict[str, list[tuple[str, str]]]]:
    """A term's docstring without the names; and the names with their remarks, by the library."""
    text = inspect.getdoc(function.func) or ""
    found = _NAMES.search(text)
    names: dict[str, list[tuple[str, str]]] = {library: [] for library in LIBRARIES}
    if found is None:
        return text, names
    for part in re.split(r"\.\s+(?=Isaac Lab: )", f"{found[1]}: {' '.join(found[2].split())}"):
        owners, _, listed = part.partition(": ")
        for library, owner in LIBRARIES.items():
            if owner in owners.split(", "):
                for each in re.split(r",(?![^(]*\))", listed):
                    theirs, _, remark = each.strip().partition(" ")
                    names[library].append((theirs, remark.strip("()")))
    return text[: found.start()].rstrip(), names


def aliases(library: str) -> dict[str, wp.Function]:
    """Our term for each name in a library. Of several terms it is the one without a remark, else the first."""
    found: dict[str, tuple[bool, wp.Function]] = {}
    for _, _, function in all_terms():
        for theirs, remark in meaning_and_names(function)[1][library]:
            if theirs.isidentifier() and (theirs not in found or (found[theirs][0] and not remark)):
                found[theirs] = (bool(remark), function)
    return {theirs: function for theirs, (_, function) in found.items()}


def term_named(library: str, name: str) -> wp.Function:
    """Our term for a name in a library. Raises AttributeError, which says what to use instead."""
    known = aliases(library)
    if name in known:
        return known[name]
    owner, instead = ELSEWHERE.get(name, ("", ""))
    if owner == library:
        plain = re.sub(r"\[([^]]+)\]\([^)]+\)", r"\1", instead)
        words = f"{LIBRARIES[owner]}'s {name} is not a term here (docs/tasks/porting.md): {plain}"
    else:
        hint = nearest(name, list(known), "docs/tasks/porting.md lists them")
        words = f"no term has the name {name!r} in {LIBRARIES[library]}; {hint}"
    raise AttributeError(words, name=None)  # without a name Python adds no second hint
