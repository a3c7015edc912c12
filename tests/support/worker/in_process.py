"""A command of the worker in the test's own process: the simulation, whose import takes seconds of a processor, is here already."""

from __future__ import annotations

import faulthandler
import gc
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from subprocess import CompletedProcess

import pytest
import torch

from worker.learning.job import run_command

_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR2)


@contextmanager
def _undone() -> Iterator[None]:
    """What a command changes in its process is afterwards as it was."""
    handlers = {number: signal.getsignal(number) for number in _SIGNALS}
    interval, threads, path = sys.getswitchinterval(), torch.get_num_threads(), list(sys.path)
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        faulthandler.unregister(signal.SIGUSR1)
        sys.setswitchinterval(interval)
        torch.set_num_threads(threads)
        sys.path[:] = path
        gc.enable()


def call_worker(body: Callable[[], int], environment: Mapping[str, str], *arguments: str) -> CompletedProcess[str]:
    """Run ``body``, the ``main`` of a module of the worker, to its end: what ``python -m MODULE ARGUMENTS`` would say and exit with.

    One rank alone; what has to be killed, or to meet others, is a process of its own.
    """

    def leave(code: int) -> None:
        raise SystemExit(code)

    with (
        tempfile.TemporaryFile("w+") as output,
        tempfile.TemporaryFile("w+") as errors,
        pytest.MonkeyPatch.context() as patch,
        _undone(),
        redirect_stdout(output),
        redirect_stderr(errors),
    ):
        for name, value in environment.items():
            patch.setenv(name, value)
        patch.setattr(sys, "argv", ["worker", *arguments])
        patch.setattr(os, "_exit", leave)
        with pytest.raises(SystemExit) as ended:
            run_command(body)
        texts = [(file.seek(0), file.read())[1] for file in (output, errors)]
    return CompletedProcess(arguments, int(ended.value.code or 0), *texts)
