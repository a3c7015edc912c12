"""Edges of a pass, beside the other modules of this folder."""

from __future__ import annotations

from dataclasses import replace

from orchestrator.scheduling.fit import Fit, fit
from orchestrator.scheduling.free_resources import Allocation
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
    assert Pass([host()], waiting, queues=queues).started == "p0:a p1:a q0:a q1:a"


def test_a_gang_is_preempted_once_for_two_heads() -> None:
    queues = [queue("p", 9, ("p",)), queue("q", 9, ("q",)), queue("low", 1, ("p",))]
    environments = [environment("p", ("a",)), environment("q", ("b",))]
    both = running("both", on("a", 4), on("b", 4), queue="low", environment="p", preemptible=True)
    decided = Pass(
        [host("a"), host("b")], [job("x", 3, queue="p"), job("y", 3, queue="q")], [both], queues, environments
    )
    assert decided.preempted == "both"
    assert decided.reason("y").endswith("free until job both (both-012), preempted for it, has stopped")


def test_long_jobs_together_leave_the_head_the_cpus_of_its_compute_environment() -> None:
    # at the end of cart 8 CPUs may be used, of which the head takes 6; q's jobs count apart
    environments = [environment("p", max_cpus=8), environment("q")]
    queues = [queue("p", 2, ("p",)), queue("q", 1, ("q",))]
    held = [running("cart", on("a", 4), environment="p", timeout=700)]
    waiting = line(job("head", 6, queue="p"), *[job(f"j{i}", queue="p") for i in range(3)], job("k", 5, queue="q"))
    assert Pass([host(cpus=64)], waiting, held, queues, environments).started == "j0:a j1:a k:a"


def test_an_idle_queue_s_answer_has_a_place_or_a_problem() -> None:
    both = {"a - b": environment("a - b", max_cpus=2)}
    asked = queue(environments=("a - b",))
    placed = fit(gang(node(2)), asked, both, [host()])
    assert placed == Fit(Allocation("a - b", (on("a", 2, memory=100),)), None)
    assert fit(gang(node(3)), asked, both, [host()]) == Fit(
        None, "needs 1 node with 3 CPUs, 0 GPUs, 100 MiB in all; compute environment a - b has at most 2 CPUs"
    )
