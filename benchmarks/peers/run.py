"""Common part of all peers' commands: options, one process per training, and its record."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.load import Watch, add_option
from benchmarks.peers.cases import CASES, LIMITS, Case, find_case

HERE = Path(__file__).parent
REPOSITORY = HERE.parent.parent
RECORDS = HERE / "records"
POINTS = 400
"""Most points of the curve in a record."""
OUTPUT = 25
"""Number of last lines to show of a failed training."""

Command = Callable[[argparse.Namespace, Case, str], tuple[list[str], dict[str, str]]]


def options_of(peer: str, doc: str | None, cases: Sequence[str]) -> argparse.ArgumentParser:
    """The options of every peer's command."""
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks.peers.{peer}",
        description=doc,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--case", default=cases[0], help=f"case to train: {', '.join(cases)}")
    parser.add_argument("--limits", default=LIMITS[0], help="limits of the solver: theirs or ours")
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--iterations", type=int, default=110, help="of one training")
    parser.add_argument("--warm", type=int, default=10, help="number of first iterations not counted in rates")
    parser.add_argument("--repeats", type=int, default=3, help="number of trainings, one process each")
    parser.add_argument("--save-every", type=int, default=50, help="iterations between two checkpoints")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=RECORDS, help="folder of the records")
    parser.add_argument("--keep", type=Path, help="folder for logs and checkpoints, which are otherwise deleted")
    add_option(parser)
    return parser


def cases_of(peer: str) -> list[str]:
    """Names of the cases that ``peer`` can train."""
    return [name for name, case in CASES.items() if peer in ("muster", "rsl_rl") or peer in case.peers]


def checked(options: argparse.Namespace, peer: str) -> Case:
    """The case of the options. Raises ValueError for invalid options."""
    case = find_case(options.case)
    case.named_in(peer)
    case.limits(options.limits)
    for name in ("worlds", "iterations", "warm", "repeats", "save_every"):
        if getattr(options, name) < 1:
            raise ValueError(f"--{name.replace('_', '-')} {getattr(options, name)}: it is at least 1")
    if options.iterations <= options.warm:
        raise ValueError(
            f"--iterations {options.iterations}: of these {options.warm} are not counted (--warm); give more iterations"
        )
    if options.seed < 0:
        raise ValueError(f"--seed {options.seed}: it is at least 0")
    return case


def measure(peer: str, parser: argparse.ArgumentParser, command: Command, arguments: Sequence[str] | None) -> None:
    """Train by the options, and write a record of each training.

    Args:
        peer: Name of the system.
        parser: From :func:`options_of`, with the peer's own options.
        command: Returns the command and additional variables of the training's process, from the options, the case and its JSON.
        arguments: Command-line arguments; None: those of this process.
    """
    options = parser.parse_args(arguments)
    try:
        case = checked(options, peer)
        command(options, case, "{}")  # refuse mistakes before anything runs
    except ValueError as error:
        parser.error(str(error))
    options.out.mkdir(parents=True, exist_ok=True)
    watch = Watch(options.loaded_anyway)
    chosen = ((key, getattr(options, key, None)) for key in ("algorithm", "frontend"))
    named = [peer, *(str(value) for key, value in chosen if value != parser.get_default(key))]
    for number in range(options.repeats):
        with tempfile.TemporaryDirectory() as passing:
            name = "-".join([*named, case.name, options.limits, str(options.worlds), str(options.seed + number)])
            logs = (options.keep or Path(passing)) / f"{name}-{time.time_ns()}"
            record = train(peer, options, case, command, number, logs.resolve())
        record |= watch.check(f"while {peer} trained {case.name}")
        (options.out / f"{name}.json").write_text(json.dumps(record, indent=1))
        print(f"{name}: {record['rate']:,.0f} steps/s, ready after {record['startup_s']:.1f} s", flush=True)


def train(
    peer: str, options: argparse.Namespace, case: Case, command: Command, number: int, logs: Path
) -> dict[str, Any]:
    """The record of one training in a separate process. Raises SystemExit with its last lines if it fails."""
    logs.mkdir(parents=True, exist_ok=True)
    out, output = logs / "found.json", logs / "output.txt"
    requested = case.shared(peer, options.limits) | {
        "worlds": options.worlds,
        "iterations": options.iterations,
        "save_every": options.save_every,
        "seed": options.seed + number,
        "logs": str(logs / "logs"),
        "out": str(out),
        "began": time.time(),
    }
    words, variables = command(options, case, json.dumps(requested))
    with output.open("w") as stream:
        ended = subprocess.run(
            words, stdout=stream, stderr=subprocess.STDOUT, env={**os.environ, **variables}, cwd=REPOSITORY
        )
    if not out.exists():
        last = "\n".join(output.read_text(errors="replace").splitlines()[-OUTPUT:])
        raise SystemExit(f"{peer}: its training ended with exit code {ended.returncode} and no result:\n{last}")
    return record_of(peer, case, options, requested, json.loads(out.read_text()))


def record_of(
    peer: str, case: Case, options: argparse.Namespace, requested: dict[str, Any], found: dict[str, Any]
) -> dict[str, Any]:
    """The record of a training.

    Raises:
        ValueError: It made fewer iterations than requested.
    """
    curve = found.pop("curve")
    if len(curve) != options.iterations:
        raise ValueError(f"{peer}: {options.iterations} iterations were asked for, {len(curve)} are in its log")
    if not options.keep:
        found["checkpoints"] = []
    facts = {"peer": peer, "case": case.name, "limits": options.limits, "warm": options.warm}
    reported = {name: requested[name] for name in ("task", "worlds", "iterations", "steps", "seed", "save_every")}
    figures = {
        "rate": rate(curve, options.warm),
        "first_s": curve[0]["seconds"],
        "trained_s": curve[-1]["seconds"],
    }
    return facts | reported | figures | found | {"curve": thinned(curve)}


def rate(curve: Sequence[dict[str, Any]], warm: int) -> float:
    """Steps per second of wall time, from the end of iteration ``warm`` to the end of the last one."""
    first, last = curve[warm - 1], curve[-1]
    return float((last["env_steps"] - first["env_steps"]) / (last["seconds"] - first["seconds"]))


def thinned(curve: Sequence[dict[str, Any]], most: int = POINTS) -> list[dict[str, Any]]:
    """About ``most`` points of a curve, with its last one."""
    every = -(-len(curve) // most)
    kept = list(curve[every - 1 :: every])
    return kept if kept and kept[-1] is curve[-1] else [*kept, curve[-1]]


def own_process(module: str) -> tuple[list[str], dict[str, str]]:
    """A training in this environment: ``module`` of :mod:`benchmarks.peers.inside`."""
    return [sys.executable, "-m", f"benchmarks.peers.inside.{module}"], {}


def other_process(python: Path, script: str) -> tuple[list[str], dict[str, str]]:
    """A training in a separate environment, isolated from this one.

    Raises:
        ValueError: The environment does not exist.
    """
    if not python.exists():
        raise ValueError(
            f"there is no environment with {python}; make it: python -m benchmarks.peers.environment --help"
        )
    return [str(python.absolute()), str(HERE / "inside" / script)], {"PYTHONPATH": "", "PYTHONNOUSERSITE": "1"}
