"""A task, and what the plug-in adds to the bundle of a policy."""

from collections.abc import Mapping
from typing import Any

from worker.tasks.library.cartpole import Cartpole


class ShortCartpole(Cartpole):
    """The cart-pole under another name."""


def bundle_parts(task: Any) -> Mapping[str, Mapping[str, Any]]:
    """``notes.json``: the task that the policy was trained on."""
    return {"notes.json": {"task": type(task).__name__}}
