"""The reaper: what carries the marks of a process that died is ended, in whichever session it is; nothing else is."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from tests.conftest import alive, wait_for

OWNER = """
import time
from shared_store.reaper import start_reaper
reaper = start_reaper(["MUSTER_GANG=%s", "NODE_RANK=1"])
print(reaper.pid, flush=True)
time.sleep(600)
"""


@contextmanager
def sleeper(**env: str) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(["sleep", "600"], env={**os.environ, **env}, start_new_session=True)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def test_it_ends_what_a_killed_process_leaves_behind_and_nothing_else() -> None:
    gang = f"reaper-{os.getpid()}/1/1"
    owner = subprocess.Popen([sys.executable, "-c", OWNER % gang], stdout=subprocess.PIPE, text=True)
    assert owner.stdout is not None
    reaper = int(owner.stdout.readline())
    with (
        sleeper(MUSTER_GANG=gang, NODE_RANK="1") as mine,
        sleeper(MUSTER_GANG=gang, NODE_RANK="2") as other_node,
        sleeper(MUSTER_GANG=f"{gang}1", NODE_RANK="1") as other_gang,
    ):
        assert alive(reaper) and os.getsid(reaper) == reaper
        owner.send_signal(signal.SIGKILL)
        owner.wait()
        wait_for(lambda: not alive(reaper), 20, "the reaper has done its work")
        assert mine.wait(5) == -signal.SIGKILL
        assert other_node.poll() is None and other_gang.poll() is None
