"""Whom the job that waits for room first preempts, and when such a job is given up."""

from __future__ import annotations

import pytest

from orchestrator.domain.gang import Shape
from orchestrator.scheduling.decisions import Cancel, Preempt
from orchestrator.scheduling.snapshot import Queue, RunningGang, TimeLimit
from tests.support.orchestrator.scheduling import (
    CAPACITY,
    FAIR,
    MAXIMUM,
    REQUIREMENT,
    Pass,
    environment,
    gang,
    host,
    job,
    leads,
    line,
    needs,
    node,
    on,
    queue,
    running,
)

# -- preemption -------------------------------------------------------------------------------------------------------

HIGH = [queue("high", 9), queue("mid", 5), queue("low", 1)]


def cart(cpus: float = 4, queue: str = "low", name: str = "cart", host: str = "a", **facts: object) -> RunningGang:
    """A gang that may be preempted."""
    return running(name, on(host, cpus), queue=queue, **{"preemptible": True, **facts})


def test_a_job_of_a_higher_queue_preempts_also_for_the_cpus_that_may_be_used_and_keeps_what_comes_free() -> None:
    decided = Pass([host()], [job("ant", 3, queue="high"), job("small", 2, queue="low", timeout=60)], [cart()], HIGH)
    assert decided.preempts == (Preempt("cart-0123456789", "ant-0123456789"),)
    assert decided.starts == ()
    assert decided.reason("ant").startswith(f"{CAPACITY} - waits for job cart (cart-012), preempted for it, to stop: ")
    assert decided.reason("small").startswith(f"{CAPACITY} - 1st in queue low, behind")
    decided = Pass([host(cpus=64)], [job("ant", 3, queue="high")], [cart(2)], HIGH, [environment(max_cpus=4)])
    assert decided.preempted == "cart"


@pytest.mark.parametrize(
    ("held", "queues"),
    [
        ([cart(preemptible=False)], HIGH),
        ([cart(queue="high")], HIGH),
        ([cart(ending=True)], HIGH),
        ([cart(queue="deleted")], HIGH),
        ([cart(queue="equal")], [queue("high", 5), queue("equal", 5)]),
        ([cart(2), running("fixed", on("a", 2), queue="low")], HIGH),  # that would not be enough
        ([cart(queue="high")], [queue("high")]),  # first in, first out
    ],
)
def test_only_what_may_be_preempted_and_gives_room_is(held: list[RunningGang], queues: list[Queue]) -> None:
    assert Pass([host()], [job("ant", 3, queue="high", priority=9)], held, queues).preempts == ()


def test_victims_are_ordered_by_queue_then_priority_then_age() -> None:
    held = [
        cart(1, "mid", "mid", for_seconds=1),
        cart(1, name="old", for_seconds=900),
        cart(1, name="young", for_seconds=10),
        cart(1, name="dear", for_seconds=1, priority=7),
    ]
    chosen = [Pass([host()], [job("ant", cpus, queue="high")], held, HIGH).preempted for cpus in (1, 2, 3, 4)]
    assert chosen == ["young", "young old", "young old dear", "young old dear mid"]
    held = [cart(2, name="running", for_seconds=0), cart(2, name="starting", for_seconds=None)]
    assert Pass([host()], [job("ant", 2, queue="high")], held, HIGH).preempted == "starting"


def test_a_gang_of_another_compute_environment_is_preempted_if_one_of_its_hosts_is_needed() -> None:
    queues, places = [queue("high", 9, ("p",)), queue("low", 1, ("q",))], [environment("p", ("a",)), environment("q")]
    wide = running("wide", on("a", 4), on("b", 4), queue="low", environment="q", preemptible=True)
    decided = Pass([host("a"), host("b")], [job("ant", 3, queue="high")], [wide], queues, places)
    assert decided.preempted == "wide"


def test_a_gang_whose_host_is_gone_is_preempted_for_the_cpus_that_it_counts_for() -> None:
    lost, places = cart(host="gone"), [environment(max_cpus=4)]
    assert Pass([host()], [job("ant", 2, queue="high")], [lost], HIGH, places).preempted == "cart"


def test_no_more_are_preempted_than_needed_and_none_while_some_stop() -> None:
    held = [
        cart(1, name="small", for_seconds=1),
        cart(1, name="other", host="b", for_seconds=2),
        cart(3, name="large", host="b", for_seconds=3),
        running("fixed", on("a", 3), queue="low"),
    ]
    # the youngest two come first but are not enough, and with the third they are no longer needed
    assert Pass([host("a"), host("b")], [job("ant", 3, queue="high")], held, HIGH).preempted == "large"
    held = [cart(2, name="first", ending=True), cart(2, name="second")]
    assert Pass([host()], [job("ant", 2, queue="high")], held, HIGH).preempted == ""
    decided = Pass([host()], [job("ant", 3, queue="high")], held, HIGH)
    assert decided.preempted == "second"
    assert decided.reason("ant").startswith(
        f"{CAPACITY} - waits for job second (second-0), preempted for it, to stop: "
    )
    report = decided.decisions.report
    assert [report.preempts(each.job) for each in held] == [False, True]


def test_nothing_starts_where_a_job_waits_for_the_gang_that_it_preempts_though_another_one_is_overdue() -> None:
    overdue = running("overdue", on("a", 2), on("b", 2), on("c", 2), queue="high", timeout=1, for_seconds=9)
    held = [overdue, cart(2, host="b"), running("fixed", on("a", 2), queue="high")]
    waiting = [job("ant", gang(node(2), node(2)), queue="high"), job("small", 2, queue="low")]
    decided = Pass([host("a"), host("b"), host("c")], waiting, held, HIGH)
    assert (decided.preempted, decided.starts) == ("cart", ())


def test_in_a_share_a_higher_priority_preempts_a_lower_one() -> None:
    for share, priority, expected in (("s", 2, "cart"), ("s", 1, ""), (None, 2, "cart")):
        waiting, held = [job("ant", share=share, priority=priority)], [cart(queue="default", share=share, priority=1)]
        assert Pass([host()], waiting, held, [queue(policy=FAIR)]).preempted == expected


def test_across_shares_only_one_that_would_be_served_first_preempts() -> None:
    held, queues = [cart(queue="default", share="t", priority=1)], [queue(policy=FAIR)]
    ant = job("ant", share="s", priority=2)
    # behind a job that never fits, for which 120 are charged, it comes later
    huge = job("huge", gang(node(2, 2)), share="s", priority=9)
    for waiting, mine, its, expected in (
        *(([ant], 10.0, 20.0, "cart"), ([ant], 20.0, 10.0, ""), ([ant], 10.0, 10.0, "cart")),
        *(([huge, ant], 10.0, 129.0, ""), ([huge, ant], 10.0, 131.0, "cart")),
    ):
        usage = {("default", "s"): mine, ("default", "t"): its}
        assert Pass([host()], waiting, held, queues, usage=usage).preempted == expected


# -- jobs that are stuck ----------------------------------------------------------------------------------------------

LIMITED = (TimeLimit(CAPACITY, 600),)


@pytest.mark.parametrize(
    ("code", "shape"), [(CAPACITY, gang(node(4))), (MAXIMUM, gang(node(6))), (REQUIREMENT, gang(node(1, 1)))]
)
@pytest.mark.parametrize(("waited", "late"), [(601, True), (600, False)])
def test_a_job_stuck_first_in_its_queue_is_cancelled(code: str, shape: Shape, waited: int, late: bool) -> None:
    others = [TimeLimit(each, 1) for each in (CAPACITY, MAXIMUM, REQUIREMENT) if each != code]
    queues, held = [queue(limits=(*others, TimeLimit(code, 600)))], [running("cart", on("a", 1))]
    waiting, leading = [job("x", shape, runnable=999)], leads("x", code, waited)
    decided = Pass([host()], waiting, held, queues, [environment(max_cpus=5)], leading=leading)
    if late:
        cancel = Cancel("x-0123456789", f"Canceled by JobStateTimeLimit action due to reason: {code}")
        assert decided.cancels == (cancel,) and decided.waits() == ""
    else:
        assert decided.cancels == () and decided.reason("x").startswith(f"{code} - ")


def test_only_the_first_that_does_not_start_is_cancelled_and_the_next_takes_its_place() -> None:
    jobs = (("runs", 1), ("stuck", 4), ("next", 4), ("small", 1))
    waiting = line(*[job(name, cpus, runnable=999) for name, cpus in jobs])
    held, leading = [running("cart", on("a", 2), timeout=700)], leads("stuck", CAPACITY, 601)
    decided = Pass([host()], waiting, held, [queue(limits=LIMITED)], leading=leading)
    assert (decided.started, decided.cancelled, decided.waits()) == ("runs:a", "stuck", "next small")
    assert f"3 of 4 CPUs short; {needs(4)}; " in decided.reason("next")
    assert decided.reason("small").startswith("2nd in queue default, behind job next (next-012)")


def test_only_the_time_at_the_head_counts_and_a_pass_tells_the_next_one_since_when_that_is() -> None:
    held, waiting = [running("cart", on("a", 4))], line(job("x", runnable=9999), job("y", runnable=9999))
    for before, since in (
        ({}, 0),
        (leads("x", CAPACITY, 500), 500),
        (leads("y", CAPACITY, 999), 0),  # another job, another reason: from now on
        (leads("x", MAXIMUM, 999), 0),
    ):
        decided = Pass([host()], waiting, held, [queue(limits=LIMITED)], leading=before)
        assert decided.cancels == () and decided.decisions.leading == leads("x", CAPACITY, since)


def test_a_cancelled_job_preempts_no_gang_and_an_unusable_queue_cancels_none() -> None:
    queues, leading = [queue("high", 9, limits=LIMITED), queue("low")], leads("ant", CAPACITY, 601, "high")
    decided = Pass([host()], [job("ant", queue="high")], [cart()], queues, leading=leading)
    assert (len(decided.cancels), decided.preempts) == (1, ())
    queues = [queue(limits=tuple(TimeLimit(code, 600) for code in (CAPACITY, MAXIMUM, REQUIREMENT)))]
    assert Pass([host()], [job("x", runnable=999)], (), queues, [environment(enabled=False)]).cancels == ()


@pytest.mark.parametrize("cpus", [1, 4])
def test_the_first_of_a_queue_behind_the_head_of_another_is_stuck_too_also_where_it_is_its_equal(cpus: int) -> None:
    queues, held = [queue("high", 9), queue("low", limits=LIMITED)], [running("cart", on("a", 2))]
    waiting = [job("ant", 4, queue="high"), job("next", cpus, queue="low")]
    assert Pass([host()], waiting, held, queues, leading=leads("next", CAPACITY, 601, "low")).cancelled == "next"
