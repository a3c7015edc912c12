"""``python -P -m worker.fork_server DESCRIPTOR``: imports what ranks of Muster's own commands import, once, and forks nodes.

It is the child of a local engine, and ends with it. See :mod:`shared_store.process.forking`.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import runpy
import signal
import socket
import sys
import traceback
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from shared_store.process import shim, tether
from shared_store.process.forking import PADDING, RANKS, receive, send
from worker.settings.deferred_imports import defer_imports

_IMPORTED = (
    *("worker.learning.distributed", "worker.learning.leaving"),
    *("worker.learning.memory_estimate", "worker.learning.training"),
    *("worker.tasks.library.cartpole", "worker.learning.ppo.fused", "worker.telemetry.tap"),
    *("worker.evaluation.final_evaluation", "worker.evaluation.episodes"),
)
"""What most ranks import; nothing that initialises CUDA or starts a thread, since neither survives a fork."""


def main(descriptor: str) -> int:
    """Import, then fork a node for each request. Returns at the end of the requests."""
    tether.follow(os.getppid())
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal sends it to the command's whole group
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the engine learns of a shim's end by its file
    gc.disable()
    defer_imports()
    for name in _IMPORTED:
        import_module(name)
    gc.freeze()
    channel = socket.socket(fileno=int(descriptor))
    channel.set_inheritable(False)
    while (request := receive(channel)) is not None:
        message, descriptors = request
        if "module" in message:
            channel.close()
            _become_program(message, descriptors)
        (errors,) = descriptors
        pid = os.fork()
        if not pid:
            channel.close()
            with _dying():
                _become_shim(message, errors)
        os.close(errors)
        send(channel, {"pid": pid})
    return 0


@contextlib.contextmanager
def _dying() -> Any:
    """End a forked process where its own code fails: it must not go on as its parent."""
    try:
        yield
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
    os._exit(1)


def _become_shim(message: Mapping[str, Any], errors: int) -> NoReturn:
    """Become the shim of a node, with a supervisor below it.

    Args:
        message: ``command`` and ``environment`` of the shim, ``directory`` where both run, ``ranks`` of the node.
        errors: Its standard error.
    """
    command, environment = message["command"], message["environment"]
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.setsid()
    nothing = os.open(os.devnull, os.O_RDWR)
    for target, source in enumerate((nothing, nothing, errors)):
        os.dup2(source, target)
    os.chdir(message["directory"])
    _, _, _, _, _, group, files, _, *supervisor = command
    me = os.getpid()
    pid = os.fork()
    if not pid:
        with _dying():
            shim.enter(me, group, int(files))
            ranks = [_fork_rank() for _ in range(message["ranks"])]
            os.environ.clear()
            os.environ.update(environment, **{RANKS: ",".join(f"{rank}:{end}" for rank, end in ranks)})
            tether.become(supervisor)
    os.execve(command[0], command, {**environment, shim.FORKED: str(pid)})


def _fork_rank() -> tuple[int, int]:
    """Fork a rank of this supervisor: its pid, and the descriptor at which it waits for the supervisor's word."""
    parent = os.getpid()
    own, other = socket.socketpair()
    pid = os.fork()
    if not pid:
        own.close()
        with _dying():
            tether.follow(parent)
            os.setsid()
            other.send(b"+")  # from now on its supervisor can signal it
            if (request := receive(other)) is None:  # its supervisor starts no rank
                os._exit(0)
            other.close()
            _become_rank(*request)
    other.close()
    own.recv(1)
    own.set_inheritable(True)
    return pid, own.detach()


def _become_program(message: Mapping[str, Any], streams: Sequence[int]) -> NoReturn:
    """Become a part of the worker that the command runs by itself: ``module`` with ``arguments`` and ``environment``, in ``directory``."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    _run(message["module"], message["arguments"], message["environment"], message["directory"], streams)


def _become_rank(message: Mapping[str, Any], descriptors: Sequence[int]) -> NoReturn:
    """Become a rank.

    Args:
        message: ``module``, its ``environment`` and its ``directory`` (None: where this process is).
        descriptors: Its standard streams, and that of its messages.
    """
    *streams, progress = descriptors
    environment = {**message["environment"], "MUSTER_PROGRESS_FD": str(progress)}
    _run(message["module"], [], environment, message["directory"], streams)


def _run(
    module: str, arguments: Sequence[str], environment: Mapping[str, str], directory: str | None, streams: Sequence[int]
) -> NoReturn:
    """Run a module as a program, as a new interpreter would: with these variables, in this directory, with these standard streams."""
    # what the interpreter sets when it starts
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGPIPE, signal.SIGXFSZ):
        signal.signal(number, signal.SIG_IGN)
    for target, source in enumerate(streams):
        os.dup2(source, target)
        os.close(source)
    if directory:
        os.chdir(directory)
    os.environ.clear()
    os.environ.update(environment)
    command = ["python", "-P", "-m", module, *arguments]
    _show(os.environ, command)
    import numpy

    numpy.random.seed()  # the state of its global generator was forked, too
    sys.argv[1:], sys.orig_argv = arguments, command
    code: Any = None
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as leaving:
        code = leaving.code
    sys.stdout.flush()
    os._exit(code if isinstance(code, int) else bool(code))


def _show(environment: Mapping[str, str], command: Sequence[str]) -> None:
    """Show this process's command and variables in ``/proc``, where the kernel shows what the fork server was started with.

    It writes over :data:`PADDING`, as many variables as fit. The first is that by which a node's processes are found.
    """
    fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    arguments, arguments_end, first, last = map(int, fields[45:49])  # arg_start to env_end in proc(5)
    started_with = ctypes.string_at(first, last - first).split(b"\0")
    padding = next(each for each in started_with if each.startswith(PADDING.encode()))
    room = len(padding)
    shown = bytearray()
    for name in sorted(environment, key=lambda name: (name != "MUSTER_GANG", name)):
        variable = f"{name}={environment[name]}\0".encode()
        if variable[:-1] not in started_with and len(shown) + len(variable) <= room:
            shown += variable
    at = first + sum(len(each) + 1 for each in started_with[: started_with.index(padding)])
    ctypes.memmove(at, bytes(shown.ljust(room, b"\0")), room)
    room = arguments_end - arguments
    ctypes.memmove(arguments, b"\0".join(each.encode() for each in command)[: room - 1].ljust(room, b"\0"), room)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
