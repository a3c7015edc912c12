"""The tether of a process: a command that dies with the process that started it, ``python -I -S tether.py PARENT IGNORED GROUP COMMAND ...``.

It is not a shell: a shell drops environment variables with names that it does not allow, such as ``my.var``. It is a separate program,
not a ``preexec_fn``: Python must not run between fork and exec in a process with threads, since a thread
that the child lacks may hold one of Python's locks (seen with CPython 3.11: child and parent wait forever). Linux only.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence

TYPE_CHECKING = False
if TYPE_CHECKING:
    import subprocess
    from typing import Any

_PR_SET_PDEATHSIG = 1
_PR_SET_PTRACER = 0x59616D61


def tied(command: Sequence[str], ignoring: Sequence[int] = (), group: str = "") -> list[str]:
    """The command line that runs ``command`` so that the kernel kills it when this process dies, however it dies.

    The signal is tied to the *thread* that forks (``prctl(2)``), so start it from one that lives as long as the process. All signals
    have their default action, except those in ``ignoring``. ``group`` is the directory of a control group that the command enters; where
    it can't be entered, one line on standard error says so, and the command runs outside.
    """
    ignored = ",".join(str(int(number)) for number in ignoring)
    return [sys.executable, "-I", "-S", __file__, str(os.getpid()), ignored, group, *command]


def start_tied(command: Sequence[str], ignoring: Sequence[int] = (), **options: Any) -> subprocess.Popen[bytes]:
    """Start ``command`` with :func:`tied` and ``options`` of ``Popen``. It ignores the signals in ``ignoring`` from the start, because
    Slurm sends SIGTERM to every process of a step, whatever its session.
    """
    import subprocess  # not at the top: this program itself does not need it

    before = signal.pthread_sigmask(signal.SIG_BLOCK, ignoring)
    try:
        return subprocess.Popen(tied(command, ignoring), **options)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def follow(parent: int) -> None:
    """Make the kernel kill this process, also after an exec, when its parent, ``parent``, dies.

    The parent may read its stacks, also under Yama's ptrace_scope 1.
    """
    import ctypes  # not at the top: callers that only start commands do not need it

    libc = ctypes.CDLL(None)
    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    libc.prctl(_PR_SET_PTRACER, parent, 0, 0, 0)
    if os.getppid() != parent:  # it died before the request to the kernel
        os._exit(1)


def enter(parent: str, ignored: str, group: str) -> None:
    """Be tied to ``parent``, in the control group ``group`` if that can be entered, with the signals of :func:`tied`."""
    follow(int(parent))
    if group:
        try:
            os.write(os.open(f"{group}/cgroup.procs", os.O_WRONLY | os.O_CLOEXEC), b"0")
        except OSError as error:
            print(f"{group}/cgroup.procs: {error.strerror}", file=sys.stderr, flush=True)
    # Python ignores some, and a parent may: nohup SIGHUP, a shell SIGINT of what it runs in the background
    for number in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP}:
        signal.signal(number, signal.SIG_IGN if str(int(number)) in ignored.split(",") else signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, [])


def main(parent: str, ignored: str, group: str, *command: str) -> None:
    """Become ``command``, tied to ``parent``."""
    enter(parent, ignored, group)
    become(command)


def become(command: Sequence[str]) -> None:
    """Become ``command``; if that fails, exit with 127 and one line on standard error."""
    try:
        os.execvp(command[0], list(command))
    except OSError as error:
        print(f"can't start {command[0]!r}: {error.strerror}", file=sys.stderr, flush=True)
        os._exit(127)


if __name__ == "__main__":
    main(*sys.argv[1:])
