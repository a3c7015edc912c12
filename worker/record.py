"""``python -m worker.record``: record a checkpoint's policy on fresh worlds as an MCAP file.

It writes ``recordings/<checkpoint>-<job>.mcap`` of the run that the job names; its directory entry appears when the file is whole.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from shared_store.contract.error_text import counted
from worker.learning.job import Job, end_startup, run_command
from worker.settings.errors import UserError
from worker.telemetry.progress import Activity, loading

if TYPE_CHECKING:
    from worker.telemetry.rollout import Rollout


def open_rollout(job: Job, worlds: int, activity: Activity, seed: int | None = None) -> Rollout:
    """The rollout that a job asks for. Raises UserError."""
    run = job.named_run()
    activity.say(loading(run, worlds))
    from worker.learning.distributed import use_cpu_threads

    use_cpu_threads(os.environ)
    from worker.telemetry.rollout import Rollout

    return Rollout.of(run, job.section, worlds, seed)


def target_of(job: Job, rollout: Rollout, ending: str) -> Path:
    """The file in ``recordings/`` of the run. Raises UserError where that can't be made."""
    folder = rollout.run.recordings
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: it can't be made ({error.strerror or error})") from error
    return folder / f"{rollout.checkpoint.name}-{(job.id or 'job')[:8]}{ending}"


def main() -> int:
    """Record on rank 0; the other ranks, if any, have nothing to do."""
    job = Job.from_env(os.environ, "record")
    if int(os.environ.get("RANK") or 0):
        return 0
    worlds, episodes = job.setting("worlds", 4), job.setting("episodes", 2)
    seed = job.setting("seed", 0, least=0) if "seed" in job.section else None
    activity = Activity()
    rollout = open_rollout(job, worlds, activity, seed)
    from worker.telemetry.recording import Recording

    stage = rollout.stage()
    end_startup()
    recording = Recording(target_of(job, rollout, ".mcap"), stage, rollout.facts(), rollout.attachments())
    policy = f"checkpoint {rollout.checkpoint.name} of run {rollout.run.name}"
    recording.log(f"{policy}: {counted(worlds, 'world')}, {counted(episodes, 'episode')} of each")
    most = episodes * rollout.task.max_episode_length
    for rows in rollout.steps(most):
        recording.write(rows)
        activity.count("recording: step", recording.steps, most)
        if recording.complete(episodes):
            break
    path = recording.finish()
    counts = f"{counted(recording.steps, 'step')}, {counted(recording.episodes, 'episode')}"
    print(f"recorded: {counts}, {path.stat().st_size / 1e6:.1f} MB\nwritten: {path}", flush=True)
    return 0


if __name__ == "__main__":
    run_command(main)
