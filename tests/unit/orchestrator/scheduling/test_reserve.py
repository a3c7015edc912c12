"""A reservation by itself: when and where, behind whom, and what it leaves to others."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

from orchestrator.domain.hosts import Host
from orchestrator.scheduling.free_resources import FreeResources
from orchestrator.scheduling.reservation import Reservation, holder_of, reserve
from orchestrator.scheduling.snapshot import ComputeEnvironment, RunningGang, Snapshot, Waiting
from tests.support.orchestrator.scheduling import NOW, environment, gang, host, job, node, on, running


def reserved(
    requested: Waiting,
    held: Sequence[RunningGang],
    hosts: Sequence[Host] = (host("a", 4), host("b", 4)),
    environments: Sequence[ComputeEnvironment] = (environment(),),
) -> Reservation | None:
    known = {each.name: each for each in environments}
    free = FreeResources.of(Snapshot(NOW, hosts, known, {}, (), held, {}))
    return reserve(requested, tuple(known), free, [holder_of(each, NOW, each.ending) for each in held])


def reported(found: Reservation | None) -> tuple[float, str, str]:
    """Seconds until the start, the hosts, and the gangs that it waits for."""
    assert found is not None
    hosts = " ".join(placement.host for placement in found.allocation.placements)
    return (found.window.at - NOW) / 1000, hosts, " ".join(each.name for each in found.awaits)


def ends(name: str, seconds: int | None, *places: tuple[str, float], **facts: object) -> RunningGang:
    """A gang that ends in so many seconds."""
    held = [on(place, cpus) for place, cpus in places]
    return running(name, *held, for_seconds=0, timeout=seconds, **facts)  # type: ignore[arg-type]


def test_it_starts_at_the_first_end_that_makes_room_and_awaits_those_on_its_hosts_alone() -> None:
    held = [
        ends("late", 300, ("a", 4)),
        ends("early", 100, ("b", 1)),
        ends("middle", 200, ("b", 2)),
        ends("other", 50, ("a", 0)),
    ]
    assert reported(reserved(job("x", 4), held)) == (200, "b", "early middle")
    assert reported(reserved(job("x", 3), held)) == (200, "b", "early middle")
    assert reported(reserved(job("x", 2), held)) == (100, "b", "early")
    assert reported(reserved(job("x", gang(node(4), node(4))), held)) == (300, "a b", "other early middle late")
    assert reserved(job("x", 5), held) is None


def test_all_that_end_at_that_time_make_room_and_those_without_a_known_end_come_last() -> None:
    held = [ends("x", 100, ("a", 2)), ends("y", 100, ("a", 1)), ends("z", None, ("b", 4)), ends("w", 200, ("a", 1))]
    found = reserved(job("j", 2), held)
    assert reported(found) == (100, "a", "x y") and found is not None
    assert found.window.hosts == {"a": host("a", 1, memory=8092)} and found.window.cpus == inf
    assert reported(reserved(job("j", gang(node(4), node(4))), held)) == (inf, "a b", "x y w z")
    stopping = [ends("s", None, ("a", 2), ending=True), *held[2:]]
    assert reported(reserved(job("j", 3), stopping)) == (0, "a", "s")


def test_the_smallest_gang_is_reserved_and_the_limit_of_its_environment_counts() -> None:
    limited = [environment("p", ("a", "b"), max_cpus=6), environment("q", ("c",), max_cpus=1)]
    hosts = [host("a", 4), host("b", 4), host("c", 9)]
    held = [ends("x", 100, ("c", 3), environment="p"), ends("y", 200, ("a", 2), environment="p")]
    found = reserved(job("j", gang(*[node(2)] * 3, minimum=2)), held, hosts, limited)
    assert reported(found) == (100, "a b", "x") and found is not None
    assert (found.window.compute_environment, found.window.cpus) == ("p", 0)
    assert found.hosts == {"a", "b", "c"} and found.compute_environments == ("p", "q")


def test_hosts_of_one_machine_are_reserved_together() -> None:
    pair = [Host("a", 4, ("0", "1"), 100, machine="m"), Host("docker/a", 4, ("0", "1"), 100, machine="m")]
    held = [running("x", on("a", 3), for_seconds=0, timeout=60)]
    found = reserved(job("j", gang(node(2, 1, 10))), held, pair, [environment("p", ("a",))])
    assert found is not None and found.hosts == {"a", "docker/a"}
    assert {name: (left.cpus, left.gpus, left.memory) for name, left in found.window.hosts.items()} == {
        "a": (2, ("1",), 90),
        "docker/a": (2, ("1",), 90),
    }
    assert found.window.binds(NOW + 60_001) and not found.window.binds(NOW + 60_000)
