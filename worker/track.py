"""Sends a run's metrics to a tracking service: a process of its own beside the main rank, which follows what the run's files say.

``python -m worker.track`` is started by :class:`worker.telemetry.tracking_processes.Tracking` for each service that the job names. It reads one
JSON order on standard input, later how the training ended; its lines on standard output, JSON too, are for the log. Whatever a service
does, the training neither waits nor fails: the metrics are in the store, and are sent once the service takes them.

``python -m worker.track RUN_DIRECTORY SERVICE`` sends what a service lacks of a run, whenever that is. Imports no torch.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from shared_store.volume.epoch import StaleEpoch, check_epoch
from shared_store.volume.evaluations import list_evaluations
from shared_store.volume.files import read_json, write_json
from shared_store.volume.layout import Run
from shared_store.volume.metrics import MetricsHistory
from worker.telemetry.services import SERVICES, Service, ServiceRefused, Tracked, TrainingEnd, one_line, without_key

POLL_SECONDS = 2.0
"""Between two polls of the metrics."""
_PATIENCE = (5.0, 300.0)
"""Seconds until what a service did not take is tried again: at first, and at most."""
_MOST = 500
"""Iterations that are sent at once."""
_PACKAGES = ("muster", "torch", "warp-lang", "newton", "mujoco", "mujoco-warp", "rsl-rl-lib")
_NICE = 10

Say = Callable[[str], None]


class SenderLock:
    """The right to send a run to a service, which one process has at a time; the kernel takes it back when the process dies.

    Args:
        run: The run.
        kind: Name of the service.
    """

    def __init__(self, run: Run, kind: str) -> None:
        self._path = run.tracking / f"{kind}.lock"
        self._file: int | None = None

    def take(self) -> str | None:
        """Take it, unless it is taken already; returns the process that has it, None for this one. Raises OSError."""
        if self._file is not None:
            return None
        self._path.parent.mkdir(exist_ok=True)
        file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(file, 200).decode(errors="replace").strip()
            os.close(file)
            return holder or "another process"
        except OSError:  # a volume without locks
            pass
        os.truncate(file, 0)
        os.write(file, f"process {os.getpid()} on {socket.gethostname()}".encode())
        self._file = file
        return None


class Sender:
    """One run and one service.

    Args:
        run: The run.
        service: Prepared.
        kind: Its name, under which the run notes what the service knows it by.
        settings: What the iterations follow from: where these change, iterations that are done again are other ones.
        say: Called with lines for people.
    """

    def __init__(self, run: Run, service: Service, kind: str, settings: Mapping[str, Any], say: Say) -> None:
        self._run, self._service, self._settings, self._say = run, service, dict(settings), say
        self._note = run.tracking / f"{kind}.json"
        self._history = MetricsHistory(run)
        self._sent: int | None = None
        self._tries = 0
        """Without success, since the last one."""
        self._next = 0.0

    def open(self, resumed_from: int | None, epoch: int) -> None:
        """Go on with what the service has of this history, or begin.

        Iterations after ``resumed_from`` that the service has were given up. With the same settings they are done again alike, and
        are not sent twice; with others the service gets a new run, with the whole history. None: nothing was given up.
        """
        note = read_json(self._note) or {}
        fresh = f"{self._run.name}-e{epoch}" if note.get("id") else self._run.name
        sent = self._service.open(note.get("id"), fresh)
        is_other = note.get("settings") != self._settings
        if resumed_from is not None and sent > resumed_from and is_other:
            self._service.leave()
            sent = self._service.open(None, fresh)
        if is_other or note.get("id") != self._service.identity:
            write_json(self._note, {"id": self._service.identity, "settings": self._settings})
        self._sent = sent
        self._say(without_key(self._service.place))

    def step(self, resumed_from: int | None, epoch: int, *, at_once: bool = False) -> bool:
        """Send what is new, unless a try failed a moment ago; returns whether everything is sent. Raises StaleEpoch."""
        if time.monotonic() < self._next and not at_once:
            return False
        try:
            if self._sent is None:
                self.open(resumed_from, epoch)
            assert self._sent is not None
            while records := self._history.after(self._sent, _MOST):
                self._service.send(records)
                self._sent = records[-1]["iteration"]
            if self._tries:
                self._say("it answers again; everything is sent")
            self._tries = 0
            return not self._history.behind
        except Exception as error:  # of the network, of the service's library, of the volume: all may pass
            first, most = _PATIENCE
            self._next = time.monotonic() + min(most, first * 2**self._tries)
            if not self._tries:
                self._say(f"warning: nothing can be sent now ({one_line(error)})")
            self._tries = min(self._tries + 1, 10)
            return False

    def finish(self, outcome: str) -> None:
        """Send the end: evaluation and pictures of a training that is done. Raises whatever the service does."""
        figures, files = _results(self._run) if outcome == "finished" else ({}, [])
        self._service.finish(TrainingEnd(outcome, self._sent or 0, figures, files))


def _results(run: Run) -> tuple[dict[str, float], list[Path]]:
    files = [run.metrics / "policy.png", run.metrics / "reward.png"]
    figures: dict[str, Any] = {}
    own = [each for each in list_evaluations(run) if not each.get("config")]
    if own:
        last = max(own, key=lambda each: (each["checkpoint"], each["time"]))
        files.append(run.evaluations / f"{last['name']}.json")
        figures = {"return": last["mean_return"], "length": last["mean_length"]}
        figures["success"] = (last.get("success") or {}).get("share")
        figures |= {name: each.get("mean") for name, each in (last.get("metrics") or {}).items()}
    numbers = {f"evaluation/{name}": float(value) for name, value in figures.items() if isinstance(value, int | float)}
    return numbers, [path for path in files if path.is_file()]


def tracked_of(run: Run, train: Mapping[str, Any], facts: Mapping[str, Any]) -> Tracked:
    """The configuration that a service receives: settings, ``facts``, the working directory's git commit, versions."""
    versions = {}
    for name in _PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            versions[name] = version(name)
    config: dict[str, Any] = {"train": dict(train), "run": run.name, **facts, "versions": versions}
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        done = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, timeout=5)
        if commit := done.stdout.strip():
            config["git_commit"] = commit
    return Tracked(run.name, str(train.get("task", "")).rpartition(":")[2], config, run.tracking)


def same_iterations(train: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that a training's iterations follow from."""
    return {key: value for key, value in train.items() if key != "iterations"}


def beside_a_rank() -> None:
    """Carry out the order of a main rank."""
    output = _own_output()
    order = json.loads(sys.stdin.buffer.readline() or b"null")
    if order is None:
        return
    os.nice(_NICE)

    def report(**words: Any) -> None:
        with contextlib.suppress(OSError):  # the rank has ended
            os.write(output, json.dumps(words).encode() + b"\n")

    def say(text: str) -> None:
        report(message=text)

    run, epoch, train, kind = Run(Path(order["run"])), order["epoch"], order["train"], order["service"]
    service = SERVICES[kind](tracked_of(run, train, order["facts"]), order["settings"])
    try:
        service.prepare()
    except ServiceRefused as refused:
        report(refused=str(refused))
        return
    report(ready=True)
    sender, lock, waits_for = Sender(run, service, kind, same_iterations(train), say), SenderLock(run, kind), None
    resumed_from, ending = None, None
    while ending is None:
        if select.select([0], [], [], POLL_SECONDS)[0]:
            ending = json.loads(sys.stdin.buffer.readline() or b'{"end": "failed"}')
        try:
            check_epoch(run, epoch)
            resumed_from = _resumed_from(run, epoch) if resumed_from is None else resumed_from
            if resumed_from is None:  # this attempt has not begun to train
                continue
            other = lock.take()
            if other is None:
                sender.step(resumed_from, epoch)
            elif other != waits_for:
                say(f"{other} sends this run; what is new is sent after it")
            waits_for = other
        except StaleEpoch:
            return
        except (OSError, ValueError):  # the volume can't be reached
            continue
    try:
        if resumed_from is None:
            report(done=True)
        elif lock.take() is None and sender.step(resumed_from, epoch, at_once=True):
            sender.finish(ending["end"])
            report(done=True)
    except Exception as error:
        say(f"warning: its end could not be sent ({one_line(error)})")


def _resumed_from(run: Run, epoch: int) -> int | None:
    """The iteration from which the attempt went on; None before it has written that, which is before its first one."""
    with contextlib.suppress(FileNotFoundError), open(run.metrics / f"metrics-e{epoch}.jsonl", "rb") as file:
        line = file.readline()
        if line.endswith(b"\n"):
            return int(json.loads(line)["resumed_from"])
    return None


def _own_output() -> int:
    """A descriptor of standard output for this module alone: what libraries print goes nowhere, and none finds a terminal to ask at."""
    output = os.dup(1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for standard in (1, 2):
        os.dup2(nowhere, standard)
    os.close(nowhere)
    return output


def afterwards(directory: str, kind: str) -> int:
    """Send what the service lacks of a run; returns the exit code."""
    run = Run(Path(directory).expanduser().absolute())
    described = run.description()
    spec = (described or {}).get("spec") or {}
    if not described or "train" not in spec:
        return _fail(f"{run.path} is not a run that a `train` job made; name a directory of runs/ in the store")
    if kind not in SERVICES:
        return _fail(f"no service is called {kind}; available: {', '.join(SERVICES)}")
    service = SERVICES[kind](tracked_of(run, spec["train"], {}), (spec.get("track") or {}).get(kind) or {})
    try:
        service.prepare()
        other = SenderLock(run, kind).take()
    except ServiceRefused as refused:
        return _fail(f"{kind}: {refused}")
    except OSError as error:
        return _fail(f"{kind}: {run.tracking} can't be written ({error.strerror})")
    if other is not None:
        return _fail(f"{kind}: {other} sends this run already; run this again once its training is over")
    settings = same_iterations(spec["train"])
    sender = Sender(run, service, kind, settings, lambda text: print(f"{kind}: {text}", flush=True))
    if not sender.step(None, 0):
        return _fail(f"{kind}: not everything was sent; run this again")
    try:
        sender.finish("finished")
    except Exception as error:
        return _fail(f"{kind}: its end could not be sent ({one_line(error)}); run this again")
    return 0


def _fail(text: str) -> int:
    print(f"error: {text}", file=sys.stderr, flush=True)
    return 2


if __name__ == "__main__":
    if len(sys.argv) == 1:
        beside_a_rank()
    elif len(sys.argv) == 3:
        sys.exit(afterwards(sys.argv[1], sys.argv[2]))
    else:
        sys.exit(_fail("usage: python -m worker.track RUN_DIRECTORY wandb|mlflow"))
