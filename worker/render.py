"""``python -m worker.render``: film a checkpoint's policy, or show some moments of it in one picture.

It writes ``recordings/<checkpoint>-<job>.<format>`` of the run that the job names.
"""

from __future__ import annotations

import os
import time
from importlib.util import find_spec
from typing import TYPE_CHECKING

from shared_store.contract.error_text import counted
from worker.learning.job import Job, end_startup, run_command
from worker.record import open_rollout, target_of
from worker.settings.errors import UserError
from worker.telemetry.progress import Activity

if TYPE_CHECKING:
    import numpy as np


def main() -> int:
    """Render on rank 0; the other ranks, if any, have nothing to do."""
    job = Job.from_env(os.environ, "render")
    if int(os.environ.get("RANK") or 0):
        return 0
    worlds = job.setting("worlds", 4)
    width, height = job.setting("width", 640, least=64), job.setting("height", 360, least=64)
    seconds = job.section.get("seconds", 6.0)
    if not isinstance(seconds, int | float) or not 0 < seconds <= 600:
        raise UserError(f"seconds: expected a number above 0, at most 600, found {seconds!r}")
    ending = f".{job.section.get('format', 'gif')}"
    if ending == ".mp4" and find_spec("av") is None:
        raise UserError(
            "an .mp4 needs PyAV, which is not installed where the job ran: pip install 'muster[video]', or make a .gif"
        )
    activity = Activity()
    rollout = open_rollout(job, worlds, activity)
    from worker.telemetry.messages import tiled
    from worker.telemetry.picture import MOMENTS, STRIP, StageCamera, encode, pace, write

    camera = StageCamera(rollout.stage(rollout.task.device), width, height)
    end_startup()
    steps = max(1, round(seconds * rollout.config.control_hz))
    stride, rate = pace(rollout.config.control_hz, ending)
    is_still = ending == ".png"
    if is_still:
        stride = max(1, steps // MOMENTS)
    taken: list[np.ndarray] = []
    camera_seconds = 0.0
    for number, rows in enumerate(rollout.steps(steps)):
        activity.count("rendering: step", number + 1, steps)
        if number % stride == 0 and not (is_still and len(taken) == MOMENTS):
            started = time.perf_counter()
            taken.append(camera.take(rows.coordinates[-1]))
            camera_seconds += time.perf_counter() - started
    target = target_of(job, rollout, ending)
    data = encode([tiled(taken, *STRIP)] if is_still else taken, ending, rate)
    write(target, data)
    facts = f"{counted(worlds, 'world')}, {len(data) / 1e6:.2f} MB, {camera_seconds:.1f} s for the camera"
    print(f"rendered: {seconds:g} s of {facts}\nwritten: {target}", flush=True)
    return 0


if __name__ == "__main__":
    run_command(main)
