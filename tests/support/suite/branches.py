"""``python -m tests.support.suite.branches FILE``: the branches that no test entered, of what ``coverage json`` wrote to FILE.

A line each: ``file:line -> line: source``, with ``exit`` for the end of a function. What only a process that SIGKILL ended had entered
is counted as never entered: such a process writes no data.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path


def never_entered(found: dict[str, dict[str, list[list[int]]]]) -> list[str]:
    """The lines, by file and line."""
    lines = []
    for file, facts in sorted(found.items()):
        source = Path(file).read_text().splitlines()
        for begin, end in sorted(facts["missing_branches"]):
            lines.append(f"{file}:{begin} -> {end if end > 0 else 'exit'}: {source[begin - 1].strip()}")
    return lines


def main() -> None:
    found = json.loads(Path(sys.argv[1]).read_text())
    print("\n".join(never_entered(found["files"])))
    totals = found["totals"]
    print(
        f"\n{totals['missing_branches']} of {totals['num_branches']} branches were never entered. Processes that SIGKILL ended wrote "
        "no data: what only they entered is among these."
    )


if __name__ == "__main__":
    main()
