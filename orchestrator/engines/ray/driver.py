"""The driver of a job on a Ray cluster: a process of its own that holds the placement group and one actor a node.

``python -m orchestrator.engines.ray.driver FOLDER JOIN FD``. It outlives the controller, takes commands from the folder's pipe
and reports the nodes in state files (:mod:`orchestrator.engines.ray.folder`). When a gang is over it keeps the placement group
for a while: the job's next attempt finds its place, its GPUs and a driver that knows the cluster. On SIGTERM, which comes where its machine
shuts down, it has the gang save and leave; a gang that was not started is left to the next driver. Ray is imported here and
in the watch alone, so that what it does to a process that loses its cluster does not happen to the controller.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import sys
import threading
import time
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import ray

from orchestrator.engines.ray import node as ray_node
from orchestrator.engines.ray.folder import NEW, UNSTARTED, Folder
from orchestrator.engines.ray.gang import DrivenGang
from orchestrator.engines.ray.placement_groups import STRATEGY, bundle_of, selector_of

_LINGER = 15.0
"""Seconds for which the place of a gang that is over is kept for the job's next attempt."""
_PLACINGS = 3
"""How often a gang is placed whose actors are lost before they have started anything."""
_JOINING = 90.0
"""Seconds that joining the cluster may take: ``ray.init`` itself would try for ever."""


class Driver:
    """Gangs of one job, one after the other, and the placement group that they share."""

    def __init__(self, folder: Folder, commands: int) -> None:
        """``commands``: descriptor of the folder's pipe, from which it reads."""
        self.folder, self.commands = folder, commands
        self.gang: DrivenGang | None = None
        self.group: Any = None
        self.key: Any = None
        """The bundles and the pinned machines for which the placement group was made."""
        self.idle_since = time.monotonic()
        self._partial = b""
        self._draining: set[str] = set()
        self._leaves = False
        self._next_check = 0.0

    def run(self) -> None:
        """Until the job has been over for a while."""
        while not self.obey():
            self.folder.alive.touch()
            gang, idle = self.gang, time.monotonic() - self.idle_since
            if gang is None or gang.phase == "stopped":
                if self._leaves or idle > _LINGER:
                    return
                self._read(0.2)
                continue
            if self._leaves and gang.phase in UNSTARTED:
                gang.forget()
                return
            self._step(gang)
            if not gang.is_over or gang.phase == "stopping":
                self.idle_since = time.monotonic()
            elif self._leaves or idle > 4 * _LINGER:  # nobody asks: the controller has been gone for long
                gang.publish()
                gang.clear()
            gang.publish()

    def _step(self, gang: DrivenGang) -> None:
        if gang.phase == "joining":
            self._place(gang)
        elif gang.phase == "placing":
            self._await_place(gang)
        elif gang.phase == "starting":
            gang.listen(0.1)
            if gang.lost and gang.placings < _PLACINGS:
                gang.place_again()
            elif not gang.is_over and all("facts" in node for node in gang.nodes):
                addresses = {node["NodeID"]: node["NodeManagerAddress"] for node in ray.nodes()}
                gang.start([addresses[node["ray_node"]] for node in gang.nodes])
        else:
            gang.listen(0.1)
            leaves = self._leaves or any(node["ray_node"] in self._draining for node in gang.nodes)
            if leaves and gang.phase == "running":
                gang.leave()
            if gang.phase == "stopping" and (not gang.is_stopping or time.monotonic() > gang.deadline):
                gang.clear()
                self.idle_since = time.monotonic()

    def _place(self, gang: DrivenGang) -> None:
        """Keep the placement group of the attempt before where it fits, else ask for another."""
        nodes, staying = gang.plan["nodes"], self._staying()
        for node in nodes:
            if node["pin"] not in staying:  # it has left or is draining; any other machine with room will do
                node["pin"] = None
        key = [bundle_of(node) for node in nodes], [node["pin"] for node in nodes]
        if self.group is not None and (
            key != self.key or not self.group.wait(0.5) or not staying.issuperset(self._where())
        ):
            self._let_go()
        if self.group is None:
            # names have to be unique, and a dead driver's group stays until Ray has noticed its death
            name = f"muster {gang.name} {uuid.uuid4().hex[:8]}"
            selectors = [selector_of(node) for node in nodes]
            self.group = ray.util.placement_group(key[0], STRATEGY, name, bundle_label_selector=selectors)
            self.key = key
        gang.phase, gang.why = "placing", "waits for its placement group"

    def _staying(self) -> set[str]:
        """Ids of the machines that are alive and not draining."""
        return {node["NodeID"] for node in ray.nodes() if node["Alive"]} - self._draining

    def _where(self) -> list[str]:
        """Id of the machine of each bundle; the placement group has its room."""
        where = ray.util.placement_group_table(self.group)["bundles_to_node_id"]
        return [machine for _, machine in sorted(where.items())]

    def _let_go(self) -> None:
        ray.util.remove_placement_group(self.group)
        self.group = None

    def _await_place(self, gang: DrivenGang) -> None:
        if self.group.wait(0.1):
            for node, machine in zip(gang.nodes, self._where(), strict=True):
                node["ray_node"] = machine
            gang.place(self.group)
        elif time.monotonic() > self._next_check:
            self._next_check = time.monotonic() + 1.0
            if not {node["pin"] for node in gang.plan["nodes"] if node["pin"]} <= self._staying():
                self._place(gang)
            gang.why = _why_waiting(gang.plan["nodes"])

    def leave(self, *_: object) -> None:
        """SIGTERM: see the module."""
        self._leaves = True

    def obey(self) -> bool:
        """Carry out the commands that have come; True where the driver should leave."""
        self._read(0.0)
        *lines, self._partial = self._partial.split(b"\n")
        for line in lines:
            try:
                command = json.loads(line)
            except ValueError:
                continue
            gang = self.gang
            if gang is None or gang.phase == "stopped":
                if command["do"] == "leave":
                    return True
                if command["do"] == "run":
                    self._take(command["gang"])
            elif command["do"] == "stop" and command["gang"] == gang.name:
                if gang.phase == "placing":  # it asks for machines that nobody needs any more
                    self._let_go()
                if gang.phase != "stopping":
                    gang.stop(command["grace"])
        return False

    def _take(self, name: str) -> None:
        """Begin with the gang of that name, unless it was here already."""
        if self.folder.state(name).exists():
            return
        with contextlib.suppress(OSError):  # it was stopped meanwhile
            self.gang = DrivenGang(json.loads(self.folder.plan(name).read_bytes()), self.folder)
            self.gang.publish()

    def _read(self, seconds: float) -> None:
        if select.select([self.commands], [], [], seconds)[0]:
            with contextlib.suppress(BlockingIOError):
                self._partial += os.read(self.commands, 65536)

    def watch(self) -> None:
        """In a thread, since it waits where the head is away: which nodes have to leave."""
        while True:
            with contextlib.suppress(ray.exceptions.RaySystemError):
                self._draining = set(ray._private.state.state.get_draining_nodes())
            time.sleep(1.0)


def _why_waiting(nodes: list[Mapping[str, Any]]) -> str:
    """The reason why a placement group is pending."""
    free = ray._private.state.available_resources_per_node()
    full, new = [], []
    for node in nodes:
        if node["pin"] not in free:
            new.append(node)
        elif any(free[node["pin"]].get(name, 0.0) < amount for name, amount in bundle_of(node).items()):
            full.append(node["host"])
    if full:
        return f"waits for room on {', '.join(full)}: other work of the Ray cluster holds it"
    if not new:
        return "waits for its placement group"
    gpus = f", {new[0]['gpus']} GPUs" if new[0]["gpus"] else ""
    shape = f"{new[0]['cpus']:g} CPUs{gpus}, {new[0]['memory']} MiB"
    if gone := [node["host"] for node in new if not node["host"].startswith(NEW)]:
        return f"waits for {', '.join(gone)} to come back to the Ray cluster, or for another node with {shape}"
    return f"waits for {len(new)} more node{'s' if len(new) > 1 else ''} with {shape}: Ray's autoscaler was asked"


def main(argv: list[str]) -> int:
    """Join the cluster through this machine's Ray node, then drive."""
    folder, join, commands = Folder(Path(argv[0])), argv[1], int(argv[2])
    os.set_inheritable(commands, False)
    driver = Driver(folder, commands)
    driver.obey()
    gang, head = driver.gang, os.environ["RAY_ADDRESS"]
    if gang is None:
        return 0

    def give_up(why: str) -> None:
        gang.fail(why)
        gang.publish()
        os._exit(1)

    late = f"the Ray cluster at {head} let nobody join for {_JOINING:.0f} s"
    patience = _timer(_JOINING, give_up, late)
    try:
        ray.cloudpickle.register_pickle_by_value(ray_node)
        quiet = {"log_to_driver": False, "logging_level": "error"}
        ray.init(address=head, namespace="muster", _node_ip_address=join, **quiet)
    except SystemExit:  # SIGTERM: until then Ray's own handler has it
        gang.forget()
        return 0
    except Exception as error:
        give_up(f"can't join the Ray cluster at {head}: {str(error).strip().splitlines()[0]}")
    patience.cancel()
    signal.signal(signal.SIGTERM, driver.leave)
    threading.Thread(target=driver.watch, name="watch", daemon=True).start()
    driver.run()
    # leaving, it must not wait for a head that is away; what it holds goes with it
    _timer(10.0, os._exit, 0)
    ray.shutdown()
    return 0


def _timer(seconds: float, body: Callable[..., None], argument: object) -> threading.Timer:
    timer = threading.Timer(seconds, body, (argument,))
    timer.daemon = True
    timer.start()
    return timer


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
