"""Why the others wait: jobs that can never start, and what the report says of those that can."""

from __future__ import annotations

from dataclasses import replace

import pytest

from orchestrator.domain.reasons import Reason, named
from orchestrator.domain.resources import Resources
from orchestrator.scheduling.decisions import decide
from orchestrator.scheduling.fit import fit
from orchestrator.scheduling.placement import shortage
from orchestrator.scheduling.snapshot import ComputeEnvironment, Queue, Snapshot
from tests.support.orchestrator.scheduling import (
    CAPACITY,
    MAXIMUM,
    NOW,
    REQUIREMENT,
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

# -- jobs that can never start ----------------------------------------------------------------------------------------


def test_a_job_that_can_never_start_says_so_even_behind_one_that_waits_and_delays_no_other() -> None:
    decided = Pass([host(gpus=1), host("b", 2)], line(job("huge", gang(node(64, 2))), job("small")))
    assert decided.started == "small:a"
    assert decided.reason("huge") == (
        "MISCONFIGURATION:JOB_RESOURCE_REQUIREMENT - each node needs 64 CPUs, 2 GPUs, 100 MiB; "
        "the largest host has 4 CPUs, 1 GPU, 8 GiB"
    )
    assert Pass([], [job("ant")]).reason("ant") == (
        f"{REQUIREMENT} - each node needs 1 CPU, 0 GPUs, 100 MiB; the largest host has nothing: there is no host"
    )
    waiting = line(job("first", 4), job("wide", gang(*[node()] * 9)))
    assert Pass([host(), host("b", 3)], waiting, [running("cart", on("a", 1))]).reason("wide") == (
        f"{REQUIREMENT} - {needs(9, nodes=9)}; all hosts together have 7 CPUs, 0 GPUs, 16 GiB"
    )


def test_while_an_engine_has_not_reported_its_hosts_its_jobs_wait_and_name_it() -> None:
    silent = replace(environment("silent", hosts=()), unknown="the ray engine has not answered yet")
    existing = environment("there")
    queues = [queue("silent", environments=("silent",)), queue("both", environments=("silent", "there"))]
    waiting = line(job("ant", queue="silent"), job("cart", queue="both"), job("huge", 64, queue="both"))
    decided = Pass([host()], waiting, (), queues, [silent, existing])
    assert decided.started == "cart:a", "in a compute environment that is known"
    assert decided.reason("ant") == f"{CAPACITY} - the ray engine has not answered yet; {needs(1)}"
    assert f"{CAPACITY} - {silent.unknown}; " in decided.reason("huge"), "it may have that much"
    waiting = line(job("large", 4, queue="both"), job("next", 3, queue="both"))
    cart = running("cart", on("a", 1), environment="there")
    assert "behind job large" in Pass([host()], waiting, [cart], queues, [silent, existing]).reason("next")
    quiet = replace(environment("quiet", hosts=()), unknown="the slurm engine has not answered yet")
    waiting, queues[1] = [job("ant", queue="both")], queue("both", environments=("quiet", "silent"))
    assert f"- {quiet.unknown}; " in Pass([], waiting, (), queues, [silent, quiet]).reason("ant"), "its first one"
    queues[1] = queue("both", environments=("silent", "there"))
    requested = fit(gang(node(64)), queues[1], {"silent": silent, "there": existing}, [host()])
    assert (requested.allocation, requested.problem) == (None, None), "it is not refused"


def test_the_reasons_of_all_refusing_compute_environments_are_reported_and_nobody_is_held_up() -> None:
    queues, small = [queue(environments=("p", "q"))], [environment("p", max_cpus=3), environment("q", max_cpus=2.5)]
    decided = Pass([host()], line(job("big", gang(node(2), node(2))), job("small")), (), queues, small)
    assert decided.started == "small:a"
    assert decided.reason("big") == (
        f"{MAXIMUM} - compute environment p has at most 3 CPUs; compute environment q has at most 2.5 CPUs; "
        f"{needs(4, nodes=2)}"
    )
    either = [environment("p", max_cpus=1), environment("q", ("b",))]
    assert Pass([host(), host("b", 1)], [job("x", 2)], (), queues, either).reason("x") == (
        f"{REQUIREMENT} - compute environment p has at most 1 CPU; "
        "compute environment q: each node needs 2 CPUs, 0 GPUs, 100 MiB; the largest host has 1 CPU, 0 GPUs, 8 GiB; "
        f"{needs(2)}"
    )


@pytest.mark.parametrize(
    ("queues", "environments"),
    [
        ([queue()], [environment(enabled=False)]),
        ([queue(environments=())], [environment()]),
        ([queue(environments=("deleted",))], [environment()]),
        ([queue("another")], [environment()]),
    ],
)
def test_a_queue_without_a_usable_compute_environment_says_so(
    queues: list[Queue], environments: list[ComputeEnvironment]
) -> None:
    decided = Pass([host()], [job("x")], (), queues, environments)
    assert decided.starts == () and decided.waits() == "x"
    assert decided.reason("x") == "ACTION_REQUIRED - CE(s) associated with the job queue are invalid."


def test_the_words_begin_with_what_matters_and_aws_s_code_is_apart() -> None:
    short = gang(*[node(1, 1, 4096)] * 2)
    held = [running("cart", on("a", 3, (0,), memory=4096))]
    reason = Pass([host(cpus=4, gpus=2)], [job("ant", short)], held).decisions.report.reason("ant-0123456789")
    assert reason.words == (
        "waits for job cart (cart-012) to end: 1 of 2 CPUs, 1 of 2 GPUs, 4 GiB of 8 GiB short; "
        "needs 2 nodes with 2 CPUs, 2 GPUs, 8 GiB in all; 1 CPU, 1 GPU, 4 GiB free"
    )
    assert (reason.aws, reason.code) == (f"{CAPACITY} - {reason.words}", CAPACITY)
    nowhere = Pass([host()], [job("x")], (), [queue(environments=())]).decisions.report.reason("x-0123456789")
    assert nowhere.words == "no compute environment of its queue is enabled" and nowhere.code == nowhere.aws
    assert Reason.plain("starting 1 node").code == ""


# -- the report -------------------------------------------------------------------------------------------------------


def test_the_board_lists_who_still_waits_and_numbers_them() -> None:
    waiting = line(job("runs"), job("large", 4), *[job(f"j{i:02}", 4) for i in range(2, 120)])
    decided = Pass([host()], waiting, [running("cart", on("a", 1), timeout=160)])
    assert decided.started == "runs:a" and decided.waits("nowhere") == ""
    assert decided.waits() == " ".join(["large", *[f"j{i:02}" for i in range(2, 120)]])
    behind = "behind job large (large-01), which needs 1 node with 4 CPUs, 0 GPUs, 100 MiB in all"
    assert decided.reason("j02") == f"2nd in queue default, {behind}"
    ordinals = [decided.reason(f"j{i:02}").partition(" ")[0] for i in (3, 4, 10, 11, 12, 13, 20, 21, 22, 23, 111)]
    assert ordinals == ["3rd", "4th", "10th", "11th", "12th", "13th", "20th", "21st", "22nd", "23rd", "111th"]
    with pytest.raises(KeyError):
        decided.reason("runs")


def test_a_reason_says_that_room_is_in_pieces_and_names_the_last_gangs_that_it_waits_for() -> None:
    held = [running("x", on("a", 2)), running("y", on("b", 2)), running("z", on("b", 1)), running("v", on("a", 1))]
    assert Pass([host("a"), host("b")], [job("ant", 2)], held).reason("ant") == (
        f"{CAPACITY} - waits for job v (v-012345) to end: enough is free, but not in one piece for each node; {needs(2)}; "
        "2 CPUs, 0 GPUs, 16 GiB free"
    )
    held = [running("x", on("a", 2), ending=True), running("y", on("a", 2), timeout=700)]
    message = "waits for jobs x (x-012345), y (y-012345) to end, at the latest at 2027-01-15 08:10:00 UTC: 4 of 4 CPUs short; "
    assert message in Pass([host()], [job("ant", 4)], held).reason("ant")
    late = [running("x", on("a", 2), timeout=50)]
    assert "for job x (x-012345) to end: 2 of 4 CPUs short" in Pass([host()], [job("ant", 4)], late).reason("ant"), (
        "overdue"
    )
    held = [running(f"r{i}", on("a", 1), timeout=100 + i) for i in range(1, 6)]
    assert Pass([host(cpus=5)], [job("ant", 5)], held).reason("ant") == (
        f"{CAPACITY} - waits for jobs r3 (r3-01234), r4 (r4-01234), r5 (r5-01234) and 2 more to end, "
        f"at the latest at 2027-01-15 08:00:05 UTC: 5 of 5 CPUs short; {needs(5)}; 0 CPUs, 0 GPUs, 8 GiB free"
    )


@pytest.mark.parametrize(
    ("most", "used", "says"),
    [
        (4, 3.5, "compute environment all may use 0.5 CPUs more at this time"),
        (4, 6, "compute environment all may use 0 CPUs more at this time"),
        (6, 2, "2 of 4 CPUs short"),  # exactly the 4 CPUs that it needs: the host lacks them
    ],
)
def test_a_reason_names_the_limit_of_the_compute_environment_where_that_is_what_lacks(
    most: float, used: float, says: str
) -> None:
    hosts = [host(cpus=4 if most == 6 else 64)]
    waits = Pass(hosts, [job("ant", 4)], [running("cart", on("a", used))], (), [environment(max_cpus=most)])
    assert waits.reason("ant").startswith(f"{CAPACITY} - waits for job cart (cart-012) to end: {says}; {needs(4)}")


def test_a_time_is_of_the_wall_clock_whatever_the_pass_counts_from() -> None:
    held = [running("cart", on("a", 1), timeout=700)]
    snapshot = Snapshot(NOW, [host()], {"all": environment()}, {"default": queue()}, [job("ant", 4)], held, {})
    ahead = decide(replace(snapshot, drift=3_600_000)).report.reason("ant-0123456789")
    assert "at the latest at 2027-01-15 09:10:00 UTC" in ahead.words


@pytest.mark.parametrize(
    ("ends_in", "hint"),
    [
        (1.0, ": with a timeout of at most 1 s it could start"),
        (0.999, ""),  # no timeout is that short
        (2.999, ": with a timeout of at most 2 s it could start"),
    ],
)
def test_the_hint_of_a_timeout_is_in_whole_seconds(ends_in: float, hint: str) -> None:
    cart = replace(running("cart", on("a", 1), timeout=100), started_at=NOW - 100_000 + round(1000 * ends_in))
    decided = Pass([host()], line(job("large", 4), job("small", timeout=9)), [cart])
    assert decided.reason("small").endswith(f"it would fit now, but on what is kept for that job{hint}")


def test_no_timeout_is_advised_where_another_reservation_without_a_known_time_is_in_the_way() -> None:
    queues = [queue("one", 3, ("p",)), queue("two", 2, ("q",)), queue("any", 1, ("p", "q"))]
    held = [running("x", on("a", 3), environment="p", timeout=700), running("y", on("b", 1), environment="q")]
    waiting = [job("large", 4, queue="one"), job("other", 4, queue="two"), job("wide", 3, queue="any")]
    places = [environment("p", ("a",)), environment("q", ("b",))]
    decided = Pass([host("a"), host("b")], waiting, held, queues, places)
    assert decided.reason("wide").endswith("; it would fit now, but on what is kept for that job")


def test_a_child_of_an_array_is_named_with_its_index_and_no_shortage_is_of_nothing() -> None:
    assert (
        named("arr", "aa97f6c7-1111:12") == "arr:12 (aa97f6c7:12)" and named("ant", "aa97f6c7-1111") == "ant (aa97f6c7)"
    )
    expected, free = Resources(cpus=2, memory=1), Resources(cpus=1.996, memory=1)
    assert shortage(expected, free) == "less than 0.01 of 2 CPUs short"
