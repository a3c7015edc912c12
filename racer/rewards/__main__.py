"""``python -m racer.rewards FILE`` says whether a reward function is valid, and whether it compiles.

Standard error has the fault of a file that is not valid; of a valid one, notes: why it is not compiled, where it was not run, or not on
the job's tracks.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from racer.rewards.guard import check, read_file
from racer.rewards.samples import FINE_OVAL, Course
from racer.rewards.translation import Outside, translate
from shared_store.contract.error_text import shown
from shared_store.volume.layout import Store
from shared_store.volume.texts import IN_DEFINITION, size_in_definition


def main() -> int:
    """Check the files; returns 0 where all are valid, 2 where one does not exist, else 1."""
    parser = argparse.ArgumentParser(
        prog="python -m racer.rewards",
        description="Check reward functions of the racer: valid or why not, compiled to the device or why in Python workers.",
        epilog="example: python -m racer.rewards reward_function.py",
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE")
    parser.add_argument(
        "--config",
        metavar="JSON",
        help='track and obstacles of the task, such as {"track": "chicane"}: the samples are of them; by default of an oval',
    )
    parser.add_argument("--store", type=Path, metavar="DIRECTORY", help="of the tracks that are not made from a name")
    failed, arguments = 0, parser.parse_args()
    courses: tuple[Course, ...] = (FINE_OVAL,)
    unknown: list[str] = []
    if arguments.config is not None:
        from racer.car.courses import courses_for  # it takes numpy

        try:
            config = json.loads(arguments.config)
        except (ValueError, RecursionError):
            config = None
        if not isinstance(config, dict):
            sys.exit(
                f'--config: expected a JSON object such as {{"track": "chicane"}}, found {shown(arguments.config)}'
            )
        courses, unknown = courses_for(config, Store(arguments.store) if arguments.store else None)
    if missing := next((path for path in arguments.files if not path.exists()), None):
        print(f"{missing}: there is no such file; name a reward function's file", file=sys.stderr)
        return 2
    for path in arguments.files:
        for line in unknown:
            print(f"{path}: {line}", file=sys.stderr)
        problem = check(path, courses, note=lambda line: print(line, file=sys.stderr))
        if problem is not None:
            failed = 1
            print(problem, file=sys.stderr)
            continue
        text = read_file(path)
        try:
            notes = translate(text).notes
        except Outside as outside:
            print(f"{path}: valid, not compiled")
            slow = "hundreds of times slower than compiled ones for thousands of cars"
            print(f"{path}: {outside}, {slow}", file=sys.stderr)
        else:
            print("\n".join([f"{path}: valid, compiled to the device", *(f"  {note}" for note in notes)]))
        if size_in_definition({"file": str(path), "text": text}) > IN_DEFINITION:
            print(f"  {len(text.encode()):,} bytes: a job keeps it in the store, not in its definition")
    return failed


if __name__ == "__main__":
    sys.exit(main())
