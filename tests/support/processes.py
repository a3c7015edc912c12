"""The processes that a test has to do with: found in ``/proc``, as a stranger would find them; ended, frozen and awaited."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from tests.support.waiting import wait_for

_ROLES = {"worker.supervisor": "supervisor", "worker.checkpoint_writer": "writer", "worker.train": "rank"}
_START = 19
"""Which field of :func:`_stat` is the start time."""


# -- one process ------------------------------------------------------------------------------------------------------


def alive(pid: int) -> bool:
    """Whether the process is there, and no zombie."""
    try:
        return _stat(pid)[0] not in "ZX"
    except OSError:
        return False


def parent(pid: int) -> int:
    """Pid of its parent. Raises OSError where the process is gone."""
    return int(_stat(pid)[1])


def command(pid: int) -> list[str]:
    """The words of its command line; an empty one where the process is gone."""
    return _items(pid, "cmdline")


def environment(pid: int) -> dict[str, str]:
    """The environment that it was started with; empty where the process is gone or belongs to another user."""
    return dict(item.split("=", 1) for item in _items(pid, "environ") if "=" in item)


def session_of(pid: int) -> int:
    """Pid of the leader of its session; 0 where the process is gone."""
    try:
        return os.getsid(pid)
    except OSError:
        return 0


def has_signal(pid: int, mask: str, number: int) -> bool:
    """Whether a signal is in a mask of the process: ``SigCgt`` of those that it catches, ``ShdPnd`` of those that it has yet to see."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    found = next(line.split()[1] for line in lines if line.startswith(mask))
    return bool(int(found, 16) >> (number - 1) & 1)


def _stat(pid: int) -> list[str]:
    """State, parent and so on: what follows the name in ``/proc/PID/stat``."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


def _items(pid: int, file: str) -> list[str]:
    try:
        return os.fsdecode(Path(f"/proc/{pid}/{file}").read_bytes()).split("\0")
    except OSError:
        return [""]


# -- finding ----------------------------------------------------------------------------------------------------------


def find_processes(is_expected: Callable[[int], bool]) -> list[int]:
    """Pids of all living processes that are wanted, this one left out."""
    pids = [int(entry) for entry in os.listdir("/proc") if entry.isdigit()]
    return [pid for pid in pids if pid != os.getpid() and is_expected(pid) and alive(pid)]


def processes_of(home: Path, **variables: str) -> list[int]:
    """Pids of all whose environment names a store below ``home``, and has these variables."""

    def is_expected(pid: int) -> bool:
        found = environment(pid)
        return f"{found.get('MUSTER_STORE')}/".startswith(f"{home}/") and variables.items() <= found.items()

    return find_processes(is_expected)


def processes_of_job(job: str, **variables: str) -> list[int]:
    """Pids of all that carries the job's id, and these variables, on this machine: in containers, too."""
    requested = {"MUSTER_JOB_ID": job, **variables}.items()
    return find_processes(lambda pid: requested <= environment(pid).items())


def processes_running(text: str) -> list[int]:
    """Pids of all processes with ``text`` in their command line; zero bytes separate its words."""
    return find_processes(lambda pid: text in "\0".join(command(pid)))


@dataclass(frozen=True)
class Process:
    """A living process of a gang; pid and start time [clock ticks since boot] name it for ever."""

    pid: int
    start: str
    role: str
    """``supervisor``, ``rank``, ``writer`` or ``other``."""
    gang: str
    """``<job>/<attempt>/<epoch>``, as the engine called it."""
    number: int
    """Of the rank, or of the rank that the writer serves, or of the node."""

    def strike(self, number: int) -> bool:
        """Send signal ``number``; False where the process is gone already."""
        try:
            if _stat(self.pid)[_START] != self.start:
                return False
            os.kill(self.pid, number)
        except OSError:
            return False
        return True

    def __str__(self) -> str:
        return f"{self.role} {self.number} (pid {self.pid})"


def gang_members(home: Path, role: str = "", number: int | None = None) -> list[Process]:
    """What runs for a store below ``home``: all of it, or that of one role, or of one role and number."""
    found, parents = [], {}
    for pid in processes_of(home):
        variables = environment(pid)
        with contextlib.suppress(OSError):
            stat = _stat(pid)
            parents[pid] = int(stat[1])
            its_role = next((_ROLES[word] for word in command(pid)[:5] if word in _ROLES), "other")
            its_number = int(variables.get("RANK") or variables.get("AWS_BATCH_JOB_NODE_INDEX") or -1)
            found.append(Process(pid, stat[_START], its_role, variables.get("MUSTER_GANG", ""), its_number))
    ranks = {process.pid for process in found if process.role == "rank"}
    forked = {pid for pid in ranks if parents[pid] in ranks}  # writers to be
    found = [replace(process, role="other") if process.pid in forked else process for process in found]
    return [each for each in found if role in ("", each.role) and number in (None, each.number)]


# -- ending and freezing ----------------------------------------------------------------------------------------------


def signal_all(pids: Iterable[int], number: int) -> None:
    """Send signal ``number`` to each that is still there."""
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)


def await_end(*pids: int, timeout: float = 20) -> None:
    """Wait until none of the processes is left."""
    wait_for(lambda: not any(alive(pid) for pid in pids), timeout, f"end of {pids}")


def end_all(home: Path) -> None:
    """SIGKILL for whatever is left below ``home``."""

    def ended() -> bool:
        left = processes_of(home)
        signal_all(left, signal.SIGKILL)
        return not left

    wait_for(ended, 20, f"end of all below {home}")


def kill_rank(job: str, rank: int) -> None:
    """SIGKILL to one rank."""
    signal_all(processes_of_job(job, RANK=str(rank)), signal.SIGKILL)


def kill_supervisor(job: str, node: int) -> None:
    """SIGKILL to the supervisor of one node: what started its rank, which has what is not of the job for a parent."""
    ranks = processes_of_job(job, RANK=str(node))
    for pid in ranks:
        with contextlib.suppress(OSError):
            if (supervisor := parent(pid)) not in ranks:
                os.kill(supervisor, signal.SIGKILL)


def freeze(job: str, node: int) -> None:
    """SIGSTOP to the supervisor of one node and all of its rank, as when its machine stands still."""
    ranks = processes_of_job(job, RANK=str(node))
    signal_all({*map(parent, ranks), *ranks}, signal.SIGSTOP)


@contextlib.contextmanager
def frozen(pid: int) -> Iterator[None]:
    """A process in state D that SIGKILL does not end until this is left: what version 1 of the freezer does."""
    directory = Path("/sys/fs/cgroup/freezer") / f"muster-test-{os.getpid()}"
    try:
        directory.mkdir()
        (directory / "cgroup.procs").write_text(str(pid))
    except OSError:
        pytest.skip("this process can't freeze others (cgroup v1 freezer)")
    try:
        (directory / "freezer.state").write_text("FROZEN")
        yield
    finally:
        (directory / "freezer.state").write_text("THAWED")
        wait_for(lambda: not (directory / "cgroup.procs").read_text(), 20, "an empty freezer")
        directory.rmdir()
