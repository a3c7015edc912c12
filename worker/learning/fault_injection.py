"""Fault injection, to prove that a run survives a crash.

``MUSTER_KILL_AT=N`` in a training job's environment: in the job's first attempt the main rank kills itself with SIGKILL right
after the gang has finished iteration N, before any of it is written: no metrics, no checkpoint. ``muster verify-resume`` sets it,
and a job from the Batch API may.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping

from worker.learning.job import Job
from worker.settings.errors import UserError


def kill_at(env: Mapping[str, str], job: Job) -> int | None:
    """The iteration after which this attempt dies; None: never. Raises UserError for a value other than an iteration."""
    text = env.get("MUSTER_KILL_AT")
    if not text:
        return None
    if not text.isdecimal() or int(text) < 1:
        raise UserError(f"MUSTER_KILL_AT is {text!r}; set it to the number of an iteration, from 1")
    return int(text) if job.epoch == job.job_epoch else None


def die() -> None:
    """End this process like a crash: no handler runs, nothing is flushed."""
    os.kill(os.getpid(), signal.SIGKILL)
