"""The table of a torture, for the terminal and for ``benchmarks/torture.md``."""

from __future__ import annotations

import os
import platform
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime

from tests.support.faults.fire import Result
from tests.support.faults.rounds import Class, class_table
from tests.support.faults.schedule import SHARES


def table(results: Sequence[Result], seconds: float) -> str:
    """What was struck and what came of it, as a Markdown table."""
    hits = Counter((hit.target, hit.signal) for result in results for hit in result.hits)
    inside = Counter(hit.target for result in results for hit in result.hits if hit.in_commit)
    lines = ["| struck | SIGKILL | SIGSTOP | of them inside a commit |", "|---|--:|--:|--:|"]
    for target in SHARES:
        lines.append(f"| {target} | {hits[target, 'SIGKILL']} | {hits[target, 'SIGSTOP']} | {inside[target]} |")
    kills, stops = (sum(count for (_, name), count in hits.items() if name == kind) for kind in ("SIGKILL", "SIGSTOP"))
    lines.append(f"| **all** | **{kills}** | **{stops}** | **{sum(inside.values())}** |")
    verdicts = [result.verdict for result in results]
    facts = {
        "runs (of 1, 2 and 3 nodes)": f"{len(results)} "
        f"({', '.join(str(sum(r.plan.nodes == nodes for r in results)) for nodes in (1, 2, 3))})",
        "gang starts after the first of each run": sum(max(0, verdict.attempts - 1) for verdict in verdicts),
        "controller starts": sum(result.controller_starts for result in results),
        "jobs that resumed a run whose attempts were spent": sum(max(0, verdict.jobs - 1) for verdict in verdicts),
        "iterations repeated (lost work)": sum(verdict.repeated for verdict in verdicts),
        "epochs skipped (controller killed before it had recorded the attempt)": sum(
            verdict.skipped_epochs for verdict in verdicts
        ),
        "checkpoints compared bit by bit": sum(verdict.checkpoints for verdict in verdicts),
        "**runs that ended differently, or with anything amiss**": f"**{sum(bool(v.violations) for v in verdicts)}**",
        "seconds": f"{seconds:.0f}",
    }
    lines += ["", "| what came of it | |", "|---|--:|", *(f"| {name} | {value} |" for name, value in facts.items())]
    return "\n".join(lines)


def summary(
    results: Sequence[Result], classes: Sequence[Class], seconds: float, seed: int, iterations: int, jobs: int
) -> str:
    """The page."""
    wrong = [f"- run {r.plan.seed}: {violation}" for r in results for violation in r.verdict.violations]
    wrong += [f"- {violation}" for each in classes for violation in each.violations]
    total = sum(len(result.hits) for result in results)
    return f"""# Kill anything, at any instant

Written by `make torture N={total}` (`python -m tests.support.faults.torture --seed {seed} --jobs {jobs}`), {datetime.now(UTC):%Y-%m-%d}, {os.cpu_count()} CPUs, Python {platform.python_version()}.

A Cartpole job of {iterations} iterations with a checkpoint every 10 is run straight, then again and again through the real command and
controller while signals hit its processes at random moments. Every run must end with the straight run's tensors, bit for bit, in all
checkpoints that it has left; every metrics record that was ever written must be the straight run's (timing apart), none missing or
doubled; attempts, launches and epochs must agree; every attempt must have its reason; no process and no hidden file may be left.

{table(results, seconds)}

## Besides killing

Each round brings up a controller of its own and does its worst: jobs that fork, flood, ignore signals and try to escape; a volume without
a free byte; a wall clock that jumps by up to 90 days; a second controller that takes the same run at the same moment.

{class_table(classes)}
{"" if not wrong else chr(10) + "## What was wrong" + chr(10) + chr(10) + chr(10).join(wrong) + chr(10)}"""
