"""One rank: a process of the job's command, its output, and how it ended."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

from shared_store.contract.faults import fault_from, fault_in
from shared_store.contract.node import NodeContract
from shared_store.process.forking import module_of
from shared_store.process.tether import tied
from shared_store.volume.files import DamagedFile, json_object, read_json
from shared_store.volume.node_outcomes import FirstError
from worker.node.forked import ForkedRank

_PR_SET_CHILD_SUBREAPER = 36
_LONGEST_LINE = 65536
"""Bytes after which a line without an end is cut, so that a program that never prints a newline can't fill the memory."""
_LONGEST_MESSAGE = 65536
"""Bytes of a message on the progress pipe; a longer one is dropped."""
_LONGEST_VALUE = 1024
"""Characters of a text in such a message; the rest is cut."""
_TOO_LONG = b"\0"
"""Stands for the beginning of a message that is too long, until its end comes; no JSON begins with it."""
_MOST_VALUES = 100
"""Names that a rank may report in all; further ones are dropped."""
_LARGEST_NUMBER = 2**63
_LARGEST_ERROR_FILE = 2**20
"""Bytes; of a larger error file nothing is read."""
_PLACE_IN_CPP = re.compile(r"\[(?:enforce fail at )?[^\]\s]*\.(?:cc|cpp|cu|h):\d+\] ?")
_STACK_IN_CPP = re.compile(r"\n(?:Exception raised from |frame #\d+: |C\+\+ CapturedTraceback)")
"""What Gloo and NCCL add to a message: the C++ file of an error, and its stack."""


class Rank:
    """A process started for one rank of the gang. Times are Unix seconds."""

    def __init__(self, contract: NodeContract, local: int, error_file: Path) -> None:
        self.contract, self.local, self.error_file = contract, local, error_file
        self.number = contract.node_rank * contract.ranks_per_node + local
        self.running = False
        self.overdue = False
        """Killed because it did not leave in time."""
        self.requested = False
        """It was asked to end before it was seen to have ended: its end is not the cause of anything."""
        self.stuck: str | None = None
        """Names the processes of it that SIGKILL does not end, and where they are."""
        self.exit_code = 0
        self.signal_name: str | None = None
        self.ended = 0.0
        self.stalled: str | None = None
        """Its stacks when it had made no progress for too long."""
        self.progress: dict[str, Any] = {}
        """The newest of everything that it reported (:class:`worker.learning.reporter.Beacon`)."""
        self.last_report: float | None = None
        """Time of its last message about an iteration (monotonic [s]); None before the first and after the last iteration."""
        self.spoke = time.monotonic()
        """Time of its start or of its last message (monotonic [s])."""
        self._process: subprocess.Popen[bytes] | ForkedRank
        self._directory: Path | None = None
        self._beacon = b""
        self._partial = {"o": b"", "e": b""}
        self._stderr: deque[str] = deque(maxlen=200)

    @property
    def pid(self) -> int:
        return self._process.pid

    def environment(self) -> dict[str, str]:
        """The variables that torchrun sets (torch.distributed.elastic, 2.13), so that scripts written for it run unchanged."""
        contract = self.contract
        return {
            "RANK": str(self.number),
            "LOCAL_RANK": str(self.local),
            "WORLD_SIZE": str(contract.world_size),
            "LOCAL_WORLD_SIZE": str(contract.ranks_per_node),
            "GROUP_RANK": str(contract.node_rank),
            "GROUP_WORLD_SIZE": str(contract.node_count),
            "ROLE_NAME": "default",
            "ROLE_RANK": str(self.number),
            "ROLE_WORLD_SIZE": str(contract.world_size),
            "TORCHELASTIC_RUN_ID": contract.job,
            "TORCHELASTIC_RESTART_COUNT": str(contract.attempt - 1),
            "TORCHELASTIC_MAX_RESTARTS": "0",
            "TORCHELASTIC_USE_AGENT_STORE": "False",
            "TORCHELASTIC_ERROR_FILE": str(self.error_file),
        }

    def start(
        self,
        command: list[str],
        env: dict[str, str],
        *,
        directory: Path | None = None,
        prefix: Sequence[str] = (),
        group: str = "",
        forked: tuple[int, int] | None = None,
    ) -> None:
        """Start ``command`` in a session of its own, tied to this process's life. Raises OSError where it can't be started.

        Args:
            command: What to run.
            env: All its variables.
            directory: Its working directory; None: that of this process.
            prefix: A command that becomes ``command``.
            group: Directory of the control group that it enters; empty: none.
            forked: A process that waits to become it (:func:`worker.node.forked.forked_ranks`).
        """
        program = os.path.join(directory or "", command[0]) if "/" in command[0] else command[0]
        if shutil.which(program, path=env.get("PATH", os.defpath)) is None:
            problem = errno.EACCES if os.path.exists(program) else errno.ENOENT
            raise OSError(problem, os.strerror(problem))
        self.beacon, write_end = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._directory = directory
        module = module_of(command)
        if forked is not None and module and not (prefix or group):
            self._process = ForkedRank(*forked, module, env, directory, write_end)
        else:
            self._process = subprocess.Popen(
                tied([*prefix, *command], group=group),
                cwd=directory,
                env={**env, "MUSTER_PROGRESS_FD": str(write_end)},
                pass_fds=(write_end,),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                start_new_session=True,
            )
        os.close(write_end)
        self.running = True
        for stream in ("o", "e"):
            os.set_blocking(self.pipe(stream).fileno(), False)

    def pipe(self, stream: str) -> IO[bytes]:
        pipe = self._process.stdout if stream == "o" else self._process.stderr
        assert pipe is not None
        return pipe

    def poll(self) -> bool:
        """True once, when the process is found to have ended."""
        if not self.running or (code := self._process.poll()) is None:
            return False
        self.running, self.ended = False, time.time()
        self.exit_code = code if code >= 0 else 128 - code
        if code < 0:
            try:
                self.signal_name = signal.Signals(-code).name
            except ValueError:  # a real-time signal
                self.signal_name = f"signal {-code}"
        return True

    def give_up(self, stuck: str) -> None:
        """It does not end from SIGKILL: count it as ended, for the reason ``stuck``."""
        self.running, self.ended, self.stuck = False, time.time(), stuck
        self.exit_code, self.signal_name = 128 + signal.SIGKILL, "SIGKILL"

    def read(self, stream: str) -> list[str] | None:
        """The whole lines printed since the last call; None at the end of the stream."""
        try:
            chunk = os.read(self.pipe(stream).fileno(), 65536)
        except BlockingIOError:
            return []
        if not chunk:
            return None
        *whole, partial = (self._partial[stream] + chunk).split(b"\n")
        if len(partial) > _LONGEST_LINE:
            whole.append(partial)
            partial = b""
        self._partial[stream] = partial
        return [self._keep(stream, line) for line in whole]

    def listen(self) -> list[str] | None:
        """Its messages about saves since the last call; notes its progress. None at the end of its messages.

        The program itself may write here: anything but a message of scalars is dropped.
        """
        chunk = os.read(self.beacon, 65536)
        if not chunk:
            os.close(self.beacon)
            return None
        *lines, self._beacon = (self._beacon + chunk).split(b"\n")
        if len(self._beacon) > _LONGEST_MESSAGE:
            self._beacon = _TOO_LONG
        reports = []
        self.spoke = time.monotonic()
        for line in lines:
            if line.startswith(_TOO_LONG) or len(line) > _LONGEST_MESSAGE:
                continue
            try:
                message = json_object(line, "message")
            except ValueError:
                continue
            iteration = message.get("iteration")
            if type(iteration) is int and 0 <= iteration < _LARGEST_NUMBER:
                self.last_report = time.monotonic()
            else:
                message.pop("iteration", None)
            if message.get("done"):
                self.last_report = None
            for key in {"message", "said"} & message.keys():  # the second is its name in older versions
                reports.append(str(message.pop(key))[:_LONGEST_VALUE])
            for name, value in message.items():
                known = name in self.progress or (len(self.progress) < _MOST_VALUES and len(name) <= _LONGEST_VALUE)
                if known and isinstance(value, str):
                    self.progress[name] = value[:_LONGEST_VALUE]
                elif known and (value is None or (isinstance(value, int | float) and abs(value) < _LARGEST_NUMBER)):
                    self.progress[name] = value
        return reports

    def rest(self, stream: str) -> str:
        """The output after the last newline."""
        partial, self._partial[stream] = self._partial[stream], b""
        return self._keep(stream, partial) if partial else ""

    def _keep(self, stream: str, line: bytes) -> str:
        text = line.rstrip(b"\r").rpartition(b"\r")[2].decode(errors="replace")  # of a progress bar, its last state
        if stream == "e":
            self._stderr.append(text)
        return text

    def reason(self, grace: float) -> str:
        """Why the rank ended, in one line."""
        if self.stalled:
            return f"rank {self.number} {self.stalled}"
        if self.stuck:
            return f"rank {self.number} was killed and is still there: {self.stuck}"
        if self.overdue:
            return f"rank {self.number} did not leave within {grace:g} s of SIGTERM and was killed"
        if self.signal_name:
            return f"rank {self.number} was killed by {self.signal_name}"
        error = self.first_error()
        return f"rank {self.number} exited with code {self.exit_code}" + (f": {error.message}" if error else "")

    def first_error(self) -> FirstError | None:
        """From the error file that ``@record`` or our own commands write, else the last traceback on standard error."""
        try:
            message = (read_json(self.error_file, _LARGEST_ERROR_FILE) or {})["message"]
            if isinstance(message, str):
                return FirstError(self.number, message, "", self.ended)
            extra, text = message["extraInfo"], _in_one_line(str(message["message"]))
            when = float(extra.get("time") or extra.get("timestamp", self.ended))
            when = when if 0 <= when <= self.ended else self.ended
            trace = str(extra.get("py_callstack", ""))
            known = fault_from(extra["fault"]) if "fault" in extra else fault_in(trace, self._directory)
            return FirstError(self.number, text, trace, when, known if self._failed_alone else None)
        except DamagedFile as error:
            return self._traceback() or FirstError(self.number, str(error), "", self.ended)
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return self._traceback()

    @property
    def _failed_alone(self) -> bool:
        """Whether the program ended by itself."""
        return not (self.requested or self.overdue or self.stalled or self.stuck or self.signal_name)

    def _traceback(self) -> FirstError | None:
        lines = list(self._stderr)
        starts = [i for i, line in enumerate(lines) if line.startswith("Traceback (most recent call last)")]
        if starts:
            block = lines[starts[-1] :]
            end = next((i for i, line in enumerate(block[1:], 1) if line and not line.startswith(" ")), len(block) - 1)
            # Python leaves with 1 after an exception: a program that leaves otherwise had another reason
            fault = fault_in("\n".join(lines), self._directory) if self._failed_alone and self.exit_code == 1 else None
            return FirstError(self.number, block[end], "\n".join(block[: end + 1]), self.ended, fault)
        last = next((line for line in reversed(lines) if line.strip()), None)
        return FirstError(self.number, last, "", self.ended) if last and self.exit_code else None


def _in_one_line(message: str) -> str:
    """The message of an error in one line, without the C++ files and stacks of Gloo and NCCL, which the log has."""
    return " ".join(_PLACE_IN_CPP.sub("", _STACK_IN_CPP.split(message)[0]).split())


def adopt_orphans() -> None:
    """Have descendants whose parent dies re-parented to this process instead of to init, so that they can be found (``prctl(2)``)."""
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def kill_group(pid: int, number: int) -> None:
    """Send signal ``number`` to the process group that ``pid`` leads, where it still exists."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, number)


_SECONDS = 15.0


def state_of(pid: int) -> str:
    """The kernel's word for what the process does: ``R`` runs, ``S`` sleeps, ``D`` waits for a device, ``T`` is stopped, ``Z`` is dead."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return "Z"


def dump_stacks(pid: int, *, speaks: bool = False) -> list[str]:
    """The stacks of every thread of ``pid`` as lines.

    py-spy reads them through ptrace, with native frames where the process can be paused. Where that is not allowed, a process of
    ours (``speaks``) is asked to print its own Python stacks on stderr (SIGUSR1, ``faulthandler``); others keep their secret.
    """
    spy = Path(sys.executable).parent / "py-spy"
    stopped = state_of(pid) in "Tt"
    # a stopped process can't be paused once more; it holds still anyway
    variants = [["--nonblocking"]] if stopped else [["--native"], [], ["--nonblocking"]]
    problem = f"{spy} is not installed"
    for options in variants if spy.exists() else []:
        try:
            command = [str(spy), "dump", *options, "--pid", str(pid)]
            done = subprocess.run(command, capture_output=True, text=True, timeout=_SECONDS)
        except (OSError, subprocess.TimeoutExpired) as error:
            problem = str(error)
            continue
        if done.returncode == 0:
            return [line for line in done.stdout.splitlines() if line.strip()]
        problem = next((line.strip() for line in reversed(done.stderr.splitlines()) if line.strip()), problem)
    if speaks and not stopped:
        os.kill(pid, signal.SIGUSR1)
        return [
            f"stacks could not be read from outside ({problem}); the process was asked to print its Python stacks itself"
        ]
    return [f"stacks could not be read ({problem})"]
