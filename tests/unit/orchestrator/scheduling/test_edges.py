"""Edges of a pass, beside the other modules of this folder."""

from __future__ import annotations

from dataclasses import replace

from orchestrator.scheduling.fit import Fit, fit
from orchestrator.scheduling.free_resources import Allocation
from orchestrator.scheduling.order import decayed, score, share_score, weight
from orchestrator.scheduling.placement import (
    affordable,
    amounts,
    count_of,
    less,
    limit_of,
    needs,
    never_fits,
    place,
    together,
)
from orchestrator.scheduling.quota import Quota, quota_of
from orchestrator.scheduling.reservation import end_of
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


def test_an_idle_queue_s_answer_has_a_place_or_a_problem() -> None:
    both = {"a - b": environment("a - b", max_cpus=2)}
    requested = queue(environments=("a - b",))
    placed = fit(gang(node(2)), requested, both, [host()])
    assert placed == Fit(Allocation("a - b", (on("a", 2, memory=100),)), None)
    assert fit(gang(node(3)), requested, both, [host()]) == Fit(
        None, "compute environment a - b has at most 2 CPUs; needs 1 node with 3 CPUs, 0 GPUs, 100 MiB in all"
    )


def test_the_use_of_a_share_is_weighted_by_its_name_or_its_longest_prefix() -> None:
    policy = FairShare(600, 0, {"a": 0.5, "t*": 2.0, "te*": 3.0, "tea": 4.0, "*": 5.0})
    weights = {"a": 0.5, "to": 2.0, "ten": 3.0, "tea": 4.0, "b": 5.0, "aa": 5.0}
    assert {share: weight(policy, share) for share in weights} == weights
    assert weight(FairShare(600, 0, {"x": 2.0, "yx": 2.0}), "xy") == 1.0
    plain, fair = queue(), queue(policy=policy)
    usage = {("default", "a"): 8.0, ("other", "b"): 9.0}
    assert [score(each, "a", usage) for each in (plain, fair)] == [8.0, 4.0]
    assert [score(each, "b", usage) for each in (plain, fair)] == [0.0, 0.0]
    ordered = [job("x", 2, share="a"), job("y", 3, share="b"), job("z", share="a"), job("w", share="a")]
    assert share_score(fair, ordered, ordered[2], usage) == 4.0 + 0.5 * 60 * 2
    assert share_score(plain, ordered, ordered[3], usage) == 8.0 + 60 * 3
    unnamed = [job("x", 2), job("y", share="a"), job("z")]
    assert share_score(fair, unnamed, unnamed[2], {("default", ""): 1.0}) == 5.0 + 5 * 60 * 2
    assert [decayed(8.0, age, half) for age, half in ((0, 9), (-9, 9), (9, 9), (600, 0), (1, 1))] == [8, 8, 4, 4, 4]


def test_jobs_and_gangs_without_a_share_have_one_in_common() -> None:
    found = quota_of(queue(policy=HALF), [job("x")], [running("y", share=None), running("z", share="")], {})
    assert found is not None and found.active == 1
    assert found.used_of("new", False) == found.used_of("new", True) == 0


def test_a_quota_counts_active_shares_and_the_queue_s_own_gangs() -> None:
    assert quota_of(queue(), [], [], {}) is None and quota_of(queue(policy=FairShare(600, 0, {})), [], [], {}) is None
    held = [
        running("x", on("a", 2, [0, 1]), on("b", 1), share="s"),
        running("y", on("a", 3), environment="other"),
        running("z", on("a", 4), queue="elsewhere", share="e"),
    ]
    usage = {("default", "u"): 1.0, ("default", "v"): 0.99, ("elsewhere", "w"): 9.0}
    found = quota_of(queue(policy=FairShare(600, 1, {})), [job("w", share="s")], held, usage)
    assert found == Quota(0.01**3, 3, {"all": [3.0, 2.0], "other": [3.0, 0.0]}), "s, none and u"
    assert found.used_of("all", True) == 2 and found.used_of("all", False) == 3 and found.used_of("new", True) == 0
    half, hosts = Quota(0.5, 1, {"all": [1.0, 1.0]}), [host("a", 4, 2), host("b", 6, 2)]
    assert [half.limit(True, hosts, 3.0), half.limit(False, hosts, 3.0), half.limit(False, hosts, 99.0)] == [2, 1.5, 5]
    assert half.left(gang(node(1, 1)), "all", hosts, 99.0) == 1 and half.left(gang(node(1)), "all", hosts, 99.0) == 4


def test_amounts_are_worded_with_few_digits_and_never_below_zero() -> None:
    assert (
        amounts(node(1, 1, 1023)) == "1 CPU, 1 GPU, 1023 MiB" and amounts(node(0, 2, 1024)) == "0 CPUs, 2 GPUs, 1 GiB"
    )
    assert (
        amounts(node(-1, 0, -5)) == "0 CPUs, 0 GPUs, 0 MiB"
        and amounts(node(0.004, 0, 8182)) == "0 CPUs, 0 GPUs, 7.99 GiB"
    )
    assert [count_of(each, "CPU") for each in (2.5, 100, 1.004, 1.006)] == [
        "2.5 CPUs",
        "100 CPUs",
        "1 CPU",
        "1.01 CPUs",
    ]
    assert needs(gang(node(), node(), minimum=1)) == "needs at least 1 node with 1 CPU, 0 GPUs, 100 MiB in all"
    assert limit_of([host()]) is None and limit_of([]) is None
    assert limit_of([host(), replace(host("q", 8), queue=True)]) == "queue q gives a gang at most 8 CPUs, 0 GPUs, 8 GiB"


def test_of_a_gang_as_many_nodes_are_affordable_as_fit_in_all() -> None:
    shape = gang(node(1, 1), node(2), node(1, 1), minimum=2)
    assert [affordable(shape, cpus) for cpus in (4, 3.999, 3, 3 - 1e-10, 2.9)] == [3, 2, 2, 2, 0]
    assert [affordable(shape, gpus=gpus) for gpus in (2, 1, 0)] == [3, 2, 0] and affordable(shape) == 3
    assert less(host("a", 4, 3, 100), [on("a", 1, [1], 30), on("a", 0.5, (), 10)]) == replace(
        host("a", 2.5, 3, 60), gpus=("a0", "a2")
    )


def test_a_gang_ends_at_its_timeout_and_one_that_starts_counts_from_now() -> None:
    assert end_of(5000, 1000, 9) == 10_000 and end_of(5000, None, 9) == 14_000 and end_of(5000, 1000, 2) == 5000
    assert end_of(5000, 1000, None) == end_of(0, 0, 4_000_000_000) == float("inf")
    assert end_of(0, 0, 3_999_999_999) == 3_999_999_999_000


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
