"""Who starts, where, and why the others wait."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orchestrator.definition import GangNeeds, NodeNeeds
from orchestrator.engines.base import Host, Placement
from orchestrator.scheduler import Start, Wait, Waiting, decide, never_fits, place


def node(cpus: float = 1, gpus: int = 0, memory: int = 100) -> NodeNeeds:
    return NodeNeeds(("x",), {}, cpus, gpus, memory)


def gang(name: str, *nodes: NodeNeeds, minimum: int | None = None) -> Waiting:
    return Waiting(f"{name}-0123456789", name, GangNeeds(0, nodes, len(nodes) if minimum is None else minimum))


def host(name: str = "a", cpus: float = 4, gpus: int = 0, memory: int = 8192) -> Host:
    return Host(name, cpus, tuple(f"{name}{i}" for i in range(gpus)), memory)


def reasons(decisions: Sequence[Start | Wait]) -> list[str]:
    """By job: its hosts, or why it waits."""
    return [
        decision.reason if isinstance(decision, Wait) else " ".join(p.host for p in decision.placements)
        for decision in decisions
    ]


# -- examples ---------------------------------------------------------------------------------------------------------


def test_where_nothing_waits_nothing_is_decided() -> None:
    assert decide([], [host()], []) == []


def test_a_gang_that_fits_starts_with_what_it_asked_for() -> None:
    waiting = [gang("ant", node(0.5, 1, 1024), node(1, 2, 512))]
    assert decide(waiting, [host(gpus=3)], []) == [
        Start("ant-0123456789", (Placement("a", ("a2",), 0.5, 1024), Placement("a", ("a0", "a1"), 1, 512)))
    ]


def test_no_gpu_is_given_twice() -> None:
    held = [("other", [Placement("a", ("a0", "a2"), 1, 1)])]
    [start] = decide([gang("ant", node(1, 1), node(1, 1))], [host(gpus=4)], held)
    assert isinstance(start, Start)
    assert sorted(gpu for placement in start.placements for gpu in placement.gpus) == ["a1", "a3"]


def test_a_gang_starts_whole_or_not_at_all() -> None:
    [decision] = decide([gang("ant", *[node()] * 4)], [host(cpus=8)], [("cart", [Placement("a", (), 5, 10)])])
    assert decision == Wait(
        "ant-0123456789",
        "needs 4 nodes with 4 CPUs, 0 GPUs, 400 MiB in all; 3 CPUs, 0 GPUs, 7.99 GiB free until cart ends",
    )


def test_a_gang_may_span_hosts() -> None:
    assert reasons(decide([gang("ant", *[node(2)] * 3)], [host("a"), host("b", 2)], [])) == ["a a b"]


def test_the_oldest_starts_first_and_what_is_left_goes_to_the_next() -> None:
    waiting = [gang("first", node(3)), gang("second", node(1)), gang("third", node(1))]
    assert reasons(decide(waiting, [host(cpus=4)], [])) == [
        "a",
        "a",
        "needs 1 node with 1 CPU, 0 GPUs, 100 MiB in all; 0 CPUs, 0 GPUs, 7.8 GiB free",
    ]


def test_small_jobs_do_not_overtake_a_large_one_that_waits_for_room() -> None:
    waiting = [gang("large", node(4)), gang("small", node(1))]
    held = [("running", [Placement("a", (), 1, 10)])]
    assert reasons(decide(waiting, [host(cpus=4)], held)) == [
        "needs 1 node with 4 CPUs, 0 GPUs, 100 MiB in all; 3 CPUs, 0 GPUs, 7.99 GiB free until running ends",
        "behind job large (large-01) in the queue, which waits for room",
    ]


def test_a_job_that_can_never_start_says_so_and_holds_up_nobody() -> None:
    waiting = [gang("huge", node(64, 2)), gang("small", node(1))]
    assert reasons(decide(waiting, [host(cpus=4, gpus=1), host("b", 2)], [])) == [
        "MISCONFIGURATION:JOB_RESOURCE_REQUIREMENT - each node needs 64 CPUs, 2 GPUs, 100 MiB; "
        "the largest host has 4 CPUs, 1 GPU, 8 GiB",
        "a",
    ]


def test_a_gang_too_large_for_all_hosts_together_says_so_even_behind_one_that_waits() -> None:
    waiting = [gang("first", node(4)), gang("wide", *[node(1)] * 9)]
    held = [("running", [Placement("a", (), 1, 10)])]
    assert reasons(decide(waiting, [host(cpus=4), host("b", 3)], held))[1] == (
        "MISCONFIGURATION:JOB_RESOURCE_REQUIREMENT - needs 9 nodes with 9 CPUs, 0 GPUs, 900 MiB in all; "
        "all hosts together have 7 CPUs, 0 GPUs, 16 GiB"
    )


def test_without_any_host_the_job_says_so() -> None:
    assert reasons(decide([gang("ant", node())], [], [])) == [
        "MISCONFIGURATION:JOB_RESOURCE_REQUIREMENT - each node needs 1 CPU, 0 GPUs, 100 MiB; "
        "the largest host has nothing: there is no host"
    ]


def test_an_elastic_gang_starts_with_as_many_nodes_as_fit() -> None:
    waiting = [gang("ant", *[node(1)] * 4, minimum=2)]
    assert reasons(decide(waiting, [host(cpus=8)], [])) == ["a a a a"]
    assert reasons(decide(waiting, [host(cpus=8)], [("x", [Placement("a", (), 5, 1)])])) == ["a a a"]
    assert reasons(decide(waiting, [host(cpus=8)], [("x", [Placement("a", (), 7, 1)])])) == [
        "needs at least 2 nodes with 2 CPUs, 0 GPUs, 200 MiB in all; 1 CPU, 0 GPUs, 8 GiB free until x ends"
    ]


def test_fractions_of_a_cpu_add_up() -> None:
    assert reasons(decide([gang("ant", *[node(0.1)] * 10)], [host(cpus=1)], [])) == [" ".join("a" * 10)]


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_unlike_nodes_fit_on_unlike_hosts_in_whatever_order_they_come(order: tuple[int, int]) -> None:
    nodes = [node(2), node(4)]
    needs = GangNeeds(0, tuple(nodes[i] for i in order), 2)
    hosts = [host("large", 4), host("small", 2)]
    assert never_fits(needs, hosts) is None
    placements = place(needs, hosts)
    assert placements
    assert [placement.host for placement in placements] == [("small", "large")[i] for i in order]


def test_nodes_without_gpus_leave_those_with_gpus_their_host() -> None:
    needs = GangNeeds(0, (node(4), node(1, 1)), 2)
    placements = place(needs, [host("gpu", 4, gpus=1), host("cpu", 4)])
    assert placements
    assert [placement.host for placement in placements] == ["cpu", "gpu"]


# -- properties -------------------------------------------------------------------------------------------------------

nodes = st.builds(node, st.sampled_from([0.5, 1, 2, 3, 5]), st.integers(0, 3), st.sampled_from([100, 500, 2000]))
hosts_strategy = st.lists(
    st.tuples(st.sampled_from([0, 1, 2.5, 4, 8]), st.integers(0, 4), st.sampled_from([50, 1000, 4000])), max_size=4
).map(lambda each: [host(f"h{i}", cpus, gpus, memory) for i, (cpus, gpus, memory) in enumerate(each)])


@st.composite
def queues(draw: st.DrawFn) -> list[Waiting]:
    made = []
    for index in range(draw(st.integers(0, 6))):
        members = draw(st.lists(nodes, min_size=1, max_size=4))
        made.append(gang(f"job{index}", *members, minimum=draw(st.integers(1, len(members)))))
    return made


@st.composite
def snapshots(draw: st.DrawFn) -> tuple[list[Waiting], list[Host], list[tuple[str, Sequence[Placement]]]]:
    """A queue, hosts, and gangs that hold resources because an earlier decision gave them."""
    hosts = draw(hosts_strategy)
    earlier = [each for each in decide(draw(queues()), hosts, []) if isinstance(each, Start)]
    kept = draw(st.lists(st.booleans(), min_size=len(earlier), max_size=len(earlier)))
    running = [(start.job, start.placements) for start, keep in zip(earlier, kept, strict=True) if keep]
    return draw(queues()), hosts, running


def started(decisions: Sequence[Start | Wait]) -> list[Start]:
    return [decision for decision in decisions if isinstance(decision, Start)]


properties = settings(max_examples=60, deadline=None)


@properties
@given(snapshots())
def test_every_waiting_job_has_one_decision_and_every_one_that_waits_a_reason(
    snapshot: tuple[list[Waiting], list[Host], list[tuple[str, Sequence[Placement]]]],
) -> None:
    decisions = decide(*snapshot)
    assert [decision.job for decision in decisions] == [job.job for job in snapshot[0]]
    for decision in decisions:
        if isinstance(decision, Wait):
            assert len(decision.reason) > 20
            assert "\n" not in decision.reason


@properties
@given(snapshots())
def test_nothing_is_ever_over_committed(
    snapshot: tuple[list[Waiting], list[Host], list[tuple[str, Sequence[Placement]]]],
) -> None:
    waiting, hosts, running = snapshot
    taken = [p for _, placements in running for p in placements]
    taken += [p for start in started(decide(waiting, hosts, running)) for p in start.placements]
    for each in hosts:
        here = [placement for placement in taken if placement.host == each.name]
        assert sum(placement.cpus for placement in here) <= each.cpus + 1e-6
        assert sum(placement.memory for placement in here) <= each.memory
        gpus = Counter(gpu for placement in here for gpu in placement.gpus)
        assert set(gpus) <= set(each.gpus)
        assert all(count == 1 for count in gpus.values())
    assert {placement.host for placement in taken} <= {each.name for each in hosts}


@properties
@given(snapshots())
def test_no_gang_starts_by_half_and_every_node_gets_what_it_needs(
    snapshot: tuple[list[Waiting], list[Host], list[tuple[str, Sequence[Placement]]]],
) -> None:
    by_id = {job.job: job for job in snapshot[0]}
    for start in started(decide(*snapshot)):
        needs = by_id[start.job].needs
        assert needs.minimum <= len(start.placements) <= len(needs.nodes)
        for placement, wanted in zip(start.placements, needs.nodes, strict=False):
            assert (placement.cpus, len(placement.gpus), placement.memory) == (wanted.cpus, wanted.gpus, wanted.memory)


@properties
@given(snapshots())
def test_nobody_overtakes_a_job_that_waits_for_room(
    snapshot: tuple[list[Waiting], list[Host], list[tuple[str, Sequence[Placement]]]],
) -> None:
    head_waits = False
    for decision in decide(*snapshot):
        if isinstance(decision, Start):
            assert not head_waits
        elif not decision.reason.startswith("MISCONFIGURATION"):
            assert head_waits == decision.reason.startswith("behind job ")
            head_waits = True


@properties
@given(snapshots())
def test_an_impossible_job_changes_nothing_for_the_others(
    snapshot: tuple[list[Waiting], list[Host], list[tuple[str, Sequence[Placement]]]],
) -> None:
    waiting, hosts, running = snapshot
    impossible = gang("impossible", node(1000, 99))
    decisions = decide([impossible, *waiting], hosts, running)
    assert isinstance(decisions[0], Wait)
    assert decisions[0].reason.startswith("MISCONFIGURATION:JOB_RESOURCE_REQUIREMENT - each node needs 1000 CPUs")
    assert decisions[1:] == decide(waiting, hosts, running)


@properties
@given(snapshots())
def test_on_idle_hosts_the_oldest_job_that_can_ever_start_starts(
    snapshot: tuple[list[Waiting], list[Host], list[tuple[str, Sequence[Placement]]]],
) -> None:
    waiting, hosts, _ = snapshot
    first = next((job.job for job in waiting if not never_fits(job.needs, hosts)), None)
    assert next((start.job for start in started(decide(waiting, hosts, []))), None) == first


@properties
@given(snapshots())
def test_every_job_that_can_ever_start_does_so_in_the_end_and_in_order(
    snapshot: tuple[list[Waiting], list[Host], list[tuple[str, Sequence[Placement]]]],
) -> None:
    waiting, hosts, running = snapshot
    possible = [job.job for job in waiting if not never_fits(job.needs, hosts)]
    order: list[str] = []
    for _ in range(len(waiting) + len(running) + 1):
        starts = started(decide(waiting, hosts, running))
        order += [start.job for start in starts]
        waiting = [job for job in waiting if job.job not in order]
        running = [*running[1:], *((start.job, start.placements) for start in starts)]
    assert order == possible


@settings(max_examples=60, deadline=None)
@given(hosts_strategy, nodes, st.integers(1, 6))
def test_a_gang_of_equal_nodes_fits_exactly_where_it_can(hosts: list[Host], each: NodeNeeds, count: int) -> None:
    room = sum(
        min(
            int((h.cpus + 1e-9) // each.cpus),
            len(h.gpus) // each.gpus if each.gpus else count,
            h.memory // each.memory,
        )
        for h in hosts
    )
    assert (place(GangNeeds(0, (each,) * count, count), hosts) is not None) == (room >= count)
