"""Who starts, where, and whose turn it is."""

from __future__ import annotations

from orchestrator.domain.hosts import Host, Placement
from orchestrator.scheduling.decisions import Start
from orchestrator.scheduling.snapshot import ComputeEnvironment, FairShare
from tests.support.orchestrator.scheduling import (
    CAPACITY,
    FAIR,
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

# -- gangs ------------------------------------------------------------------------------------------------------------


def test_a_gang_that_fits_starts_with_what_it_asked_for_and_no_gpu_is_given_twice() -> None:
    waiting = [job("ant", gang(node(0.5, 1, 1024), node(1, 2, 512)))]
    assert Pass([host(gpus=3)], waiting).starts == (
        Start("ant-0123456789", "all", (Placement("a", ("a2",), 0.5, 1024), Placement("a", ("a0", "a1"), 1, 512))),
    )
    held = [running("other", on("a", 1, [0, 2]))]
    [start] = Pass([host(gpus=4)], [job("ant", gang(node(1, 1), node(1, 1)))], held).starts
    assert [placement.gpus for placement in start.placements] == [("a1",), ("a3",)]


def test_a_gang_starts_whole_or_not_at_all() -> None:
    decided = Pass([host(cpus=8)], [job("ant", gang(*[node()] * 4))], [running("cart", on("a", 5, memory=10))])
    assert decided.starts == ()
    assert decided.reason("ant") == (
        "CAPACITY:INSUFFICIENT_INSTANCE_CAPACITY - waits for job cart (cart-012) to end: 1 of 4 CPUs short; "
        "needs 4 nodes with 4 CPUs, 0 GPUs, 400 MiB in all; 3 CPUs, 0 GPUs, 7.99 GiB free"
    )


def test_an_elastic_gang_starts_with_as_many_nodes_as_fit() -> None:
    waiting = [job("ant", gang(*[node()] * 4, minimum=2))]
    assert Pass([host(cpus=8)], waiting).started == "ant:a+a+a+a"
    assert Pass([host(cpus=8)], waiting, [running("x", on("a", 5))]).started == "ant:a+a+a"
    assert Pass([host(cpus=8)], waiting, [running("x", on("a", 7))]).reason("ant") == (
        f"{CAPACITY} - waits for job x (x-012345) to end: 1 of 2 CPUs short; {needs(2, nodes=2, least='at least ')}; "
        "1 CPU, 0 GPUs, 8 GiB free"
    )
    limited = Pass([host(cpus=16)], [job("ant", gang(*[node(2)] * 4, minimum=1))], (), (), [environment(max_cpus=5)])
    assert limited.started == "ant:a+a", "to the limit of its compute environment"


def test_resources_of_a_vanished_host_are_not_counted() -> None:
    held = [running("lost", on("gone", 4)), running("cart", on("a", 1))]
    assert Pass([host()], [job("ant", 3)], held).started == "ant:a"


# -- order ------------------------------------------------------------------------------------------------------------


def test_first_in_first_out_whatever_the_priority_and_the_order_of_the_snapshot() -> None:
    waiting = [job("young", age=1, priority=9), job("old", age=3), job("tie-b", age=2), job("tie-a", age=2)]
    assert Pass([host()], waiting).started == "old:a tie-a:a tie-b:a young:a"
    assert Pass([host()], waiting, [running("x", on("a", 4))]).waits() == "old tie-a tie-b young"


def test_queues_come_by_priority_then_by_their_oldest_job() -> None:
    queues = [queue("low", 1), queue("high-b", 5), queue("high-a", 5)]
    waiting = [job("l", queue="low", age=9), job("b", queue="high-b", age=5), job("a", queue="high-a")]
    assert Pass([host()], waiting, queues=queues).started == "b:a a:a l:a"


def test_the_share_with_the_least_weighted_use_is_served_first() -> None:
    policy = FairShare(600, 0, {"heavy": 0.1, "team*": 2.0, "team-x*": 3.0})
    waiting = [job(share, share=share) for share in ("heavy", "team-a", "team-xy", "other")]
    usage = {("default", s): u for s, u in {"heavy": 5000, "team-a": 240, "team-xy": 170, "other": 490}.items()}
    usage["elsewhere", "heavy"] = 1e9
    # weighted: heavy 500, team-a 480, team-xy 510 (the longer prefix), other 490
    decided = Pass([host()], waiting, queues=[queue(policy=policy)], usage=usage)
    assert decided.started == "team-a:a other:a heavy:a team-xy:a"


def test_shares_take_turns_as_their_weights_say() -> None:
    waiting = [job(f"{share}{i}", share=share, age=9 - i) for share in "ab" for i in range(4)]
    decided = Pass([host(cpus=8)], waiting, queues=[queue(policy=FairShare(600, 0, {"a": 0.5}))])
    # a CPU of a is charged 30, one of b 60: a0 (a 30) b0 (b 60) a1 (60) a2 (90) b1 (120) a3; then only b is left
    assert decided.started == "a0:a b0:a a1:a a2:a b1:a a3:a b2:a b3:a"


def test_gpus_count_where_a_gang_has_any_else_cpus() -> None:
    waiting = [
        job("a0", gang(node(1, 2), node(1, 2)), share="a", age=9),  # charges 240
        job("a1", share="a", age=8),
        job("b0", 3, share="b", age=9),  # 180
        job("b1", share="b", age=8),  # 60
        job("b2", share="b", age=7),
    ]
    # a 240, then b: 180, b: 240, a tie that a's name wins
    decided = Pass([host(cpus=16, gpus=4)], waiting, queues=[queue(policy=FAIR)])
    assert decided.started == "a0:a+a b0:a b1:a a1:a b2:a"


def test_in_a_share_priority_comes_before_age_and_jobs_without_one_have_their_own() -> None:
    young, old = job("young", share="s", priority=5), job("old", share="s", priority=5, age=5)
    waiting = [young, old, job("eldest", share="s", age=9), job("first", share="s", priority=9999)]
    assert Pass([host()], waiting, queues=[queue(policy=FAIR)]).started == "first:a old:a young:a eldest:a"
    usage = {("default", ""): 50.0, ("default", "s"): 10.0}
    decided = Pass([host()], [job("named", share="s"), job("none")], queues=[queue(policy=FAIR)], usage=usage)
    assert decided.started == "named:a none:a"


# -- compute environments ---------------------------------------------------------------------------------------------


def test_compute_environments_are_tried_in_the_queues_order() -> None:
    environments = [environment("p", ("a",)), environment("q", ("b",)), environment("r", ("c",), enabled=False)]
    hosts = [host("a", 2), host("b", 1), host("c", 8)]
    waiting = line(job("x"), job("y"), job("z"))
    decided = Pass(hosts, waiting, queues=[queue(environments=("r", "q", "p"))], environments=environments)
    assert decided.started == "x:b y:a z:a"
    assert [start.compute_environment for start in decided.starts] == ["q", "p", "p"]


def test_a_compute_environment_uses_no_more_cpus_than_it_may() -> None:
    held = [running("cart", on("a", 2)), running("other", on("b", 1), environment="rest")]
    environments = [environment(max_cpus=5), environment("rest")]
    decided = Pass([host("a", 8), host("b", 8)], line(job("x", 2), job("y", 2)), held, (), environments)
    assert decided.started == "x:a"
    assert decided.reason("y") == (
        f"{CAPACITY} - waits for job cart (cart-012) to end: compute environment all may use 1 CPU more at this time; {needs(2)}"
    )


def test_one_machine_that_two_engines_have_is_not_given_out_twice() -> None:
    one = Host("localhost", 4, ("0",), 8192, machine="localhost")
    two = Host("docker/here", 4, ("0",), 8192, machine="localhost")
    queues = [queue("local", environments=("local",)), queue("docker", environments=("docker",))]
    environments = [ComputeEnvironment(name, True, None, None, name) for name in ("local", "docker")]
    for cpus, gpus in (1, ("0",)), (3, ()):
        shape = gang(node(cpus, len(gpus)))
        both = [job("a", shape, queue="docker"), job("b", shape, queue="local")]
        decided = Pass([one, two], both, queues=queues, environments=environments)
        assert decided.started == "a:docker/here" and "free" in decided.reason("b")
        held = [running("a", Placement("docker/here", gpus, cpus, 100), environment="docker")]
        decided = Pass([one, two], both[1:], held, queues, environments)
        assert decided.started == "" and "waits for job a (a-012345) to end: " in decided.reason("b")
    # what a head of one engine waits for is kept by the other too, but for what it leaves
    held = [running("a", on("localhost", 2), environment="local", timeout=200)]
    waiting = line(job("head", 3, queue="docker"), job("late", queue="local"), job("b", queue="local"))
    decided = Pass([one, two], waiting, held, queues, environments)
    assert decided.started == "late:localhost" and "behind job head" in decided.reason("b")
    # and a compute environment of every engine has it once
    everywhere = Pass([one, two], [job("both", gang(node(3), node(3)))])
    assert everywhere.started == "" and "all hosts together have 4 CPUs, 1 GPU" in everywhere.reason("both")
