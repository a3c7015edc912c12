"""An interpreter process of the pool: it calls a reward function for its share of the cars, a step at a time.

Run by its path, in isolated mode. The first line of standard input is a JSON object (``source``, ``file``, ``seconds``, ``memory``,
``root``, ``worlds``, ``first``, ``last``, ``tracks``, ``shared``: the descriptor of the shared memory); then each line is a step, or
``anew``: every car's function begins anew. Each line of standard output answers one: a JSON list of failures (message, line, car, how many).
"""

from __future__ import annotations

import gc
import json
import math
import mmap
import os
import sys
import warnings
from typing import Any, NoReturn

ANEW = b"anew\n"
_LOADING = 60.0
"""For the statements of the file, with its imports on a loaded machine [s]."""
_MOST_FAILURES = 20
"""Different failures in an answer."""


def main() -> None:
    """Serve steps until standard input ends."""
    request = json.loads(sys.stdin.buffer.readline())
    sys.path.append(request["root"])
    from racer.rewards import confinement as confined
    from racer.rewards import namespaces, parameters, problems

    warnings.simplefilter("ignore")
    steps, out = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "w")
    nothing = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(nothing, descriptor)
    file, seconds, worlds = request["file"], request["seconds"], request["worlds"]
    tracks = [[tuple(point) for point in track] for track in request["tracks"]]
    shared = memoryview(mmap.mmap(request["shared"], 0)).cast("f")  # its descriptor is closed, and its size sealed
    width, most, of_object = parameters.NUMBERS, parameters.MOST_OBJECTS, parameters.OBJECT_NUMBERS
    numbers, objects = shared[: worlds * width], shared[worlds * width : worlds * (width + most * of_object)]
    rewards = shared[worlds * (width + most * of_object) :]
    car, late = -1, ""

    def answer(what: Any) -> None:
        out.write(json.dumps(what) + "\n")
        out.flush()

    def end(message: str, line: int) -> NoReturn:
        answer({"message": message, "line": line, "car": car})
        os._exit(0)

    def expired(frame: Any) -> None:
        end(late, confined.line_of_frame(frame, file))

    def flooded() -> None:
        line = confined.line_of_frame(sys._getframe(), file)
        end(f"the function printed more than {confined.MOST_PRINTED >> 10} KiB of text in one call", line)

    def load() -> list[namespaces.Car]:
        """A function for each car."""
        nonlocal car, late
        car, late = -1, f"the statements of the file did not end within {_LOADING:g} s"
        made: list[namespaces.Car] = []
        gc.unfreeze()
        gc.collect()
        gc.disable()
        try:
            program = namespaces.RewardProgram(request["source"], file)
            for _ in cars:
                printed.count = 0
                alarm.set(_LOADING)
                made.append(program.car())
            alarm.set(0)
        except BaseException as error:
            alarm.set(0)
            message, count = confined.error_message(error), len(made)
            if isinstance(error, MemoryError) and made:
                made.clear()
                gc.collect()
                message = f"{message} after {count} of {len(cars)} copies, one for each car: shorten its tables or have fewer worlds"
            end(message, confined.line_of(error, file))
        gc.enable()
        gc.freeze()  # what thousands of copies hold is not looked at again and again
        late = f"the function did not return within {seconds:g} s"
        return made

    alarm, printed = confined.CallTimeout(expired), confined.Printed(flooded)
    # where it does not hold, the guard has refused it
    confined.confine(request["memory"], keep=(steps.fileno(), out.fileno()))
    cars = range(request["first"], request["last"])
    with confined.printing(printed):
        functions = load()
        answer([])
        while order := steps.readline():
            if order == ANEW:
                functions.clear()
                functions = load()
                answer([])
                continue
            failures: dict[tuple[str, int], list[Any]] = {}
            for car in cars:
                row = numbers[car * width : (car + 1) * width].tolist()
                start = car * most * of_object
                count = int(row[parameters.OBJECT_COUNT])
                cells = objects[start : start + count * of_object].tolist()
                rows = [cells[place : place + of_object] for place in range(0, len(cells), of_object)]
                params = parameters.parameters_of(row, rows, tracks[int(row[parameters.TRACK])])
                printed.count = 0
                message, line = "", 0
                result: Any = None
                try:
                    alarm.set(seconds)
                    result = functions[car - cars.start].call(params)
                    alarm.set(0)
                    message = confined.result_problem(result)
                except BaseException as error:
                    alarm.set(0)
                    message, line = confined.error_message(error), confined.line_of(error, file)
                rewards[car] = math.nan if message else float(result)
                kind = problems.alike(message), line
                if message and (kind in failures or len(failures) < _MOST_FAILURES):
                    failures.setdefault(kind, [message, line, car, 0])[3] += 1
            answer(list(failures.values()))


if __name__ == "__main__":
    main()
