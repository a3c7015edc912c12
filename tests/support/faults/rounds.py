"""What a torture does besides killing, class by class: hostile jobs, a full disk, a wall clock that jumps, a second controller.

A class is a function ``round(directory, seed)`` that brings up a real home below ``directory``, does its worst as the seed says, and
returns what it did (counted by name) and what was wrong afterwards, one line each.
"""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.support.faults.full_disk import full_disk_round
from tests.support.faults.hostile import hostile_round
from tests.support.faults.second_controller import second_controller_round
from tests.support.faults.wall_clock import wall_clock_round

Round = Callable[[Path, int], tuple[Counter[str], list[str]]]

ROUNDS: Mapping[str, Round] = {
    "hostile jobs": hostile_round,
    "full disk": full_disk_round,
    "wall clock": wall_clock_round,
    "second controller": second_controller_round,
}


@dataclass
class Class:
    """What the rounds of one class came to."""

    name: str
    rounds: int = 0
    done: Counter[str] = field(default_factory=Counter)
    violations: list[str] = field(default_factory=list)
    not_run: str | None = None
    """Why no round of it can run on this machine."""

    def run(self, directory: Path, seed: int) -> None:
        """One more round; a defect of the harness counts as a violation."""
        try:
            done, violations = ROUNDS[self.name](directory, seed)
        except pytest.skip.Exception as skipped:
            self.not_run = str(skipped)
            return
        except Exception as error:  # must not pass for a pass
            traceback.print_exc()
            done, violations = Counter(), [f"the harness failed: {error!r}"]
        self.rounds += 1
        self.done += done
        self.violations += [f"{self.name}, round {seed}: {violation}" for violation in violations]


def class_table(classes: Sequence[Class]) -> str:
    """A Markdown table: a line for each class."""
    lines = ["| class | rounds | what was done | violations |", "|---|--:|---|--:|"]
    for each in classes:
        done = each.not_run or ", ".join(f"{count} {name}" for name, count in sorted(each.done.items()))
        lines.append(f"| {each.name} | {each.rounds} | {done} | **{len(each.violations)}** |")
    return "\n".join(lines)
