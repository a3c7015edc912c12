"""A gang on a Ray cluster, as its driver has it: an actor on each node, the calls that are not answered, and the state of the nodes."""

from __future__ import annotations

import dataclasses
import json
import os
import time
from collections.abc import Mapping
from typing import Any

import ray
from ray.util.scheduling_strategies import PlacementGroupSchedulingStrategy

from orchestrator.engines.api import Cause
from orchestrator.engines.ray import node as ray_node
from orchestrator.engines.ray.folder import LEASE, Folder
from orchestrator.engines.ray.placement_groups import bundle_of
from orchestrator.engines.toolkit.environment import named_variables
from shared_store import __version__
from shared_store.contract.node import NodeContract
from shared_store.process.ports import first_port
from shared_store.volume.files import write_json

_BEAT = 2.0
"""Seconds between two heartbeats to an actor."""
_BROKEN = 3.0
"""Seconds after which an actor whose connection broke, and that does not answer on another, is given up."""
_ENDING = 15.0
"""Seconds beyond the grace time that an actor may take to kill its node, or to say what of it can't be killed."""
_STARTING = 60.0
"""Seconds that an actor may take to start: a machine that Ray believes alive may be frozen."""


class DrivenGang:
    """One attempt: its actors, and what is known of its nodes."""

    def __init__(self, plan: Mapping[str, Any], folder: Folder) -> None:
        self.plan, self.folder = plan, folder
        self.name: str = plan["gang"]
        self.contracts = [_contract(node["contract"]) for node in plan["nodes"]]
        self.phase, self.why = "joining", "joining the Ray cluster"
        self.placings = 0
        """How often it was placed."""
        self.deadline = self._next_beat = 0.0
        """When a stop has to be done with, and when the next heartbeats are due [monotonic s]."""
        self._reported: dict[str, Any] = {}
        """The state file's content."""
        self._unplace()

    def _unplace(self) -> None:
        fresh = {"running": True, "started": False, "address": "", "gpus": "", "code": None, "detail": ""}
        self.nodes: list[dict[str, Any]] = [{**fresh, "ray_node": node["pin"] or ""} for node in self.plan["nodes"]]
        self.actors: list[Any] = []
        self.pending_calls: dict[Any, tuple[str, int]] = {}
        """Calls of actors that are not answered: a kind and a node's index."""
        self.last_replies = [time.monotonic()] * len(self.nodes)
        self.leaving: set[int] = set()
        """Indices of nodes that have to leave."""
        self.broken: dict[int, float] = {}
        """Since when the connection to an actor is broken."""

    def publish(self) -> None:
        """Write the state file where something changed."""
        state = {"gang": self.name, "driver": os.getpid(), "phase": self.phase, "why": self.why, "nodes": self.nodes}
        if state != self._reported:
            write_json(self.folder.state(self.name), state)
            self._reported = json.loads(json.dumps(state))

    @property
    def lost(self) -> set[int]:
        """Indices of nodes that ended without an exit code."""
        return {index for index, node in enumerate(self.nodes) if not node["running"] and node["code"] is None}

    @property
    def is_over(self) -> bool:
        return not any(node["running"] for node in self.nodes)

    @property
    def is_stopping(self) -> bool:
        """Whether a node that was asked to end, or that is to say how it ended, has not answered yet."""
        return any(kind in ("stop", "wait") for kind, _ in self.pending_calls.values())

    def end(self, index: int, code: int | None, detail: str, cause: Cause | None = None) -> None:
        """``cause``: where it is another one than the exit code says."""
        node = self.nodes[index]
        if node["running"]:
            node.update(running=False, code=code, detail=detail, cause=cause)

    def fail(self, detail: str) -> None:
        """The gang can't be started, as ``detail`` says."""
        for index in range(len(self.nodes)):
            self.end(index, 1, detail)

    def place_again(self) -> None:
        """Have the gang placed anew: an actor was lost before any command was started, so the attempt has not begun."""
        lost = min(self.lost)
        host, detail = self.plan["nodes"][lost]["host"], self.nodes[lost]["detail"]
        self.phase, self.why = "joining", f"node {lost} on {host}: {detail}; it is placed again"
        self._kill_actors()
        self._unplace()

    def _ask(self, kind: str, index: int, *arguments: Any) -> Any:
        """Call a method of a node's actor; :meth:`listen` takes the answer."""
        reference = getattr(self.actors[index], kind).remote(*arguments)
        self.pending_calls[reference] = (kind, index)
        return reference

    def place(self, group: Any) -> None:
        """Actors on the bundles of a placement group that has its room."""
        self.placings += 1
        for index, node in enumerate(self.plan["nodes"]):
            bundle = bundle_of(node)
            actor = ray.remote(ray_node.Node).options(
                num_cpus=bundle["CPU"],
                num_gpus=bundle.get("GPU", 0),
                memory=bundle["memory"],
                scheduling_strategy=PlacementGroupSchedulingStrategy(group, placement_group_bundle_index=index),
                max_concurrency=6,
            )
            marks = {"MUSTER_GANG": self.name, "NODE_RANK": str(self.contracts[index].node_rank)}
            self.actors.append(actor.remote(marks, LEASE))
        contract = self.contracts[0]
        about = self.plan["directory"], contract.store, contract.run, contract.epoch, self.name
        for index in range(len(self.actors)):
            self._ask("facts", index, __version__, *about)
        self.last_replies = [time.monotonic()] * len(self.nodes)
        self.phase, self.why = "starting", "starting an actor on each node"

    def start(self, addresses: list[str]) -> None:
        """Start the supervisors, the main node's first. Waits for it."""
        main = self.plan["main"]
        port = self.nodes[main]["facts"]["port"]
        if not port:
            self.fail(f"no free port from {first_port(self.name)} on {addresses[main]}")
            return
        self.phase, self.why = "running", ""
        self.publish()  # before it starts anything: the engine starts a gang again if it finds an earlier phase
        meeting = {"master_address": addresses[main], "master_port": port}
        for index in sorted(range(len(self.nodes)), key=lambda index: index != main):
            node = self.plan["nodes"][index]
            contract = dataclasses.replace(self.contracts[index], address=addresses[index], **meeting)
            order = node["prefix"], node["command"], node["environment"], contract.to_env(), node["gpus"]
            started = self._ask("start", index, *order, self.plan["directory"], named_variables())
            self.nodes[index]["address"] = addresses[index]
            if index == main:
                ray.wait([started], timeout=LEASE)

    def stop(self, grace: float) -> None:
        """Ask every node that can be reached to end; :meth:`listen` notes when they have."""
        self.phase, self.why, self.deadline = "stopping", "", time.monotonic() + grace + _ENDING
        lost = self.lost  # nobody is there to answer
        self.pending_calls = {reference: call for reference, call in self.pending_calls.items() if call[1] not in lost}
        for index in range(len(self.actors)):
            if index not in lost:
                self._ask("stop", index, grace)

    def leave(self) -> None:
        """SIGTERM to all that are started, once: one of the machines will go away, or the driver's. Called until all have had it."""
        for index, node in enumerate(self.nodes):
            if node["started"] and index not in self.leaving:
                self.leaving.add(index)
                self.actors[index].leave.remote()

    def listen(self, seconds: float) -> None:
        """Take what actors answer within that time, and what became of those that do not."""
        if not self.pending_calls:
            time.sleep(seconds)
        else:
            ray.wait(list(self.pending_calls), num_returns=1, timeout=seconds)
            for reference in ray.wait(list(self.pending_calls), num_returns=len(self.pending_calls), timeout=0)[0]:
                kind, index = self.pending_calls.pop(reference)
                try:
                    self._take(kind, index, ray.get(reference))
                    self.last_replies[index] = time.monotonic()
                    self.broken.pop(index, None)
                except ray.exceptions.ActorUnavailableError:  # a connection broke: the machine's end, or the network's
                    self.broken.setdefault(index, time.monotonic())
                    self._ask("beat", index)
                    if kind == "wait":
                        self._ask("wait", index)
                except ray.exceptions.RayActorError as error:
                    self.end(index, None, f"its Ray actor died ({_last_line(error)})")
                except Exception as error:
                    self.end(index, 1, f"node {index}: {_last_line(error)}")
        self._beat()

    def _take(self, kind: str, index: int, answer: Any) -> None:
        node, name = self.nodes[index], f"node {index}"
        match kind:
            case "facts":
                node["facts"], planned = answer, self.plan["nodes"][index]
                node["gpus"] = answer.get("gpus", "") if planned["gpus"] else ""
                problem = answer["problem"] and f": {answer['problem']}"
                if not problem and answer["version"] != __version__:
                    problem = f" has Muster {answer['version']}, the controller {__version__}: install the same on both"
                if problem:
                    self.fail(f"{name} on {planned['host']}{problem}")
            case "start" if answer:
                self.end(index, 127, f"{name}: {answer}")
            case "start":
                node["started"] = True
                self._ask("wait", index)
            case "stop" if answer:  # it was asked in vain: again, until nothing is left
                self.why, self.deadline = f"{name}: {answer}", time.monotonic() + _ENDING
                self._ask("stop", index, 0.0)
            case "wait":
                self.end(index, answer[0], answer[1] if answer[0] else "")

    def _beat(self) -> None:
        """Show actors that the driver is there, and see that they are: sooner than Ray, which needs 13 to 64 s."""
        now = time.monotonic()
        for index, since in self.broken.items():
            if now - since > _BROKEN:
                self.end(index, None, "the connection to its Ray actor broke")
        if now < self._next_beat or not self.actors:
            return
        self._next_beat = now + _BEAT
        waiting = {index for kind, index in self.pending_calls.values() if kind == "beat"}
        patience = _STARTING if self.phase == "starting" else LEASE
        for index, node in enumerate(self.nodes):
            if index not in waiting:
                self._ask("beat", index)
                if not node["running"]:
                    self.last_replies[index] = now
            elif now - self.last_replies[index] > patience:
                node["silent"] = True
                self.end(index, None, f"its Ray actor has not answered for {patience:.0f} s")

    def forget(self) -> None:
        """No command was started: the next driver that finds the gang starts it."""
        self._kill_actors()
        self.folder.state(self.name).unlink(missing_ok=True)

    def clear(self) -> None:
        """The gang is over: its actors go."""
        for index, node in enumerate(self.nodes):
            early = ("stopped before it was started", Cause.STOPPED)
            self.end(index, None, *(("", None) if node["started"] else early))
        self._kill_actors()
        self.actors, self.pending_calls, self.phase = [], {}, "stopped"
        self.folder.plan(self.name).unlink(missing_ok=True)

    def _kill_actors(self) -> None:
        for actor in self.actors:
            ray.kill(actor)


def _contract(fields: Mapping[str, Any]) -> NodeContract:
    return NodeContract(**{**fields, "array": tuple(fields["array"]) if fields["array"] else None})


def _last_line(error: Exception) -> str:
    return str(error).strip().splitlines()[-1].strip()
