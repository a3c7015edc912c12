"""``python -m worker.racer.rewards FILE`` says whether a reward function is valid, and whether it compiles.

Standard error has the fault of a file that is not valid; of a valid one, a note where it was not run.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from shared_store.texts import IN_DEFINITION, size_in_definition
from worker.racer.rewards.guard import check, read_file
from worker.racer.rewards.translation import Outside, translate


def main() -> int:
    """Check the files; returns 0 where all are valid, else 1."""
    parser = argparse.ArgumentParser(
        prog="python -m worker.racer.rewards",
        description="Check reward functions of the racer: valid or why not, compiled to the device or why in Python workers.",
        epilog="example: python -m worker.racer.rewards reward_function.py",
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE")
    failed = 0
    for path in parser.parse_args().files:
        problem = check(path, note=lambda line: print(line, file=sys.stderr))
        if problem is not None:
            failed = 1
            print(problem, file=sys.stderr)
            continue
        text = read_file(path)
        try:
            notes = translate(text).notes
        except Outside as outside:
            print(f"{path}: valid; {outside}")
        else:
            print("\n".join([f"{path}: valid, compiled to the device", *(f"  {note}" for note in notes)]))
        if size_in_definition({"file": str(path), "text": text}) > IN_DEFINITION:
            print(f"  {len(text.encode()):,} bytes: a job keeps it in the store, not in its definition")
    return failed


if __name__ == "__main__":
    sys.exit(main())
