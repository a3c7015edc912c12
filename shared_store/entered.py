"""Runs a command in a control group: ``python -I -S entered.py FILE COMMAND ...``, with FILE the group's ``cgroup.procs``.

It is no shell, which would drop variables of the environment that have names that it can't have itself, such as ``my.var``.
"""

from __future__ import annotations

import os
import sys


def entered(processes: str) -> list[str]:
    """The command line, before a command, that enters the group of ``processes`` (its ``cgroup.procs``) and becomes the command."""
    return [sys.executable, "-I", "-S", __file__, processes]


def main(processes: str, *command: str) -> None:
    """Become ``command``, outside the group where that can't be entered; if that fails, exit with 127 and one line on standard error."""
    try:
        file = os.open(processes, os.O_WRONLY)
        os.write(file, b"0")
        os.close(file)
    except OSError as error:
        print(f"{processes}: {error.strerror}", file=sys.stderr, flush=True)
    with open("/proc/self/environ", "rb") as given:  # Python has added LC_CTYPE to its own where the locale is C
        environment = dict(each.split(b"=", 1) for each in given.read().split(b"\0") if b"=" in each)
    try:
        os.execvpe(command[0], command, environment)
    except OSError as error:
        print(f"can't start {command[0]!r}: {error.strerror}", file=sys.stderr, flush=True)
        os._exit(127)


if __name__ == "__main__":
    import signal

    for number in (signal.SIGPIPE, signal.SIGXFSZ):  # Python ignores them, and exec would hand that on
        signal.signal(number, signal.SIG_DFL)
    main(*sys.argv[1:])
