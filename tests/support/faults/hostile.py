"""Hostile jobs against a real controller and its local engine.

Each job tries one thing that must not work: to outlive its end, to stop or confuse what supervises it, to fill what others need. All of
a round run side by side with an honest neighbour. After a job's end nothing of it may be left, its reason must be right, and the
neighbour must not have noticed. Whatever a job starts ends by itself after a minute.
"""

from __future__ import annotations

import random
import re
import secrets
import signal
import time
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from shared_store.process.cgroups import own_group
from tests.conftest import Serving, submit_gang
from tests.support.processes import processes_running, signal_all
from tests.support.waiting import wait_for

_NATIVE = {"MUSTER_ON_CHILD_FAILURE": "fail"}
_PRELUDE = """
import ctypes, json, os, random, signal, subprocess, sys, time
random.seed({seed})
def sleep():
    os.execvp("sleep", ["sleep", "60", "0.{token}"])
def escape(times=3):
    for _ in range(times):  # a double fork into a session of its own, without the job's environment
        if not os.fork():
            os.setsid()
            if not os.fork():
                os.execve("/bin/sleep", ["sleep", "60", "0.{token}"], {{}})
            os._exit(0)
        os.wait()
def status(pid):
    return open(f"/proc/{{pid}}/stat").read().rpartition(")")[2].split()
"""
"""``sleep`` adds its arguments up: by the second one, a number of the job's own, its processes are found without their environment."""


@dataclass(frozen=True)
class Case:
    """One hostile job."""

    script: str
    reason: str
    """What ``statusReason`` has to match."""
    stop: bool = False
    """Whether it is stopped once it has printed ``ready``; else it ends by itself."""
    slow: bool = False
    """It takes a whole grace time."""
    needs_group: bool = False
    """Only a control group holds it."""


CASES = {
    "fork tree": Case(
        """
def grow(depth):
    for _ in range(3):
        if not os.fork():
            if random.random() < 0.5: os.setsid()
            if depth: grow(depth - 1)
            sleep()
grow(2)  # 39 processes
time.sleep(0.3)
""",
        "^done$",
    ),
    "escapes and fails": Case("escape(); sys.exit(3)", r"^main node: rank 0 exited with code 3"),
    "escapes and is stopped": Case("escape(); print('ready'); time.sleep(60)", "^hostile$", stop=True),
    "ignores SIGTERM": Case(
        "signal.signal(signal.SIGTERM, signal.SIG_IGN); escape(); print('ready'); time.sleep(60)",
        "^hostile$",
        stop=True,
        slow=True,
    ),
    "kills its supervisor": Case(
        "escape(); os.kill(os.getppid(), signal.SIGKILL); time.sleep(60)",
        r"^main node: the supervisor died without an outcome",
    ),
    "kills its shim": Case(
        "escape(); os.kill(int(status(os.getppid())[1]), signal.SIGKILL); time.sleep(60)",
        r"^main node: the supervisor died without an outcome",
        needs_group=True,
    ),
    "stops its supervisor": Case(
        "print('ready', flush=True); time.sleep(0.3); os.kill(os.getppid(), signal.SIGSTOP); escape(); time.sleep(60)",
        "^hostile$",
        stop=True,
    ),
    "stops its shim": Case(
        "print('ready', flush=True); os.kill(int(status(os.getppid())[1]), signal.SIGSTOP); escape(); time.sleep(0.5); sys.exit(3)",
        r"^hostile$",
        stop=True,
        slow=True,
    ),
    "floods its output": Case(
        "end = time.time() + 1\nwhile time.time() < end: os.write(1, b'y\\n' * 4096)",
        "^done$",
    ),
    "garbage for progress": Case(
        """
os.set_blocking(fd := int(os.environ["MUSTER_PROGRESS_FD"]), True)
for junk in (b'[1]\\n1\\nnull\\n"x"\\n', b'{"iteration": "x"}\\n{"iteration": 1e400}\\n', b"[" * 200000, os.urandom(500000), b"\\n{"):
    os.write(fd, junk)
escape()
""",
        "^done$",
    ),
    "a huge error file": Case(
        """
with open(os.environ["TORCHELASTIC_ERROR_FILE"], "w") as file:
    file.write('{"message": "' + "x" * (random.choice((8, 32, 60)) << 20) + '"}')
sys.exit(3)
""",
        r"^main node: rank 0 exited with code 3",
    ),
    "closes its pipes": Case(
        "os.closerange(0, 256); escape(); time.sleep(0.3); os._exit(4)", r"^main node: rank 0 exited with code 4"
    ),
    "another name and place": Case(
        "os.chdir('/'); ctypes.CDLL(None).prctl(15, b'muster-stuck', 0, 0, 0); escape(); time.sleep(0.3); sys.exit(5)",
        r"^main node: rank 0 exited with code 5",
    ),
}
_NEIGHBOUR = "import os, time\nwhile not os.path.exists({over!r}): print('tick', flush=True); time.sleep(0.1)"


def hostile_round(home: Path, seed: int, *, slow: bool = True) -> tuple[Counter[str], list[str]]:
    """Run every case once beside a neighbour, on a controller with a home of its own.

    Args:
        home: Directory that is not there yet.
        seed: Of the order and of what the jobs draw.
        slow: Whether to run those cases, too, that take a whole grace time.

    Returns:
        How often each case ran, and what was wrong; empty if nothing was.
    """
    draw = random.Random(seed)
    cases = [name for name, case in CASES.items() if slow or not case.slow]
    if not own_group():
        cases = [name for name in cases if not CASES[name].needs_group]
    draw.shuffle(cases)
    home.mkdir(parents=True)
    over, violations, tokens = home / "over", list[str](), dict[str, str]()
    serving = Serving(home, "--cpus", "64")
    try:
        neighbour = submit_gang(serving.client, _NEIGHBOUR.format(over=str(over)), name="neighbour", env=_NATIVE)
        jobs = {}
        for name in cases:
            # not drawn from the seed: another round of the same seed may run on this machine
            tokens[name] = f"{secrets.randbelow(10**17):017d}"
            prelude = _PRELUDE.format(seed=draw.randrange(2**31), token=tokens[name])
            jobs[name] = submit_gang(serving.client, prelude + CASES[name].script, name="hostile", env=_NATIVE)
        for name in cases:
            if CASES[name].stop:
                wait_for(partial(_is_ready, serving, jobs[name]), 60, f"{name}: ready")
                time.sleep(0.5)
                serving.client.batch("TerminateJob", jobId=jobs[name], reason="hostile")
        for name in cases:
            violations += _judge(name, serving.wait(jobs[name], timeout=90), tokens[name])
        over.touch()
        detail = serving.wait(neighbour)
        if detail["status"] != "SUCCEEDED" or len(detail["attempts"]) != 1:
            violations.append(f"the neighbour is {detail['status']} after {len(detail['attempts'])} attempts")
        if kept := sorted(path.name for path in (home / "supervisors").iterdir()):
            violations.append(f"kept of supervisors: {', '.join(kept)}")
        if groups := [
            group for job in jobs.values() for group in Path(own_group() or "/nowhere").glob(f"muster-{job}-*")
        ]:
            violations.append(f"control groups left: {', '.join(map(str, groups))}")
    finally:
        serving.close()
        for token in tokens.values():
            signal_all(_left(token), signal.SIGKILL)
    return Counter(cases), violations


def _is_ready(serving: Serving, job: str) -> bool:
    return "ready" in serving.log(job)


def _judge(name: str, detail: dict[str, Any], token: str) -> list[str]:
    """What is wrong with a job that has just ended."""
    found, reason = [], detail["statusReason"]
    if not re.search(CASES[name].reason, reason):
        found.append(f"{name}: its reason is {reason[:200]!r}")
    if len(reason) > 1024:
        found.append(f"{name}: its reason has {len(reason)} characters")
    if left := _left(token):
        found.append(f"{name}: {len(left)} processes are left")
    return found


def _left(token: str) -> list[int]:
    """Pids of the processes with the token in their command line."""
    return processes_running(f"\0000.{token}")
