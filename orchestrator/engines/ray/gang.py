"""A gang on a Ray cluster, as its driver has it: an actor on each node, what was asked of it, and how the node is."""

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
"""Seconds between two signs of life to an actor."""
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
        self.phase, self.why = "joining", "joining the Ray cluster"
        self.placings = 0
        """How often it was placed."""
        self.nodes = self._unplaced()
        self.actors: list[Any] = []
        self.asked: dict[Any, tuple[str, int]] = {}
        """Calls of actors that are not answered: a kind and a node's index."""
        self.heard = [time.monotonic()] * len(self.nodes)
        self.left: set[int] = set()
        """Indices of nodes that were told to leave."""
        self.broken: dict[int, float] = {}
        """Since when the connection to an actor is broken."""
        self.next_beat = 0.0
        self.deadline = 0.0
        """When a stop has to be done with [monotonic s]."""
        self.told: dict[str, Any] = {}

    def tell(self) -> None:
        """Write the state file where something changed."""
        state = {"gang": self.name, "driver": os.getpid(), "phase": self.phase, "why": self.why, "nodes": self.nodes}
        if state != self.told:
            write_json(self.folder.state(self.name), state)
            self.told = json.loads(json.dumps(state))

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
        return any(kind in ("stop", "wait") for kind, _ in self.asked.values())

    def end(self, index: int, code: int | None, detail: str, cause: Cause | None = None) -> None:
        """``cause``: where it is another one than the exit code says."""
        node = self.nodes[index]
        if node["running"]:
            node.update(running=False, code=code, detail=detail, cause=cause)

    def fail(self, detail: str) -> None:
        """The gang can't be started, as ``detail`` says."""
        for index in range(len(self.nodes)):
            self.end(index, 1, detail)

    def _unplaced(self) -> list[dict[str, Any]]:
        return [
            {
                "running": True,
                "started": False,
                "address": "",
                "gpus": "",
                "code": None,
                "detail": "",
                "ray_node": node["pin"] or "",
            }
            for node in self.plan["nodes"]
        ]

    def place_again(self) -> None:
        """Have the gang placed anew: an actor was lost before any command was started, so the attempt has not begun."""
        lost = min(self.lost)
        self.why = (
            f"node {lost} on {self.plan['nodes'][lost]['host']}: {self.nodes[lost]['detail']}; it is placed again"
        )
        for actor in self.actors:
            ray.kill(actor)
        self.nodes, self.actors, self.asked, self.broken = self._unplaced(), [], {}, {}
        self.phase = "joining"

    def place(self, group: Any) -> None:
        """Actors on the bundles of a placement group that has its room."""
        self.placings += 1
        actor = ray.remote(ray_node.Node)
        for index, node in enumerate(self.plan["nodes"]):
            bundle = bundle_of(node)
            strategy = PlacementGroupSchedulingStrategy(group, placement_group_bundle_index=index)
            self.actors.append(
                actor.options(
                    num_cpus=bundle["CPU"],
                    num_gpus=bundle.get("GPU", 0),
                    memory=bundle["memory"],
                    scheduling_strategy=strategy,
                    max_concurrency=6,
                ).remote({"MUSTER_GANG": self.name, "NODE_RANK": str(_contract(node["contract"]).node_rank)}, LEASE)
            )
        contract = _contract(self.plan["nodes"][0]["contract"])
        about = self.plan["directory"], contract.store, contract.run, contract.epoch, self.name
        for index, node in enumerate(self.actors):
            self.asked[node.facts.remote(__version__, *about)] = ("facts", index)
        self.heard = [time.monotonic()] * len(self.nodes)
        self.phase, self.why = "starting", "starting an actor on each node"

    def start(self, addresses: list[str]) -> None:
        """Start the supervisors, the main node's first. Waits for it."""
        main = self.plan["main"]
        port = self.nodes[main]["facts"]["port"]
        if not port:
            self.fail(f"no free port from {first_port(self.name)} on {addresses[main]}")
            return
        self.phase, self.why = "running", ""
        self.tell()  # before it starts anything: the engine starts a gang again if it finds an earlier phase
        for index in sorted(range(len(self.nodes)), key=lambda index: index != main):
            node = self.plan["nodes"][index]
            contract = dataclasses.replace(
                _contract(node["contract"]),
                address=addresses[index],
                master_address=addresses[main],
                master_port=port,
            )
            ref = self.actors[index].start.remote(
                node["prefix"],
                node["command"],
                node["environment"],
                contract.to_env(),
                node["gpus"],
                self.plan["directory"],
                named_variables(),
            )
            self.asked[ref] = ("start", index)
            self.nodes[index]["address"] = addresses[index]
            if index == main:
                ray.wait([ref], timeout=LEASE)

    def stop(self, grace: float) -> None:
        """Ask every node that can be reached to end; :meth:`listen` notes when they have."""
        self.phase, self.why, self.deadline = "stopping", "", time.monotonic() + grace + _ENDING
        lost = self.lost
        self.asked = {ref: told for ref, told in self.asked.items() if told[1] not in lost}
        for index, actor in enumerate(self.actors):
            if index not in lost:  # nobody is there to answer
                self.asked[actor.stop.remote(grace)] = ("stop", index)

    def leave(self) -> None:
        """SIGTERM to all that are started, once: one of the machines will go away, or the driver's. Called until all have had it."""
        for index, node in enumerate(self.nodes):
            if node["started"] and index not in self.left:
                self.left.add(index)
                self.actors[index].leave.remote()

    def listen(self, seconds: float) -> None:
        """Take what actors answer within that time, and what became of those that do not."""
        if self.asked:
            ready, _ = ray.wait(list(self.asked), num_returns=1, timeout=seconds)
            more, _ = ray.wait(list(self.asked), num_returns=len(self.asked), timeout=0)
            for ref in {*ready, *more}:
                kind, index = self.asked.pop(ref)
                try:
                    self._take(kind, index, ray.get(ref))
                    self.heard[index] = time.monotonic()
                    self.broken.pop(index, None)
                except ray.exceptions.ActorUnavailableError:  # a connection broke: the machine's end, or the network's
                    self.broken.setdefault(index, time.monotonic())
                    self.asked[self.actors[index].beat.remote()] = ("beat", index)
                    if kind == "wait":
                        self.asked[self.actors[index].wait.remote()] = ("wait", index)
                except ray.exceptions.RayActorError as error:
                    self.end(index, None, f"its Ray actor died ({_last_line(error)})")
                except Exception as error:
                    self.end(index, 1, f"node {index}: {_last_line(error)}")
        else:
            time.sleep(seconds)
        self._beat()

    def _take(self, kind: str, index: int, answer: Any) -> None:
        node = self.nodes[index]
        if kind == "facts":
            node["facts"] = answer
            wanted = self.plan["nodes"][index]
            host = wanted["host"]
            node["gpus"] = answer.get("gpus", "") if wanted["gpus"] else ""
            if answer["problem"]:
                self.fail(f"node {index} on {host}: {answer['problem']}")
            elif answer["version"] != __version__:
                self.fail(
                    f"node {index} on {host} has Muster {answer['version']}, the controller {__version__}: install the same on both"
                )
        elif kind == "start":
            if answer:
                self.end(index, 127, f"node {index}: {answer}")
            else:
                node["started"] = True
                self.asked[self.actors[index].wait.remote()] = ("wait", index)
        elif kind == "stop" and answer:  # it was asked in vain: again, until nothing is left
            self.why, self.deadline = f"node {index}: {answer}", time.monotonic() + _ENDING
            self.asked[self.actors[index].stop.remote(0.0)] = ("stop", index)
        elif kind == "wait":
            self.end(index, answer[0], answer[1] if answer[0] else "")

    def _beat(self) -> None:
        """Show actors that the driver is there, and see that they are: sooner than Ray, which needs 13 to 64 s."""
        now = time.monotonic()
        for index, since in self.broken.items():
            if now - since > _BROKEN:
                self.end(index, None, "the connection to its Ray actor broke")
        if now < self.next_beat or not self.actors:
            return
        self.next_beat = now + _BEAT
        waiting = {index for kind, index in self.asked.values() if kind == "beat"}
        for index, actor in enumerate(self.actors):
            if index not in waiting:
                self.asked[actor.beat.remote()] = ("beat", index)
                if not self.nodes[index]["running"]:
                    self.heard[index] = now
            elif now - self.heard[index] > (patience := _STARTING if self.phase == "starting" else LEASE):
                self.nodes[index]["silent"] = True
                self.end(index, None, f"its Ray actor has not answered for {patience:.0f} s")

    def forget(self) -> None:
        """No command was started: who looks for the gang next starts it."""
        for actor in self.actors:
            ray.kill(actor)
        self.folder.state(self.name).unlink(missing_ok=True)

    def clear(self) -> None:
        """The gang is over: its actors go."""
        for index, node in enumerate(self.nodes):
            if node["started"]:
                self.end(index, None, "")
            else:
                self.end(index, None, "stopped before it was started", Cause.STOPPED)
        for actor in self.actors:
            ray.kill(actor)
        self.actors, self.asked = [], {}
        self.phase = "stopped"
        self.folder.plan(self.name).unlink(missing_ok=True)


def _contract(told: Mapping[str, Any]) -> NodeContract:
    return NodeContract(**{**told, "array": tuple(told["array"]) if told["array"] else None})


def _last_line(error: Exception) -> str:
    return str(error).strip().splitlines()[-1].strip()
