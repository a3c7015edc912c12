"""Edges of a pass, beside the other modules of this folder."""

from __future__ import annotations

from dataclasses import replace

from orchestrator.scheduling.placement import (
    never_fits,
    place,
    together,
)
from orchestrator.scheduling.snapshot import FairShare, TimeLimit
from tests.support.orchestrator.scheduling import (
    CAPACITY,
    NOW,
    Pass,
    environment,
    gang,
    host,
    job,
    leads,
    line,
    node,
    on,
    queue,
    running,
)

HALF = FairShare(600, 50, {})
"""Half of a compute environment is kept while one share is active."""


def test_the_time_at_the_head_is_that_of_the_first_job_and_counts_by_the_millisecond() -> None:
    waiting, held = line(job("x", 4), job("y", 3)), [running("cart", on("a", 4))]
    limited = [queue(limits=(TimeLimit(CAPACITY, 600),))]
    assert Pass([host()], waiting, held, limited).decisions.leading == leads("x", CAPACITY, 0)
    for late, cancelled in ((0, ""), (1, "x")):
        since = {"default": replace(leads("x", CAPACITY, 600)["default"], since=NOW - 600_000 - late)}
        assert Pass([host()], waiting, held, limited, leading=since).cancelled == cancelled


def test_each_queue_has_a_quota_of_its_own() -> None:
    queues = [queue("p", policy=HALF), queue("q", policy=HALF)]
    waiting = [job(f"{name}{i}", queue=name, share="s", age=9 - i) for name in "pq" for i in range(3)]
    assert Pass([host()], waiting, queues=queues).started == "p0:a q0:a p1:a q1:a"


def test_a_gang_is_preempted_once_for_two_heads() -> None:
    queues = [queue("p", 9, ("p",)), queue("q", 9, ("q",)), queue("low", 1, ("p",))]
    environments = [environment("p", ("a",)), environment("q", ("b",))]
    both = running("both", on("a", 4), on("b", 4), queue="low", environment="p", preemptible=True)
    decided = Pass(
        [host("a"), host("b")], [job("x", 3, queue="p"), job("y", 3, queue="q")], [both], queues, environments
    )
    assert decided.preempted == "both"
    assert decided.reason("y").startswith(f"{CAPACITY} - waits for job both (both-012), preempted for it, to stop: ")


def test_long_jobs_together_leave_the_head_the_cpus_of_its_compute_environment() -> None:
    # at the end of cart 8 CPUs may be used, of which the head takes 6; q's jobs count apart
    environments = [environment("p", max_cpus=8), environment("q")]
    queues = [queue("p", 2, ("p",)), queue("q", 1, ("q",))]
    held = [running("cart", on("a", 4), environment="p", timeout=700)]
    waiting = line(job("head", 6, queue="p"), *[job(f"j{i}", queue="p") for i in range(3)], job("k", 5, queue="q"))
    assert Pass([host(cpus=64)], waiting, held, queues, environments).started == "j0:a j1:a k:a"


def test_what_is_reserved_on_other_hosts_is_nothing_to_a_queue() -> None:
    queues, environments = (
        [queue("p", 2, ("p",)), queue("q", 1, ("q",))],
        [environment("p", ("a",)), environment("q", ("b",))],
    )
    held = [running("x", on("a", 2), for_seconds=0, timeout=100), running("y", on("b", 2), for_seconds=0, timeout=600)]
    waiting = line(job("head-p", 4, queue="p"), job("head-q", 4, queue="q"), job("small", queue="q"))
    decided = Pass([host("a"), host("b")], waiting, held, queues, environments)
    assert decided.reason("small").endswith("with a timeout of at most 600 s it could start")


def test_hosts_that_are_away_are_taken_for_the_smallest_gang_alone() -> None:
    absent, present = replace(host("a", 1), unavailable=True), host("b", 1)

    def where(most: int | None, minimum: int = 2, count: int = 3) -> str | None:
        found = place(
            gang(*[node()] * count, minimum=minimum), [absent, present, replace(host("c", 1), unavailable=True)], most
        )
        return found and " ".join(each.host for each in found)

    assert [where(most) for most in (None, 3, 2, 1)] == ["b a", "b a", "b a", None]
    assert where(1, minimum=1) == "b" and where(None, minimum=3) == "b a c" and where(None, minimum=4, count=4) is None


def test_the_host_that_lacks_least_is_called_the_largest() -> None:
    def largest(requested: tuple[float, int, int], *known: tuple[float, int, int]) -> str:
        hosts = [host(str(index), *each) for index, each in enumerate(known)]
        message = never_fits(gang(node(*requested)), hosts)
        assert message is not None
        return message.partition("the largest host has ")[2]

    assert largest((2, 1, 50), (9, 0, 90), (1, 1, 10)) == "1 CPU, 1 GPU, 10 MiB"
    assert largest((2, 0, 99), (1, 0, 90), (2, 0, 10)) == "2 CPUs, 0 GPUs, 10 MiB"
    assert largest((2, 0, 99), (2, 0, 90), (9, 0, 10)) == "2 CPUs, 0 GPUs, 90 MiB"
    assert largest((2, 1, 99), (1, 1, 9), (1, 5, 8)) == "1 CPU, 1 GPU, 9 MiB"
    assert together([host("a", 1, 1, 10), host("b", 2, 1, 20)]) == "3 CPUs, 2 GPUs, 30 MiB"


def test_a_host_for_one_node_has_no_room_beside_it_not_even_for_nothing() -> None:
    one = replace(host("a"), single=True)
    nothing = gang(node(1), node(0, 0, 0))
    assert place(nothing, [one]) is None and place(nothing, [host()]) is not None
    assert never_fits(nothing, [one]) == "needs 2 hosts, one for each node; there is 1"
