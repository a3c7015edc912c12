"""The job that waits for room first: what is kept for it, who may pass it; and what is kept for inactive shares."""

from __future__ import annotations

import pytest

from orchestrator.domain.gang import Shape
from orchestrator.scheduling import free_resources as free
from orchestrator.scheduling.placement import place
from orchestrator.scheduling.snapshot import FairShare, RunningGang
from tests.support.orchestrator.scheduling import (
    CAPACITY,
    Pass,
    environment,
    gang,
    host,
    job,
    line,
    needs,
    node,
    on,
    queue,
    running,
)

# -- backfill ---------------------------------------------------------------------------------------------------------

BEHIND = f"2nd in queue default, behind job large (large-01), which {needs(4)}"
LARGE = job("large", 4)


def cart(cpus: float = 1, **facts: object) -> RunningGang:
    return running("cart", on("a", cpus), **facts)


def test_small_jobs_do_not_overtake_a_large_one_that_waits_for_room() -> None:
    decided = Pass([host()], line(LARGE, job("small")), [running("cart", on("a", 1, memory=10))])
    assert decided.started == ""
    assert decided.reason("large") == (
        "CAPACITY:INSUFFICIENT_INSTANCE_CAPACITY - waits for job cart (cart-012) to end: 1 of 4 CPUs short; "
        "needs 1 node with 4 CPUs, 0 GPUs, 100 MiB in all; 3 CPUs, 0 GPUs, 7.99 GiB free"
    )
    assert decided.reason("small") == (
        "2nd in queue default, behind job large (large-01), which needs 1 node with 4 CPUs, 0 GPUs, 100 MiB in all; "
        "it would fit now, but on what is kept for that job"
    )


def test_a_job_passes_only_if_its_timeout_ends_by_the_start_of_the_head() -> None:
    waiting = line(LARGE, job("late", timeout=601), job("in-time", timeout=600), job("endless"))
    decided = Pass([host()], waiting, [cart(for_seconds=100, timeout=700)])  # ends in 600 s
    assert decided.started == "in-time:a"
    assert decided.reason("large") == (
        f"{CAPACITY} - waits for job cart (cart-012) to end, at the latest at 2027-01-15 08:10:00 UTC: "
        f"2 of 4 CPUs short; {needs(4)}; 2 CPUs, 0 GPUs, 7.9 GiB free"
    )
    assert decided.reason("late") == (
        f"{BEHIND} and starts by 2027-01-15 08:10:00 UTC; "
        "it would fit now, but on what is kept for that job: with a timeout of at most 600 s it could start"
    )


def test_no_timeout_is_short_enough_while_nobody_knows_when_the_head_starts_and_an_absurd_one_is_none() -> None:
    held = [running("known", on("a", 1), timeout=700), running("unknown", on("a", 1))]
    assert Pass([host()], line(LARGE, job("short", timeout=60)), held).started == ""
    decided = Pass([host()], line(LARGE, job("small", timeout=10**14)), [cart(timeout=10**15)])
    assert decided.started == "" and decided.reason("large").startswith(
        f"{CAPACITY} - waits for job cart (cart-012) to end: 1 of 4 CPUs short; "
    )


def test_a_job_of_any_length_may_start_beside_a_reservation() -> None:
    # the head will be on b, from which nothing but its own room is taken; one CPU of b is left over
    waiting = line(job("large", 3), job("wide", 2), job("first"), job("second"), job("third"))
    decided = Pass([host("a", 2), host("b", 4)], waiting, [running("cart", on("b", 3))])
    assert decided.started == "wide:a first:b"
    assert decided.reason("second").startswith("2nd in queue default, behind job large (large-01)")


def test_short_jobs_use_what_is_kept_and_long_ones_what_is_not() -> None:
    waiting = line(
        job("large", 3),  # in 100 s, which leaves one CPU
        job("short", timeout=100),  # takes one of the two that are free
        job("long", timeout=101),  # takes the other, and the one that the head leaves
        job("more", timeout=101),
    )
    assert Pass([host()], waiting, [cart(2, for_seconds=0, timeout=100)]).started == "short:a long:a"


def test_long_jobs_together_leave_the_head_its_resources_and_no_more_is_kept() -> None:
    waiting = line(job("large", 5), *[job(f"j{i}", timeout=9999) for i in range(5)])
    assert Pass([host(cpus=8)], waiting, [cart(4, timeout=700)]).started == "j0:a j1:a j2:a"
    held = [running("x", on("a", 1), timeout=700), running("y", on("a", 1), timeout=700)]
    assert Pass([host()], line(job("large", 3), job("long"), job("longer")), held).started == "long:a"
    # at the end of cart there are 6 CPUs, of which the smallest size takes 4
    elastic = line(job("elastic", gang(*[node(2)] * 3, minimum=2)), job("small"), job("next"))
    assert Pass([host(cpus=6)], elastic, [cart(3, timeout=700)]).started == "small:a next:a"


def test_gpus_are_kept_by_number() -> None:
    held = [running("cart", on("a", 1, [0, 1]), timeout=700)]
    waiting = line(job("large", gang(node(1, 3))), *[job(f"j{i}", gang(node(1, 1))) for i in range(2)])
    decided = Pass([host(cpus=8, gpus=4)], waiting, held)
    assert decided.started == "j0:a" and decided.starts[0].placements[0].gpus == ("a2",)


def test_the_limit_of_a_compute_environment_is_reserved_too() -> None:
    queues = [queue("one", 2, ("p",)), queue("two", 1, ("p",)), queue("three", 0, ("q",))]
    waiting = [
        job("large", 4, queue="one"),
        job("same-environment", queue="two"),
        job("other-environment", 6, queue="three"),  # of the 16 CPUs at that time, 12 are not kept
        job("too-much", 7, queue="three"),
    ]
    held, environments = [cart(environment="p", timeout=700)], [environment("p", max_cpus=4), environment("q")]
    assert Pass([host(cpus=16)], waiting, held, queues, environments).started == "other-environment:a"


def test_a_gang_that_is_being_stopped_counts_as_gone_soon() -> None:
    held = [cart(ending=True), running("other", on("b", 4), timeout=700)]
    decided = Pass([host(), host("b")], line(LARGE, job("small", timeout=60)), held)
    assert decided.started == ""
    assert decided.reason("large").startswith(
        f"{CAPACITY} - waits for job cart (cart-012) to stop: 1 of 4 CPUs short; "
    )


def test_a_gang_that_starts_now_or_before_is_expected_to_run_for_its_whole_timeout() -> None:
    waiting = line(LARGE, job("late", timeout=301), job("in-time", timeout=300))
    assert Pass([host()], waiting, [cart(for_seconds=None, timeout=300)]).started == "in-time:a"
    decided = Pass([host()], line(job("now", timeout=500), LARGE, job("late", timeout=501), job("ok", timeout=500)))
    assert decided.started == "now:a ok:a"
    assert "waits for job now (now-0123) to end, at the latest at 2027-01-15 08:08:20 UTC: " in decided.reason("large")


def test_equal_jobs_are_tried_once_a_pass_however_many_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[Shape] = []
    monkeypatch.setattr(free, "place", lambda shape, *rest: tried.append(shape) or place(shape, *rest))
    held = [running(f"r{i}", on("a", 1), timeout=200 + i) for i in range(4)]
    Pass([host()], line(*[job(f"j{i}", 1 + i % 2, timeout=60 + i) for i in range(2000)]), held)
    # two shapes, each with and without time to end before the head starts, and the bisection for the head
    assert len(tried) < 20


def test_gangs_of_unknown_ends_are_awaited_the_oldest_first_and_also_where_their_hosts_are_gone() -> None:
    held = [running("a", on("a", 1), for_seconds=9), running("b", on("a", 3), for_seconds=900)]
    assert " - waits for jobs b (b-012345), a (a-012345) to end: " in Pass([host()], [LARGE], held).reason("large")
    decided = Pass([host()], [job("ant", 2)], [running("x", on("gone", 4))], (), [environment(max_cpus=4)])
    assert "job x (x-012345) to end: compute environment all may use 0 CPUs more at this time; " in decided.reason(
        "ant"
    )


# -- several reservations ---------------------------------------------------------------------------------------------

TWO_HOSTS, APART = [host("a"), host("b")], [environment("p", ("a",)), environment("q", ("b",))]


def test_a_job_that_waits_holds_up_only_the_hosts_that_it_could_use() -> None:
    queues = [queue("one", 2, ("p",)), queue("two", 1, ("q",))]
    held = [cart(environment="p"), running("ant", on("b", 1), environment="q")]
    waiting = [
        job("one-large", 4, queue="one"),
        job("two-small", queue="two", age=9),
        job("two-large", 4, queue="two", age=8),
        job("two-next", queue="two", age=7),
    ]
    decided = Pass(TWO_HOSTS, waiting, held, queues, APART)
    assert decided.started == "two-small:b"
    assert f"2 of 4 CPUs short; {needs(4)}; " in decided.reason("two-large")
    assert decided.reason("two-next").startswith("2nd in queue two, behind job two-large (two-larg)")
    waiting = [job("large", 4, queue="high"), job("short", queue="low", timeout=600, age=99)]
    assert Pass([host()], waiting, [cart(2, timeout=700)], [queue("high", 2), queue("low", 1)]).started == "short:a"


def test_a_job_with_several_compute_environments_is_the_head_of_those_that_are_not_kept_yet() -> None:
    queues = [queue("one", 3, ("p",)), queue("both", 2, ("p", "q")), queue("two", 1, ("q",))]
    held = [cart(environment="p"), running("ant", on("b", 1), environment="q", timeout=700)]
    large = [job("one-large", 4, queue="one"), job("both-large", 4, queue="both")]
    waiting = [*large, job("two-small", queue="two"), job("two-short", queue="two", timeout=600)]
    waiting += [job("both-next", 3, queue="both"), job("any", 3, queue="any")]
    queues.append(queue("any", 0, ("p", "q")))
    decided = Pass(TWO_HOSTS, waiting, held, queues, APART)
    assert decided.started == "two-short:b"
    assert ", behind job both-large (both-lar), " in decided.reason("both-next"), "the head of its own queue"
    assert ", behind job one-large (one-larg), " in decided.reason("any"), "the first of those before it"
    assert decided.reason("two-small") == (
        f"{CAPACITY} - 1st in queue two, behind job both-large (both-lar), "
        f"which {needs(4)} and starts by 2027-01-15 08:10:00 UTC; "
        "it would fit now, but on what is kept for that job: with a timeout of at most 600 s it could start"
    )


def test_equal_jobs_with_other_timeouts_are_each_judged_by_their_own() -> None:
    queues = [queue("one", 3, ("p",)), queue("two", 2, ("q",)), queue("any", 1, ("r",))]
    held = [
        cart(3, environment="p", timeout=200),  # ends in 100 s
        running("ant", on("b", 3), environment="q", timeout=300),  # ends in 200 s
    ]
    waiting = [
        job("one-large", 4, queue="one"),
        job("two-large", 4, queue="two"),
        job("endless", queue="any", age=9),
        job("long", queue="any", age=8, timeout=201),
        job("longer", queue="any", age=7, timeout=202),
        job("middle", queue="any", age=6, timeout=200),  # only b will not be needed before it ends
        job("short", queue="any", age=5, timeout=100),
        job("second", queue="any", age=4, timeout=100),
    ]
    assert Pass(TWO_HOSTS, waiting, held, queues, [*APART, environment("r")]).started == "middle:b short:a"


# -- what is kept for shares that are not active ----------------------------------------------------------------------

HALF = FairShare(600, 50, {})


def test_a_queue_keeps_part_of_its_compute_environment_for_shares_that_are_not_active() -> None:
    waiting = line(*[job(f"j{i}", gang(node(1, 1)), share="s") for i in range(6)])
    decided = Pass([host(cpus=8, gpus=8)], waiting, queues=[queue(policy=HALF)])
    assert decided.started == "j0:a j1:a j2:a j3:a"
    assert decided.reason("j4") == (
        f"{CAPACITY} - its queue uses 4 of the 4 GPUs that it may use of all: "
        f"50% is kept for shares that are not active (1 active share now); {needs(1, 1)}"
    )
    elastic = [job("ant", gang(*[node(1, 1)] * 6, minimum=2), share="s")]
    assert Pass([host(cpus=8, gpus=8)], elastic, queues=[queue(policy=HALF)]).started == "ant:a+a+a+a"


@pytest.mark.parametrize(
    ("usage", "extra", "free"),
    [
        ({}, [], 4),
        ({("default", "t"): 100.0}, [], 6),  # two active shares: a quarter is kept
        ({("default", "t"): 0.5}, [], 4),  # as good as forgotten
        ({("elsewhere", "t"): 100.0}, [], 4),
        ({("default", "t"): 100.0}, [running("cart", share="u")], 7),  # three: an eighth
        ({("default", "t"): 100.0}, [running("cart", queue="elsewhere", share="u")], 6),
    ],
)
def test_more_active_shares_reduce_the_reservation(usage, extra, free) -> None:
    waiting = line(*[job(f"j{i}", gang(node(0.1, 1)), share="s") for i in range(9)])
    assert len(Pass([host(cpus=8, gpus=8)], waiting, extra, [queue(policy=HALF)], usage=usage).starts) == free


def test_only_use_of_the_queues_own_gangs_counts() -> None:
    held = [running("cart", on("a", 1.5), share="s"), running("ant", on("a", 4), queue="other")]
    waiting = line(job("x", 2, share="s"), job("y", 3, share="s"), job("z", share="s"))
    decided = Pass([host(cpus=10)], waiting, held, [queue(policy=HALF), queue("other")])
    # 5 of 10 CPUs may be used, 1.5 are: x makes that 3.5, y does not fit into the rest and holds up nobody, z does
    assert decided.started == "x:a z:a"
    assert decided.reason("y") == (
        f"{CAPACITY} - its queue uses 4.5 of the 5 CPUs that it may use of all: "
        f"50% is kept for shares that are not active (1 active share now); {needs(3)}"
    )


def test_a_job_may_start_in_the_next_compute_environment_when_the_first_is_reserved() -> None:
    queues, waiting = [queue(environments=("p", "q"), policy=HALF)], line(*[job(f"j{i}", share="s") for i in range(5)])
    assert Pass([host("a"), host("b", 2)], waiting, (), queues, APART).started == "j0:a j1:a j2:b"
