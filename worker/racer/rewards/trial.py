"""The guard's process: tries a reward function on sample inputs, with limits, and says what happened in lines of JSON.

Run by its path, in isolated mode. It reads one JSON object from standard input: ``source``, ``file``, ``samples``, ``seconds``, ``root``,
``anyway``: try it also where the sandbox does not hold.
"""

from __future__ import annotations

import copy
import json
import os
import sys
import traceback
import warnings
from typing import Any, NoReturn


def main() -> None:
    """Try the function; each line of standard output says which sample is next, or what is wrong."""
    asked = json.load(sys.stdin)
    sys.path.append(asked["root"])
    from worker.racer.rewards import confined

    warnings.simplefilter("ignore")
    out = os.fdopen(os.dup(1), "w")
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    os.dup2(nothing, 2)
    file = asked["file"]
    now = "the module"

    def tell(**what: Any) -> None:
        out.write(json.dumps(what) + "\n")
        out.flush()

    def end(kind: str, message: str, line: int) -> NoReturn:
        tell(kind=kind, message=message, line=line)
        os._exit(0)

    def expired(frame: Any) -> None:
        line = confined.line_of_frame(frame, file)
        end("TIMEOUT", f"{now} did not end within {asked['seconds']:g} s", line)

    def flooded() -> None:
        line = confined.line_of_frame(sys._getframe(), file)
        end("TEST_FAILURE", f"{now} printed more than {confined.MOST_PRINTED >> 10} KiB of text", line)

    alarm, printed = confined.Alarm(expired), confined.Printed(flooded)
    if unconfined := confined.confine(cpu=int(4 * asked["seconds"]) + 5, keep=(out.fileno(),)):
        tell(unconfined=unconfined)
        if not asked["anyway"]:
            os._exit(0)
    try:
        with confined.printing(printed):
            tell(trying=now)
            alarm.set(asked["seconds"])
            function = confined.load(asked["source"], file)
            for name, params in asked["samples"].items():
                now = f"the sample {name!r}"
                tell(trying=now)
                _points(params)
                given = copy.deepcopy(params)
                printed.count = 0
                alarm.set(asked["seconds"])
                result = function(given)
                alarm.set(0)
                if wrong := confined.told_result(result):
                    end("TEST_FAILURE", f"{now}: {wrong}", _last_line(function))
                if where := confined.changed(params, given):
                    end("TEST_FAILURE", f"{now}: it changed {where}; copy what you change", _last_line(function))
    except BaseException as error:
        alarm.set(0)
        kind = "IMPORT_ERROR" if isinstance(error, ImportError) else "TEST_FAILURE"
        end(kind, f"{now}: {confined.told_error(error)}", confined.line_of(error, file) or _syntax_line(error))
    tell(kind="", message="", line=0)


def _points(params: dict[str, Any]) -> None:
    """Points are tuples, which JSON does not have."""
    for name in ("waypoints", "objects_location"):
        params[name] = [tuple(point) for point in params[name]]


def _last_line(function: Any) -> int:
    """First line of a function, for a fault of its return value, which no single line causes."""
    code = getattr(function, "__code__", None)
    return code.co_firstlineno if code else 0


def _syntax_line(error: BaseException) -> int:
    """The line of a mistake that Python finds when it compiles."""
    return int(getattr(error, "lineno", 0) or 0) if isinstance(error, SyntaxError) else 0


if __name__ == "__main__":
    try:
        main()
    except Exception:
        traceback.print_exc()
        sys.exit(1)
