"""The rows of the tap, one for each world and control step: the meaning of each number, and the images that the policy sees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import TYPE_CHECKING, Any

import numpy as np

from shared_store.contract.error_text import counted

if TYPE_CHECKING:
    from worker.tasks.run.task import Task

MARKS = ("episode", "age", "done", "time_out", "cause")
"""Whole numbers of a row: how many episodes of the world have ended before this step since the tap began, steps on the clock after the
step (0 where the next episode has begun), whether the step ended an episode, whether by the clock alone, and of the episode that ended
last the cause, an index into ``Layout.causes``."""


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
        images: The observation groups of images that are kept: name, channels (3: red, green and blue; 1), height and width [px].
        causes: Names of what can end an episode, see :class:`worker.tasks.run.episode_records.LastEpisodes`.
    """

    worlds: int
    rows: int
    coordinates: int
    dofs: int
    observations: tuple[str, ...]
    actions: tuple[str, ...]
    terms: tuple[str, ...]
    control_hz: float
    images: tuple[tuple[str, int, int, int], ...] = ()
    causes: tuple[str, ...] = ()

    @classmethod
    def of(cls, task: Task, worlds: int, rows: int, images: bool = True) -> Layout:
        """That of a task's first ``worlds`` worlds, with the images of its cameras or without."""
        arrays = task.worlds.arrays
        shapes = {name: tensor.shape[1:] for name, tensor in task.groups.items() if images and tensor.ndim == 4}
        return cls(
            worlds,
            rows,
            arrays.joint_q.shape[1],
            arrays.joint_qd.shape[1],
            tuple(task.observation_names),
            ("choice",) if task.discrete else tuple(task.action_names),
            tuple(task.reward_terms),
            task.config.control_hz,
            # the present frame comes first; of masks and the like that are not colours, the first channel is shown
            tuple((name, 3 if shape[0] % 3 == 0 else 1, shape[1], shape[2]) for name, shape in shapes.items()),
            tuple(task.ended.names),
        )

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Layout:
        """A layout from :func:`dataclasses.asdict` and JSON."""
        names = {name: tuple(value[name]) for name in ("observations", "actions", "terms", "causes")}
        return cls(**{**value, **names, "images": tuple(map(tuple, value["images"]))})

    @property
    def ends(self) -> tuple[int, ...]:
        """The column behind each of the six parts, in order."""
        sizes = (self.coordinates, self.dofs, len(self.observations), len(self.actions), len(self.terms), 1)
        return tuple(accumulate(sizes))

    @property
    def width(self) -> int:
        """Columns of a row."""
        return self.ends[-1]

    @property
    def image_bytes(self) -> int:
        """Bytes of the images of a world in one control step."""
        return sum(channels * height * width for _, channels, height, width in self.images)


@dataclass(frozen=True)
class Rows:
    """Some control steps of the watched worlds, the oldest first.

    Attributes:
        layout: What the columns are.
        first: Number of the first step since the tap began.
        values: Shape ``(steps, worlds, layout.width)``, float32.
        marks: Shape ``(steps, worlds, len(MARKS))``, int32.
        images: The present frames of ``layout.images`` one after the other, shape ``(steps, worlds, layout.image_bytes)``, uint8.
        lost: Steps before ``first`` that were overwritten before they were read.
    """

    layout: Layout
    first: int
    values: np.ndarray
    marks: np.ndarray
    images: np.ndarray
    lost: int = 0

    def __len__(self) -> int:
        return len(self.values)

    def _part(self, number: int) -> np.ndarray:
        ends = (0, *self.layout.ends)
        return self.values[:, :, ends[number] : ends[number + 1]]

    coordinates = property(lambda self: self._part(0))
    """Joint coordinates, shape ``(steps, worlds, coordinates)``."""
    velocities = property(lambda self: self._part(1))
    """Joint velocities, shape ``(steps, worlds, dofs)``."""
    observations = property(lambda self: self._part(2))
    """Observations after the step, shape ``(steps, worlds, observations)``."""
    actions = property(lambda self: self._part(3))
    """The policy's actions, shape ``(steps, worlds, actions)``."""
    terms = property(lambda self: self._part(4))
    """Weighted reward terms, shape ``(steps, worlds, terms)``."""
    rewards = property(lambda self: self._part(5)[:, :, 0])
    """Shape ``(steps, worlds)``."""

    def mark(self, name: str) -> np.ndarray:
        """One of :data:`MARKS`, shape ``(steps, worlds)``."""
        return self.marks[:, :, MARKS.index(name)]

    def cause(self, step: int, world: int) -> str:
        """Cause of the end of the episode that ended in this step; in any other step, of the world's last episode."""
        return self.layout.causes[int(self.mark("cause")[step, world])]

    def end_of_episode(self, step: int, world: int, number: int, total: float, length: int) -> str:
        """A line about the episode ``number`` of a world that ended in this step, with its return and its length [control steps]."""
        cause = self.cause(step, world)
        return f"world {world}: episode {number} ended by {cause} after {counted(length, 'step')}, return {total:.4g}"

    def pictures(self, step: int) -> dict[str, np.ndarray]:
        """The image of each camera after a step, by its group: uint8, ``(worlds, height, width, 3)`` or ``(worlds, height, width)``."""
        found: dict[str, np.ndarray] = {}
        start = 0
        for name, channels, height, width in self.layout.images:
            end = start + channels * height * width
            frame = self.images[step, :, start:end].reshape(-1, channels, height, width)
            found[name] = np.ascontiguousarray(np.moveaxis(frame, 1, -1) if channels == 3 else frame[:, 0])
            start = end
        return found

    def of_worlds(self, worlds: int, since: int = 0) -> Rows:
        """Those of the first ``worlds`` worlds, with steps numbered from step ``since``."""
        values, marks, images = (each[:, :worlds] for each in (self.values, self.marks, self.images))
        return Rows(replace(self.layout, worlds=worlds), self.first - since, values, marks, images, self.lost)
