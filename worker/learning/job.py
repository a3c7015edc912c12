"""A rank's job (``MUSTER_*`` variables), and its end: exit codes and the error file."""

from __future__ import annotations

import faulthandler
import gc
import json
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shared_store.contract.error_text import kind_of
from shared_store.contract.faults import fault_in
from shared_store.contract.plugins import PluginError
from shared_store.volume.checkpoints import DamagedCheckpoint, list_checkpoints
from shared_store.volume.epoch import StaleEpoch
from shared_store.volume.layout import Run, Store, StoreError
from shared_store.volume.texts import TextError, resolved
from worker.settings.accepted_changes import CHANGED_ROBOTS
from worker.settings.deferred_imports import defer_imports
from worker.settings.errors import GangError, TrainingError, UserError

if TYPE_CHECKING:
    from worker.settings.task import TaskConfig
    from worker.tasks.run.task import Task

EX_ERROR, EX_USAGE = 1, 2


class StopRequest:
    """Requests by signal: SIGTERM and SIGINT save a checkpoint and exit after the iteration; SIGUSR2 saves and continues."""

    def __init__(self) -> None:
        self.requested = False
        self.save_requested = False
        self._since = 0.0

    def listen(self) -> StopRequest:
        """Catch the signals from now on."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._request)
        signal.signal(signal.SIGUSR2, self._request_save)
        faulthandler.register(
            signal.SIGUSR1, all_threads=True
        )  # Python stacks to stderr, for where ptrace is not allowed
        return self

    def when_late(self, seconds: float, late: Callable[[], object]) -> None:
        """Call ``late`` on a thread of its own, ``seconds`` after a request to exit. The main thread calls this once.

        The thread hears of the signal also while the main thread is inside a library's call, where Python runs no handlers.
        """
        read_end, write_end = os.pipe()
        os.set_blocking(write_end, False)
        signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)

        def wait() -> None:
            while not self.requested and not {signal.SIGTERM, signal.SIGINT} & set(os.read(read_end, 64)):
                pass
            time.sleep(seconds)
            late()

        threading.Thread(target=wait, name="stop", daemon=True).start()

    def is_older(self, seconds: float) -> bool:
        """Whether an exit was requested more than ``seconds`` ago."""
        return self.requested and time.monotonic() - self._since > seconds

    def _request(self, number: int, frame: object) -> None:
        self._since = self._since or time.monotonic()
        self.requested = True

    def _request_save(self, number: int, frame: object) -> None:
        self.save_requested = True


@dataclass(frozen=True)
class Job:
    """The job of this rank."""

    spec: dict[str, Any]
    """The job YAML."""
    store: Store
    run: Run
    epoch: int
    job_epoch: int
    """Epoch of the job's first attempt."""
    id: str
    checkpoint: str | None = None
    """Name of a checkpoint that a person chose to start from."""
    parent: str | None = None
    """``RUN@ITERATION`` with a clone's initial weights."""
    section: dict[str, Any] = field(default_factory=dict)
    """The part of the YAML for this command: ``train``, ``evaluate`` or ``export``."""

    @classmethod
    def from_env(cls, env: Mapping[str, str], kind: str) -> Job:
        """Read the job for command ``kind``, and keep what it accepts (:mod:`worker.settings.accepted_changes`).

        Raises:
            UserError: A variable is missing or malformed; the message names it.
        """
        for name in ("MUSTER_STORE", "MUSTER_RUN", "MUSTER_SPEC"):
            if not env.get(name):
                raise UserError(
                    f"{name} is not set: a rank that does `{kind}` is started by Muster (use `muster run SPEC`)"
                )
        try:
            spec = json.loads(env["MUSTER_SPEC"])
            section = spec[kind]
            epoch = int(env.get("MUSTER_EPOCH") or 0)
            job_epoch = int(env.get("MUSTER_JOB_EPOCH") or epoch)
            assert isinstance(section, dict)
        except (ValueError, KeyError, TypeError, AssertionError) as error:
            raise UserError(
                f"MUSTER_SPEC, MUSTER_EPOCH or MUSTER_JOB_EPOCH is malformed for `{kind}`: {error!r}"
            ) from error
        _check_kinds(spec, kind)
        store = Store(env["MUSTER_STORE"])
        run = store.run(env["MUSTER_RUN"])
        section = with_texts(section, run, kind)
        # a new training has no policy that another robot could have trained
        continues = kind != "train" or bool(list_checkpoints(run))
        CHANGED_ROBOTS.set(continues and bool(section.get("accept_changed_robot")))
        chosen = env.get("MUSTER_CHECKPOINT") or None
        parent = env.get("MUSTER_PARENT") or None
        return cls(spec, store, run, epoch, job_epoch, env.get("MUSTER_JOB_ID", ""), chosen, parent, section)

    def named_run(self) -> Run:
        """The run that the section (``evaluate``, ``export``) names, else the job's own."""
        return self.store.run(self.section["run"]) if self.section.get("run") else self.run

    def setting(self, name: str, default: int, *, least: int = 1) -> int:
        """The whole number ``name`` of the section. Raises UserError for anything else."""
        value = self.section.get(name, default)
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            raise UserError(f"{name}: expected an integer of at least {least}, got {value!r}")
        return value


def _check_kinds(spec: Mapping[str, Any], kind: str) -> None:
    """Check sections, since the submission of a Batch API job does not. Raises UserError for a malformed section."""
    from worker.settings.overrides import training_sections

    section = spec[kind]
    if not isinstance(algorithm := section.get("algorithm", ""), str):
        raise UserError(f"{kind}.algorithm: expected a string, found {kind_of(algorithm)}")
    places = {f"{kind}.{name}": section.get(name) for name in ("config", "settings", *sorted(training_sections()))}
    for where, found in {**places, "checkpoint": spec.get("checkpoint")}.items():
        if not isinstance(found, dict | None):
            raise UserError(f"{where}: expected an object, found {kind_of(found)}")


def with_texts(section: Mapping[str, Any], run: Run, kind: str) -> dict[str, Any]:
    """A section of the job YAML, ``kind``, with the texts that its run keeps in the place of their digests. Raises UserError."""
    if not (config := section.get("config")):
        return dict(section)
    try:
        return {**section, "config": resolved(config, run.texts, f"{kind}.config")}
    except TextError as error:
        raise UserError(str(error)) from error


def configure(task: type[Task], section: Mapping[str, Any], kind: str = "train") -> TaskConfig:
    """``task``'s configuration with the overrides of a section (``config``) of the YAML, which ``kind`` names in errors.

    Raises UserError for an unknown key or an invalid value, in the same words as the submission.
    """
    from worker.settings.overrides import Refused, configured

    try:
        configured(task.config_type, {})
    except Refused as refused:
        raise UserError(f"task {task.__name__}: its own configuration: {refused}") from refused
    try:
        return configured(task.config_type, section.get("config") or {})
    except Refused as refused:
        raise UserError(": ".join((".".join(map(str, (kind, "config", *refused.path))), refused.words))) from refused


def end_startup() -> None:
    """Freeze start-up objects out of the garbage collector, then enable it."""
    gc.freeze()
    gc.enable()


@contextmanager
def user_errors(where: str | None = None) -> Iterator[None]:
    """Turn a ValueError into a UserError, which is shown in one line; elsewhere a ValueError is a defect and shows its traceback."""
    try:
        yield
    except ValueError as error:
        raise UserError(f"{where}: {error}" if where else str(error)) from error


def run_command(body: Callable[[], int]) -> None:
    """Run a command and exit with its code: 2 for a user's error, 1 for any other, both reported to the supervisor."""
    # Importing the simulation parses hundreds of kernels; garbage collection would make that 50 % slower.
    gc.disable()
    defer_imports()
    try:
        code = body()
    except (UserError, StoreError, PluginError) as error:
        print(getattr(error.__cause__, "trace", ""), end="", file=sys.stderr, flush=True)  # of a TaskMistake
        code = _fail(str(error), EX_USAGE)
    except (GangError, TrainingError, StaleEpoch, DamagedCheckpoint) as error:
        code = _fail(str(error), EX_ERROR, getattr(error, "cause", ""))
    except Exception as error:
        trace = traceback.format_exc()
        print(trace, file=sys.stderr, flush=True)
        _write_error_file(f"{type(error).__name__}: {error}", trace, trace)
        code = EX_ERROR
    sys.stdout.flush()
    sys.stderr.flush()
    # A normal exit would join NCCL/Gloo threads that wait for dead peers.
    os._exit(code)


def _fail(message: str, code: int, cause: str = "") -> int:
    """Report the exception that is being handled in one line; returns ``code``."""
    print(f"error: {message}", file=sys.stderr, flush=True)
    _write_error_file(message, "", traceback.format_exc(), cause)
    return code


def _write_error_file(message: str, shown: str, trace: str, cause: str = "") -> None:
    """Write the file of ``torch.distributed.elastic``'s ``@record``, without importing it.

    Args:
        message: The error.
        shown: The traceback for people, empty for an error that says all in one line.
        trace: The traceback with its place.
        cause: As :attr:`shared_store.contract.faults.Fault.cause`.
    """
    path = os.environ.get("TORCHELASTIC_ERROR_FILE")
    if not path:
        return
    now = time.time()
    # torch writes whole seconds; "time" is ours, to tell the first failure of a gang from those that it caused, and so is "fault"
    fault = fault_in(trace, cause=cause)
    extra = {
        "py_callstack": shown,
        "timestamp": str(int(now)),
        "time": now,
        "fault": None if fault is None else asdict(fault),
    }
    try:
        Path(path).write_text(json.dumps({"message": {"message": message, "extraInfo": extra}}))
    except OSError as error:
        print(f"error: {path} can't be written ({error.strerror})", file=sys.stderr, flush=True)
