"""On which hosts a gang fits."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orchestrator.domain.gang import Shape
from orchestrator.domain.hosts import Host, Placement
from orchestrator.domain.resources import Resources
from orchestrator.scheduling.fit import fit
from orchestrator.scheduling.placement import never_fits, place
from tests.support.orchestrator.scheduling import (
    Pass,
    environment,
    gang,
    host,
    job,
    needs,
    node,
    on,
    queue,
    running,
    seats,
)


def where(shape: Shape, *hosts: Host) -> str | None:
    """The host of each node by index."""
    placements = place(shape, hosts)
    return " ".join(placement.host for placement in placements) if placements else None


UNLIKE = gang(node(1, 1), node(1), node(4), minimum=1)
ELASTIC = gang(*[node(1)] * 4, minimum=2)
TENTHS = [node(0.1)] * 10
HUNGRY = node(1, 0, 5000)
WHERE: dict[str, tuple[Shape, list[Host], str | None]] = {
    "hosts are filled one after the other": (gang(*[node(2)] * 3), [host("a", 4), host("b", 2)], "a a b"),
    "fractions of a CPU add up": (gang(*TENTHS), [host(cpus=1)], " ".join("a" * 10)),
    "to what is a CPU but for rounding": (gang(*TENTHS), [host(cpus=1 - 1e-12)], " ".join("a" * 10)),
    "but not to more": (gang(*TENTHS, node(0.1)), [host(cpus=1)], None),
    "an elastic gang takes no more than it asks for": (ELASTIC, [host(cpus=8)], "a a a a"),
    "it takes as many nodes as fit": (ELASTIC, [host(cpus=3.5)], "a a a"),
    "down to the least": (ELASTIC, [host(cpus=2)], "a a"),
    "and not less": (ELASTIC, [host(cpus=1.9)], None),
    "one of unlike nodes starts whole": (UNLIKE, [host("a", 8, 1)], "a a a"),
    "or drops the last ones": (UNLIKE, [host("a", 5, 1)], "a a"),
    "down to the first": (UNLIKE, [host("a", 1, 1)], "a"),
    "which it needs": (UNLIKE, [host("a", 8, 0)], None),
    "small and large nodes": (gang(node(2), node(4)), [host("large", 4), host("small", 2)], "small large"),
    "in whatever order they come": (gang(node(4), node(2)), [host("large", 4), host("small", 2)], "large small"),
    "nodes without GPUs leave those with GPUs their host": (
        gang(node(4), node(1, 1)),
        [host("gpu", 4, gpus=1), host("cpu", 4)],
        "cpu gpu",
    ),
    # filling hosts as they come would put the first node on the wide host, on which alone the second one fits
    "a node with GPUs leaves the other the only host with enough CPUs": (
        gang(node(4, 1), node(8)),
        [host("wide", 8, gpus=1), host("narrow", 4, gpus=1)],
        "narrow wide",
    ),
    "memory counts": (gang(HUNGRY, HUNGRY), [host("a"), host("b")], "a b"),
    "and may be too little": (gang(HUNGRY, HUNGRY, HUNGRY), [host("a"), host("b")], None),
    "and counts to the last MiB": (gang(*[node(1, 0, 1)] * 3), [host(memory=2)], None),
    "no GPU is given twice": (gang(*[node(1, 2)] * 2), [host(gpus=3)], None),
    "a host is filled before a tighter one": (
        gang(node(2), node(1)),
        [host("large", 8), host("small", 2)],
        "large large",
    ),
    "nodes that take nothing fit anywhere": (gang(*[Resources(0, 0, 0)] * 3), [host(cpus=0, memory=0)], "a a a"),
}


@pytest.mark.parametrize("case", WHERE)
def test_a_gang_has_its_place(case: str) -> None:
    shape, hosts, expected = WHERE[case]
    assert where(shape, *hosts) == expected
    assert (never_fits(shape, hosts) is None) == (expected is not None)


def test_every_node_gets_gpus_of_its_own_and_there_are_no_more_nodes_than_asked_for() -> None:
    assert place(gang(node(1, 2), node(1, 1)), [host("a", 4, 3)]) == (
        Placement("a", ("a0", "a1"), 1, 100),
        Placement("a", ("a2",), 1, 100),
    )
    placements = place(ELASTIC, [host(cpus=8)], 3)
    assert placements is not None and len(placements) == 3 and place(ELASTIC, [host(cpus=8)], 1) is None


def test_a_gang_never_fits_for_its_required_nodes_and_on_elastic_hosts_for_one_larger_than_any() -> None:
    shape = gang(node(1), node(99), node(1), minimum=1)
    assert never_fits(shape, [host()]) is None
    assert never_fits(shape, [host(cpus=0.5)]) == (
        "each node needs 1 CPU, 0 GPUs, 100 MiB; the largest host has 0.5 CPUs, 0 GPUs, 8 GiB"
    )
    assert never_fits(gang(node(8)), [], elastic=True) is None, "nobody knows what will come"
    assert never_fits(gang(node(8)), [single("a")], elastic=True) == (
        "each node needs 8 CPUs, 0 GPUs, 100 MiB; the largest host has 4 CPUs, 0 GPUs, 8 GiB"
    )


def single(name: str, cpus: float = 4, gpus: int = 0, absent: bool = False) -> Host:
    return Host(name, cpus, tuple(f"{name}{i}" for i in range(gpus)), 8192, single=True, unavailable=absent)


@pytest.mark.parametrize(
    ("nodes", "minimum", "why"),
    [
        ([node(0.5)] * 3, 3, "needs 3 hosts, one for each node; there are 2"),
        ([node(0.5)] * 4, 3, "needs at least 3 hosts, one for each node; there are 2"),
        ([node(1, 1)] * 2, 2, "needs 2 hosts with 1 CPU, 1 GPU, 100 MiB, one for each node; there is 1"),
        ([node(1, 1)] * 3, 2, "needs at least 2 hosts with 1 CPU, 1 GPU, 100 MiB, one for each node; there is 1"),
    ],
)
def test_a_lack_of_hosts_for_one_node_each_is_counted_in_hosts(nodes: list[Resources], minimum: int, why: str) -> None:
    hosts = [single("a"), single("b", gpus=1)]
    shape = gang(*nodes, minimum=minimum)
    assert never_fits(shape, hosts) == why
    assert never_fits(shape, hosts, elastic=True) is None, "more may come"


def test_where_hosts_for_one_node_each_are_enough_in_number_the_sum_of_resources_is_what_lacks() -> None:
    unlike = gang(node(1, 1), node(4, 0, 200))
    lacking = "needs 2 nodes with 5 CPUs, 1 GPU, 300 MiB in all; all hosts together have 5 CPUs, 1 GPU, 16 GiB"
    assert never_fits(unlike, [single("a", 4, 1), single("b", 1)]) == lacking
    shared = [single("a", 2), host("b", 2)]
    assert never_fits(gang(*[node(2)] * 3), shared) == (
        "needs 3 nodes with 6 CPUs, 0 GPUs, 300 MiB in all; all hosts together have 4 CPUs, 0 GPUs, 16 GiB"
    )


def test_what_the_queue_of_an_engine_gives_at_most_is_named_in_place_of_hosts() -> None:
    limited = [replace(host("slurm/main", 4), queue=True)]
    most = "queue slurm/main gives a gang at most 4 CPUs, 0 GPUs, 8 GiB"
    assert never_fits(gang(node(5)), limited) == f"each node needs 5 CPUs, 0 GPUs, 100 MiB; {most}"
    assert never_fits(gang(*[node(3)] * 2), limited) == f"needs 2 nodes with 6 CPUs, 0 GPUs, 200 MiB in all; {most}"
    waits = Pass(limited, [job("ant", 2)], [running("cart", on("slurm/main", 3))]).reason("ant")
    assert waits.endswith(f" - waits for job cart (cart-012) to end: {most}; {needs(2)}")


def test_hosts_that_are_away_are_taken_only_where_the_gang_needs_them() -> None:
    hosts = [single("a", absent=True), single("b"), single("c")]
    assert where(gang(*[node()] * 2), *hosts) == "b c"
    assert where(gang(*[node()] * 2, minimum=1), *hosts) == "b c"
    assert where(gang(*[node()] * 3, minimum=2), *hosts) == "b c", "fewer nodes start now"
    assert where(gang(*[node()] * 3), *hosts) == "b c a"
    assert never_fits(gang(*[node()] * 3), hosts) is None
    assert where(gang(*[node()] * 4), *hosts) is None


nodes = st.builds(node, st.sampled_from([0.5, 1, 2, 3, 5]), st.integers(0, 3), st.sampled_from([100, 500, 2000]))
hosts_strategy = st.lists(
    st.tuples(st.sampled_from([0, 1, 2.5, 4, 8]), st.integers(0, 4), st.sampled_from([50, 1000, 4000])), max_size=4
).map(lambda each: [host(f"h{i}", cpus, gpus, memory) for i, (cpus, gpus, memory) in enumerate(each)])


@settings(max_examples=100)
@given(hosts_strategy, nodes, st.integers(1, 6))
def test_a_gang_of_equal_nodes_fits_exactly_where_it_can(hosts: list[Host], each: Resources, count: int) -> None:
    assert (place(gang(*[each] * count), hosts) is not None) == (seats(each, hosts) >= count)


@settings(max_examples=100)
@given(hosts_strategy, st.lists(nodes, min_size=1, max_size=5), st.data())
def test_every_node_gets_what_it_needs_and_no_host_gives_more_than_it_has(
    hosts: list[Host], members: list[Resources], data: st.DataObject
) -> None:
    minimum = data.draw(st.integers(1, len(members)))
    placements = place(gang(*members, minimum=minimum), hosts)
    if placements is None:
        assert never_fits(gang(*members, minimum=minimum), hosts)
        return
    assert minimum <= len(placements) <= len(members)
    for placement, requested in zip(placements, members, strict=False):
        assert placement.resources == requested
    for each in hosts:
        here = [placement for placement in placements if placement.host == each.name]
        assert sum(placement.cpus for placement in here) <= each.cpus + 1e-6
        assert sum(placement.memory for placement in here) <= each.memory
        gpus = [gpu for placement in here for gpu in placement.gpus]
        assert len(gpus) == len(set(gpus)) and set(gpus) <= set(each.gpus)


def test_one_machine_of_two_engines_is_placed_on_once_and_a_gang_that_awaits_new_hosts_nowhere_yet() -> None:
    twice = [replace(host("localhost"), machine="pc"), replace(host("docker/pc"), machine="pc")]
    found = fit(gang(node(3), node(3)), queue(), {"all": environment()}, twice)
    assert found.allocation is None and found.problem is not None and "all hosts together have 4 CPUs" in found.problem
    found = fit(gang(*[node(3)] * 3), queue(), {"all": environment()}, [host()], elastic=["all"])
    assert (found.allocation, found.problem) == (None, None)


def test_a_disabled_compute_environment_is_used_if_no_other_is_possible() -> None:
    environments = {"off": environment("off", enabled=False), "on": environment("on", hosts=("a",))}
    for cpus, expected in ((2, "on"), (6, "off")):
        both = queue(environments=("off", "on"))
        found = fit(gang(node(cpus)), both, environments, [host("a", 2), host("b", 8)]).allocation
        assert found is not None and found.compute_environment == expected


machines = st.sampled_from(["", "m1", "m2"])
pools_strategy = st.lists(
    st.tuples(st.none() | st.sets(st.sampled_from(["h0", "h1", "h2"])), st.none() | st.sampled_from([0, 1, 4])),
    min_size=1,
    max_size=3,
)


@settings(max_examples=200)
@given(hosts_strategy, st.lists(machines, min_size=4, max_size=4), pools_strategy, nodes, st.integers(1, 4), st.data())
def test_a_gang_alone_starts_exactly_where_it_is_reported_to_fit(
    hosts: list[Host], on: list[str], pools: list, each: Resources, count: int, data: st.DataObject
) -> None:
    hosts = [replace(host, machine=machine) for host, machine in zip(hosts, on, strict=False)]
    known = [
        environment(f"p{i}", None if names is None else tuple(sorted(names)), max_cpus=most)
        for i, (names, most) in enumerate(pools)
    ]
    shape = gang(*[each] * count, minimum=data.draw(st.integers(1, count)))
    ordered = queue(environments=tuple(each.name for each in known))
    found = fit(shape, ordered, {each.name: each for each in known}, hosts)
    decided = Pass(hosts, [job("a", shape)], (), [ordered], known)
    assert [(start.compute_environment, start.placements) for start in decided.starts] == (
        [tuple(found.allocation)] if found.allocation else []
    )
    if found.allocation is None:
        assert found.problem is not None and decided.reason("a").endswith(found.problem)
