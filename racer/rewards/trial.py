"""The trial of a reward function, in a process of the guard: on sample inputs, with limits, and reported in lines of JSON.

Run by its path, in isolated mode. It reads one JSON object from standard input: ``source``, ``file``, ``samples``, ``seconds``, ``root``,
``anyway``: try it also where the sandbox does not hold.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
import warnings
from typing import Any, NoReturn


def main() -> None:
    """Try the function; each line of standard output says which sample is next, or what is wrong."""
    request = json.load(sys.stdin)
    sys.path.append(request["root"])
    from racer.rewards import confinement as confined
    from racer.rewards import namespaces

    warnings.simplefilter("ignore")
    out = os.fdopen(os.dup(1), "w")
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    os.dup2(nothing, 2)
    file = request["file"]
    now, limit = "the module", 4 * request["seconds"]  # it imports packages, on a loaded machine

    def report(**what: Any) -> None:
        out.write(json.dumps(what) + "\n")
        out.flush()

    def end(kind: str, message: str, line: int) -> NoReturn:
        report(kind=kind, message=message, line=line)
        os._exit(0)

    def expired(frame: Any) -> None:
        line = confined.line_of_frame(frame, file)
        end("TIMEOUT", f"{now} did not end within {limit:g} s", line)

    def flooded() -> None:
        line = confined.line_of_frame(sys._getframe(), file)
        end("TEST_FAILURE", f"{now} printed more than {confined.MOST_PRINTED >> 10} KiB of text", line)

    alarm, printed = confined.CallTimeout(expired), confined.Printed(flooded)
    if unconfined := confined.confine(cpu=int(4 * request["seconds"]) + 5, keep=(out.fileno(),)):
        report(unconfined=unconfined)
        if not request["anyway"]:
            os._exit(0)
    try:
        with confined.printing(printed):
            report(trying=now)
            alarm.set(limit)
            car = namespaces.RewardProgram(request["source"], file).car()
            limit = request["seconds"]
            for name, params in request["samples"].items():
                now = f"the sample {name!r}"
                report(trying=now)
                _points(params)
                printed.count = 0
                alarm.set(limit)
                result = car.call(params)
                alarm.set(0)
                if wrong := confined.result_problem(result):
                    end("TEST_FAILURE", f"{now}: {wrong}", _last_line(car.function))
    except BaseException as error:
        alarm.set(0)
        kind = "IMPORT_ERROR" if isinstance(error, ImportError) else "TEST_FAILURE"
        if isinstance(error, namespaces.Forbidden):
            kind = "FORBIDDEN"
        end(kind, f"{now}: {confined.error_message(error)}", confined.line_of(error, file))
    report(kind="", message="", line=0)


def _points(params: dict[str, Any]) -> None:
    """Points are tuples, which JSON does not have."""
    for name in ("waypoints", "objects_location"):
        params[name] = [tuple(point) for point in params[name]]


def _last_line(function: Any) -> int:
    """First line of a function, for a fault of its return value, which no single line causes."""
    code = getattr(function, "__code__", None)
    return code.co_firstlineno if code else 0


if __name__ == "__main__":
    try:
        main()
    except Exception:
        traceback.print_exc()
        sys.exit(1)
