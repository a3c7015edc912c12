"""``python -m worker.telemetry.live_recording``: record a training as it runs on this machine, or recover a recording that was cut short.

``muster record`` starts it.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from shared_store.contract.error_text import counted
from shared_store.volume.files import read_json
from shared_store.volume.layout import Run
from shared_store.volume.log_view import LogView
from shared_store.volume.logs import LogLine
from shared_store.volume.metrics import history_of
from worker.settings.errors import UserError
from worker.telemetry.progress import Activity
from worker.telemetry.recording import Recording, recover
from worker.telemetry.tap_request import PATIENCE, TapRequest


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
    instead = f"record its newest checkpoint: muster record {run.name} -o FILE.mcap"
    request = TapRequest(run, worlds, instead, stop, activity)
    try:
        segment, stage, train = request.open(patience)
        recording = Recording(output, stage, {**_facts(run, train), "job": job}, _attachments(run))
        log = LogView.of(run, job)
        for _ in log.drain():
            pass  # older than the recording
        segment.skip()
        layout, since = segment.layout, 0
        total = episodes * request.worlds
        first: int | None = None
        """The attempt's step that is the recording's step ``since``."""
        while True:
            ended = segment.closed or request.is_orphaned
            for rows in segment.take():
                first = rows.first if first is None else first
                recording.write(rows.of_worlds(request.worlds, since=first - since))
                activity.count("recording: episode", recording.ended(episodes), total)
                for line in log.poll():
                    recording.log(line.text, name=source_of(line))
                if stop or recording.complete(episodes):
                    break
            if stop or recording.complete(episodes) or (ended and segment.closed):
                break
            if not ended:
                time.sleep(0.02)
                continue
            recording.interrupt("the training died; the recording goes on with its next attempt")
            activity.say(f"the training of run {run.name} died; waiting for its next attempt on this machine …")
            try:
                segment = request.attach(patience)
                same = replace(segment.layout, rows=layout.rows, worlds=layout.worlds) == layout
                if not same or episodes * request.worlds != total:
                    raise UserError(f"run {run.name}: its training went on with other worlds")
            except UserError as error:
                if stop:
                    break
                path, found = recording.finish(), recording.ended(episodes)
                raise UserError(f"{error}; {path} has {found} of {counted(total, 'episode')}") from None
            first, since = None, recording.steps
        recording.finish()
        if (found := recording.ended(episodes)) < total:
            why = "it was interrupted" if stop else "the training ended"
            print(f"note: {why} after {found} of {counted(total, 'episode')}", flush=True)
        return recording
    finally:
        activity.end()
        signal.signal(signal.SIGINT, before)
        request.withdraw()


def source_of(line: LogLine) -> str:
    """The process that wrote a line of a job's log."""
    return f"node {line.node}" if line.rank is None else f"rank {line.rank}"


def _facts(run: Run, train: dict[str, Any]) -> dict[str, str]:
    from worker.telemetry.rollout import facts_of

    iteration = (history_of(run).last() or {}).get("iteration", 0)
    facts = facts_of(run, {"task": train["task"], "algorithm": train.get("algorithm", "ppo")})
    return {**facts, "iteration": str(iteration), "seed": str(train.get("seed", ""))}


def _attachments(run: Run) -> dict[str, bytes]:
    from worker.telemetry.rollout import as_json, job_attachment

    contract = read_json(run.contract)
    return {**({"contract.json": as_json(contract)} if contract else {}), **job_attachment(run)}


def _recover(file: Path) -> None:
    made = recover(file)
    if made is None:
        print(f"{file}: it is whole already; nothing had to be recovered", flush=True)
        return
    print(f"recovered: {counted(made.messages, 'message')}; written: {made.path}", flush=True)
    if made.losses:
        raise UserError(f"{file}: {made.losses}; the rest is in {made.path.name}")


def main() -> int:
    """Read the arguments; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m worker.telemetry.live_recording")
    parser.add_argument("run", nargs="?", type=Path)
    parser.add_argument("--recover", type=Path)
    parser.add_argument("--job", default="")
    parser.add_argument("--worlds", type=int, default=4)
    parser.add_argument("--episodes", type=int, default=2)
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    try:
        if options.recover:
            _recover(options.recover)
            return 0
        done = record(Run(options.run), options.job, options.worlds, options.episodes, options.output)
        lost = f", {counted(done.lost, 'step')} lost" if done.lost else ""
        print(f"recorded: {counted(done.steps, 'step')}, {counted(done.episodes, 'episode')}{lost}", flush=True)
        print(f"written: {done.path}", flush=True)
        return 0
    except UserError as error:
        print(f"muster: {error}", file=sys.stderr, flush=True)
        return 1


if __name__ == "__main__":
    sys.exit(main())
