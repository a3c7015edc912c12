"""What befalls a controller, its network, its volumes and its nodes."""

from __future__ import annotations

from collections.abc import Callable
from random import Random
from typing import TYPE_CHECKING

from tests.support.simulation.cluster import SimulatedNode
from tests.support.simulation.jobs import SUBMITTING

if TYPE_CHECKING:
    from tests.support.simulation.run import Simulation

_LEASE = 4.0
"""Seconds until the bus notices that a node is silent."""
_PACE = 5.0
"""Seconds for each further node of a cut network where the router removes them one after the other, as Zenoh may."""

Fault = Callable[["Simulation", Random], None]


def draw_fault(seed: int, index: int) -> tuple[float, Fault, Random]:
    """Fault number ``index`` of a seed, the same whichever others there are: when [s], what, and the source of its extent."""
    rng = Random(f"{seed} fault {index}")
    return rng.uniform(0, SUBMITTING), rng.choice(KINDS), rng


def _during(world: Simulation, seconds: float, name: str, of: object | None = None) -> None:
    """Set a flag for a while."""
    target = world if of is None else of

    def turn(value: bool) -> None:
        setattr(target, name, value)
        if name not in ("bus_down", "crowded"):
            world.changed = world.machine.time

    world.note(f"{name} for {seconds:.0f} s")
    turn(True)
    world.machine.after(seconds, lambda: turn(False))


def _seconds(rng: Random) -> float:
    return rng.choice((5.0, 30.0, 90.0, 300.0, 600.0, 1500.0)) * rng.uniform(0.7, 1.0)


def crash_at_a_write(world: Simulation, rng: Random) -> None:
    """The controller's process is killed at one of its next writes."""
    world.writes_left = rng.choice((1, 2, 3, 5, 8, 13, 21))
    world.note(f"the controller dies at its write number {world.writes_left}")


def move(world: Simulation, rng: Random) -> None:
    """The controller is stopped, and started at another address: nodes look for it at the old one."""
    world.note("the controller moves")
    world.router += 1
    world.die()


def partition(world: Simulation, rng: Random) -> None:
    """The controller alone is cut off: from its engine, and from all nodes."""
    seconds = _seconds(rng)
    _during(world, seconds, "engine_down")
    _break_bus(world, rng, seconds)


def engine_outage(world: Simulation, rng: Random) -> None:
    _during(world, _seconds(rng), "engine_down")


def hang_engine(world: Simulation, rng: Random) -> None:
    """Calls of the engine do not return."""
    _during(world, _seconds(rng), "engine_hangs")


def bus_outage(world: Simulation, rng: Random) -> None:
    _break_bus(world, rng, _seconds(rng))


def _break_bus(world: Simulation, rng: Random, seconds: float) -> None:
    pace = rng.choice((0.0, _PACE))

    def notice(pace: float = 0.0) -> None:
        for position, node in enumerate(world.cluster.running):
            world.notice(node, world.rng.uniform(0.5, _LEASE) + position * pace)

    def end() -> None:
        if (
            world.received <= 1
        ):  # the controller may have declared the node lost: it could not tell which side was cut off
            for node in world.cluster.running:
                node.was_silent = max(node.was_silent, world.machine.time - world.bus_down_since)

    if not world.bus_down:
        world.bus_down_since = world.machine.time
    world.machine.after(seconds, end)
    _during(world, seconds, "bus_down")
    notice(pace)
    world.machine.after(seconds + 0.1, notice)


def database_outage(world: Simulation, rng: Random) -> None:
    _during(world, rng.uniform(1, 60), "database_down")


def crowd_database(world: Simulation, rng: Random) -> None:
    _during(world, _seconds(rng), "crowded")


def stall_volume(world: Simulation, rng: Random) -> None:
    _during(world, _seconds(rng), "stalled", world.volume)


def fill_volume(world: Simulation, rng: Random) -> None:
    _during(world, _seconds(rng), "full", world.volume)


def unmount_volume(world: Simulation, rng: Random) -> None:
    _during(world, _seconds(rng), "absent", world.volume)


def break_volume(world: Simulation, rng: Random) -> None:
    _during(world, rng.uniform(1, 60), "failing", world.volume)


def step_clock(world: Simulation, rng: Random) -> None:
    seconds = rng.choice((-3600.0, -5.0, 5.0, 3600.0))
    world.note(f"the wall clock steps by {seconds:.0f} s")
    world.machine.offset += seconds


def freeze_node(world: Simulation, rng: Random) -> None:
    _silence(world, rng, "frozen")


def isolate_node(world: Simulation, rng: Random) -> None:
    _silence(world, rng, "isolated")


def _silence(world: Simulation, rng: Random, how: str) -> None:
    if (node := _some_node(world, rng)) is None or node.silent_since is not None:
        return
    seconds = _seconds(rng)
    world.note(f"{node} is {how} for {seconds:.0f} s")
    setattr(node, how, True)
    is_alone = (
        world.bus_down and world.received <= 1
    )  # then the router has received nothing from it for as long as the bus is down
    node.silent_since = world.bus_down_since if is_alone else world.machine.time
    world.notice(node, _LEASE)

    def back() -> None:
        setattr(node, how, False)
        node.was_silent = max(node.was_silent, seconds)
        received = rng.uniform(0.2, 5.0)
        world.notice(node, received)
        world.machine.after(received, lambda: setattr(node, "silent_since", None))

    world.machine.after(seconds, back)


def lose_host(world: Simulation, rng: Random) -> None:
    """A host dies, and its engine notices that."""
    if (node := _some_node(world, rng)) is None:
        return
    world.note(f"host {node.host} dies")
    for each in world.cluster.running:
        if each.host == node.host:
            each.host_lost, each.alive = True, False
            world.notice(each, _LEASE)


def kill_node(world: Simulation, rng: Random) -> None:
    if (node := _some_node(world, rng)) is None or node.frozen:
        return
    world.note(f"{node} is killed")
    node.alive, node.killed = False, True
    world.notice(node, 0.2)


def _some_node(world: Simulation, rng: Random) -> SimulatedNode | None:
    nodes = world.cluster.running
    return rng.choice(nodes) if nodes else None


KINDS: tuple[Fault, ...] = (
    *(crash_at_a_write, crash_at_a_write, move, partition, engine_outage, hang_engine, bus_outage, step_clock),
    *(database_outage, crowd_database),
    *(stall_volume, fill_volume, unmount_volume, break_volume, freeze_node, isolate_node, lose_host, kill_node),
)
