"""``python -m worker.record``: record a checkpoint's policy on fresh worlds as an MCAP file.

It writes ``recordings/<checkpoint>-<job>.mcap`` of the run that the job names; its directory entry appears when the file is whole.
"""

from __future__ import annotations

import os

from shared_store.contract.error_text import counted
from worker.learning.job import Job, end_startup, run_command
from worker.settings.errors import UserError


def main() -> int:
    """Record on rank 0; the other ranks, if any, have nothing to do."""
    job = Job.from_env(os.environ, "record")
    if int(os.environ.get("RANK") or 0):
        return 0
    run, worlds, episodes = job.named_run(), job.setting("worlds", 4), job.setting("episodes", 2)
    from worker.telemetry.progress import Activity, loading

    activity = Activity()
    activity.say(loading(run, worlds))
    from worker.learning.distributed import use_cpu_threads

    use_cpu_threads(os.environ)
    from worker.telemetry.recording import Recording
    from worker.telemetry.rollout import Rollout

    seed = job.setting("seed", 0, least=0) if "seed" in job.section else None
    rollout = Rollout.of(run, job.section, worlds, seed)
    stage = rollout.stage()
    end_startup()
    try:
        run.recordings.mkdir(exist_ok=True)
    except OSError as error:
        raise UserError(f"{run.recordings}: it can't be made ({error.strerror or error})") from error
    target = run.recordings / f"{rollout.checkpoint.name}-{(job.id or 'job')[:8]}.mcap"
    recording = Recording(target, stage, rollout.facts(), rollout.attachments())
    recording.log(
        f"checkpoint {rollout.checkpoint.name} of run {run.name}: {counted(worlds, 'world')}, {counted(episodes, 'episode')} of each"
    )
    most = episodes * rollout.task.max_episode_length
    for rows in rollout.steps(most):
        recording.write(rows)
        activity.count("recording: step", recording.steps, most)
        if recording.complete(episodes):
            break
    path = recording.finish()
    print(
        f"recorded: {counted(recording.steps, 'step')}, {counted(recording.episodes, 'episode')}, {path.stat().st_size / 1e6:.1f} MB",
        flush=True,
    )
    print(f"written: {path}", flush=True)
    return 0


if __name__ == "__main__":
    run_command(main)
