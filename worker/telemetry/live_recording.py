"""``python -m worker.telemetry.live_recording``: record a training as it runs on this machine, or recover a recording that was cut short.

``muster record`` starts it.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shared_store.contract.error_text import counted
from shared_store.volume.files import read_json
from shared_store.volume.layout import Run
from shared_store.volume.log_view import LogView
from shared_store.volume.metrics import history_of
from worker.settings.errors import UserError
from worker.telemetry.progress import Activity, loading
from worker.telemetry.recording import Recording
from worker.telemetry.recovering import recover
from worker.telemetry.rows import Rows
from worker.telemetry.segment import Segment
from worker.telemetry.tap_request import PATIENCE, Asking

if TYPE_CHECKING:
    from worker.telemetry.stage import Stage


def record(run: Run, job: str, worlds: int, episodes: int, output: Path, patience: float = PATIENCE) -> Recording:
    """Record a running training until each world has ended so many episodes, the training ends, or SIGINT comes.

    Where the training dies, the recording goes on with its next attempt on this machine.

    Args:
        run: The run.
        job: The job that trains, for its log.
        worlds: How many of the main rank's worlds.
        episodes: Of each world.
        output: The file.
        patience: Seconds after which a training that does not answer is given up.

    Raises:
        UserError: It can't be recorded, or it died and does not go on: then the file is whole, but shorter; one line says which.
    """
    stop: list[int] = []
    activity = Activity()
    before = signal.signal(signal.SIGINT, lambda number, _: stop.append(number))
    asking = Asking(run, worlds, f"record its newest checkpoint: muster record {run.name} -o FILE.mcap")
    try:
        segment = asking.attach(patience, stop, activity)
        activity.say(loading(run, asking.worlds))
        recording = _open(run, asking.worlds, output, {"job": job})
        if asking.worlds < worlds:
            print(f"note: the training has {counted(asking.worlds, 'world')} on its main rank", flush=True)
        if asking.note:
            print(f"note: {asking.note}", flush=True)
        log = LogView.of(run, job)
        for _ in log.drain():
            pass  # older than the recording
        segment.skip()
        wanted = episodes * asking.worlds
        while True:
            for rows in _rows(segment, asking, stop, since=recording.steps):
                recording.write(rows)
                activity.count("recording: episode", recording.ended(episodes), wanted)
                for line in log.poll():
                    recording.say(line.text, name=f"rank {line.rank}" if line.rank is not None else f"node {line.node}")
                if recording.complete(episodes):
                    break
            if stop or recording.complete(episodes) or segment.closed:
                break
            recording.interrupt("the training died; the recording goes on with its next attempt")
            activity.say(f"the training of run {run.name} died; waiting for its next attempt on this machine …")
            layout = segment.layout
            try:
                segment = asking.attach(patience, stop, activity)
                there = replace(segment.layout, rows=layout.rows, worlds=layout.worlds)
                if there != layout or episodes * asking.worlds != wanted:
                    raise UserError(f"run {run.name}: its training went on with other worlds")
            except UserError as error:
                if stop:
                    break
                path, ended = recording.finish(), recording.ended(episodes)
                raise UserError(f"{error}; {path} has {ended} of {counted(wanted, 'episode')}") from None
        path, ended = recording.finish(), recording.ended(episodes)
        if ended < wanted:
            why = "it was interrupted" if stop else "the training ended"
            print(f"note: {why} after {ended} of {counted(wanted, 'episode')}", flush=True)
        return recording
    finally:
        activity.end()
        signal.signal(signal.SIGINT, before)
        asking.withdraw()


def _rows(segment: Segment, asking: Asking, stop: list[int], since: int) -> Iterator[Rows]:
    """The rows of the first worlds as they come, numbered from ``since``, until the training ends or is killed."""
    first: int | None = None
    worlds = asking.worlds
    while not stop:
        over = segment.closed or asking.is_answered_by_nobody
        for rows in segment.take():
            first = rows.first - since if first is None else first
            yield rows.of_worlds(worlds, since=first)
        if over:
            return
        time.sleep(0.02)


def _open(run: Run, worlds: int, output: Path, known: dict[str, str]) -> Recording:
    """The recording, with what the run's description says of its training."""
    from worker.telemetry.rollout import as_json, facts_of, job_attachment

    stage, train = stage_of(run, worlds)
    told = history_of(run).last() or {}
    known = {**known, "iteration": str(told.get("iteration", 0)), "seed": str(train.get("seed", ""))}
    facts = facts_of(run, {"task": train["task"], "algorithm": train.get("algorithm", "ppo")})
    contract = read_json(run.contract)
    attached = {"contract.json": as_json(contract)} if contract else {}
    return Recording(output, stage, {**facts, **known}, {**attached, **job_attachment(run)})


def stage_of(run: Run, worlds: int) -> tuple[Stage, dict[str, Any]]:
    """The stage of a run's training worlds, and the ``train`` section of its job. Raises UserError."""
    import warp

    from worker.learning.job import configure, user_errors, with_texts
    from worker.tasks import find_task
    from worker.telemetry.stage import Stage

    warp.config.log_level = warp.LOG_WARNING  # not a line for each kernel module
    spec: dict[str, Any] = (run.description() or {}).get("spec") or {}
    train = spec.get("train")
    if not isinstance(train, dict) or not isinstance(train.get("task"), str):
        raise UserError(f"run {run.name}: its description names no task")
    train = with_texts(train, run, "train")
    with user_errors():
        task_type = find_task(train["task"])
        return Stage(task_type, configure(task_type, train), worlds), train


def main() -> int:
    """Read the arguments; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m worker.telemetry.live_recording")
    parser.add_argument("run", nargs="?", type=Path)
    parser.add_argument("--recover", type=Path)
    parser.add_argument("--job", default="")
    parser.add_argument("--worlds", type=int, default=4)
    parser.add_argument("--episodes", type=int, default=2)
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    try:
        if given.recover:
            made = recover(given.recover)
            if made is None:
                print(f"{given.recover}: it is whole already; nothing had to be recovered", flush=True)
                return 0
            print(f"recovered: {counted(made.messages, 'message')}; written: {made.path}", flush=True)
            if made.losses:
                raise UserError(f"{given.recover}: {made.losses}; the rest is in {made.path.name}")
            return 0
        done = record(Run(given.run), given.job, given.worlds, given.episodes, given.output)
        lost = f", {counted(done.lost, 'step')} lost" if done.lost else ""
        print(
            f"recorded: {counted(done.steps, 'step')}, {counted(done.episodes, 'episode')}{lost}\nwritten: {done.path}",
            flush=True,
        )
        return 0
    except UserError as error:
        print(f"muster: {error}", file=sys.stderr, flush=True)
        return 1


if __name__ == "__main__":
    sys.exit(main())
