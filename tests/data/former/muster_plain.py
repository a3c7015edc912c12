"""muster_plain.py: an engine whose nodes are plain processes of this machine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from orchestrator.domain.hosts import Host, Hosts
from orchestrator.engines.api import (
    Engine,
    EngineError,
    EngineType,
    Gang,
    GangStatus,
    Handle,
    NodePhase,
    NodeStatus,
    Option,
    Plan,
    SecretValues,
    Setting,
    Traits,
    node_plans,
)
from orchestrator.engines.toolkit.endings import ended
from orchestrator.engines.toolkit.environment import inherited
from orchestrator.engines.toolkit.outcomes import recorded, store_facts
from orchestrator.engines.toolkit.waiting import wait_until
from shared_store.contract import sealed
from shared_store.ports import first_port
from shared_store.processes import Process, await_marks, end_all, marked, unkillable


# Other users can't read the environment of its processes, so it may hold secrets; its GPUs are this machine's own.
TRAITS = Traits(secrets=SecretValues.ENVIRONMENT, gpu_ids=True)


@dataclass(frozen=True)
class Command:
    """One node as it will be started."""

    arguments: Sequence[str]
    environment: Mapping[str, str]


class PlainEngine:
    """This machine."""

    name = "plain"
    traits = TRAITS
    address = None  # nodes find the bus on loopback

    def __init__(self, setting: Setting) -> None:
        cpus = setting.cpus or float(os.cpu_count() or 1)
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") >> 20
        self._hosts = Hosts([Host("plain/here", cpus, tuple(setting.gpus or ()), memory)])
        self._started: list[subprocess.Popen[bytes]] = []

    def capacity(self) -> Hosts:
        return self._hosts

    def plan(self, gang: Gang) -> Plan[Sequence[Command]]:
        # The port follows from the gang's name: a second plan says the same, and the next attempt has another one.
        nodes = node_plans(gang, ["127.0.0.1"] * len(gang.placements), first_port(gang.name))
        commands = []
        for node in nodes:
            gpus = ",".join(node.placement.gpus)
            told = sealed(node.environment, node.contract.to_env())
            supervisor = [sys.executable, "-P", "-m", "worker.supervisor", "--", *node.command]
            if nice := gang.options.get("niceness"):
                supervisor = ["nice", "-n", nice, *supervisor]
            commands.append(Command(supervisor, {**inherited(), "CUDA_VISIBLE_DEVICES": gpus, **told}))
        return Plan(gang, nodes, commands)

    def launch(self, plan: Plan[Sequence[Command]]) -> Handle:
        gang = plan.gang
        if gang.directory and not os.path.isdir(gang.directory):
            raise EngineError(f"working directory {gang.directory} is not on this machine")
        ranks = [node.contract.node_rank for node in plan.nodes]
        handle = Handle(self.name, gang.name, len(plan.nodes), {**store_facts(gang), "ranks": ranks})
        try:
            for index in sorted(range(len(ranks)), key=lambda index: index != gang.main):
                # One that runs, or ran to its end, was started by the controller before this one.
                if not self._node(handle, index) and recorded(handle, index) is None:
                    self._start(plan.request[index], gang.directory)
        except BaseException:
            end_all(lambda: marked([f"MUSTER_GANG={gang.name}"]))  # never half a gang
            raise
        return handle

    def observe(self, handle: Handle) -> GangStatus:
        self._started = [process for process in self._started if process.poll() is None]
        return [self._status(handle, index) for index in range(handle.nodes)]

    def stop(self, handle: Handle, grace: float) -> None:
        mark = [f"MUSTER_GANG={handle.gang}"]
        found = marked(mark)
        inner = {process.pid for process in found}
        for process in found:
            if process.parent not in inner:  # a supervisor: it tells its ranks
                try:
                    os.kill(process.pid, signal.SIGTERM)
                except ProcessLookupError:
                    pass  # it has just ended
        if not wait_until(lambda: not marked(mark), grace) and (left := end_all(lambda: marked(mark))):
            raise EngineError(f"{unkillable(left)}; what it holds is not given to other jobs until it is gone")

    def close(self) -> None:
        pass

    def _start(self, command: Command, directory: str | None) -> None:
        process = subprocess.Popen(
            list(command.arguments),
            env=dict(command.environment),
            cwd=directory,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        self._started.append(process)
        await_marks(process.pid)

    def _status(self, handle: Handle, index: int) -> NodeStatus:
        if self._node(handle, index):
            return NodeStatus(NodePhase.RUNNING, "127.0.0.1")
        outcome = recorded(handle, index)
        return ended("127.0.0.1", outcome.exit_code if outcome else None)

    @staticmethod
    def _node(handle: Handle, index: int) -> Sequence[Process]:
        return marked([f"MUSTER_GANG={handle.gang}", f"NODE_RANK={handle.facts['ranks'][index]}"])


def make(setting: Setting) -> Engine:
    return PlainEngine(setting)


ENGINE = EngineType(make, options=(Option("niceness", "how nice its nodes are, 0 to 19", int),), traits=TRAITS)
