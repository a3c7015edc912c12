"""``python -m worker.telemetry.live``: record a training as it runs on this machine, or recover a recording that was cut short.

``muster record`` starts it.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from shared_store.files import DamagedFile, read_json, write_json
from shared_store.layout import Run
from shared_store.logs import LogFollower
from shared_store.metrics import history_of
from worker.errors import UserError
from worker.telemetry.attending import answer_of, is_alive, request_of
from worker.telemetry.recording import Recording, recover
from worker.telemetry.rows import Layout, Rows
from worker.telemetry.segment import Segment

PATIENCE = 180.0
"""Seconds in which a training answers: it does between two iterations."""


def record(run: Run, job: str, worlds: int, episodes: int, output: Path, patience: float = PATIENCE) -> Recording:
    """Record a running training until each world has ended so many episodes, the training ends, or SIGINT comes.

    Args:
        run: The run.
        job: The job that trains, for its log.
        worlds: How many of the main rank's worlds.
        episodes: Of each world.
        output: The file.
        patience: Seconds after which a training that does not answer is given up.

    Raises:
        UserError: It can't be recorded; one line says why.
    """
    stop: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: stop.append(number))
    segment, there = _attach(run, worlds, patience, stop)
    try:
        recording = _open(run, there, output, {"job": job})
        if there < worlds:
            print(f"note: the training has {there} worlds on its main rank", flush=True)
        log = LogFollower(run, job)
        for _ in log.drain():
            pass  # what was said before the recording began
        segment.skip()
        for rows in _rows(segment, there, stop):
            recording.write(rows)
            for line in log.poll():
                recording.say(line.text, name=f"rank {line.rank}" if line.rank is not None else f"node {line.node}")
            if recording.complete(episodes):
                break
        recording.finish()
        return recording
    finally:
        signal.signal(signal.SIGINT, before)
        request_of(run).unlink(missing_ok=True)  # the training sees that nobody reads any more


def _attach(run: Run, worlds: int, patience: float, stop: list[int]) -> tuple[Segment, int]:
    """Ask for the tap; returns it, and how many worlds are to be read. Raises UserError."""
    request, answer = request_of(run), answer_of(run)
    try:
        earlier = read_json(request)
        if earlier and is_alive(earlier.get("host"), earlier.get("process")):
            raise UserError(
                f"run {run.name} is being recorded already, by process {earlier['process']}; wait for its end"
            )
        answer.unlink(missing_ok=True)
        write_json(request, {"host": socket.gethostname(), "process": os.getpid(), "worlds": worlds}, 0o600)
        until = time.monotonic() + patience
        while (told := read_json(answer)) is None:
            if time.monotonic() > until:
                raise UserError(
                    f"run {run.name}: its training did not answer within {patience:.0f} s: it does not run on this machine, or not any "
                    f"more; record its newest checkpoint: muster record {run.name} -o FILE.mcap"
                )
            if stop:
                raise UserError(f"run {run.name}: interrupted before its training answered; nothing was recorded")
            time.sleep(0.1)
        if "problem" in told:
            answer.unlink(missing_ok=True)
            raise UserError(
                f"run {run.name}: {told['problem']}; record it there, or its newest checkpoint: muster record {run.name} -o FILE.mcap"
            )
        layout = Layout.from_json(told["layout"])
        segment = Segment.open(Path(told["path"]), layout)
        segment.path.unlink(missing_ok=True)  # it lives as long as both map it, and no crash leaves it behind
        return segment, min(worlds, layout.worlds)
    except (OSError, DamagedFile, ValueError, KeyError, TypeError) as error:
        request.unlink(missing_ok=True)
        raise UserError(f"run {run.name}: its tap can't be read ({error})") from error
    except UserError:
        if not (earlier and is_alive(earlier.get("host"), earlier.get("process"))):
            request.unlink(missing_ok=True)
        raise


def _rows(segment: Segment, worlds: int, stop: list[int]) -> Iterator[Rows]:
    """The rows of the first ``worlds`` worlds as they come, numbered from 0."""
    first: int | None = None
    while not stop:
        over = segment.closed
        for rows in segment.take():
            first = rows.first if first is None else first
            layout = Layout(**{**vars(segment.layout), "worlds": worlds})
            values, marks = rows.values[:, :worlds], rows.marks[:, :worlds]
            yield Rows(layout, rows.first - first, values, np.ascontiguousarray(marks), rows.lost)
        if over:
            return
        time.sleep(0.02)


def _open(run: Run, worlds: int, output: Path, known: dict[str, str]) -> Recording:
    """The recording, with what the run's description says of its training."""
    import warp

    from worker.learning.job import configure, user_errors
    from worker.tasks import find_task
    from worker.telemetry.rollout import as_json, facts_of, job_attachment
    from worker.telemetry.stage import Stage

    warp.config.log_level = warp.LOG_WARNING  # not a line for each kernel module
    spec: dict[str, Any] = (run.description() or {}).get("spec") or {}
    train = spec.get("train")
    if not isinstance(train, dict) or not isinstance(train.get("task"), str):
        raise UserError(f"run {run.name}: its description names no task")
    with user_errors():
        task_type = find_task(train["task"])
        stage = Stage(task_type, configure(task_type, train), worlds)
    told = history_of(run).last() or {}
    known = {**known, "iteration": str(told.get("iteration", 0)), "seed": str(train.get("seed", ""))}
    facts = facts_of(run, {"task": train["task"], "algorithm": train.get("algorithm", "ppo")})
    contract = read_json(run.contract)
    attached = {"contract.json": as_json(contract)} if contract else {}
    return Recording(output, stage, {**facts, **known}, {**attached, **job_attachment(run)})


def main() -> int:
    """Read the arguments; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m worker.telemetry.live")
    parser.add_argument("run", nargs="?", type=Path)
    parser.add_argument("--recover", type=Path)
    parser.add_argument("--job", default="")
    parser.add_argument("--worlds", type=int, default=4)
    parser.add_argument("--episodes", type=int, default=2)
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    try:
        if given.recover:
            path, count = recover(given.recover)
            print(f"recovered: {count} messages; written: {path}", flush=True)
            return 0
        made = record(Run(given.run), given.job, given.worlds, given.episodes, given.output)
        lost = f", {made.lost} steps were lost" if made.lost else ""
        print(f"recorded: {made.steps} steps, {made.episodes} episodes{lost}\nwritten: {made.path}", flush=True)
        return 0
    except UserError as error:
        print(f"muster: {error}", file=sys.stderr, flush=True)
        return 1


if __name__ == "__main__":
    sys.exit(main())
