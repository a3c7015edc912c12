"""``make mutants``: how many small faults the unit tests notice, module by module. Writes ``benchmarks/mutation.md``.

``python -m tests.support.mutation.run [MODULE …] [--seed N] [--which WHICH]``: of some modules only (parts of their paths), with another
sample, or only those faults that the last run's tests did not notice, or that it did not come to.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import random
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import yaml

from tests.support.mutation.mutants import Mutant, mutants
from tests.support.mutation.trial import KILLED, REPOSITORY, SURVIVED, TIMED_OUT, Trial

RESULTS = REPOSITORY / "benchmarks" / "mutation.json"
PAGE = REPOSITORY / "benchmarks" / "mutation.md"
EQUIVALENT = Path(__file__).parent / "equivalent.yaml"
"""Faults that change nothing anybody could notice: by module and reason."""


@dataclass(frozen=True)
class Group:
    """Modules, and their tests."""

    modules: Sequence[str]
    """Patterns of paths."""
    tests: Sequence[str]
    sample: int | None = None
    """How many mutants are tried; None: all."""
    options: Sequence[str] = ()
    bounds_memory: bool = True

    def paths(self) -> list[str]:
        return sorted(
            str(path.relative_to(REPOSITORY)) for pattern in self.modules for path in REPOSITORY.glob(pattern)
        )


_UNIT = "tests/unit"
GROUPS = (
    Group(
        ["orchestrator/domain/*.py", "orchestrator/scheduling/*.py"],
        [f"{_UNIT}/orchestrator/domain", f"{_UNIT}/orchestrator/scheduling"],
        options=["--noconftest"],
    ),
    Group(
        ["shared_store/volume/epoch.py", "shared_store/volume/checkpoints.py", "shared_store/contract/policy.py"],
        [
            *(
                f"{_UNIT}/shared_store/test_{name}.py"
                for name in (
                    "epoch",
                    "fence_edges",
                    "checkpoints",
                    "evaluations",
                    "parent",
                    "policy_contract",
                    "policy_contract_edges",
                )
            ),
            *(f"{_UNIT}/policy_node/test_{name}.py" for name in ("choices", "observations", "runner")),
        ],
        options=["--noconftest"],
    ),
    Group(
        ["worker/learning/ppo/*.py"],
        [f"{_UNIT}/worker/test_{name}.py" for name in ("ppo", "ppo_choices", "plain_ppo", "algorithms")],
        sample=200,
        bounds_memory=False,
    ),
)


class Results:
    """What became of each mutant and how long that took [s, processor], kept on disk as it becomes known."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.by_module: defaultdict[str, dict[str, tuple[str, float]]] = defaultdict(dict)
        if path.exists():
            for line in path.read_text().splitlines():
                module, key, result, seconds = json.loads(line)
                self.by_module[module][key] = result, seconds

    def note(self, module: str, mutant: Mutant, result: str, seconds: float) -> None:
        self.by_module[module][mutant.key] = result, seconds
        with self._path.open("a") as file:
            file.write(json.dumps([module, mutant.key, result, round(seconds, 3)], ensure_ascii=False) + "\n")
        counts = Counter(result for results in self.by_module.values() for result, _ in results.values())
        print(f"\r{module}: {dict(counts)}    ", end="", flush=True, file=sys.stderr)


def chosen(group: Group, seed: int) -> dict[str, set[int]]:
    """Numbers of the mutants that are tried, by module."""
    every = [(m, mutant.number) for m in group.paths() for mutant in mutants((REPOSITORY / m).read_text())]
    if group.sample is not None:
        every = random.Random(seed).sample(every, min(group.sample, len(every)))
    found: dict[str, set[int]] = {module: set() for module in group.paths()}
    for module, number in every:
        found[module].add(number)
    return found


def equivalent() -> dict[str, dict[str, str]]:
    """The reason why a mutant is equivalent, by module and key."""
    listed = yaml.safe_load(EQUIVALENT.read_text()) if EQUIVALENT.exists() else {}
    return {
        module: {key: reason for reason, keys in reasons.items() for key in keys}
        for module, reasons in (listed or {}).items()
    }


def measure(names: Sequence[str], seed: int, which: str) -> Results:
    """Try the mutants, ``which``: all, the survivors of the last time, or the rest, which have no result yet."""
    path = REPOSITORY / "build" / "mutation.jsonl"
    path.parent.mkdir(exist_ok=True)
    if which == "all" and not names:
        path.unlink(missing_ok=True)
    results, last, known = Results(path), Results(path), equivalent()
    for group in GROUPS:
        numbers = {m: n for m, n in chosen(group, seed).items() if not names or any(name in m for name in names)}

        def requested(module: str, mutant: Mutant, numbers: Mapping[str, set[int]] = numbers) -> bool:
            if mutant.number not in numbers[module] or mutant.key in known.get(module, ()):
                return False
            result, _ = last.by_module[module].get(mutant.key, ("", 0.0))
            return which == "all" or result == (SURVIVED if which == "survivors" else "")

        if any(numbers.values()):
            Trial([*numbers], group.tests, requested, results.note, group.options, group.bounds_memory).run()
    return Results(path)  # children have noted most of them


def summary(results: Results, seed: int) -> dict[str, dict[str, Any]]:
    """How many mutants of each module had which result, and which survived."""
    known, found = equivalent(), {}
    for group in GROUPS:
        for module, numbers in chosen(group, seed).items():
            keys = [each.key for each in mutants((REPOSITORY / module).read_text()) if each.number in numbers]
            tried = {key: results.by_module[module].get(key, ("not tried", 0.0)) for key in keys}
            tried |= {key: ("equivalent", 0.0) for key in keys if key in known.get(module, ())}
            if keys:
                counts = Counter(result for result, _ in tried.values())
                survivors = [key for key, (result, _) in tried.items() if result == SURVIVED]
                seconds = round(sum(seconds for _, seconds in tried.values()), 1)
                found[module] = {"mutants": len(keys), **counts, "seconds": seconds, "survivors": survivors}
    return found


def write(results: Results, seed: int, label: str) -> None:
    """Keep this measurement under its label, and write the page of all of them."""
    modules = summary(results, seed)
    kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=REPOSITORY, capture_output=True, text=True)
    day = datetime.now(UTC).strftime("%Y-%m-%d")
    kept[label] = {"commit": commit.stdout.strip(), "date": day, "seed": seed, "modules": modules}
    RESULTS.write_text(json.dumps(kept, indent=1, ensure_ascii=False) + "\n")
    pure, sampled = (
        {m for group in GROUPS if (group.sample is None) == whole for m in group.paths()} for whole in (True, False)
    )
    lines = [
        "# Whether the tests notice small faults",
        "",
        f"Written by `make mutants`, {day}, {os.cpu_count()} CPUs ({platform.machine()}), Python {platform.python_version()}.",
        "",
        "A mutant is a module with one small fault: another comparison, operator, constant or default, a part of a condition left out, a",
        "statement removed. It is killed if a unit test fails or takes ten times its time. The score is the share of the mutants that are",
        "killed; those that change nothing anybody could notice (`tests/support/mutation/equivalent.yaml`, with the reasons) do not count.",
        "Of the pure modules every mutant is tried, of PPO, with its kernels, a sample.",
        "",
    ]
    for name, rows in kept.items():
        lines += [f"## {name.capitalize()}: {rows['commit']}, {rows['date']}", ""]
        lines += [
            "| module | mutants | killed | of them timed out | survived | equivalent | score |",
            "|---|--:|--:|--:|--:|--:|--:|",
        ]
        for title, part in (
            ("pure modules", pure),
            (f"PPO, {sum(map(_tried, _of(rows, sampled)))} mutants, seed {rows['seed']}", sampled),
        ):
            found = {module: counts for module, counts in rows["modules"].items() if module in part and _tried(counts)}
            lines += [_row(f"`{module}`", counts) for module, counts in found.items()]
            lines += [_row(f"**{title}**", _sum(found.values()))] if found else []
        seconds = sum(counts["seconds"] for counts in rows["modules"].values())
        left = _sum(rows["modules"].values())["not tried"]
        lines += [
            "",
            f"{seconds / 60:.0f} minutes of one processor.",
            *([f"{left} mutants were not tried."] if left else []),
            "",
        ]
    lines += [
        "## Survivors",
        "",
        *(f"- `{module}` {key.replace('`', '')}" for module, counts in modules.items() for key in counts["survivors"]),
    ]
    PAGE.write_text("\n".join(lines) + "\n")


def _of(rows: Mapping[str, Any], modules: set[str]) -> list[Mapping[str, Any]]:
    return [counts for module, counts in rows["modules"].items() if module in modules]


def _tried(counts: Mapping[str, Any]) -> int:
    return sum(counts.get(result, 0) for result in (KILLED, TIMED_OUT, SURVIVED))


def _sum(rows: Iterable[Mapping[str, Any]]) -> Counter[str]:
    total = Counter[str]()
    for counts in rows:
        total.update({name: value for name, value in counts.items() if isinstance(value, int)})
    return total


def _row(name: str, counts: Mapping[str, Any]) -> str:
    killed, late = counts.get(KILLED, 0) + counts.get(TIMED_OUT, 0), counts.get(TIMED_OUT, 0)
    survived, equal = counts.get(SURVIVED, 0), counts.get("equivalent", 0)
    score = f"{100 * killed / (killed + survived):.1f} %" if killed + survived else "–"
    return f"| {name} | {killed + survived + equal} | {killed} | {late} | {survived} | {equal} | {score} |"


def main() -> None:
    parser = argparse.ArgumentParser(prog="make mutants", description="Which small faults do the unit tests notice?")
    parser.add_argument("modules", nargs="*", help="parts of the modules' paths; all of them by default")
    parser.add_argument("--seed", type=int, default=1, help="of the sample")
    parser.add_argument(
        "--which", choices=("all", "survivors", "rest"), default="all", help="those that survived, or were not tried"
    )
    parser.add_argument("--label", default="now", help="of the measurement on the page")
    arguments = parser.parse_args()
    write(measure(arguments.modules, arguments.seed, arguments.which), arguments.seed, arguments.label)


if __name__ == "__main__":
    main()
