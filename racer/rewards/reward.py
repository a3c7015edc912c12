"""A reward function as a task uses it: for all cars of a step, compiled where it can be, else in Python workers."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import warp as wp

from racer.rewards.compiled_function import failures_of, kernels, race_arrays, warp_function
from racer.rewards.guard import check_source, read_file
from racer.rewards.parameters import Point
from racer.rewards.problems import Failure, Problem, RewardFailed, RewardRefused, one_line
from racer.rewards.samples import OVAL, Course
from racer.rewards.translation import Outside, translate
from racer.rewards.translation.prelude import ERRORS, LOOP
from racer.rewards.workers import Workers


class RewardFunction:
    """A learner's ``reward_function(params)`` for all cars at once.

    Args:
        source: Text of its file.
        tracks: Waypoints of each track, or of each track and direction [m]; the cars' rows say which line is theirs.
        worlds: How many cars there are.
        device: Where the arrays are, such as ``cuda:0``.
        file: Name of the file, in messages.
        compiled: False: in Python workers, even if it could be compiled.
        processes: How many Python workers; by default as many as there are processors.
        courses: On which the guard tries it.

    Attributes:
        race: The arrays that a step fills before the call (:class:`racer.rewards.compiled_function.RaceArrays`).
        function: The Warp function ``(world: int, race: RaceArrays) -> float``, which a task can name as a reward term; None
            where it runs in Python workers.
        reason: Why it is not compiled, one line; empty where it is.
        notes: What the compiled function leaves out, a line each.

    Raises:
        RewardRefused: The guard refuses it.
        RewardFailed: Its file can't be loaded by the Python workers.
    """

    def __init__(
        self,
        source: str,
        tracks: Sequence[Sequence[Point]],
        worlds: int,
        device: str = "cpu",
        file: str = "reward_function.py",
        *,
        compiled: bool = True,
        processes: int | None = None,
        courses: tuple[Course, ...] = (OVAL,),
    ) -> None:
        if problem := checked(source, file, courses)[0]:
            raise RewardRefused(problem)
        self.file = file
        self.function: Any = None
        self.reason = "" if compiled else "Python workers were asked for"
        self.notes: tuple[str, ...] = ()
        self._kernel: Any = None
        self._messages: dict[int, str] = {}
        if compiled:
            self.function, self._kernel, self.reason, self.notes = compiled_function(source, file, device)
        self.race = race_arrays(worlds, tracks, device)
        self._rewards = wp.zeros(worlds, dtype=wp.float32, device=device)
        self._workers: Workers | None = None
        if self.function is None:
            self._workers = Workers(source, file, tracks, worlds, processes)

    @classmethod
    def of_file(cls, path: Path, tracks: Sequence[Sequence[Point]], worlds: int, **options: Any) -> RewardFunction:
        """The reward function in a file; options as of the class.

        Raises:
            RewardRefused: The file can't be read, or the guard refuses it.
        """
        return cls(read_file(path), tracks, worlds, file=str(path), **options)

    def rewards(self) -> wp.array[wp.float32]:
        """The rewards of the cars in ``race``, shape ``(worlds,)``, float32, on the device; the same array each time.

        NaN where the function raised an error or gave no finite number: :meth:`failures` says which and how often. The compiled function
        is one launch, which a graph may capture; Python workers wait for the device and copy ``race`` to the host.

        Raises:
            RewardFailed: A Python worker's call does not return, floods its output or ends its process.
        """
        if self._workers is None:
            wp.launch(
                self._kernel, dim=len(self._rewards), inputs=[self.race, self._rewards], device=self._rewards.device
            )
        else:
            self._workers.numbers[:] = self.race.numbers.numpy()
            self._workers.objects[:] = self.race.objects.numpy()
            self._rewards.assign(self._workers.rewards())
        return self._rewards

    def failures(self) -> dict[str, Failure]:
        """The calls that gave no reward so far, by their message, the most frequent first. Waits for the device.

        A compiled function keeps of each car its last error and the number of all: they count under the last one.

        Raises:
            RewardFailed: A call of the compiled function would not have returned.
        """
        if self._workers is not None:
            found = self._workers.failures
        else:
            found = {}
            for code, (message, failure) in failures_of(self.race).items():
                if code % 16 == LOOP:
                    raise RewardFailed(f"{self.file}:{code // 16}: car {failure.car}: {ERRORS[LOOP]}")
                found[f"{self.file}: {self._messages.setdefault(code, message)}"] = failure
        return dict(sorted(found.items(), key=lambda item: -item[1].count))

    def begin_anew(self) -> None:
        """Forget all failures, and all that the cars' functions remember.

        Raises:
            RewardFailed: The Python workers can't load the file again.
        """
        self.race.errors.zero_()
        self._messages.clear()
        if self._workers is not None:
            self._workers.begin_anew()

    def close(self) -> None:
        """End the Python workers."""
        if self._workers is not None:
            self._workers.close()


@functools.lru_cache(maxsize=64)
def checked(source: str, file: str, courses: tuple[Course, ...] = (OVAL,)) -> tuple[Problem | None, tuple[str, ...]]:
    """The guard's answer on a job's own node, asked once in a process for each function, with its warnings, a line each."""
    notes: list[str] = []
    return check_source(source, file, courses, anyway=True, note=notes.append), tuple(notes)


def compiled_function(source: str, file: str, device: str) -> tuple[Any, Any, str, tuple[str, ...]]:
    """A reward function that the guard let pass, compiled.

    Args:
        source: Text of its file.
        file: Name of the file, in messages.
        device: For which it is compiled, such as ``cuda:0``; empty: it is translated alone.

    Returns:
        The Warp function and the kernel that calls it for all cars, both None where it can't be compiled; why it can't, one line; what
        the compiled function leaves out, a line each.
    """
    try:
        translated = translate(source)
    except Outside as outside:
        return None, None, f"{file}: {outside}", ()
    function = warp_function(translated.snippet)
    wp.init()  # a module's load does not do it
    (kernel,) = kernels([function], function.key.replace(".", "_"))
    try:
        if device:
            kernel.module.load(device)
    except Exception as error:  # Warp has no type for what a compiler refuses
        if "build failed" not in str(error):
            raise
        message = one_line(error)
        reason = f"{file}: the compiler refused its translation, a mistake of Muster's to report ({message}): it runs in Python workers"
        return None, None, reason, ()
    return function, kernel, "", translated.notes
