"""Ends a process with SIGKILL before each of its file operations in turn, one process an operation.

``python -m tests.support.shared_store.crashes MODULE:FUNCTION PREPARED WORK`` copies the directory PREPARED to ``WORK/<step>`` and calls
``FUNCTION(WORK/<step>)`` in a child that dies before its step-th operation, until a child lives to the end of the function.
"""

from __future__ import annotations

import importlib
import itertools
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

_OPERATIONS = {"open", "os.listdir", "os.mkdir", "os.remove", "os.rename", "os.rmdir", "os.scandir"}


def killed_at_every_step(action: Callable[[Path], None], prepared: Path, work: Path) -> list[Path]:
    """What each of the killed processes left, and last what the process left that was not killed."""
    name = f"{action.__module__}:{action.__name__}"
    command = [sys.executable, "-m", "tests.support.shared_store.crashes", name, str(prepared), str(work)]
    subprocess.run(command, cwd=Path(__file__).parents[3], check=True, timeout=60)
    left = sorted(work.iterdir())
    assert len(left) > 3, "the action does nothing that could be cut"
    return left


def _arm(fatal: int, root: Path) -> None:
    steps = itertools.count(1)

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        if event in _OPERATIONS and str(arguments[0]).startswith(str(root)) and next(steps) == fatal:
            os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)


def _main(name: str, prepared: Path, work: Path) -> None:
    module, _, function = name.partition(":")
    action = getattr(importlib.import_module(module), function)
    for step in itertools.count(1):
        root = work / f"{step:03d}"
        shutil.copytree(prepared, root)
        child = os.fork()
        if child == 0:
            code = 1
            try:
                _arm(step, root)
                action(root)
                code = 0
            finally:
                os._exit(code)
        status = os.waitpid(child, 0)[1]
        if not os.WIFSIGNALED(status):
            sys.exit(os.waitstatus_to_exitcode(status))


if __name__ == "__main__":
    _main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
