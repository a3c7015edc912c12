"""The Python and native stacks of a process, taken from outside, even of a frozen one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

_SECONDS = 15.0


def state_of(pid: int) -> str:
    """The kernel's word for what the process does: ``R`` runs, ``S`` sleeps, ``D`` waits for a device, ``T`` is stopped, ``Z`` is dead."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return "Z"


def dump_stacks(pid: int, *, speaks: bool = False) -> list[str]:
    """The stacks of every thread of ``pid`` as lines.

    py-spy reads them through ptrace, with native frames where the process can be paused. Where that is not allowed, a process of
    ours (``speaks``) is asked to print its own Python stacks on stderr (SIGUSR1, ``faulthandler``); others keep their secret.
    """
    spy = Path(sys.executable).parent / "py-spy"
    stopped = state_of(pid) in "Tt"
    # a stopped process can't be paused once more; it holds still anyway
    variants = [["--nonblocking"]] if stopped else [["--native"], [], ["--nonblocking"]]
    problem = f"{spy} is not installed"
    for options in variants if spy.exists() else []:
        try:
            command = [str(spy), "dump", *options, "--pid", str(pid)]
            done = subprocess.run(command, capture_output=True, text=True, timeout=_SECONDS)
        except (OSError, subprocess.TimeoutExpired) as error:
            problem = str(error)
            continue
        if done.returncode == 0:
            return [line for line in done.stdout.splitlines() if line.strip()]
        problem = next((line.strip() for line in reversed(done.stderr.splitlines()) if line.strip()), problem)
    if speaks and not stopped:
        os.kill(pid, signal.SIGUSR1)
        return [
            f"stacks could not be read from outside ({problem}); the process was asked to print its Python stacks itself"
        ]
    return [f"stacks could not be read ({problem})"]
