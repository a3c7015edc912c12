"""``python -m worker.render``: film a checkpoint's policy, or show some moments of it in one picture.

It writes ``recordings/<checkpoint>-<job>.<format>`` of the run that the job names.
"""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING

from shared_store.contract.error_text import counted
from worker.learning.job import Job, end_startup, run_command
from worker.settings.errors import UserError

if TYPE_CHECKING:
    import numpy as np


def main() -> int:
    """Render on rank 0; the other ranks, if any, have nothing to do."""
    job = Job.from_env(os.environ, "render")
    if int(os.environ.get("RANK") or 0):
        return 0
    run, worlds = job.named_run(), job.setting("worlds", 4)
    width, height = job.setting("width", 640, least=64), job.setting("height", 360, least=64)
    seconds = job.section.get("seconds", 6.0)
    if not isinstance(seconds, int | float) or not 0 < seconds <= 600:
        raise UserError(f"seconds: expected a number above 0, at most 600, found {seconds!r}")
    ending = f".{job.section.get('format', 'gif')}"
    from worker.telemetry.progress import Activity, loading

    activity = Activity()
    activity.say(loading(run, worlds))
    from worker.learning.distributed import use_cpu_threads

    use_cpu_threads(os.environ)
    from worker.telemetry import picture
    from worker.telemetry.rollout import Rollout

    picture.check_film(ending)
    rollout = Rollout.of(run, job.section, worlds)
    stage = rollout.stage(rollout.task.device)
    end_startup()
    rate = rollout.config.control_hz
    steps = max(1, round(seconds * rate))
    stride, frames = picture.pace(rate, ending)
    if ending == ".png":
        stride = max(1, steps // picture.MOMENTS)
    camera = picture.StageCamera(stage, width, height)
    taken: list[np.ndarray] = []
    spent = 0.0
    for number, rows in enumerate(rollout.steps(steps)):
        activity.count("rendering: step", number + 1, steps)
        if number % stride == 0 and not (ending == ".png" and len(taken) == picture.MOMENTS):
            started = time.perf_counter()
            taken.append(camera.take(rows.coordinates[-1]))
            spent += time.perf_counter() - started
    if ending == ".png":
        taken = [picture.strip(taken)]
    run.recordings.mkdir(exist_ok=True)
    target = run.recordings / f"{rollout.checkpoint.name}-{(job.id or 'job')[:8]}{ending}"
    data = picture.encode(taken, ending, frames)
    picture.write(target, data)
    print(
        f"rendered: {seconds:g} s of {counted(worlds, 'world')}, {len(data) / 1e6:.2f} MB, {spent:.1f} s for the camera",
        flush=True,
    )
    print(f"written: {target}", flush=True)
    return 0


if __name__ == "__main__":
    run_command(main)
