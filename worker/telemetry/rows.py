"""What the tap keeps of a world in one control step: one row of numbers, and what each of them is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from worker.tasks.task import Task

MARKS = ("episode", "age", "done", "time_out")
"""Whole numbers of a row: how many episodes of the world have ended before this step since the tap began, steps on the clock after the
step (0 where the next episode has begun), whether the step ended an episode, whether by the clock alone."""


@dataclass(frozen=True)
class Layout:
    """The columns of a row, float32: joint coordinates, joint velocities, observations, actions, reward terms, the reward.

    Everything is as it is after the step: where the step ended an episode, coordinates, velocities and observations are already those
    with which the next one begins, while actions, terms and reward belong to the one that ended.

    Attributes:
        worlds: How many worlds are watched: the first ones.
        rows: Control steps that a ring holds.
        coordinates: Joint coordinates of a world [m, rad, quaternion xyzw].
        dofs: Joint velocities of a world [m/s, rad/s].
        observations: Names, those of ``Task.states``.
        actions: Names.
        terms: Names of the reward terms.
        control_hz: Control steps of a simulated second.
    """

    worlds: int
    rows: int
    coordinates: int
    dofs: int
    observations: tuple[str, ...]
    actions: tuple[str, ...]
    terms: tuple[str, ...]
    control_hz: float

    @classmethod
    def of(cls, task: Task, worlds: int, rows: int) -> Layout:
        """That of a task's first ``worlds`` worlds."""
        arrays = task.worlds.arrays
        actions = tuple(task.action_names) if not task.discrete else ("choice",)
        names = tuple(task.observation_names), actions, tuple(task.reward_terms)
        return cls(worlds, rows, arrays.joint_q.shape[1], arrays.joint_qd.shape[1], *names, task.config.control_hz)

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Layout:
        """What :meth:`to_json` wrote."""
        names = {name: tuple(value[name]) for name in ("observations", "actions", "terms")}
        return cls(**{**value, **names})

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)

    @property
    def ends(self) -> tuple[int, int, int, int, int, int]:
        """The column behind each part, in order."""
        sizes = (self.coordinates, self.dofs, len(self.observations), len(self.actions), len(self.terms), 1)
        first, second, third, fourth, fifth, sixth = np.cumsum(sizes).tolist()
        return first, second, third, fourth, fifth, sixth

    @property
    def width(self) -> int:
        """Columns of a row."""
        return self.ends[-1]


@dataclass(frozen=True)
class Rows:
    """Some control steps of the watched worlds, the oldest first.

    Attributes:
        layout: What the columns are.
        first: Number of the first step since the tap began.
        values: Shape ``(steps, worlds, layout.width)``, float32.
        marks: Shape ``(steps, worlds, len(MARKS))``, int32.
        lost: Steps before ``first`` that were overwritten before they were read.
    """

    layout: Layout
    first: int
    values: np.ndarray
    marks: np.ndarray
    lost: int = 0

    def __len__(self) -> int:
        return len(self.values)

    def part(self, number: int) -> np.ndarray:
        """The columns of a part, numbered as in :attr:`Layout.ends`; shape ``(steps, worlds, columns)``."""
        ends = (0, *self.layout.ends)
        return self.values[:, :, ends[number] : ends[number + 1]]

    @property
    def coordinates(self) -> np.ndarray:
        """Joint coordinates, shape ``(steps, worlds, coordinates)``."""
        return self.part(0)

    @property
    def velocities(self) -> np.ndarray:
        """Joint velocities, shape ``(steps, worlds, dofs)``."""
        return self.part(1)

    @property
    def observations(self) -> np.ndarray:
        """What is observed after the step, shape ``(steps, worlds, observations)``."""
        return self.part(2)

    @property
    def actions(self) -> np.ndarray:
        """What the policy asked for, shape ``(steps, worlds, actions)``."""
        return self.part(3)

    @property
    def terms(self) -> np.ndarray:
        """Weighted reward terms, shape ``(steps, worlds, terms)``."""
        return self.part(4)

    @property
    def rewards(self) -> np.ndarray:
        """Shape ``(steps, worlds)``."""
        return self.part(5)[:, :, 0]

    def mark(self, name: str) -> np.ndarray:
        """One of :data:`MARKS`, shape ``(steps, worlds)``."""
        return self.marks[:, :, MARKS.index(name)]
