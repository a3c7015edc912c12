"""The actor of a gang's driver on each node of a Ray cluster: it starts the node's supervisor and ends it.

It travels to the node by value, since that may have another version of Muster, or none: that has to be reported. So it imports
nothing but the standard library. Python and Muster are those of the node.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

_OF_RAY = ("OMP_NUM_THREADS", "PYTHONBREAKPOINT")
"""Variables that Ray sets in its workers; a node's command does not get them."""


class Node:
    """One node of a gang. Methods that wait and methods that do not run side by side."""

    def __init__(self, marks: Mapping[str, str], lease: float) -> None:
        """Args:
        marks: Variables that every process of the node, and of no other, has in its environment.
        lease: Seconds without :meth:`beat` after which the node is ended: its driver is gone, or cut off.
        """
        self.marks, self.lease = [f"{name}={value}" for name, value in marks.items()], lease
        self.last_call = time.monotonic()
        self._order: tuple[list[str], dict[str, str], str | None] | None = None
        self._started, self._ended, self._ordered = threading.Event(), threading.Event(), threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._shim: Any = None
        """``shared_store.process.node_processes.NodeProcesses`` of the node."""
        self._problem = ""
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the actor
        # The kernel ties a child to the thread that started it: to one that lives as long as the process.
        threading.Thread(target=self._keep, name="keeper", daemon=True).start()

    def facts(self, version: str, directory: str | None, store: str, run: str, epoch: int, gang: str) -> dict[str, Any]:
        """Facts that the driver needs before it starts anything: the version of Muster here, the GPUs, a free port, what is missing.

        Args:
            version: Of Muster, the driver's; the driver refuses another one.
            directory: Working directory of the node.
            store: Path of the shared volume.
            run: The run, to which the controller has given ``epoch`` on that volume.
            epoch: The gang's.
            gang: Its name. ``port`` is where its nodes could meet on this machine; 0 where no port is free.
        """
        try:
            from shared_store import __version__ as muster
        except ImportError as error:
            return {"problem": f"Muster is not installed there for {sys.executable} ({error})"}
        for title, path in ("working directory", directory), ("store", store):
            if path and not os.path.isdir(path):
                return {"problem": f"{title} {path} is not there: it has to be on a volume that all nodes share"}
        gpus = os.environ.get("CUDA_VISIBLE_DEVICES", "")
        if muster != version:
            return {"version": muster, "gpus": gpus, "port": 0, "problem": ""}
        from shared_store.process.ports import free_port

        port = 0
        with contextlib.suppress(OSError):
            port = free_port(gang)
        return {"version": muster, "gpus": gpus, "port": port, "problem": _foreign(store, run, epoch)}

    def start(
        self,
        prefix: Sequence[str],
        command: Sequence[str],
        user: Mapping[str, str],
        contract: Mapping[str, str],
        gpus: int,
        directory: str | None,
        named: Sequence[str] = (),
    ) -> str:
        """Start the supervisor; returns why it could not be started, or nothing.

        Args:
            prefix: Put before it: what gives it its mounts.
            command: What it supervises.
            user: The job's environment, which goes over that of the node.
            contract: The node contract, which goes over both.
            gpus: How many GPUs the node has; which ones is for Ray to say.
            directory: Working directory.
            named: Variables of this machine that the controller's ``--inherit`` names.
        """
        # Muster is here by now, and of the same version: see facts()
        from orchestrator.engines.toolkit.environment import inherited, named_variables, node_environment, supervised

        own = inherited(_OF_RAY, ("RAY_",), named=[*named_variables(), *named])
        visible = os.environ.get("CUDA_VISIBLE_DEVICES", "") if gpus else ""
        environment = node_environment(own, visible, user, contract)
        self._order = ([*prefix, *supervised(command)], environment, directory)
        self._ordered.set()
        self._started.wait()
        return self._problem

    def wait(self) -> tuple[int, str]:
        """Block until the supervisor has ended; its exit code (128 + n for signal n) and its last words."""
        self._ended.wait()
        assert self._process is not None
        code = self._process.returncode
        self._errors.seek(0)
        words = self._errors.read().decode(errors="replace").strip().rpartition("\n")[2]
        return code if code >= 0 else 128 - code, words

    def beat(self) -> None:
        """The driver is there."""
        self.last_call = time.monotonic()

    def leave(self) -> None:
        """Ask the supervisor to leave (SIGTERM): it saves, within its grace time."""
        if self._process is not None and not self._ended.is_set():
            with contextlib.suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGTERM)

    def stop(self, grace: float) -> str:
        """SIGTERM, ``grace`` seconds later SIGKILL; what of the node can't be killed, or nothing once no process of it is left."""
        if self._process is not None:
            self.leave()
            self._ended.wait(grace)
        return self._end()

    def _keep(self) -> None:
        while not self._ordered.wait(0.5):
            if self._abandoned():
                os._exit(1)
        assert self._order is not None
        command, environment, directory = self._order
        try:
            from shared_store.process.cgroups import own_group
            from shared_store.process.node_processes import NodeProcesses
            from shared_store.process.processes import find_process
            from shared_store.process.shim import shimmed

            name = "-".join(mark.partition("=")[2] for mark in self.marks).replace("/", "-")
            group = f"{groups}/muster-{name}" if (groups := own_group()) else ""
            self._process = subprocess.Popen(
                # where the actor is killed (Ray does that to the actors of a driver that died) the shim ends the node
                shimmed(command, group, tied_to=os.getpid()),
                env=environment,
                cwd=directory,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._errors,
                start_new_session=True,
            )
            shim = find_process(self._process.pid)
            self._shim = NodeProcesses(self._process.pid, shim.start if shim else "", group)
        except (ImportError, OSError, ValueError) as error:
            self._problem = f"can't start the node: {error}"
            self._started.set()
            return
        self._started.set()
        while True:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(0.5)
                break
            if self._abandoned():
                self._end()
                os._exit(1)
        self._end()  # a shim that was killed has left what it should have ended
        self._ended.set()
        while not self._abandoned():
            time.sleep(0.5)
        os._exit(1)

    def _abandoned(self) -> bool:
        return time.monotonic() - self.last_call > self.lease

    def _end(self) -> str:
        """SIGKILL to all of the node; what it does not end, or nothing."""
        if self._shim is None:
            return ""
        from shared_store.process.node_processes import end_nodes
        from shared_store.process.processes import unkillable

        left = end_nodes([self._shim], self.marks)
        return unkillable(left) if left else ""


def _foreign(store: str, run: str, epoch: int) -> str:
    """Why the store here is not the controller's; empty where it is. For a node with the driver's version of Muster."""
    from shared_store.volume.epoch import StaleEpoch, find_epoch
    from shared_store.volume.layout import Store, StoreError

    try:
        find_epoch(Store(store).run(run), epoch)
    except (StaleEpoch, StoreError, ValueError, OSError) as error:
        return str(error)
    return ""
