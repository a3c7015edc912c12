"""The Ray engine: nodes are actors' children on the machines of a Ray cluster.

Ray places the gang (a ``STRICT_SPREAD`` placement group), starts an actor on each machine, tells of machines that die or will leave,
and asks its autoscaler for more. All of that is done by two kinds of processes that import Ray: a watch that reads the cluster's
tables, and for each job a driver, which outlives the controller and is found again by the pipe in its folder
(:mod:`orchestrator.engines.ray.folder`). This module does not import Ray, which aborts a process that loses its cluster.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import Any

from orchestrator.domain.hosts import Host, Hosts
from orchestrator.engines.api import (
    Cause,
    EngineError,
    Gang,
    GangStatus,
    Handle,
    NodePhase,
    NodePlan,
    NodeStatus,
    NotYet,
    Plan,
    StatusOrError,
    node_plans,
)
from orchestrator.engines.ray import TRAITS
from orchestrator.engines.ray.cluster import ClusterWatch, address_towards, grows_to, ray_environment
from orchestrator.engines.ray.folder import LEASE, NEW, UNSTARTED, Folder
from orchestrator.engines.ray.placement_groups import GangRequest, NodeRequest, in_words
from orchestrator.engines.toolkit.mounts import mounts_of, with_mounts
from orchestrator.engines.toolkit.statuses import ended, one_by_one
from orchestrator.engines.toolkit.waiting import stop_within
from shared_store.process.ports import first_port
from shared_store.volume.files import read_json, write_json

DEFAULT_ADDRESS = "127.0.0.1:6379"
_DRIVERS = 3
"""How many drivers are started for a gang after one that died before it had started anything."""
_SUSPECT, _SUSPECT_IF_SILENT = 20.0, 70.0
"""Seconds for which a machine that lost its part of a gang does not count as a host: until Ray, too, knows whether it is there."""
_ENDING = 4 * LEASE
"""Seconds beyond the grace time that a gang may take to end: a driver that hangs is killed after two leases, its actors follow in one."""
_KEPT = 7 * 86400.0
"""Seconds for which a job's folder is kept when it is over."""


class RayEngine:
    """One Ray cluster."""

    name = "ray"
    traits = TRAITS

    def __init__(self, home: Path, address: str | None = None) -> None:
        """Args:
        home: ``$MUSTER_HOME``; the jobs' folders go below it.
        address: ``host:port`` of the cluster's head; that of ``RAY_ADDRESS`` by default.

        Raises:
            EngineError: Ray is not installed, the cluster does not answer, wants another token or has other versions, or this
                machine is not a node of it.
        """
        self.home = home
        self.head = address or os.environ.get("RAY_ADDRESS") or DEFAULT_ADDRESS
        if not re.fullmatch(r"[^/:]+:[0-9]+|\[[0-9a-f:]+\]:[0-9]+", self.head):
            raise EngineError(
                f"RAY_ADDRESS is {self.head!r}; the host:port of the cluster's head is needed, as 10.0.0.1:6379"
            )
        self._grows = grows_to(os.environ.get("MUSTER_RAY_GROWS_TO", ""))
        self._environment = ray_environment(self.head)
        self._watch = ClusterWatch(self.head, self._environment)
        if not self._watch.first()["join"]:
            self._watch.close()
            raise EngineError(_not_a_node(self.head))
        self.address = address_towards(self.head)
        self._drivers: dict[str, subprocess.Popen[bytes]] = {}
        self._tries: dict[str, int] = {}
        """How many drivers of a gang have died before they had started anything."""
        self._next_let_go = 0.0
        self._suspects: dict[str, float] = {}
        """Until when (monotonic [s]), by node id."""
        self._lock = threading.Lock()
        self._grown: dict[str, Sequence[str]] = {}
        """Hosts of the gangs for which machines were to be added; guarded by the lock, since stops forget gangs."""
        self._clear()

    # -- the cluster --------------------------------------------------------------------------------------------------

    def capacity(self) -> Hosts:
        """The machines that have CPUs, and those that the autoscaler could add (``ray/+1``, …).

        One that was added for a gang is called what the gang's placement calls it until that is over.

        Raises NotYet while the head does not answer: its last answer may be wrong.
        """
        if problem := self._watch.problem():
            raise NotYet(problem)
        machines = self._machines()
        free = (name for number in count(1) if (name := f"{NEW}{number}") not in machines)
        hosts = [_host(name, machine) for name, machine in machines.items()]
        for shape in [*self._grows, *self._watch.seen.get("grows", [])]:
            like = [m for m in machines.values() if (m["cpus"], m["gpus"]) == (shape["cpus"], shape["gpus"])]
            hosts += [_host(next(free), shape) for _ in range(shape["most"] - len(like))]
        return Hosts(hosts)

    def _machines(self) -> dict[str, dict[str, Any]]:
        """The cluster's machines that have CPUs, by host name."""
        now, nodes = time.monotonic(), self._watch.seen.get("nodes", [])
        nodes = [node for node in nodes if node["cpus"] > 0 and self._suspects.get(node["id"], 0.0) < now]
        names = [node["name"] for node in nodes]
        taken = self._taken()
        found = {}
        for node in nodes:
            twin = names.count(node["name"]) > 1
            found[taken.get(node["id"]) or f"ray/{node['name']}{'-' + node['id'][:6] if twin else ''}"] = node
        return found

    def _taken(self) -> dict[str, str]:
        """Names under which gangs hold machines that were added for them, by node id."""
        names = {}
        with self._lock:
            grown = list(self._grown.items())
        for gang, hosts in grown:
            state = read_json(Folder.of(self.home, gang).state(gang)) or {}
            for host, node in zip(hosts, state.get("nodes", ()), strict=False):
                if host.startswith(NEW) and node["ray_node"]:
                    names[node["ray_node"]] = host
        return names

    # -- gangs --------------------------------------------------------------------------------------------------------

    def plan(self, gang: Gang) -> Plan[GangRequest]:
        """With the placement group. Addresses of machines that are not there yet are empty; the port is chosen on the main node's."""
        machines = self._machines()
        addresses = [machines[p.host]["address"] if p.host in machines else "" for p in gang.placements]
        nodes = node_plans(gang, addresses, first_port(gang.name))
        request = GangRequest(gang.name, gang.main, gang.directory, [_request(gang, node, machines) for node in nodes])
        return Plan(gang, nodes, request, in_words(request.document()))

    def launch(self, plan: Plan[GangRequest]) -> Handle:
        gang = plan.gang
        folder = Folder.of(self.home, gang.job)
        hosts = [placement.host for placement in gang.placements]
        if not folder.state(gang.name).exists():
            problem = self._watch.problem() or ("" if self._watch.seen["join"] else _not_a_node(self.head))
            if problem:
                raise NotYet(f"{problem}; waiting for it")
            folder.make()
            write_json(folder.plan(gang.name), plan.request.document())
            folder.plan(gang.name).chmod(0o600)
            self._let_go(gang.job)
            self._drive(folder, gang.name)
        handle = Handle(self.name, gang.name, len(hosts), {"hosts": hosts})
        self._note(handle)
        return handle

    def observe(self, handles: Sequence[Handle]) -> Sequence[StatusOrError]:
        return one_by_one(self._observe, handles)

    def _observe(self, handle: Handle) -> GangStatus:
        gang, size, folder = handle.gang, handle.nodes, Folder.of(self.home, handle.gang)
        state = read_json(folder.state(gang))
        if state is None or state["phase"] != "stopped":
            self._note(handle)
        if state is None:
            if not folder.plan(gang).exists():
                return [ended("", None)] * size
            driver = self._drivers.get(folder.path.name)
            if driver is not None and driver.poll():  # one that left with 0 did so before it was asked
                return [ended("", 1, f"its driver can't run: {folder.last_line()}")] * size
            self._drive(folder, gang)
            return [NodeStatus(NodePhase.STARTING, words="its driver is starting")] * size
        driven = folder.send() or state["phase"] == "stopped"
        if not driven:  # its last words may have come in between
            state = read_json(folder.state(gang)) or state
            if state["phase"] in UNSTARTED and any(node["running"] for node in state["nodes"]):
                return self._drive_again(folder, handle, state)
        if state["phase"] == "placing" and time.monotonic() > self._next_let_go:
            self._next_let_go = time.monotonic() + 1.0
            self._let_go(folder.path.name)
        for node in state["nodes"]:
            if driven and state["phase"] == "running" and not node["running"] and node["code"] is None:
                until = time.monotonic() + (_SUSPECT_IF_SILENT if node.get("silent") else _SUSPECT)
                self._suspects.setdefault(node["ray_node"], until)
        return [_status(node, state, driven) for node in state["nodes"]]

    def stop(self, handle: Handle, grace: float) -> None:
        gang, folder = handle.gang, Folder.of(self.home, handle.gang)
        last_request, patience = 0.0, time.monotonic() + grace + 2 * LEASE

        def step() -> str:
            nonlocal last_request
            state = read_json(folder.state(gang))
            phase = state["phase"] if state is not None else ""
            if phase == "stopped" or (state is None and not folder.plan(gang).exists()):
                return ""
            if state is not None and phase == "stopping" and state["why"]:
                raise EngineError(f"{state['why']}; its CPUs and GPUs are not given to other jobs until it is gone")
            now = time.monotonic()
            if now > patience and state is not None:  # frozen; its actors have missed it for long enough
                with contextlib.suppress(ProcessLookupError):
                    os.kill(state["driver"], signal.SIGKILL)
            if now - last_request > 2.0:
                last_request = now
                if not folder.send({"do": "stop", "gang": gang, "grace": grace}):
                    self._outwait(folder, gang)
            return f"its driver reports {phase}" if phase else "its driver has reported nothing yet"

        stop_within(grace + _ENDING, step, engine=self.name, gang=gang, pause=0.02)
        self._tries.pop(gang, None)
        with self._lock:
            self._grown.pop(gang, None)

    def close(self) -> None:
        """End the watch; drivers go on."""
        self._watch.close()

    @staticmethod
    def _outwait(folder: Folder, gang: str) -> None:
        """The driver died. Ray ends the actors of a dead driver, and an actor that hears of none for a while ends itself."""
        folder.plan(gang).unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # a driver that never joined the cluster left no heartbeat
            age = time.time() - folder.alive.stat().st_mtime
            time.sleep(min(max(0.0, LEASE + 1.0 - age), LEASE + 1.0))
        if state := read_json(folder.state(gang)):
            nodes = [{**node, "running": False} for node in state["nodes"]]
            write_json(folder.state(gang), {**state, "nodes": nodes, "phase": "stopped"})

    def _note(self, handle: Handle) -> None:
        hosts = handle.facts["hosts"]
        if any(host.startswith(NEW) for host in hosts):
            with self._lock:
                self._grown[handle.gang] = hosts

    def _drive(self, folder: Folder, gang: str) -> None:
        """Have the job's driver take the gang up; start one where there is none."""
        if folder.send({"do": "run", "gang": gang}):
            return
        folder.alive.unlink(missing_ok=True)
        # it reads, and never sees the pipe's end; the driver is born with it
        commands = os.open(folder.pipe, os.O_RDWR | os.O_NONBLOCK)
        job = folder.path.name
        command = [sys.executable, "-P", "-m", "orchestrator.engines.ray.driver", str(folder.path)]
        try:
            with open(folder.errors, "ab") as errors:
                self._drivers[job] = subprocess.Popen(
                    [*command, str(self._watch.seen.get("join")), str(commands)],
                    env={**self._environment, "MUSTER_JOB_ID": job, "MUSTER_STORE": str(self.home)},
                    pass_fds=(commands,),
                    cwd=folder.path,  # Ray has workers look for modules where their driver was started
                    stdin=subprocess.DEVNULL,
                    stdout=errors,
                    stderr=errors,
                    start_new_session=True,
                )
            folder.send({"do": "run", "gang": gang})
        finally:
            os.close(commands)

    def _drive_again(self, folder: Folder, handle: Handle, state: Mapping[str, Any]) -> GangStatus:
        """A driver died before it had started anything: another one begins, a few times."""
        died = f"its driver died before it had started anything ({folder.last_line()})"
        tries = self._tries[handle.gang] = self._tries.get(handle.gang, 0) + 1
        if tries > _DRIVERS:
            return [ended(node["address"], None, died) for node in state["nodes"]]
        folder.state(handle.gang).unlink(missing_ok=True)
        self._drive(folder, handle.gang)
        return [NodeStatus(NodePhase.STARTING, words=f"{died}; another one is starting")] * handle.nodes

    def _let_go(self, job: str) -> None:
        """Ask drivers that only hold resources for another job's next attempt to exit, and reap those that have."""
        self._drivers = {name: process for name, process in self._drivers.items() if process.poll() is None}
        for path in (self.home / "ray").glob("*"):
            if path.name != job:
                Folder(path).send({"do": "leave"})

    def _clear(self) -> None:
        """Remove the folders of jobs that have long been over."""
        for path in (self.home / "ray").glob("*"):
            if time.time() - path.stat().st_mtime > _KEPT and not Folder(path).send():
                shutil.rmtree(path, ignore_errors=True)


def _request(gang: Gang, node: NodePlan, machines: Mapping[str, Mapping[str, Any]]) -> NodeRequest:
    """A node's part of the request to the driver; ``machines``: those of the cluster, by host name. Raises EngineError."""
    placement, container = node.placement, gang.nodes[node.contract.node_index].container
    return NodeRequest(
        contract=node.contract,
        command=list(node.command),
        environment=dict(node.environment),
        prefix=with_mounts([], mounts_of(container, gang.store), RayEngine.name),
        cpus=placement.cpus,
        gpus=len(placement.gpus),
        memory=placement.memory,
        host=placement.host,
        # a machine that left since is not waited for: any other that has room will do
        pin=machines[placement.host]["id"] if placement.host in machines else None,
    )


def _status(node: Mapping[str, Any], state: Mapping[str, Any], driven: bool) -> NodeStatus:
    """The status of a node, by its driver's report; ``driven``: the driver is there, or had nothing more to do."""
    gpus = tuple(filter(None, node.get("gpus", "").split(",")))
    if not (node["running"] and driven):
        detail = node["detail"] if driven or not node["running"] else "its driver died"
        over = ended(node["address"], node["code"], detail, gpus)
        # a driver of an older version says no cause
        return dataclasses.replace(over, cause=Cause(node["cause"])) if node.get("cause") else over
    if node["started"] or not state["why"]:
        return NodeStatus(NodePhase.RUNNING, node["address"], gpus=gpus)
    phase = NodePhase.QUEUED if state["phase"] == "placing" else NodePhase.STARTING
    return NodeStatus(phase, node["address"], state["why"], gpus=gpus)


def _not_a_node(head: str) -> str:
    return (
        f"this machine is not a node of the Ray cluster at {head}, and drivers run on one: "
        f"`ray start --address={head} --num-cpus=0` makes it one"
    )


def _host(name: str, shape: Mapping[str, Any]) -> Host:
    """Ray says which GPUs a node gets; until then they have numbers."""
    gpus = tuple(str(number) for number in range(shape["gpus"]))
    return Host(name, shape["cpus"], gpus, shape["memory"], single=True)
