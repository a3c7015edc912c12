"""Whom the job that waits for room first preempts, and when such a job is given up."""

from __future__ import annotations

import pytest

from orchestrator.scheduling.decide import Cancel, Decisions, Preempt, decide
from orchestrator.scheduling.snapshot import TimeLimit
from tests.support.orchestrator.scheduling import (
    FAIR,
    compute_environment,
    gang,
    host,
    job,
    leads,
    line,
    names,
    node,
    on,
    queue,
    reason,
    running,
    snapshot,
    started,
)

# -- preemption -------------------------------------------------------------------------------------------------------

HIGH = [queue("high", 9), queue("mid", 5), queue("low", 1)]


def preempted(decisions: Decisions) -> str:
    return names(each.job for each in decisions.preempts)


def test_a_job_of_a_higher_queue_preempts_and_keeps_what_comes_free() -> None:
    held = [running("cart", on("a", 4), queue="low", preemptible=True)]
    waiting = [job("ant", gang(node(3)), queue="high"), job("small", gang(node(2)), queue="low", timeout=60)]
    decisions = decide(snapshot([host()], waiting, held, HIGH))
    assert decisions.preempts == (Preempt("cart-0123456789", "ant-0123456789"),)
    assert decisions.starts == ()
    assert reason(decisions, "ant").endswith("free until job cart (cart-012), preempted for it, has stopped")
    assert reason(decisions, "small").startswith("CAPACITY:INSUFFICIENT_INSTANCE_CAPACITY - 1st in queue low, behind")


@pytest.mark.parametrize(
    "held",
    [
        running("cart", on("a", 4), queue="low"),
        running("cart", on("a", 4), queue="high", preemptible=True),
        running("cart", on("a", 4), queue="low", preemptible=True, ending=True),
        running("cart", on("a", 4), queue="deleted", preemptible=True),
    ],
)
def test_only_what_may_be_preempted_is(held) -> None:  # type: ignore[no-untyped-def]
    assert decide(snapshot([host()], [job("ant", queue="high", priority=9)], [held], HIGH)).preempts == ()


def test_an_equal_queue_is_not_preempted() -> None:
    held = [running("cart", on("a", 4), queue="b", preemptible=True)]
    queues = [queue("a", 5), queue("b", 5)]
    assert decide(snapshot([host()], [job("ant", queue="a")], held, queues)).preempts == ()


def test_nobody_is_preempted_where_that_would_not_be_enough() -> None:
    held = [running("cart", on("a", 2), queue="low", preemptible=True), running("fixed", on("a", 2), queue="low")]
    decisions = decide(snapshot([host()], [job("ant", gang(node(3)), queue="high")], held, HIGH))
    assert decisions.preempts == ()


def test_victims_are_ordered_by_queue_then_priority_then_age() -> None:
    held = [
        running("mid", on("a", 1), queue="mid", preemptible=True, for_seconds=1),
        running("old", on("a", 1), queue="low", preemptible=True, for_seconds=900),
        running("young", on("a", 1), queue="low", preemptible=True, for_seconds=10),
        running("dear", on("a", 1), queue="low", preemptible=True, for_seconds=1, priority=7),
    ]
    chosen = [
        preempted(decide(snapshot([host()], [job("ant", gang(node(cpus)), queue="high")], held, HIGH)))
        for cpus in (1, 2, 3, 4)
    ]
    assert chosen == ["young", "young old", "young old dear", "young old dear mid"]


def test_no_more_are_preempted_than_needed() -> None:
    held = [
        running("small", on("a", 1), queue="low", preemptible=True, for_seconds=1),
        running("other", on("b", 1), queue="low", preemptible=True, for_seconds=2),
        running("large", on("b", 3), queue="low", preemptible=True, for_seconds=3),
        running("fixed", on("a", 3), queue="low"),
    ]
    # the youngest two come first but are not enough, and with the third they are no longer needed
    decisions = decide(snapshot([host("a"), host("b")], [job("ant", gang(node(3)), queue="high")], held, HIGH))
    assert preempted(decisions) == "large"


def test_no_further_victims_are_chosen_while_some_stop() -> None:
    held = [
        running("first", on("a", 2), queue="low", preemptible=True, ending=True),
        running("second", on("a", 2), queue="low", preemptible=True),
    ]
    assert preempted(decide(snapshot([host()], [job("ant", gang(node(2)), queue="high")], held, HIGH))) == ""
    assert preempted(decide(snapshot([host()], [job("ant", gang(node(3)), queue="high")], held, HIGH))) == "second"


def test_in_a_share_a_higher_priority_preempts_a_lower_one() -> None:
    held = [running("cart", on("a", 4), share="s", priority=1, preemptible=True)]
    queues = [queue(policy=FAIR)]
    assert preempted(decide(snapshot([host()], [job("ant", share="s", priority=2)], held, queues))) == "cart"
    assert preempted(decide(snapshot([host()], [job("ant", share="s", priority=1)], held, queues))) == ""


def test_across_shares_only_one_that_would_be_served_first_preempts() -> None:
    held = [running("cart", on("a", 4), share="t", priority=1, preemptible=True)]
    queues, waiting = [queue(policy=FAIR)], [job("ant", share="s", priority=2)]
    for mine, its, expected in ((10.0, 20.0, "cart"), (20.0, 10.0, ""), (10.0, 10.0, "cart")):
        usage = {("default", "s"): mine, ("default", "t"): its}
        assert preempted(decide(snapshot([host()], waiting, held, queues, usage=usage))) == expected


def test_charges_for_earlier_jobs_count_when_shares_are_compared() -> None:
    # the share of the head comes first, but the head itself only after one that never fits, for which 120 are charged
    held = [running("cart", on("a", 4), share="t", priority=1, preemptible=True)]
    waiting = [job("huge", gang(node(2, 2)), share="s", priority=9), job("ant", share="s", priority=2)]
    for its, expected in ((129.0, ""), (131.0, "cart")):
        usage = {("default", "s"): 10.0, ("default", "t"): its}
        decisions = decide(snapshot([host()], waiting, held, [queue(policy=FAIR)], usage=usage))
        assert preempted(decisions) == expected


def test_in_a_queue_that_is_first_in_first_out_nobody_is_preempted() -> None:
    held = [running("cart", on("a", 4), preemptible=True)]
    assert decide(snapshot([host()], [job("ant", priority=9)], held)).preempts == ()


def test_the_cpus_that_a_compute_environment_may_use_are_preempted_for_too() -> None:
    held = [running("cart", on("a", 2), queue="low", preemptible=True)]
    waiting = [job("ant", gang(node(3)), queue="high")]
    assert (
        preempted(decide(snapshot([host(cpus=64)], waiting, held, HIGH, [compute_environment(max_cpus=4)]))) == "cart"
    )


# -- jobs that are stuck ----------------------------------------------------------------------------------------------

CAPACITY = "CAPACITY:INSUFFICIENT_INSTANCE_CAPACITY"
MAXIMUM = "MISCONFIGURATION:COMPUTE_ENVIRONMENT_MAX_RESOURCE"
REQUIREMENT = "MISCONFIGURATION:JOB_RESOURCE_REQUIREMENT"


@pytest.mark.parametrize(
    ("code", "shape"), [(CAPACITY, gang(node(4))), (MAXIMUM, gang(node(6))), (REQUIREMENT, gang(node(1, 1)))]
)
@pytest.mark.parametrize(("waited", "late"), [(601, True), (600, False)])
def test_a_job_stuck_first_in_its_queue_is_cancelled(code, shape, waited, late) -> None:  # type: ignore[no-untyped-def]
    others = [TimeLimit(each, 1) for each in (CAPACITY, MAXIMUM, REQUIREMENT) if each != code]
    queues = [queue(limits=(*others, TimeLimit(code, 600)))]
    held = [running("cart", on("a", 1))]
    decisions = decide(
        snapshot(
            [host(cpus=4)],
            [job("x", shape, runnable=999)],
            held,
            queues,
            compute_environments=[compute_environment(max_cpus=5)],
            leading=leads("x", code, waited),
        )
    )
    if late:
        cancel = Cancel("x-0123456789", f"Canceled by JobStateTimeLimit action due to reason: {code}")
        assert decisions.cancels == (cancel,)
        assert list(decisions.report.order("default")) == []
    else:
        assert decisions.cancels == ()
        assert reason(decisions, "x").startswith(f"{code} - ")


def test_only_the_first_that_does_not_start_is_cancelled_and_the_next_takes_its_place() -> None:
    queues = [queue(limits=(TimeLimit(CAPACITY, 600),))]
    held = [running("cart", on("a", 2), timeout=700)]
    waiting = line(
        job("runs", runnable=999),
        job("stuck", gang(node(4)), runnable=999),
        job("next", gang(node(4)), runnable=999),
        job("small", runnable=999),
    )
    decisions = decide(snapshot([host()], waiting, held, queues, leading=leads("stuck", CAPACITY, 601)))
    assert started(decisions) == "runs:a"
    assert names(each.job for each in decisions.cancels) == "stuck"
    assert names(decisions.report.order("default")) == "next small"
    assert reason(decisions, "next").startswith(f"{CAPACITY} - needs 1 node with 4 CPUs")
    assert reason(decisions, "small").startswith("2nd in queue default, behind job next (next-012)")


def test_only_the_time_at_the_head_counts_and_a_pass_tells_the_next_one_since_when_that_is() -> None:
    queues = [queue(limits=(TimeLimit(CAPACITY, 600),))]
    held, waiting = [running("cart", on("a", 4))], line(job("x", runnable=9999), job("y", runnable=9999))
    first = decide(snapshot([host()], waiting, held, queues))
    assert first.cancels == () and first.leading == leads("x", CAPACITY, 0)
    again = decide(snapshot([host()], waiting, held, queues, leading=leads("x", CAPACITY, 500)))
    assert again.cancels == () and again.leading == leads("x", CAPACITY, 500)
    for before in (leads("y", CAPACITY, 999), leads("x", MAXIMUM, 999)):  # another job, another reason: from now on
        assert decide(snapshot([host()], waiting, held, queues, leading=before)).leading == leads("x", CAPACITY, 0)


def test_a_cancelled_job_preempts_no_gang() -> None:
    queues = [queue("high", 9, limits=(TimeLimit(CAPACITY, 600),)), queue("low")]
    held = [running("cart", on("a", 4), queue="low", preemptible=True)]
    leading = leads("ant", CAPACITY, 601, "high")
    decisions = decide(snapshot([host()], [job("ant", queue="high")], held, queues, leading=leading))
    assert (len(decisions.cancels), decisions.preempts) == (1, ())


def test_the_first_of_a_queue_behind_the_head_of_another_is_stuck_too() -> None:
    queues = [queue("high", 9), queue("low", limits=(TimeLimit(CAPACITY, 600),))]
    held = [running("cart", on("a", 2))]
    waiting = [job("ant", gang(node(4)), queue="high"), job("small", queue="low")]
    decisions = decide(snapshot([host()], waiting, held, queues, leading=leads("small", CAPACITY, 601, "low")))
    assert names(each.job for each in decisions.cancels) == "small"


def test_the_first_of_a_queue_is_stuck_too_where_an_equal_job_of_another_queue_was_tried_before() -> None:
    queues = [queue("high", 9), queue("low", limits=(TimeLimit(CAPACITY, 600),))]
    waiting = [job("ant", gang(node(4)), queue="high"), job("cart", gang(node(4)), queue="low")]
    leading = leads("cart", CAPACITY, 601, "low")
    decisions = decide(snapshot([host()], waiting, [running("held", on("a", 2))], queues, leading=leading))
    assert names(each.job for each in decisions.cancels) == "cart"


def test_a_queue_without_a_usable_compute_environment_cancels_no_job() -> None:
    queues = [queue(limits=tuple(TimeLimit(code, 600) for code in (CAPACITY, MAXIMUM, REQUIREMENT)))]
    decisions = decide(
        snapshot(
            [host()], [job("x", runnable=999)], queues=queues, compute_environments=[compute_environment(enabled=False)]
        )
    )
    assert decisions.cancels == ()
