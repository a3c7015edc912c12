"""What must be true of a run after its last job has ended, whatever was struck: compared with a run that nothing has struck."""

from __future__ import annotations

import itertools
import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from shared_store.volume.checkpoints import Checkpoint, DamagedCheckpoint, list_checkpoints
from shared_store.volume.epoch import read_epoch
from shared_store.volume.files import read_json
from shared_store.volume.layout import Run
from shared_store.volume.metrics import read_metrics
from tests.support.faults.home import Home
from tests.support.processes import gang_members

_TIMING = ("time", "_seconds", "_per_second", "slowest_rank", "slowest_excess")
"""How the names of fields end that no two runs share."""
_NOT_TRAINING = {"checkpoint", "table", "seconds", "time"}
"""The same of an evaluation; the names of the checkpoint and of the table have the epoch in them."""
_MANIFEST = ("world_size", "worlds", "shards", "reward", "env_steps", "task", "train", "ppo", "policy")


@dataclass
class Verdict:
    """What was found."""

    violations: list[str] = field(default_factory=list)
    attempts: int = 0
    jobs: int = 0
    repeated: int = 0
    """Iterations that were computed more than once."""
    skipped_epochs: int = 0
    """Numbers that no attempt has: a controller was killed between raising EPOCH and recording the attempt."""
    checkpoints: int = 0
    """How many were compared tensor by tensor."""


class Reference:
    """The straight run: every checkpoint that it made, every record."""

    def __init__(self, run: Run) -> None:
        self.checkpoints = {checkpoint.iteration: checkpoint for checkpoint in list_checkpoints(run)}
        self.records = {record["iteration"]: without_timing(record) for record in read_metrics(run)}
        self.last = max(self.records)
        self.evaluation = _evaluation(run, self.checkpoints[self.last].name)


def judge(verdict: Verdict, home: Home, run: Run, reference: Reference, controller_kills: int) -> None:
    """Every check on a run whose newest job is over; what is found goes into ``verdict``."""
    _check_accounts(home, run, controller_kills, verdict)
    _check_processes(home, verdict)
    _check_checkpoints(run, reference, verdict)
    _check_history(run, reference, verdict)
    _check_logs(home, run, verdict)


def _check_accounts(home: Home, run: Run, controller_kills: int, verdict: Verdict) -> None:
    """Attempts in the database = epochs, and all that left a log; each has a launch, an end and a reason."""
    jobs = home.jobs(run.name)
    attempts = [attempt for job in jobs for attempt in job["attempts"]]
    verdict.jobs, verdict.attempts = len(jobs), len(attempts)
    say = verdict.violations.append
    for job in jobs:
        last = job is jobs[-1]
        if (last and job["status"] != "SUCCEEDED") or (not last and job["status"] != "FAILED"):
            say(f"job {job['id']} of {len(jobs)} is {job['status']} ({job['status_reason']})")
        if not job["stopped_at"] or not job["status_reason"]:
            say(f"job {job['id']} is over without a time or a reason")
        if [attempt["number"] for attempt in job["attempts"]] != list(range(1, len(job["attempts"]) + 1)):
            say(f"job {job['id']}: attempts are not numbered from 1")
    for attempt in attempts:
        name = f"attempt {attempt['job_id'][:8]}/{attempt['number']} (epoch {attempt['epoch']})"
        missing = [key for key in ("ending", "status_reason", "stopped_at", "handle") if not attempt[key]]
        if missing or (attempt["exit_code"] is None and attempt["ending"] in ("succeeded", "requeue")):
            say(f"{name} is closed without {', '.join(missing) or 'exit code'}")
    known = {(attempt["job_id"], attempt["number"]) for attempt in attempts}
    logged = {(path.parent.name, int(path.name)) for path in (run.path / "logs").glob("*/*")}
    if logged - known:
        say(f"launched, and not in the database: {sorted(logged - known)}")
    epochs, newest = [attempt["epoch"] for attempt in attempts], read_epoch(run)
    if any(later <= earlier for earlier, later in itertools.pairwise(epochs)):
        say(f"epochs do not grow: {epochs}")
    verdict.skipped_epochs = newest - len(epochs)
    if newest != max(epochs) or not 0 <= verdict.skipped_epochs <= controller_kills:
        say(f"EPOCH is {newest}, the attempts have {epochs}")


def _check_processes(home: Home, verdict: Verdict) -> None:
    if left := gang_members(home.path):
        verdict.violations.append(f"processes left: {', '.join(map(str, left))}")


def _check_checkpoints(run: Run, reference: Reference, verdict: Verdict) -> None:
    """All that are left verify and hold the reference's bits; nothing else is left beside them."""
    say = verdict.violations.append
    found = list_checkpoints(run)
    known = {checkpoint.name for checkpoint in found} | {"LATEST"}
    if others := sorted(entry.name for entry in run.checkpoints.iterdir() if entry.name not in known):
        say(f"left in {run.checkpoints}: {', '.join(others)}")
    if not found or found[-1].iteration != reference.last:
        say(f"the last checkpoint is {found[-1].name if found else 'none'}, not of iteration {reference.last}")
    for checkpoint in found:
        try:
            checkpoint.verify()
        except DamagedCheckpoint as error:
            say(str(error))
            continue
        if (straight := reference.checkpoints.get(checkpoint.iteration)) is None:
            say(f"checkpoint {checkpoint.name}: a straight run makes none at this iteration")
            continue
        verdict.checkpoints += 1
        for key in _MANIFEST:
            if checkpoint.manifest.get(key) != straight.manifest.get(key):
                say(f"checkpoint {checkpoint.name}: manifest.json: {key} differs")
        if differ := files_differing(straight, checkpoint):
            say(f"checkpoint {checkpoint.name} differs in {len(differ)} values: {', '.join(differ[:5])}")
    evaluation = _evaluation(run, found[-1].name) if found else {}
    if evaluation != reference.evaluation:
        say(f"the evaluation is {evaluation}, not {reference.evaluation}")


def _check_history(run: Run, reference: Reference, verdict: Verdict) -> None:
    """No iteration is missing or doubled, and every record ever written is the reference's, those that were given up too."""
    say = verdict.violations.append
    done = 0
    for path in sorted(run.metrics.glob("metrics-e*.jsonl"), key=lambda path: int(path.stem.partition("-e")[2])):
        *lines, _torn = path.read_bytes().split(b"\n")
        records = [json.loads(line) for line in lines]
        starts = [record["resumed_from"] for record in records if "resumed_from" in record]
        if not records:
            continue
        if len(starts) != 1 or "resumed_from" not in records[0]:
            say(f"{path.name}: resumed from {starts}")
            continue
        if starts[0] > done:
            say(f"{path.name}: resumed from {starts[0]}, but the history ends at {done}")
        verdict.repeated += max(0, done - starts[0])
        numbers = [record["iteration"] for record in records[1:]]
        if numbers != list(range(starts[0] + 1, starts[0] + 1 + len(numbers))):
            say(f"{path.name}: iterations missing or doubled after {starts[0]}: {numbers}")
        _compare_records(path, records[1:], reference, verdict)
        done = starts[0] + len(numbers)
    merged = [record["iteration"] for record in read_metrics(run)]
    if merged != list(range(1, reference.last + 1)):
        say(f"the merged history is not 1 … {reference.last}: {merged}")


def _compare_records(path: Path, records: list[dict[str, Any]], reference: Reference, verdict: Verdict) -> None:
    fields, iterations = set[str](), []
    for record in records:
        straight, struck = reference.records.get(record["iteration"], {}), without_timing(record)
        if differ := {key for key in straight.keys() | struck.keys() if straight.get(key) != struck.get(key)}:
            fields |= differ
            iterations.append(record["iteration"])
    if iterations:
        verdict.violations.append(
            f"{path.name}: {len(iterations)} iterations from {iterations[0]} on differ in {', '.join(sorted(fields))}"
        )


def _check_logs(home: Home, run: Run, verdict: Verdict) -> None:
    """An attempt starts once, and from nothing older than what was acknowledged before it."""
    acknowledged = 0
    for job in home.jobs(run.name):
        for attempt in job["attempts"]:
            name = f"attempt {job['id'][:8]}/{attempt['number']}"
            log = run.log(job["id"], attempt["number"], 0)
            text = log.read_text(errors="replace") if log.exists() else ""
            starts = re.findall(r" o (?:starting from new weights|resumed from checkpoint (\d{8})-e\d+)$", text, re.M)
            if len(starts) > 1:
                verdict.violations.append(f"{name} started {len(starts)} times")
            if starts and int(starts[0] or 0) < acknowledged:
                verdict.violations.append(f"{name} started from {starts[0] or 0}; {acknowledged} was acknowledged")
            saved = re.findall(r" o checkpoint (\d{8})-e\d+$", text, re.M)
            acknowledged = max([acknowledged, *map(int, saved)])
    errors = home.errors.read_text(errors="replace") if home.errors.exists() else ""
    if "Traceback" in errors:
        verdict.violations.append(f"a controller had an exception: see {home.errors}")


def files_differing(straight: Checkpoint, other: Checkpoint) -> list[str]:
    """Paths of the values of ``straight``'s files that are not the same bits in ``other``."""
    found = []
    for name in sorted(straight.manifest["files"]):
        if name in other.manifest["files"]:
            found += differences(_load(straight.path / name), _load(other.path / name), name)
        else:
            found.append(f"{name} (missing)")
    return found


def differences(a: Any, b: Any, where: str) -> list[str]:
    """Paths of the values that are not the same bits in ``a`` and ``b``."""
    if isinstance(a, dict) and isinstance(b, dict):
        keys = sorted(a.keys() | b.keys(), key=str)
        return [
            path
            for key in keys
            for path in (
                differences(a[key], b[key], f"{where}/{key}") if key in a and key in b else [f"{where}/{key} (missing)"]
            )
        ]
    if isinstance(a, list | tuple) and isinstance(b, list | tuple) and len(a) == len(b):
        return [path for i, pair in enumerate(zip(a, b, strict=True)) for path in differences(*pair, f"{where}/{i}")]
    if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        same = a.dtype == b.dtype and a.shape == b.shape and torch.equal(_bits(a), _bits(b))
    else:
        same = type(a) is type(b) and repr(a) == repr(b)
    return [] if same else [where]


def _bits(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.contiguous().reshape(-1).view(torch.uint8)


def _load(path: Path) -> Any:
    return torch.load(path, map_location="cpu", weights_only=True)


def without_timing(record: dict[str, Any]) -> dict[str, Any]:
    """What the training computed in an iteration, without how long that took."""
    return {key: value for key, value in record.items() if not key.endswith(_TIMING)}


def _evaluation(run: Run, name: str) -> dict[str, Any]:
    found = read_json(run.evaluations / f"{name}.json") or {}
    return {key: value for key, value in found.items() if key not in _NOT_TRAINING}
