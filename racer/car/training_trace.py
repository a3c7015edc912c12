"""The trace of a training in SimTrace files: every control step of the main rank's first cars, brought over once an iteration.

Whole episodes are written: a file has those that ended in its iteration. Episodes that a checkpoint finds unfinished are kept beside the
files under its iteration, so that a run that goes on from it writes what it would have written without the interruption.
"""

from __future__ import annotations

import io
import re
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp as wp

from racer.car.car_arrays import CarArrays
from racer.car.sim_trace import CONTINUOUS, SIM_TRACE_COLUMNS, sim_trace, write_documents
from racer.car.trace import COLUMNS, trace_car
from racer.store.races import SIM_TRACE
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.files import make_directory, write_atomic
from shared_store.volume.layout import Run
from worker.simulation.capture import on_torch_stream
from worker.simulation.episodes import EpisodeArrays

if TYPE_CHECKING:
    from racer.car.task import Racer

wp.set_module_options({"enable_backward": False})

CARS = 16
"""Greatest number of cars."""
END = len(COLUMNS) + 2
"""Column of a row behind the car, the reward and the action: the cause of the episode's end, -1 where the step did not end it."""
_FILE = re.compile(r"(\d+)-iteration\.csv")

Rows = tuple[np.ndarray[Any, Any], np.ndarray[Any, Any], float]
"""Of one iteration: each control step of each car, shape ``(steps, cars, 16)``; the cars after it, where the next episode has begun at
its start, shape ``(steps, cars, 13)``; when they were brought over [s]."""


@wp.kernel
def _note(
    car: CarArrays,
    episodes: EpisodeArrays,
    chooses: bool,
    count: wp.array[wp.int32],
    rows: wp.array3d[wp.float32],
    afterwards: wp.array3d[wp.float32],
):
    world = wp.tid()
    step = wp.min(count[0], rows.shape[0] - 1)
    columns = car.trace.shape[1]
    for column in range(columns):
        rows[step, world, column] = car.trace[world, column]
    rows[step, world, columns] = episodes.rewards[world]
    rows[step, world, columns + 1] = wp.where(chooses, episodes.actions[world, 0], -1.0)
    rows[step, world, columns + 2] = wp.where(episodes.dones[world], float(episodes.causes[world]), -1.0)
    trace_car(world, car)
    for column in range(columns):
        afterwards[step, world, column] = car.trace[world, column]


@wp.kernel
def _count(count: wp.array[wp.int32]):
    count[0] = count[0] + 1


class TrainingTrace:
    """Of the main rank. :meth:`begin`, :meth:`copy` and :meth:`taken` belong to the training's thread, the rest to one that may wait.

    Args:
        run: The run.
        task: Whose first cars are noted: as many as its configuration says, at most all.
        steps: Control steps of an iteration.
        iteration: Iterations done: what an attempt wrote after them is removed.
        documents: See :func:`racer.car.sim_trace.model_documents`.

    Raises:
        OSError: The store can't be written.
        DamagedFile: A link is in the place of a directory.
    """

    def __init__(self, run: Run, task: Racer, steps: int, iteration: int, documents: Mapping[str, Any]) -> None:
        arrays = task.sensors["car"].arrays
        self._run, self._task, self._arrays = run, task, arrays
        self._folder = run.path / SIM_TRACE / "training" / run.name / "training-simtrace"
        self._unfinished = run.path / SIM_TRACE / "unfinished"
        cars = arrays.trace.shape[0]
        tracks = [task.circuit.tracks[number] for number in arrays.tracks.numpy()[:cars].tolist()]
        self._lengths = [track.length for track in tracks]
        self._slots = CARS * steps
        """Episodes that can end in an iteration, whatever number of cars a later attempt has."""
        with on_torch_stream(task.device):
            self._counter = wp.zeros(1, dtype=wp.int32, device=task.device)
            self._arrays_of_rows = [
                wp.zeros((steps, cars, columns), dtype=wp.float32, device=task.device)
                for columns in (END + 1, len(COLUMNS))
            ]
            self._fill()  # loads the kernels, and notes the cars as they are
            start = wp.to_torch(self._arrays_of_rows[1])[0].cpu().numpy()
        self._count: torch.Tensor = wp.to_torch(self._counter)
        self._rows = [wp.to_torch(each) for each in self._arrays_of_rows]
        pinned = task.device.startswith("cuda")
        self._host = [torch.empty(each.shape, dtype=torch.float32, pin_memory=pinned) for each in self._rows]
        self._open: list[list[np.ndarray[Any, Any]] | None] = [[_started(row)] for row in start]
        """Of each car the rows of its running episode; None: it began before anything was noted."""
        self._clocks: list[list[float]] = [[] for _ in range(cars)]
        self._started = False
        """Whether there is a file of an episode that ended."""
        make_directory(self._folder, 4)
        self._unfinished.mkdir(exist_ok=True)
        if iteration:
            self._load(iteration)
        for path in self._folder.iterdir():
            if (found := _FILE.fullmatch(path.name)) and (int(found[1]) >= iteration or not self._started):
                path.unlink()
        write_documents(run.path, documents)
        task.watch(self._fill, by="sim_trace")

    def begin(self) -> None:
        """An iteration begins."""
        self._count.zero_()

    def copy(self) -> None:
        """Have the device send the iteration's rows once it has them; does not wait."""
        for host, rows in zip(self._host, self._rows, strict=True):
            host.copy_(rows, non_blocking=True)

    def taken(self) -> Rows:
        """The rows that :meth:`copy` sent, after the host has waited for the iteration."""
        rows, afterwards = (host.numpy().copy() for host in self._host)
        return rows, afterwards, time.time()

    def write(self, iteration: int, taken: Rows) -> None:
        """Write the file of the episodes that ended in an iteration, from 0 on; none where no episode did.

        ``deepracer-utils`` takes the number of episodes in an iteration from file 0. There has to be one, so that it has the first
        episode that ended in whatever iteration; and its last episode has the greatest number that one can have.

        Raises OSError.
        """
        rows, afterwards, clock = taken
        ended = []
        for car in range(rows.shape[1]):
            since = 0
            for step in np.flatnonzero(rows[:, car, END] >= 0).tolist():
                self._append(car, rows[since : step + 1, car], clock)
                if (driven := self._open[car]) is not None:
                    ended.append((step, car, np.concatenate(driven), self._clocks[car], int(rows[step, car, END])))
                self._open[car], self._clocks[car] = [_started(afterwards[step, car])], []
                since = step + 1
            self._append(car, rows[since:, car], clock)
        if not ended:
            return
        number = iteration if self._started else 0
        lines = [",".join(SIM_TRACE_COLUMNS)]
        for episode, (_, car, steps, clocks, cause) in enumerate(sorted(ended, key=lambda each: each[:2])):
            is_last = number == 0 and episode == len(ended) - 1
            lines += sim_trace(
                steps[:, :END].tolist(),
                clocks,
                self._task.ended.names[cause],
                episode=self._slots - 1 if is_last else episode,
                length=self._lengths[car],
                control_hz=self._task.config.control_hz,
            )
        write_atomic(self._folder / f"{number}-iteration.csv", ("\n".join(lines) + "\n").encode())
        self._started = True

    def keep(self, iteration: int) -> None:
        """Keep the unfinished episodes for a checkpoint after ``iteration`` iterations. Raises OSError."""
        content: dict[str, Any] = {"begun": np.array(self._started)}
        for car, rows in enumerate(self._open):
            if rows is not None:
                content |= {f"rows_{car}": np.concatenate(rows), f"clocks_{car}": np.array(self._clocks[car])}
        buffer = io.BytesIO()
        np.savez(buffer, **content)
        write_atomic(self._unfinished / f"{iteration:08d}.npz", buffer.getvalue())
        oldest = min((checkpoint.iteration for checkpoint in list_checkpoints(self._run)), default=0)
        for path in self._unfinished.glob("*.npz"):
            if int(path.stem) < oldest:
                path.unlink()

    def _load(self, iteration: int) -> None:
        """Go on with what was kept for a checkpoint; without it, each car's next episode is the first one that is noted."""
        content: dict[str, Any] = {}
        path = self._unfinished / f"{iteration:08d}.npz"
        try:
            with np.load(path, allow_pickle=False) as kept:
                content = dict(kept)
        except FileNotFoundError:
            pass  # trained without a trace until now
        except Exception as error:  # a damaged archive fails in many ways
            why = f"{type(error).__name__}: {error}"
            print(
                f"warning: {path} can't be read ({why}); its unfinished episodes are left out of the trace", flush=True
            )
        self._started = bool(content.get("begun", (self._folder / "0-iteration.csv").exists()))
        for car in range(len(self._open)):
            rows = content.get(f"rows_{car}")
            self._open[car] = None if rows is None else [rows]
            self._clocks[car] = [] if rows is None else content[f"clocks_{car}"].tolist()

    def _append(self, car: int, rows: np.ndarray[Any, Any], clock: float) -> None:
        episode = self._open[car]
        if episode is not None and len(rows):
            episode.append(rows)
            self._clocks[car] += [clock] * len(rows)

    def _fill(self) -> None:
        episodes: Any = self._task._episodes
        wp.launch(
            _note,
            dim=self._arrays.trace.shape[0],
            inputs=[self._arrays, episodes, self._task.discrete, self._counter],
            outputs=self._arrays_of_rows,
            device=self._task.device,
        )
        wp.launch(_count, dim=1, inputs=[self._counter], device=self._task.device)


def _started(car: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """The row of a car before the first control step of an episode, shape ``(1, 16)``."""
    return np.concatenate((car, (0.0, CONTINUOUS, -1.0))).astype(np.float32)[None]
