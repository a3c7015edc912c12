"""A part of the worker that a command starts: it knows the run's store, and outlives no command."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import psutil
import pytest

from tests.support.waiting import wait_for

CALL = "import sys; from orchestrator.cli.recordings import run_worker; sys.exit(run_worker('timeit', '-n1', '-r1', sys.argv[1], run='/a/store/runs/it'))"


def command(statement: str) -> subprocess.Popen[str]:
    call = [sys.executable, "-c", CALL, statement]
    return subprocess.Popen(call, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


def test_it_finds_what_the_store_of_the_run_has() -> None:
    with command("import os; print(os.environ['MUSTER_STORE'])") as started:
        assert started.stdout is not None and started.stdout.read().startswith("/a/store\n")  # to its end
    assert started.returncode == 0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_it_ends_with_its_command(number: int) -> None:
    with command("import os, time; print(os.getpid(), flush=True); time.sleep(600)") as started:
        assert started.stdout is not None
        pid = int(started.stdout.readline())
        os.kill(started.pid, number)
        wait_for(lambda: not psutil.pid_exists(pid), what="the worker's end")
    assert started.returncode == (1 if number == signal.SIGTERM else -signal.SIGKILL)
