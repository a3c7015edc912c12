"""A process of the pool: calls a reward function for its share of the cars, a step at a time.

Run by its path, in isolated mode. The first line of standard input is a JSON object (``source``, ``file``, ``seconds``, ``memory``,
``root``, ``worlds``, ``first``, ``last``, ``tracks``, ``shared``: the descriptor of the shared memory); then each line is a step. Each
line of standard output answers one: a JSON list of failures (message, line, car, how many).
"""

from __future__ import annotations

import json
import math
import mmap
import os
import sys
import warnings
from typing import Any, NoReturn

_MOST_TOLD = 20
"""Different failures in an answer."""


def main() -> None:
    """Serve steps until standard input ends."""
    asked = json.loads(sys.stdin.buffer.readline())
    sys.path.append(asked["root"])
    from worker.racer.rewards import confined, parameters

    warnings.simplefilter("ignore")
    steps, out = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "w")
    nothing = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(nothing, descriptor)
    file, seconds, worlds = asked["file"], asked["seconds"], asked["worlds"]
    tracks = [[tuple(point) for point in track] for track in asked["tracks"]]
    shared = memoryview(mmap.mmap(asked["shared"], 0)).cast("f")  # its descriptor is closed, and its size sealed
    width, most, of_object = parameters.NUMBERS, parameters.MOST_OBJECTS, parameters.OBJECT_NUMBERS
    numbers, objects = shared[: worlds * width], shared[worlds * width : worlds * (width + most * of_object)]
    rewards = shared[worlds * (width + most * of_object) :]
    car = -1

    def answer(what: Any) -> None:
        out.write(json.dumps(what) + "\n")
        out.flush()

    def end(message: str, line: int) -> NoReturn:
        answer({"message": message, "line": line, "car": car})
        os._exit(0)

    def expired(frame: Any) -> None:
        end(f"the function did not return within {seconds:g} s", confined.line_of_frame(frame, file))

    def flooded() -> None:
        line = confined.line_of_frame(sys._getframe(), file)
        end(f"the function printed more than {confined.MOST_PRINTED >> 10} KiB of text in one call", line)

    alarm, printed = confined.Alarm(expired), confined.Printed(flooded)
    confined.confine(
        asked["memory"], keep=(steps.fileno(), out.fileno())
    )  # where it does not hold, the guard has told it
    with confined.printing(printed):
        try:
            alarm.set(60.0)  # imports, on a loaded machine
            function = confined.load(asked["source"], file)
            alarm.set(0)
        except BaseException as error:
            end(confined.told_error(error), confined.line_of(error, file))
        answer([])
        while steps.readline():
            failures: dict[tuple[str, int], list[int]] = {}
            for car in range(asked["first"], asked["last"]):
                row = numbers[car * width : (car + 1) * width].tolist()
                start = car * most * of_object
                count = int(row[parameters.OBJECT_COUNT])
                cells = objects[start : start + count * of_object].tolist()
                rows = [cells[place : place + of_object] for place in range(0, len(cells), of_object)]
                params = parameters.parameters_of(row, rows, tracks[int(row[parameters.TRACK])])
                printed.count = 0
                told, line = "", 0
                result: Any = None
                try:
                    alarm.set(seconds)
                    result = function(params)
                    alarm.set(0)
                    told = confined.told_result(result)
                except BaseException as error:
                    alarm.set(0)
                    told, line = confined.told_error(error), confined.line_of(error, file)
                rewards[car] = math.nan if told else float(result)
                if told and ((told, line) in failures or len(failures) < _MOST_TOLD):
                    failures.setdefault((told, line), [car, 0])[1] += 1
            answer([[told, line, *rest] for (told, line), rest in failures.items()])


if __name__ == "__main__":
    main()
