"""The local engine: nodes are process groups on this machine, each with its own loopback address and its share of it.

Supervisors outlive the controller. A restarted controller finds them again by pid and start time, and every process of a gang
by the gang's name in its environment.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from orchestrator.engines.base import (
    HERE,
    PRIVATE,
    EngineError,
    Gang,
    GangStatus,
    Host,
    NodeStatus,
    Plan,
    Transient,
    node_plans,
)
from orchestrator.engines.gpus import visible_gpus
from orchestrator.engines.mounts import mounts_of, with_mounts
from shared_store.layout import Store
from shared_store.outcomes import read_outcome

_FIRST_PORT = 29500
_UNSEEN = (FileNotFoundError, ProcessLookupError, PermissionError)
"""What reading ``/proc/<pid>`` raises for a process that is gone or another user's; any other error says nothing about it."""


class LocalEngine:
    """One machine as an engine."""

    name = "local"
    queues = False
    elastic = False
    images = False
    address: str | None = None

    def __init__(self, home: Path, cpus: float | None = None, gpus: Sequence[str] | None = None) -> None:
        """Args:
        home: ``$MUSTER_HOME``: the kernel cache and what supervisors say before they reach the store go below it.
        cpus: CPU cores to hand out; those of the machine by default. More than it has is allowed (they are shared).
        gpus: Ids of the GPUs to hand out; those that the driver lists by default.
        """
        self.home = home
        self._host = Host(
            "localhost",
            cpus or float(os.cpu_count() or 1),
            tuple(gpus if gpus is not None else visible_gpus()),
            _memory(),
            machine=HERE,
        )
        self._children: dict[int, subprocess.Popen[bytes]] = {}

    def capacity(self) -> Sequence[Host]:
        return [self._host]

    def plan(self, gang: Gang) -> Plan:
        addresses = [_address(gang, index) for index in range(len(gang.placements))]
        return Plan(gang, node_plans(gang, addresses, _FIRST_PORT))

    def launch(self, plan: Plan) -> str:
        gang = plan.gang
        if gang.directory and not Path(gang.directory).is_dir():
            raise EngineError(f"working directory {gang.directory} is not on this machine")
        master = plan.nodes[gang.main].contract.master_address
        found = _supervisors(gang.name)
        running = {index: pid for pid, index, _ in found}
        # a node that is started late must meet the others where they are
        port = found[0][2] if found else _free_port(master)
        run = Store(gang.store).run(gang.run)
        nodes: dict[int, dict[str, object]] = {}
        before = set(self._children)
        try:
            for index in sorted(range(len(plan.nodes)), key=lambda index: index != gang.main):
                ended = index not in running and read_outcome(run, gang.job, gang.attempt, index) is not None
                pid = 0 if ended else running.get(index) or self._start(plan, index, port)
                nodes[index] = {"pid": pid, "start": _start_time(pid), "address": plan.nodes[index].contract.address}
        except BaseException as error:  # never half a gang
            # by its pid: for a moment after it was started a process has no environment yet by which it would be found
            for pid in self._children.keys() - before:
                child = self._children.pop(pid)
                child.kill()
                child.wait()
            try:
                _end(gang.name)
            except OSError as trouble:  # /proc can't be read now: the next try finds what may be left
                said = f"can't start the gang now ({error}), nor look for what is left of it ({trouble}); trying again"
                raise Transient(said, unknown=True) from error
            raise
        return json.dumps({"gang": gang.name, "nodes": [nodes[index] for index in range(len(nodes))]})

    def observe(self, handle: str) -> GangStatus:
        state = json.loads(handle)
        return [self._observe_node(state["gang"], index, node) for index, node in enumerate(state["nodes"])]

    def stop(self, handle: str, grace: float) -> None:
        state = json.loads(handle)
        deadline = time.monotonic() + grace
        nodes = state["nodes"]
        for node in nodes:
            if _alive(node["pid"], node["start"]):
                _signal(node["pid"], signal.SIGTERM)
        while any(_alive(node["pid"], node["start"]) for node in nodes) and time.monotonic() < deadline:
            time.sleep(0.02)
        # What is left now did not leave in time, or lost its supervisor: end it, and all that carries the gang's name.
        _end(state["gang"])

    def close(self) -> None:
        """Supervisors go on."""

    def _start(self, plan: Plan, index: int, port: int) -> int:
        node = plan.nodes[index]
        inherited = {name: value for name, value in os.environ.items() if name not in (*PRIVATE, "SLURM_JWT")}
        contract = {**node.contract.to_env(), "MASTER_PORT": str(port)}
        env = {
            **inherited,
            "PATH": f"{Path(sys.executable).parent}:{inherited.get('PATH', '/usr/bin:/bin')}",
            "WARP_CACHE_PATH": inherited.get("WARP_CACHE_PATH", str(self.home / "kernels")),
            "CUDA_VISIBLE_DEVICES": ",".join(node.placement.gpus),
            **node.environment,
            **contract,
        }
        # -P: a folder called "worker" in the job's directory must not hide ours
        command = [sys.executable, "-P", "-m", "worker.supervisor", "--", *node.command]
        container = plan.gang.containers[index] if plan.gang.containers else {}
        said = self._said(plan.gang.name, index)
        said.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with open(said, "ab") as stderr:
            process = subprocess.Popen(
                with_mounts(command, mounts_of(container, plan.gang.store)),
                env=env,
                cwd=plan.gang.directory,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                start_new_session=True,
            )
        self._children[process.pid] = process
        return process.pid

    def _observe_node(self, gang: str, index: int, node: dict[str, object]) -> NodeStatus:
        pid, start, address = int(str(node["pid"])), str(node["start"]), str(node["address"])
        child = self._children.get(pid)
        code = child.poll() if child else None
        if code is None and _alive(pid, start):
            return NodeStatus(True, address)
        said = self._said(gang, index)
        detail = said.read_text(errors="replace").strip().rpartition("\n")[2] if said.exists() else ""
        return NodeStatus(False, address, None if code is None else code if code >= 0 else 128 - code, detail)

    def _said(self, gang: str, index: int) -> Path:
        return self.home / "supervisors" / f"{gang.replace('/', '-')}-node-{index}.err"


def _address(gang: Gang, index: int) -> str:
    """A loopback address of the node's own: 127.64–127.a.b, one /24 a gang, so that two gangs can use the same ports."""
    digest = hashlib.sha256(gang.name.encode()).digest()
    return f"127.{64 + digest[0] % 63}.{digest[1]}.{index + 1}"


def _free_port(address: str) -> int:
    """The first port from 29500 that nobody listens on at ``address``. Raises EngineError where there is none."""
    for port in range(_FIRST_PORT, _FIRST_PORT + 200):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address, port))
                return port
            except OSError:
                continue
    raise EngineError(f"no free port from {_FIRST_PORT} on {address}")


def _start_time(pid: int) -> str:
    """Start time of a process in clock ticks since boot, which tells it from a later one with its pid; empty if it is gone."""
    fields = _stat(pid)
    return fields[19] if fields else ""


def _alive(pid: int, start: object) -> bool:
    """Whether the process exists and is no zombie. Raises OSError where that can't be told now."""
    fields = _stat(pid)
    return fields is not None and fields[0] not in "ZX" and fields[19] == start


def _stat(pid: int) -> list[str] | None:
    """``/proc/<pid>/stat`` from the process's state (field 3) on; None where there is no such process.

    Raises OSError where it can't be read now, without free descriptors for instance: that is not the death of a process.
    """
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return None


def _processes(gang: str) -> list[int]:
    """Every process, zombies left out, that carries ``MUSTER_GANG=<gang>`` in its environment."""
    return [pid for pid, _ in _scan(gang)]


def _end(gang: str) -> None:
    while pids := _processes(gang):
        for pid in pids:
            _signal(pid, signal.SIGKILL)
        time.sleep(0.02)


def _supervisors(gang: str) -> list[tuple[int, int, int]]:
    """Pid, node index and master port of the gang's supervisors."""
    found = []
    for pid, environment in _scan(gang):
        try:
            command = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        except _UNSEEN:
            continue
        index = environment.get(b"AWS_BATCH_JOB_NODE_INDEX", b"0")  # a single-node job has none
        # its ranks are children of it; a supervisor that is still being given its mounts has another command in front
        if b"worker.supervisor" in command and b"TORCHELASTIC_ERROR_FILE" not in environment and index.isdigit():
            found.append((pid, int(index), int(environment[b"MASTER_PORT"])))
    return found


def _scan(gang: str) -> list[tuple[int, dict[bytes, bytes]]]:
    wanted = gang.encode()
    found = []
    for entry in os.listdir("/proc"):
        if not entry.isdigit() or int(entry) == os.getpid():
            continue
        try:
            raw = Path(f"/proc/{entry}/environ").read_bytes()
            if wanted not in raw or not _alive(int(entry), _start_time(int(entry))):
                continue
        except _UNSEEN:
            continue
        environment = dict(item.split(b"=", 1) for item in raw.split(b"\0") if b"=" in item)
        if environment.get(b"MUSTER_GANG") == wanted:
            found.append((int(entry), environment))
    return found


def _signal(pid: int, number: int) -> None:
    try:
        os.kill(pid, number)
    except (ProcessLookupError, PermissionError):
        pass


def _memory() -> int:
    """Memory of the machine in MiB."""
    return int(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**20)
