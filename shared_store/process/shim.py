"""A node's shim, the parent of its supervisor: ``python -I -S shim.py PARENT GROUP FILES EXIT COMMAND ...``.

It is a subreaper: processes of the node whose parent dies are re-parented to it, not to init. If control groups can be created, it
puts the node into one. When the supervisor ends, however it ends, the shim kills and reaps all remaining processes and exits with the
supervisor's exit code. It passes on SIGTERM, SIGINT and SIGHUP.

Guarantee: no process survives the supervisor's end. If a job also kills the shim, the engine ends the node, by its control group or
else by the marks in its environment. One gap remains: a job that kills the shim and whose processes have removed the marks (``env -i``)
and are in no group (none exists, or the job's user may move processes out of it).
After ten seconds, the shim names a process that survives SIGKILL (state D) on standard error; it then renames itself to ``STUCK``, for
the engine to see, and stays until that process is gone. Linux only.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Sequence

STUCK = "muster-stuck"
"""Process name of a shim whose supervisor has ended, while a process of the node can't be killed."""
SCRATCH = "muster-node-{pid}-"
"""Prefix of a supervisor's temporary directory, by its pid: the shim removes that of a killed supervisor."""
_PASSED_ON = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
_ORPHANED = signal.SIGUSR1
"""Signal from the kernel to the shim when the process that it is tied to dies."""
FORKED = "MUSTER_FORKED_SUPERVISOR"
"""Variable with the pid of a supervisor, a child, that is there already (:mod:`shared_store.process.forking`)."""
_DIGITS = 3
"""Of an exit code."""
_PR_SET_PDEATHSIG, _PR_SET_NAME, _PR_SET_CHILD_SUBREAPER = 1, 15, 36


def shimmed(
    command: Sequence[str], group: str = "", *, tied_to: int = 0, files: int = 0, exit_file: str = ""
) -> list[str]:
    """The command line that runs ``command``, a node's supervisor, below a shim.

    Args:
        command: The command. It keeps the shim's standard streams and environment.
        group: Directory of a control group to create for it; empty for none.
        tied_to: Pid of the parent; the node ends when the parent's thread that starts the shim dies; 0 for none.
        files: Soft limit of open files for the node, at most the hard one; 0 for the limit of the process that starts the shim.
        exit_file: The file of :func:`make_exit_file`, for engines that outlive the shim's parent.
    """
    return [sys.executable, "-I", "-S", __file__, str(tied_to), group, str(files), exit_file, *command]


def group_of(command: Sequence[bytes]) -> str | None:
    """The control group (empty for none) in a command line that :func:`shimmed` made; None for any other command line."""
    is_shim = len(command) > 6 and os.path.basename(command[3]) == os.path.basename(__file__).encode()
    return os.fsdecode(command[5]) if is_shim else None


def make_exit_file(path: str) -> None:
    """Make the file in which a shim leaves its exit code, of its later size: at the end the volume may be full. Raises OSError."""
    with open(path, "w") as file:
        file.write(" " * _DIGITS)


def exit_code_in(path: str) -> int | None:
    """The exit code that a shim has left in its file; None where there is none."""
    try:
        with open(path) as file:
            return int(file.read())
    except (OSError, ValueError):
        return None


def main(parent: str, group: str, files: str, exit_file: str, *command: str) -> None:
    """Run ``command`` to its end; exits with its exit code, 128 + n for signal n."""
    import ctypes

    libc = ctypes.CDLL(None)
    libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # where it is ignored, the kernel keeps no exit code
    watched = {signal.SIGCHLD, _ORPHANED, *_PASSED_ON}
    signal.pthread_sigmask(signal.SIG_BLOCK, watched)
    if int(parent):
        libc.prctl(_PR_SET_PDEATHSIG, _ORPHANED, 0, 0, 0)
        if os.getppid() != int(parent):  # it died before the request to the kernel
            os._exit(1)
    sys.path.append(os.path.abspath(__file__).rsplit("/", 3)[0])
    me = os.getpid()
    supervisor = int(os.environ.get(FORKED, 0))
    if supervisor:
        os.kill(me, signal.SIGCHLD)  # it may have ended before the mask was set
    else:
        supervisor = os.fork()  # the process has only one thread, so Python may run in the child
        if not supervisor:
            from shared_store.process import tether

            enter(me, group, int(files))
            tether.become(command)
    code = _wait(supervisor, watched)
    if _has_children() or not _removed(group):
        _end_the_rest(group, lambda: libc.prctl(_PR_SET_NAME, STUCK.encode(), 0, 0, 0))
    memory = os.environ.get("MUSTER_MEMORY_GROUP", "")
    if os.path.isdir(memory):
        from shared_store.process.cgroups import remove_group

        remove_group(memory)
    if code > 128:  # the supervisor did not get to remove it
        _remove_scratch(supervisor)
    if exit_file:
        try:
            os.write(os.open(exit_file, os.O_WRONLY | os.O_NOFOLLOW), f"{code:{_DIGITS}}".encode())
        except OSError:
            pass  # the engine has forgotten the node
    os._exit(code)


def enter(shim: int, group: str, files: int) -> None:
    """Be the supervisor's process of the node with this shim; what it starts then is in the node's control group.

    Args:
        shim: Pid of the parent.
        group: As in :func:`shimmed`.
        files: As in :func:`shimmed`.
    """
    import resource

    from shared_store.process import tether

    os.setsid()
    if files:
        resource.setrlimit(resource.RLIMIT_NOFILE, (files, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    if group:
        try:
            os.mkdir(group)
        except OSError:
            pass  # it exists, or the tether reports that it can't be entered; the shim finds the remaining processes without it
    tether.enter(str(shim), "", group)


def _wait(supervisor: int, watched: set[signal.Signals]) -> int:
    """Pass signals on and reap orphans until the supervisor has ended; its exit code."""
    while True:
        number = signal.sigwait(watched)
        if number in _PASSED_ON:
            os.kill(supervisor, number)
            os.kill(supervisor, signal.SIGCONT)  # a job may have stopped it
        elif number == _ORPHANED:
            os.kill(supervisor, signal.SIGKILL)
        else:
            while True:
                pid, status = os.waitpid(-1, os.WNOHANG)
                if pid == supervisor:
                    code = os.waitstatus_to_exitcode(status)
                    return code if code >= 0 else 128 - code
                if not pid:
                    break


def _end_the_rest(group: str, call_stuck: Callable[[], object]) -> None:
    """Kill and reap all remaining processes of the node; returns when all are gone."""
    from shared_store.process.cgroups import remove_group
    from shared_store.process.node_processes import end_descendants
    from shared_store.process.processes import unkillable

    is_reported = False
    while True:
        try:
            stuck = end_descendants(group=group)
        except OSError:  # /proc can't be read now: the machine has no descriptors left
            time.sleep(0.2)
            continue
        if not stuck:
            break
        if not is_reported:
            is_reported = True
            print(f"muster: {unkillable(stuck)}", file=sys.stderr, flush=True)
            call_stuck()
    remove_group(group)


def _removed(group: str) -> bool:
    """Remove the group; False if it is not empty."""
    try:
        if group:
            os.rmdir(group)
    except FileNotFoundError:
        pass
    except OSError:
        return False
    return True


def _has_children() -> bool:
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return False
    return True


def _remove_scratch(supervisor: int) -> None:
    import glob
    import shutil
    import tempfile

    for path in glob.glob(os.path.join(glob.escape(tempfile.gettempdir()), SCRATCH.format(pid=supervisor) + "*")):
        shutil.rmtree(path, ignore_errors=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
