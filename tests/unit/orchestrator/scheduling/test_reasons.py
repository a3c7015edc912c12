"""Why the others wait: jobs that can never start, and what the report says of those that can."""

from __future__ import annotations

from dataclasses import replace

import pytest

from orchestrator.scheduling.decide import decide
from orchestrator.scheduling.fit import fit
from orchestrator.scheduling.snapshot import ComputeEnvironment, Queue
from tests.support.orchestrator.scheduling import (
    compute_environment,
    gang,
    host,
    job,
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

# -- jobs that can never start ----------------------------------------------------------------------------------------


def test_a_job_that_can_never_start_says_so_and_delays_no_other() -> None:
    waiting = line(job("huge", gang(node(64, 2))), job("small"))
    decisions = decide(snapshot([host(cpus=4, gpus=1), host("b", 2)], waiting))
    assert started(decisions) == "small:a"
    assert reason(decisions, "huge") == (
        "MISCONFIGURATION:JOB_RESOURCE_REQUIREMENT - each node needs 64 CPUs, 2 GPUs, 100 MiB; "
        "the largest host has 4 CPUs, 1 GPU, 8 GiB"
    )


def test_a_gang_too_large_for_all_hosts_together_says_so_even_behind_one_that_waits() -> None:
    waiting = line(job("first", gang(node(4))), job("wide", gang(*[node()] * 9)))
    decisions = decide(snapshot([host(cpus=4), host("b", 3)], waiting, [running("cart", on("a", 1))]))
    assert reason(decisions, "wide") == (
        "MISCONFIGURATION:JOB_RESOURCE_REQUIREMENT - needs 9 nodes with 9 CPUs, 0 GPUs, 900 MiB in all; "
        "all hosts together have 7 CPUs, 0 GPUs, 16 GiB"
    )


def test_without_any_host_the_job_says_so() -> None:
    assert reason(decide(snapshot([], [job("ant")])), "ant") == (
        "MISCONFIGURATION:JOB_RESOURCE_REQUIREMENT - each node needs 1 CPU, 0 GPUs, 100 MiB; "
        "the largest host has nothing: there is no host"
    )


def test_while_an_engine_has_not_told_its_hosts_its_jobs_wait_and_say_so() -> None:
    silent = replace(compute_environment("silent", hosts=()), unknown="the ray engine has not answered yet")
    there = compute_environment("there")
    queues = [
        queue("silent", compute_environments=("silent",)),
        queue("both", compute_environments=("silent", "there")),
    ]
    waiting = line(job("ant", queue="silent"), job("cart", queue="both"), job("huge", gang(node(64)), queue="both"))
    decisions = decide(snapshot([host(cpus=4)], waiting, queues=queues, compute_environments=[silent, there]))
    assert started(decisions) == "cart:a", "in a compute environment that is known"
    assert reason(decisions, "ant") == (
        "CAPACITY:INSUFFICIENT_INSTANCE_CAPACITY - needs 1 node with 1 CPU, 0 GPUs, 100 MiB in all; "
        "the ray engine has not answered yet"
    )
    assert reason(decisions, "huge").endswith("the ray engine has not answered yet"), "it may have that much"
    asked = fit(gang(node(64)), queues[1], {"silent": silent, "there": there}, [host(cpus=4)])
    assert (asked.allocation, asked.problem) == (None, None), "it is not refused"


def test_a_job_with_more_cpus_than_any_compute_environment_may_use_says_so_and_holds_up_nobody() -> None:
    waiting = line(job("big", gang(node(2), node(2))), job("small"))
    queues, compute_environments = (
        [queue(compute_environments=("p", "q"))],
        [compute_environment("p", max_cpus=3), compute_environment("q", max_cpus=2.5)],
    )
    decisions = decide(snapshot([host()], waiting, queues=queues, compute_environments=compute_environments))
    assert started(decisions) == "small:a"
    assert reason(decisions, "big") == (
        "MISCONFIGURATION:COMPUTE_ENVIRONMENT_MAX_RESOURCE - needs 2 nodes with 4 CPUs, 0 GPUs, 200 MiB in all; "
        "compute environment p has at most 3 CPUs; compute environment q has at most 2.5 CPUs"
    )


def test_the_reasons_of_all_refusing_compute_environments_are_reported() -> None:
    queues, compute_environments = (
        [queue(compute_environments=("p", "q"))],
        [compute_environment("p", max_cpus=1), compute_environment("q", ("b",))],
    )
    decisions = decide(
        snapshot(
            [host(), host("b", 1)], [job("x", gang(node(2)))], queues=queues, compute_environments=compute_environments
        )
    )
    assert reason(decisions, "x") == (
        "MISCONFIGURATION:JOB_RESOURCE_REQUIREMENT - needs 1 node with 2 CPUs, 0 GPUs, 100 MiB in all; "
        "compute environment p has at most 1 CPU; "
        "compute environment q: each node needs 2 CPUs, 0 GPUs, 100 MiB; the largest host has 1 CPU, 0 GPUs, 8 GiB"
    )


@pytest.mark.parametrize(
    ("queues", "compute_environments"),
    [
        ([queue()], [compute_environment(enabled=False)]),
        ([queue(compute_environments=())], [compute_environment()]),
        ([queue(compute_environments=("deleted",))], [compute_environment()]),
        ([queue("another")], [compute_environment()]),
    ],
)
def test_a_queue_without_a_usable_compute_environment_says_so(
    queues: list[Queue], compute_environments: list[ComputeEnvironment]
) -> None:
    decisions = decide(snapshot([host()], [job("x")], queues=queues, compute_environments=compute_environments))
    assert decisions.starts == ()
    assert reason(decisions, "x") == "ACTION_REQUIRED - CE(s) associated with the job queue are invalid."
    assert names(decisions.report.order("default")) == "x"


# -- the report --------------------------------------------------------------------------------------------------------


def test_the_board_lists_who_still_waits_and_numbers_them() -> None:
    waiting = line(job("runs"), job("large", gang(node(4))), *[job(f"j{i:02}", gang(node(4))) for i in range(2, 25)])
    decisions = decide(snapshot([host()], waiting, [running("cart", on("a", 1), timeout=160)]))
    assert started(decisions) == "runs:a"
    assert names(decisions.report.order("default")[:3]) == "large j02 j03"
    assert len(decisions.report.order("default")) == 24
    assert list(decisions.report.order("nowhere")) == []
    behind = "behind job large (large-01), which needs 1 node with 4 CPUs, 0 GPUs, 100 MiB in all"
    assert reason(decisions, "j02") == f"2nd in queue default, {behind}"
    ordinals = [reason(decisions, f"j{i:02}").partition(" ")[0] for i in (3, 4, 10, 11, 12, 13, 20, 21, 22, 23)]
    assert ordinals == ["3rd", "4th", "10th", "11th", "12th", "13th", "20th", "21st", "22nd", "23rd"]
    with pytest.raises(KeyError):
        reason(decisions, "runs")


def test_room_that_is_enough_in_all_but_in_pieces_says_so() -> None:
    held = [running("x", on("a", 2)), running("y", on("b", 2)), running("z", on("b", 1)), running("v", on("a", 1))]
    decisions = decide(snapshot([host("a"), host("b")], [job("ant", gang(node(2)))], held))
    assert reason(decisions, "ant") == (
        "CAPACITY:INSUFFICIENT_INSTANCE_CAPACITY - needs 1 node with 2 CPUs, 0 GPUs, 100 MiB in all; "
        "2 CPUs, 0 GPUs, 16 GiB free, but not in one piece for each node until job v (v-012345) ends"
    )


def test_a_reason_names_the_last_gangs_that_it_waits_for_and_counts_the_others() -> None:
    held = [running(f"r{i}", on("a", 1), timeout=100 + i) for i in range(1, 6)]
    decisions = decide(snapshot([host(cpus=5)], [job("ant", gang(node(5)))], held))
    assert reason(decisions, "ant") == (
        "CAPACITY:INSUFFICIENT_INSTANCE_CAPACITY - needs 1 node with 5 CPUs, 0 GPUs, 100 MiB in all; "
        "0 CPUs, 0 GPUs, 8 GiB free until jobs r3 (r3-01234), r4 (r4-01234), r5 (r5-01234) and 2 more end, "
        "at the latest at 2027-01-15 08:00:05 UTC"
    )
