"""Where the time of the tests goes: ``python -m benchmarks.tests build/tests/*.xml``; the tables go to ``tests.md``.

The files are what every ``make`` target of tests leaves in ``build/tests``. ``--before DIRECTORY`` puts the sums of older
files beside them.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

PAGE = Path(__file__).with_suffix(".md")
PHASES = ("setup", "call", "teardown")
STARTS = ("processes", "commands", "servers")
SLOWEST = 100


@dataclass(frozen=True)
class Test:
    """One test of a JUnit file; times in seconds."""

    tier: str
    name: str
    times: tuple[float, ...]
    """Setup, call, teardown."""
    starts: Counter[str]
    flaky: bool

    @property
    def seconds(self) -> float:
        return sum(self.times)


def read(path: Path) -> tuple[list[Test], dict[str, str]]:
    """The tests of a JUnit file, and the facts of the whole run."""
    suite = ElementTree.parse(path).getroot()[0]
    whole = {each.attrib["name"]: each.attrib["value"] for each in suite.findall("properties/property")}
    return [_test(case) for case in suite.iter("testcase")], whole


def _test(case: ElementTree.Element) -> Test:
    facts = {each.attrib["name"]: each.attrib["value"] for each in case.findall("properties/property")}
    module = case.attrib["classname"]
    times = tuple(float(facts.get(f"{phase} seconds", 0)) for phase in PHASES)
    starts = Counter({name: int(facts.get(name, 0)) for name in STARTS})
    name = f"{module.removeprefix('tests.')}::{case.attrib['name']}"
    return Test(module.split(".")[1], name, times, starts, facts.get("flaky") == "True")


def row(*cells: object) -> str:
    return f"| {' | '.join(str(cell) for cell in cells)} |"


def runs_table(files: Iterable[tuple[str, Path]]) -> Iterator[str]:
    """A row for each file: the whole run."""
    yield row("run", "tests", "minutes", "busy share of two cores", "load before", "kernels compiled", "flaky")
    yield "|---|--:|--:|--:|--:|--:|--:|"
    for label, path in files:
        tests, whole = read(path)
        minutes = f"{float(whole['wall seconds']) / 60:.1f}"
        facts = (whole[name] for name in ("busy share of all cores", "load before", "kernels compiled"))
        yield row(label, len(tests), minutes, *facts, sum(test.flaky for test in tests))


def tiers_table(tests: list[Test]) -> Iterator[str]:
    """A row for each tier: sums over its tests."""
    yield row("tier", "tests", "setup [s]", "call [s]", "teardown [s]", *(f"{name} started" for name in STARTS))
    yield "|---|--:|--:|--:|--:|--:|--:|--:|"
    for tier in sorted({test.tier for test in tests}):
        chosen = [test for test in tests if test.tier == tier]
        sums = [f"{sum(test.times[number] for test in chosen):.0f}" for number in range(len(PHASES))]
        starts = sum((test.starts for test in chosen), Counter())
        yield row(tier, len(chosen), *sums, *(starts[name] for name in STARTS))


def slowest_table(tests: list[Test]) -> Iterator[str]:
    yield row("test", "setup [s]", "call [s]", "teardown [s]", "processes")
    yield "|---|--:|--:|--:|--:|"
    for test in sorted(tests, key=lambda test: -test.seconds)[:SLOWEST]:
        yield row(
            f"`{test.name}`".replace("|", "\\|"),
            *(f"{seconds:.1f}" for seconds in test.times),
            test.starts["processes"],
        )


def page(after: list[Path], before: list[Path], notes: str) -> str:
    """The page, in Markdown. ``notes``: its text by hand, which stands before the first table."""
    tests = [test for path in after for test in read(path)[0]]
    older = [test for path in before for test in read(path)[0]]
    labelled = [*((f"before: {path.stem}", path) for path in before), *((path.stem, path) for path in after)]
    lines = [notes.rstrip(), "", "## Runs", "", *runs_table(labelled)]
    if older:
        lines += ["", "## Tiers, before", "", *tiers_table(older)]
    lines += ["", "## Tiers", "", *tiers_table(tests)]
    for tier in sorted({test.tier for test in tests}):
        lines += ["", f"## The slowest tests of {tier}", ""]
        lines += slowest_table([test for test in tests if test.tier == tier])
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, help="JUnit files of a run")
    parser.add_argument("--before", type=Path, help="a directory with the JUnit files of an earlier run")
    chosen = parser.parse_args()
    before = sorted(chosen.before.glob("*.xml")) if chosen.before else []
    notes = PAGE.read_text().split("## Runs")[0] if PAGE.exists() else "# The tests' time\n"
    PAGE.write_text(page(chosen.files, before, notes))
    print(PAGE)


if __name__ == "__main__":
    main()
