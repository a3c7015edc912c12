"""Evaluation of the checkpoints of recorded trainings: tracking errors and episode lengths, all in the same task of Muster.

    python -m benchmarks.peers.judge [RECORD ...] [--worlds 256] [--limits theirs] [--last] [--out DIRECTORY]

The records are those of trainings by mjlab, rsl_rl and Muster that kept their checkpoints (``--keep``); by default all in ``--out``.
Every policy takes its mean actions in the same worlds, drawn from the same seed, under the same limits of the solver: by default
``theirs``, whatever it was trained with, which shows that looser limits did not harm it. Writes ``judged/<record>.json``; ``python -m
benchmarks.peers.table`` shows them.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from benchmarks.peers.building import limited
from benchmarks.peers.cases import LIMITS, Case, find_case
from benchmarks.peers.conversion import check_contract, check_fit, check_probe, read_rsl_rl
from benchmarks.peers.judging import Acting, judge
from benchmarks.peers.run import RECORDS
from shared_store.volume.layout import Run
from worker.learning.trained import find_checkpoint, load_policy
from worker.tasks.run.task import Task

SEED = 12345
"""Seed of the worlds in which policies are judged; no training uses it."""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.peers.judge",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("records", nargs="*", type=Path)
    parser.add_argument("--worlds", type=int, default=256)
    parser.add_argument("--limits", default=LIMITS[0])
    parser.add_argument("--last", action="store_true", help="the last checkpoint of each training alone")
    parser.add_argument("--iteration", type=int, default=0, help="of training, whose commands are given")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--out", type=Path, default=RECORDS)
    options = parser.parse_args(arguments)
    try:
        files = options.records or sorted(options.out.glob("*.json"))
        records = {file.stem: read_record(file) for file in files}
        kept = {name: record for name, record in records.items() if record["checkpoints"]}
        if not kept:
            raise ValueError(f"none of {len(records)} records has checkpoints; train with --keep DIRECTORY")
        worlds: dict[str, Task] = {}
        for name, record in kept.items():
            judged = judge_record(record, options, worlds)
            (options.out / "judged").mkdir(parents=True, exist_ok=True)
            (options.out / "judged" / f"{name}.json").write_text(json.dumps(judged, indent=1))
            last = judged["rows"][-1]
            print(
                f"{name}: linear {last['linear_error']:.3f} m/s, angular {last['angular_error']:.3f} rad/s, "
                f"length {100 * last['length_share']:.1f} %",
                flush=True,
            )
    except ValueError as error:
        parser.error(str(error))


def read_record(path: Path) -> dict[str, Any]:
    """A record of a training. Raises ValueError for any other file."""
    try:
        record = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} can't be read: {error}") from error
    missing = [key for key in ("peer", "case", "limits", "rate", "curve", "checkpoints") if key not in record]
    if missing:
        raise ValueError(f"{path} is not a record of a training: it has no {', '.join(missing)}")
    return dict(record)


def judge_record(record: dict[str, Any], options: argparse.Namespace, worlds: dict[str, Task]) -> dict[str, Any]:
    """The judgement of each checkpoint of a training.

    Args:
        record: Record of the training.
        options: The command line's options.
        worlds: Built tasks by case; a missing one is added.
    """
    case = find_case(record["case"])
    if case.name not in worlds:
        worlds[case.name] = build(case, options)
    task = worlds[case.name]
    rows = []
    for point in record["checkpoints"][-1:] if options.last else record["checkpoints"]:
        task.seed(options.seed)  # every policy meets the same starts, commands and pushes
        policy = policy_of(record, point, task)
        shown = {"iteration": point["iteration"], "seconds": point["seconds"]}
        steps = point["iteration"] * record["steps"] * record["worlds"]
        rows.append(shown | {"env_steps": steps} | asdict(judge(task, policy)))
    facts = {name: record[name] for name in ("peer", "case", "limits", "worlds", "seed", "device")}
    facts |= {name: record[name] for name in ("versions", "frontend", "algorithm") if name in record}
    return facts | {"judged_limits": options.limits, "judged_worlds": options.worlds, "rows": rows}


def build(case: Case, options: argparse.Namespace) -> Task:
    """The worlds in which the policies of a case are judged.

    Raises:
        ValueError: An option is invalid.
    """
    if options.worlds < 1:
        raise ValueError(f"--worlds {options.worlds}: it is at least 1")
    task_type, settings = limited(case.task, case.shared("muster", options.limits)["limits"])
    device = "cuda:0" if torch.cuda.is_available() else "cpu"
    task = task_type(task_type.config_type(**settings), options.worlds, seed=options.seed, device=device)
    task.begin_iteration(options.iteration, None, None)
    return task


def policy_of(record: dict[str, Any], point: dict[str, Any], task: Task) -> Acting:
    """The policy of one checkpoint of a record.

    Raises:
        ValueError: It does not exist, or does not fit the task.
    """
    name = type(task).__name__
    if record["peer"] == "muster":
        path = Path(point["path"])
        if not path.is_dir():
            raise ValueError(f"there is no run {path}")
        return load_policy(find_checkpoint(Run(path), point["iteration"]), task.device)
    policy = read_rsl_rl(point["path"], device=task.device)
    check_fit(policy, len(task.observation_names), task.action_size, name)
    if record["peer"] == "mjlab":
        interface = task.interface()
        if interface is None:
            raise ValueError(
                f"task {name} does not say what its observations mean, so that no policy of mjlab can be judged"
            )
        check_contract(record["contract"], interface, name)
        if point is record["checkpoints"][-1]:
            check_probe(policy, record["probe"])
    return policy


if __name__ == "__main__":
    main()
