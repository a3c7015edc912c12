"""The node's supervisor: ``python -m worker.supervisor -- COMMAND…``, the same on every engine.

It reads the node contract, starts the ranks with torchrun's environment, merges their output into the node's log, forwards
SIGTERM, ends everything it started, and commits ``outcome.json`` before it leaves. It notices a rank that makes no progress, and
is the node's voice on the bus. One thread, one selector, no torch.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import selectors
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from shared_store.contract.node import OWN_VARIABLES, ContractError, NodeContract
from shared_store.process.node_processes import end_descendants
from shared_store.process.processes import PATIENCE, find_process, unkillable
from shared_store.process.shim import SCRATCH
from shared_store.volume.epoch import StaleEpoch, check_epoch, find_epoch, read_epoch
from shared_store.volume.files import DamagedFile
from shared_store.volume.layout import Run, Store, StoreError
from shared_store.volume.log_files import LogWriter, left_out
from shared_store.volume.logs import END_LINE, format_line, format_lines
from shared_store.volume.node_outcomes import EX_TEMPFAIL, OUT_OF_MEMORY, Outcome, first_cause, write_outcome
from worker.node.bus import BusCommand, NodeBus
from worker.node.forked import forked_ranks
from worker.node.rank import Rank, adopt_orphans, dump_stacks, kill_group, state_of
from worker.node.surroundings import MemoryLimit, Surroundings, interface_of

_PEER_GRACE = 5.0
"""Seconds that the other ranks of a node get after one of them failed: their collectives are broken, there is nothing to save."""
_FENCE_INTERVAL = 1.0
"""Seconds between two looks at the run's EPOCH."""
_WAITING_EXTRA = 3.0
"""Seconds that a rank which waits gets beyond the stall timeout: the one that it waits for is to be found first."""
_FLOOD = 32768
"""Characters read at once, half of a full pipe, beyond which a rank prints faster than the supervisor should work: it rests then
for as long as it has worked, and takes no more than half a core."""
_COMPLAINTS = 60.0
"""Seconds between two lines on standard error about a log that can't be written."""
_PATIENCE = 1800.0
"""Seconds that a training may take to start, and to finish after its last iteration."""
_FINAL = (errno.ENOTDIR, errno.EISDIR, errno.EACCES, errno.EPERM, errno.ELOOP, errno.ENAMETOOLONG)
"""Errors of an outcome's path that stay: a job has put something else there."""
_COMMIT_INTERVAL = 1.0
"""Seconds between two tries to write an outcome."""
_LAST_WORDS = 2.0
"""Seconds before its end of grace at which a node leaves whose outcome can't be written: its exit code must be its own."""
_REQUESTED = "asked to leave"
_REQUESTS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
"""Signals that ask the node to leave."""
_STATES = {
    "R": "it runs",
    "D": "it waits for a device or the store",
    "T": "it is stopped by a signal",
    "t": "it is being traced",
}


class Supervisor:
    """Runs the ranks of one node from start to outcome."""

    def __init__(self, contract: NodeContract, run: Run, command: list[str]) -> None:
        self.contract, self.run, self.command = contract, run, command
        self.ranks: list[Rank] = []
        self.selector = selectors.DefaultSelector()
        self.deadline: float | None = None
        self.stopping: str | None = None
        self._next_fence = 0.0
        self._saving: list[tuple[int, BusCommand]] = []
        self._log = LogWriter(run.log(contract.job, contract.attempt, contract.node_index), contract.log_limit)
        self._lost = (0, 0, "")
        """Lines and bytes that the log could not take since the last one that it could, and why."""
        self._kept: Path | None = None
        """Directory that the job keeps when it is over."""
        self._complain = 0.0
        """Time at which standard error may again report a log that can't be written (monotonic [s])."""

    # -- life ---------------------------------------------------------------------------------------------------------

    def supervise(self) -> int:
        """Start the ranks, watch them to the end, commit the outcome; returns the node's exit code."""
        started = time.time()
        adopt_orphans()
        self._wakeup, write_end = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)
        for number in _REQUESTS:
            signal.signal(number, lambda _number, _frame: self.stop(_REQUESTED, self.contract.grace))
        signal.signal(signal.SIGCHLD, lambda _number, _frame: None)
        self.selector.register(self._wakeup, selectors.EVENT_READ, None)
        self.bus = NodeBus(self.contract, write_end)
        with tempfile.TemporaryDirectory(prefix=SCRATCH.format(pid=os.getpid())) as scratch:
            try:
                self._start_ranks(Path(scratch))
            except OSError as error:
                reason = f"can't start {self.command[0]!r}: {error.strerror}; is it installed, and is the path right?"
                self.write(None, "e", reason)
                node, epoch, ended = self.contract.node_index, self.contract.epoch, time.time()
                return self._commit(Outcome(node, epoch, 127, None, reason, None, started, ended, cannot_start=True))
            if self.stopping:  # asked while the ranks were being started: they have not received it
                self._ask_ranks()
            while any(rank.running for rank in self.ranks):
                self._read(timeout=0.1)
                self._watch()
                self._serve_bus()
            if left := end_descendants():
                self.write(None, "e", unkillable(left))
            self._drain()
            outcome = self._outcome(started)
        if self._kept:
            self.write(None, "o", f"the job's directories are kept: {self._kept} on {socket.gethostname()}")
        self.write(None, "o", END_LINE.format(node=self.contract.node_index, reason=outcome.reason))
        self.bus.end_log(self.ranks[0].progress, self._log.end())
        code = self._commit(outcome)
        self.bus.close()
        for number in _REQUESTS:  # whose default, which Python restores at its end, is another exit code
            signal.signal(number, signal.SIG_IGN)
        return code

    def abandon(self) -> None:
        """Kill everything at once and write nothing more: the run belongs to a newer attempt."""
        for rank in self.ranks:
            kill_group(rank.pid, signal.SIGKILL)
        end_descendants()

    def stop(self, why: str, grace: float) -> None:
        """Ask every rank to leave; those that are still here ``grace`` seconds later are killed."""
        if self.deadline is None:
            self.stopping = why
            self.deadline = time.monotonic() + grace
            self._ask_ranks()

    def _ask_ranks(self) -> None:
        for rank in self.ranks:
            rank.poll()  # one that has ended by itself was not asked
            if rank.running:
                rank.requested = rank.stalled is None
                kill_group(rank.pid, signal.SIGTERM)

    # -- ranks --------------------------------------------------------------------------------------------------------

    def _start_ranks(self, scratch: Path) -> None:
        forked = iter(forked_ranks())
        contract, found = self.contract, Surroundings(self.contract, scratch)
        self._kept = found.kept
        threads = max(1, int(contract.cpus / contract.ranks_per_node))
        shared = {
            "OMP_NUM_THREADS": str(threads),
            "PYTHONUNBUFFERED": "1",
            "TORCH_NCCL_ASYNC_ERROR_HANDLING": "1",  # as torchrun does
        }
        if interface := interface_of(contract.address, contract.master_address):
            shared |= {"NCCL_SOCKET_IFNAME": interface, "GLOO_SOCKET_IFNAME": interface}
        self._memory = MemoryLimit(contract)
        for note in filter(None, (contract.note, self._memory.problem)):
            self.write(None, "e", note)
        for local in range(contract.ranks_per_node):
            rank = Rank(contract, local, scratch / f"error-{local}.json")
            # what the user set in the job's environment stands; some variables are the supervisor's alone
            own = {name: value for name, value in found.environment.items() if name not in OWN_VARIABLES}
            env = {**shared, **own, **rank.environment()}
            rank.start(
                self.command,
                env,
                directory=found.directory,
                prefix=found.prefix,
                group=self._memory.group,
                forked=next(forked, None),
            )
            self.ranks.append(rank)
            for stream in ("o", "e"):
                self.selector.register(rank.pipe(stream), selectors.EVENT_READ, (rank, stream))
            self.selector.register(rank.beacon, selectors.EVENT_READ, (rank, "beacon"))

    def _watch(self) -> None:
        """Notice ends; a failure of one rank ends the others, a passed deadline kills."""
        running = [rank for rank in self.ranks if rank.running]
        if self._memory.is_used_up():  # the kernel has chosen one process, anywhere in the job
            for rank in running:
                kill_group(rank.pid, signal.SIGKILL)
        for rank in running:
            if rank.poll():
                if rank.exit_code not in (0, EX_TEMPFAIL):
                    self.stop(f"rank {rank.number} failed", _PEER_GRACE)
            elif self.deadline is None and self._stalls(rank):
                self.stop(f"rank {rank.number} stalls", 0.0)
        if self.deadline is not None and (late := time.monotonic() - self.deadline) >= 0:
            for rank in (rank for rank in running if rank.running):
                rank.overdue = True
                kill_group(rank.pid, signal.SIGKILL)
                if late > PATIENCE and (process := find_process(rank.pid)):
                    rank.give_up(unkillable([process]))

    def _stalls(self, rank: Rank) -> bool:
        """Whether the rank has reported no iteration for too long; then its stacks are in the log."""
        if (timeout := self.contract.stall_timeout) is None:
            return False
        # before the first iteration (kernels are compiled) and after the last (evaluation) only the time limits tell a stall
        since, limit = (
            (rank.last_report, timeout) if rank.last_report is not None else (rank.spoke, max(timeout, _PATIENCE))
        )
        if (silence := time.monotonic() - since) < limit:
            return False
        if any(key.data == (rank, "beacon") for key, _ in self.selector.select(0)):
            return False  # it was not silent: this process was held up, such as by its log on a volume that hangs
        state = state_of(rank.pid)
        if state not in _STATES and silence < limit + _WAITING_EXTRA:
            return False
        doing, iteration = _STATES.get(state, "it waits, perhaps for another rank"), rank.progress.get("iteration", 0)
        rank.stalled = f"made no progress for {silence:.0f} s after iteration {iteration}: {doing}"
        self._log_stacks(rank, f"stall: rank {rank.number} {rank.stalled}; its stacks:", speaks=True)
        return True

    def _log_stacks(self, rank: Rank, title: str, *, speaks: bool) -> list[str]:
        """Write a rank's stacks to the log; returns them."""
        lines = dump_stacks(rank.pid, speaks=speaks) if rank.running else ["ended"]
        for line in (title, *lines):
            self.write(rank.number, "e", line)
        return lines

    # -- bus ----------------------------------------------------------------------------------------------------------

    def _serve_bus(self) -> None:
        """Carry out the commands that came, and tell how the node is."""
        if not self.ranks:
            return
        self.bus.tend(self.ranks[0].progress, self._log.end)
        while not self.bus.commands.empty():
            command = self.bus.commands.get()
            if command.name == "checkpoint":
                self._order_save(command)
            elif command.name == "stacks":
                found = []
                for rank in self.ranks:
                    title, speaks = f"stacks of rank {rank.number}, asked for:", rank.last_report is not None
                    found += [f"rank {rank.number}:", *self._log_stacks(rank, title, speaks=speaks)]
                command.reply("\n".join(found))
            elif command.name == "stop":
                command.reply("stopping")
                self.stop("asked to leave over the bus", self.contract.grace)
            else:
                command.reply(f"unknown command {command.name}")

    def _order_save(self, command: BusCommand) -> None:
        """Ask the ranks to save now (SIGUSR2); the answer follows when the first save after that is durable."""
        rank = self.ranks[0]
        if (
            rank.running and rank.last_report is None and self.contract.stall_timeout is not None
        ):  # which only a training has
            command.reply(f"job {self.contract.job[:8]} has not begun its first iteration: nothing to save yet")
            return
        if not rank.running or rank.last_report is None:
            command.reply("not training: there is nothing to save now")
            return
        self._saving.append((rank.progress["iteration"], command))
        os.kill(rank.pid, signal.SIGUSR2)

    # -- output -------------------------------------------------------------------------------------------------------

    def write(self, rank: int | None, stream: str, text: str) -> None:
        """Append one line to the node's log, as :meth:`write_lines` does."""
        self.write_lines(rank, stream, [text])

    def write_lines(self, rank: int | None, stream: str, texts: Sequence[str]) -> None:
        """Append lines to the node's log. A full or lost volume is reported once on stderr; the ranks go on.

        The log counts the lines that it could not take as soon as it takes one again.
        """
        if self._lost[0]:
            lines, size, why = self._lost
            note = left_out(lines, size, f"the log could not be written ({why})")
            if self._append(format_line(time.time(), None, "e", note).encode()):
                self._lost = (0, 0, "")
        data = format_lines(time.time(), rank, stream, texts).encode(errors="backslashreplace")
        rest = data if self._lost[0] else data[self._append(data) :]
        if rest and self._log.error:
            self._lose(rest, self._log.error)

    def _append(self, data: bytes) -> int:
        """Append lines to the log, and push them to those who follow it; returns how many bytes the log has taken."""
        written = self._log.append(data)
        if written and self.bus.is_followed and (end := self._log.end()) is not None:
            self.bus.push_log(end - written, data[:written])
        return written

    def _lose(self, data: bytes, error: OSError) -> None:
        why = error.strerror or str(error)
        if not self._lost[0] and time.monotonic() >= self._complain:
            _log(f"log of node {self.contract.node_index} can't be written: {why}")
            self._complain = time.monotonic() + _COMPLAINTS
        self._lost = (self._lost[0] + data.count(b"\n"), self._lost[1] + len(data), why)

    def _read(self, timeout: float) -> bool:
        """Move what the ranks printed into the log; False where there was nothing. Raises StaleEpoch."""
        moved, flooded = False, False
        ready = self.selector.select(timeout)
        if time.monotonic() >= self._next_fence:  # before anything is written: a node that was frozen must not log
            with contextlib.suppress(OSError, ValueError):  # a volume that is away: a commit reads it again
                check_epoch(self.run, self.contract.epoch)
            self._next_fence = time.monotonic() + _FENCE_INTERVAL
        began = time.thread_time()
        for key, _ in ready:
            if key.data is None:
                with contextlib.suppress(BlockingIOError):
                    os.read(key.fd, 4096)
                continue
            rank, stream = key.data
            if stream == "beacon":
                if (reports := rank.listen()) is None:
                    self.selector.unregister(key.fd)
                self._answer_saves(reports or [])
                continue
            lines = rank.read(stream)
            if lines is None:
                self.selector.unregister(key.fileobj)
                continue
            moved = True
            if lines:
                self.write_lines(rank.number, stream, lines)
            flooded = flooded or sum(map(len, lines)) + len(lines) > _FLOOD
        if flooded and timeout:  # the pipe fills meanwhile, and the program waits: the cores are for the ranks
            time.sleep(time.thread_time() - began)
        return moved

    def _answer_saves(self, reports: list[str]) -> None:
        """Answer requests for a save with the result of one that is not older."""
        for text in reports:
            saved = int(match[0]) if (match := re.search(r"\d+", text)) else 0
            for _, command in [request for request in self._saving if saved >= request[0]]:
                command.reply(text)
            self._saving = [request for request in self._saving if saved < request[0]]

    def _drain(self) -> None:
        while self._read(timeout=0):
            pass
        for rank in self.ranks:
            for stream in ("o", "e"):
                if rest := rank.rest(stream):
                    self.write(rank.number, stream, rest)

    # -- end ----------------------------------------------------------------------------------------------------------

    def _outcome(self, started: float) -> Outcome:
        node, epoch = self.contract.node_index, self.contract.epoch
        if self._memory.is_used_up():
            return Outcome(node, epoch, 128 + signal.SIGKILL, "SIGKILL", OUT_OF_MEMORY, None, started, time.time())
        failed = [rank for rank in self.ranks if rank.exit_code not in (0, EX_TEMPFAIL)]
        ends = [(self._was_requested(rank), rank.ended) for rank in failed]
        first = failed[first_cause(ends)] if failed else None
        if first:
            code, reason, error = first.exit_code, first.reason(self.contract.grace), first.first_error()
        elif any(rank.exit_code == EX_TEMPFAIL for rank in self.ranks):
            code, reason, error = EX_TEMPFAIL, "checkpointed and left on request", None
        else:
            code, reason, error = 0, "done", None
        name = first.signal_name if first else None
        requested = self._was_requested(first) if first else any(rank.requested for rank in self.ranks)
        return Outcome(node, epoch, code, name, reason, error, started, time.time(), requested)

    def _was_requested(self, rank: Rank) -> bool:
        """Some engines send SIGTERM to the ranks themselves, too: one may be gone before this process knows."""
        return rank.requested or (self.stopping == _REQUESTED and rank.signal_name == "SIGTERM")

    def _commit(self, outcome: Outcome) -> int:
        """Write the outcome until it stands, or the node is asked to leave; returns its exit code, by which the engine knows it too.

        Raises StaleEpoch.
        """
        with contextlib.suppress(OSError):
            self._log.sync()
        # the time that ranks had to leave is over; whoever asks the node to leave gives it more
        if self.stopping != _REQUESTED:
            self.stopping = self.deadline = None
        trouble, store = "", self.run.path.parent.parent
        # a run that was deleted, in a store that is mounted, must not come back in part
        while os.path.lexists(self.run.path) or not os.path.lexists(store / "store.json"):
            try:
                try:  # an empty directory in the run's place would take the outcome
                    is_mounted = read_epoch(self.run) > 0
                except ValueError:
                    is_mounted = True  # damaged, and there
                if not is_mounted:
                    raise OSError(f"run {self.run.name} is not in the store; see whether its volume is mounted")
                write_outcome(self.run, self.contract.job, self.contract.attempt, outcome)
                break
            except (OSError, DamagedFile) as error:
                why = f"outcome of node {outcome.node} can't be written: {getattr(error, 'strerror', None) or error}"
                if not isinstance(error, OSError) or error.errno in _FINAL:
                    _log(why)
                    break
            if why != trouble:
                _log(f"{why}; trying again until it can, or the node is asked to leave")
                trouble = why
            if self.deadline is not None and time.monotonic() > self.deadline - _LAST_WORDS:
                break
            self._read(timeout=_COMMIT_INTERVAL)
            self._serve_bus()
        return outcome.exit_code


def _log(text: str) -> None:
    """One line on standard error, which may lie on the very volume that is full; nothing is kept to fail again at the exit."""
    with contextlib.suppress(OSError):
        os.write(2, f"{text}\n".encode(errors="backslashreplace"))


def main(argv: list[str], make: Callable[[NodeContract, Run, list[str]], Supervisor] = Supervisor) -> int:
    """Entry point; exit codes: the node's (0, 75, 128 + n, the program's), 2 for a wrong call, 3 where fenced off.

    ``make``: an engine's own kind of supervisor.
    """
    if len(argv) < 2 or argv[0] != "--":
        print("usage: python -m worker.supervisor -- COMMAND [ARG …]", file=sys.stderr)
        return 2
    try:
        contract = NodeContract.from_env(os.environ)
        run = Store(contract.store).run(contract.run)
        find_epoch(run, contract.epoch)
        supervisor = make(contract, run, argv[1:])
    except (ContractError, StoreError, ValueError) as error:
        print(f"muster supervisor: {error}", file=sys.stderr)
        return 2
    except StaleEpoch as error:
        print(f"muster supervisor: {error}; leaving", file=sys.stderr)
        return 3
    except OSError as error:
        print(f"muster supervisor: store: {error.strerror}: {error.filename}", file=sys.stderr)
        return 2
    try:
        return supervisor.supervise()
    except StaleEpoch as error:
        supervisor.abandon()
        print(f"muster supervisor: {error}; leaving", file=sys.stderr)
        return 3
