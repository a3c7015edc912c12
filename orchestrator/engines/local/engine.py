"""The local engine: nodes are process groups on this machine, each with its own loopback address and its share of it.

Each supervisor has a shim as its parent (:mod:`shared_store.process.shim`), and a control group where these can be made. Both outlive the
controller. A restarted controller finds the shims again by pid and start time, what a node leaves behind by its control group and by
the gang's name in its environment.
"""

from __future__ import annotations

import grp
import hashlib
import logging
import os
import pwd
import re
import resource
import signal
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from orchestrator.domain.hosts import HERE, Host, Hosts
from orchestrator.engines.api import (
    EngineError,
    Gang,
    GangStatus,
    Handle,
    NodePhase,
    NodePlan,
    NodeStatus,
    Plan,
    StatusOrError,
    Transient,
    node_plans,
    unused_user,
)
from orchestrator.engines.local import TRAITS
from orchestrator.engines.local.forks import ForkServer, prepared
from orchestrator.engines.local.gangs import parent_of
from orchestrator.engines.toolkit.environment import inherited, node_environment, supervised
from orchestrator.engines.toolkit.gpus import visible_gpus
from orchestrator.engines.toolkit.mounts import mounts_of, with_mounts
from orchestrator.engines.toolkit.statuses import ended, one_by_one
from orchestrator.engines.toolkit.waiting import wait_until
from shared_store.process.cgroups import own_group, remove_abandoned_groups
from shared_store.process.forking import module_of
from shared_store.process.memory_groups import memory_group, memory_home
from shared_store.process.node_processes import NodeProcesses, end_nodes
from shared_store.process.ports import first_port, free_port
from shared_store.process.processes import await_marks, find_process, marked, unkillable
from shared_store.process.shim import STUCK, exit_code_in, group_of, make_exit_file, shimmed
from shared_store.volume.layout import Store
from shared_store.volume.node_outcomes import read_outcome

log = logging.getLogger("muster.engines")

_ID = re.compile(r"[0-9]{1,10}")
"""A user or a group by its number."""
_UNSEEN = (FileNotFoundError, ProcessLookupError, PermissionError)
"""Errors of reading ``/proc/<pid>`` of a process that is gone or another user's; any other error says nothing about it."""
_REMEMBERED = 256
"""Gangs whose nodes' ends are known after they were stopped: the controller asks once more when all has ended."""


@dataclass(frozen=True)
class NodeProcess:
    """One node's process as it is started."""

    command: Sequence[str]
    """Its shim, what gives it its mounts, its supervisor and the job's command."""
    environment: Mapping[str, str]
    """All of it. ``MASTER_PORT`` is the first that the gang would meet at: where that is taken, a launch takes the next free one."""
    group: str
    """Its control group; empty where none can be made."""
    directory: str | None
    forkable: int
    """Its ranks, if these may be forked; 0 for programs that have to be started."""


class LocalEngine:
    """One machine as an engine."""

    name = "local"
    traits = TRAITS
    address: str | None = None

    def __init__(self, home: Path, cpus: float | None = None, gpus: Sequence[str] | None = None) -> None:
        """Args:
        home: ``$MUSTER_HOME``: the kernel cache and what supervisors leave outside the store go below it.
        cpus: CPU cores to hand out; those of the machine by default. More than it has is allowed (they are shared).
        gpus: Ids of the GPUs to hand out; those that the driver lists by default.
        """
        self.home = home
        self._host = Host(
            "localhost",
            cpus or float(os.cpu_count() or 1),
            tuple(gpus if gpus is not None else visible_gpus()),
            int(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**20),
            machine=HERE,
        )
        self._children: dict[int, subprocess.Popen[bytes]] = {}
        self._groups = own_group()
        """Directory in which control groups of nodes are made; empty where they can't be."""
        self._memory = memory_home(self._groups, arrange=True)
        """Directory below which the memory of jobs of the Batch API is limited; empty where it can't be."""
        for directory in {self._groups, self._memory}:
            remove_abandoned_groups(directory)
        self._ended: dict[str, GangStatus] = {}
        self._files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        """Limit of open files of what is started: the controller raises its own later, and select() knows no file above 1023."""

    def capacity(self) -> Hosts:
        return Hosts([self._host])

    def plan(self, gang: Gang) -> Plan[Sequence[NodeProcess]]:
        addresses = [_address(gang, index) for index in range(len(gang.placements))]
        nodes = node_plans(gang, addresses, first_port(gang.name))
        for index, each in enumerate(gang.nodes):
            if user := each.container.get("user"):
                taken, note = _user(user)
                nodes[index] = replace(nodes[index], contract=replace(nodes[index].contract, user=taken, note=note))
        if self._memory and gang.isolated:  # of a job from YAML it is for the scheduler alone
            for index, node in enumerate(nodes):
                group, limit = memory_group(self._memory, _group_name(gang.name, index)), node.placement.memory
                contract = replace(node.contract, memory_group=group, memory_limit=limit)
                nodes[index] = replace(node, contract=contract)
        return Plan(gang, nodes, [self._process(gang, node) for node in nodes])

    def launch(self, plan: Plan[Sequence[NodeProcess]]) -> Handle:
        gang = plan.gang
        if gang.directory and not Path(gang.directory).is_dir():
            raise EngineError(f"working directory {gang.directory} is not on this machine")
        found = _shims(gang.name)
        # a node that is started late must meet the others where they are
        try:
            port = next((shim.port for shim in found.values()), 0) or free_port(gang.name)
        except OSError as error:  # none is free
            raise Transient(str(error)) from None
        run = Store(gang.store).run(gang.run)
        nodes: dict[int, dict[str, object]] = {}
        started: list[int] = []
        try:
            with self._forks(plan.request) as forks:
                for index in sorted(range(len(plan.nodes)), key=lambda index: index != gang.main):
                    if index in found:
                        pid, group = found[index].pid, found[index].group
                    elif read_outcome(run, gang.job, gang.attempt, index) is not None:
                        pid, group = 0, ""
                    else:
                        group = plan.request[index].group
                        pid = self._start(plan.request[index], port, gang.name, index, started, forks)
                    process, address = find_process(pid), plan.nodes[index].contract.address
                    start = process.start if process else ""
                    memory = plan.nodes[index].contract.memory_group
                    nodes[index] = {"pid": pid, "start": start, "address": address, "group": group, "memory": memory}
        except BaseException as error:  # never half a gang
            # by its pid: for a moment after it was started a process has no environment yet by which it would be found
            for pid in started:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                if child := self._children.pop(pid, None):
                    child.wait()
            try:
                end_nodes([_processes(node) for node in nodes.values()], [f"MUSTER_GANG={gang.name}"])
                self._forget(gang.name, list(nodes.values()))
            except OSError as trouble:  # /proc can't be read now: the next try finds what may be left
                words = f"can't start the gang now ({error}), nor look for what is left of it ({trouble}); trying again"
                raise Transient(words, unknown=True) from error
            raise
        return Handle(self.name, gang.name, len(nodes), {"nodes": [nodes[index] for index in range(len(nodes))]})

    def observe(self, handles: Sequence[Handle]) -> Sequence[StatusOrError]:
        return one_by_one(self._observe, handles)

    def _observe(self, handle: Handle) -> GangStatus:
        if handle.gang in self._ended:
            return self._ended[handle.gang]
        return [self._observe_node(handle.gang, index, node) for index, node in enumerate(handle.facts["nodes"])]

    def stop(self, handle: Handle, grace: float) -> None:
        """Raises EngineError where something of the gang can't be killed: it holds its place until it is gone."""
        gang, nodes = handle.gang, [_processes(node) for node in handle.facts["nodes"]]
        for node in nodes:
            if shim := node.shim:
                with suppress(ProcessLookupError, PermissionError):
                    os.kill(shim.pid, signal.SIGTERM)
        wait_until(lambda: not any((shim := node.shim) and shim.name != STUCK for node in nodes), grace, 0.02)
        # What is left now did not leave in time, or lost its supervisor: end it, and all that carries the gang's name.
        if left := end_nodes(nodes, [f"MUSTER_GANG={gang}"]):
            raise EngineError(f"{unkillable(left)}; its CPUs and GPUs are not given to other jobs until it is gone")
        self._ended[gang] = self._observe(handle)
        while len(self._ended) > _REMEMBERED:
            self._ended.pop(next(iter(self._ended)), None)
        self._forget(gang, handle.facts["nodes"])

    def close(self) -> None:
        """Supervisors go on."""

    @contextmanager
    def _forks(self, nodes: Sequence[NodeProcess]) -> Iterator[ForkServer | None]:
        """Where the nodes of a gang can be forked: a server of its own is worth it where several ranks would import the same."""
        server = prepared()
        with suppress(OSError):
            if server is None and sum(node.forkable for node in nodes) > 1:
                server = ForkServer()
        try:
            yield server
        finally:
            if server is not None:
                server.close()

    def _forget(self, gang: str, nodes: Sequence[Mapping[str, object]]) -> None:
        """Nothing of the gang is left: remove what was kept of its supervisors."""
        for index, node in enumerate(nodes):
            self._children.pop(int(str(node["pid"])), None)
            errors = self._left(gang, index, "err")
            try:
                if len(lines := errors.read_text(errors="replace").strip().splitlines()) > 1:
                    log.error("gang %s, node %d: its supervisor wrote:\n%s", gang, index, "\n".join(lines[-50:]))
                errors.unlink()
                self._left(gang, index, "exit").unlink()
            except OSError:
                pass  # it was never started, or this was done before

    def _process(self, gang: Gang, node: NodePlan) -> NodeProcess:
        own = inherited()
        own.setdefault("WARP_CACHE_PATH", str(self.home / "kernels"))
        gpus = ",".join(node.placement.gpus)
        environment = node_environment(own, gpus, node.environment, node.contract.to_env())
        index = node.contract.node_index
        group = f"{self._groups}/{_group_name(gang.name, index)}" if self._groups else ""
        mounts = mounts_of(gang.nodes[index].container, gang.store)
        command = with_mounts(supervised(node.command), mounts)
        is_plain = not (mounts or gang.isolated or node.contract.user)  # only isolated ones have a memory group
        forkable = node.contract.ranks_per_node if is_plain and module_of(node.command) else 0
        exit_file = str(self._left(gang.name, index, "exit"))
        whole = shimmed(command, group, files=self._files, exit_file=exit_file)
        return NodeProcess(whole, environment, group, gang.directory, forkable)

    def _start(
        self, node: NodeProcess, port: int, gang: str, index: int, started: list[int], forks: ForkServer | None
    ) -> int:
        """``port``: where the gang meets; ``started``: gets the pid as soon as there is one."""
        errors = self._left(gang, index, "err")
        errors.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        make_exit_file(str(self._left(gang, index, "exit")))
        environment = {**node.environment, "MASTER_PORT": str(port)}
        with open(errors, "ab") as stderr:
            pid = 0
            if forks is not None and node.forkable and forks.fits(environment):
                with suppress(OSError):  # it has ended
                    pid = forks.fork(node.command, environment, node.directory, stderr.fileno(), node.forkable)
            if not pid:
                process = subprocess.Popen(
                    list(node.command),
                    env=environment,
                    cwd=node.directory,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=stderr,
                    start_new_session=True,
                )
                pid = process.pid
                self._children[pid] = process
        started.append(pid)
        await_marks(pid)
        return pid

    def _observe_node(self, gang: str, index: int, node: Mapping[str, object]) -> NodeStatus:
        pid, address = int(str(node["pid"])), str(node["address"])
        child = self._children.get(pid)
        code = child.poll() if child else None
        shim = _processes(node).shim if code is None else None
        if shim is not None and shim.name != STUCK:
            return NodeStatus(NodePhase.RUNNING, address)
        if code is None:  # an earlier controller was its parent
            code = exit_code_in(str(self._left(gang, index, "exit")))
        words = ""
        with suppress(FileNotFoundError):  # another thread has just stopped the gang
            words = self._left(gang, index, "err").read_text(errors="replace").strip().rpartition("\n")[2]
        return ended(address, None if code is None else code if code >= 0 else 128 - code, words)

    def _left(self, gang: str, index: int, kind: str) -> Path:
        """The file of a supervisor: ``err`` has its standard error, ``exit`` its exit code."""
        return self.home / "supervisors" / f"{gang.replace('/', '-')}-node-{index}.{kind}"


def _user(wish: str) -> tuple[str | None, str]:
    """``UID:GID`` of ``user`` in a job definition, where it can be taken on, and a note for the log where not all of it is.

    Nodes have no image, so a name that this machine does not have is the image's, and is passed over like it. One that it has is taken
    on: that gives the job no more than a controller that runs as root would have given it.
    """
    name, _, group = wish.partition(":")
    if os.geteuid() != 0:
        return None, unused_user(wish, "the controller does not run as root")
    try:
        user = pwd.getpwuid(int(name)) if _ID.fullmatch(name) else pwd.getpwnam(name)
        uid, gid = user.pw_uid, user.pw_gid
    except KeyError:
        if not _ID.fullmatch(name):
            return None, unused_user(wish, f"this machine has no user {name}")
        uid = gid = int(name)
    note = ""
    try:
        gid = int(group) if _ID.fullmatch(group) else grp.getgrnam(group).gr_gid if group else gid
    except KeyError:  # the user alone: without it the job would have more rights, not fewer
        note = f"muster: group {group} is not used: this machine has no such group; the job runs with group {gid}"
    return f"{uid}:{gid}", note


def _group_name(gang: str, index: int) -> str:
    return f"muster-{gang.replace('/', '-')}-{index}"


def _address(gang: Gang, index: int) -> str:
    """A loopback address of the node's own in 127.64.0.0/10, so that two gangs can use the same ports: 254 nodes to each /24."""
    digest = hashlib.sha256(gang.name.encode()).digest()
    return f"127.{64 + digest[0] % 63}.{(digest[1] + index // 254) % 256}.{index % 254 + 1}"


@dataclass(frozen=True)
class _Shim:
    """The shim of a node that runs."""

    pid: int
    port: int
    """The gang's master port."""
    group: str


def _shims(gang: str) -> dict[int, _Shim]:
    """The shims of the gang's nodes that run, by node index."""
    found: dict[int, tuple[int, _Shim]] = {}
    for process in marked([f"MUSTER_GANG={gang}"]):
        try:
            group = group_of(Path(f"/proc/{process.pid}/cmdline").read_bytes().split(b"\0"))
            raw = Path(f"/proc/{process.pid}/environ").read_bytes()
        except _UNSEEN:
            continue
        if group is not None:
            environment = dict(item.split(b"=", 1) for item in raw.split(b"\0") if b"=" in item)
            index = int(environment.get(b"AWS_BATCH_JOB_NODE_INDEX", b"0"))  # a single-node job has none
            found[process.pid] = index, _Shim(process.pid, int(environment[b"MASTER_PORT"]), group)
    # between its fork and its exec a supervisor has the command line of its shim
    return {index: shim for pid, (index, shim) in found.items() if parent_of(pid) not in found}


def _processes(node: Mapping[str, object]) -> NodeProcesses:
    """Of a node in a handle; handles of older versions have no groups."""
    groups = (str(node.get(name) or "") for name in ("group", "memory"))
    return NodeProcesses(int(str(node["pid"])), str(node["start"]), *groups)
