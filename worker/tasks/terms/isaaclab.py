"""Our terms by their names in Isaac Lab: ``terms.isaaclab.joint_vel_l2`` is ``terms.joint_velocity_squared``."""

from __future__ import annotations

from typing import Any

from worker.tasks.terms.aliases import aliases, term_named


def __getattr__(name: str) -> Any:
    return term_named("isaaclab", name)


def __dir__() -> list[str]:
    return sorted(aliases("isaaclab"))
