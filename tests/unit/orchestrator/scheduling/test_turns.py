"""Owners of one queue, and queues of one priority, take turns: a backlog holds up nobody else, and starves none of its own."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from hypothesis import given, settings
from hypothesis import strategies as st

from orchestrator.scheduling.decisions import decide
from orchestrator.scheduling.snapshot import FairShare, Queue, RoundRobin, RunningGang, Snapshot, Waiting
from tests.support.orchestrator.scheduling import FAIR, NOW, Pass, environment, host, job, line, queue

DEFAULT = queue()


@dataclass
class Cluster:
    """One host, on which a gang runs for as many passes as it is set to."""

    cpus: float
    queues: dict[str, Queue] = field(default_factory=lambda: {"default": DEFAULT})
    now: int = NOW
    waiting: list[Waiting] = field(default_factory=list)
    running: dict[str, tuple[RunningGang, int]] = field(default_factory=dict)
    turns: RoundRobin = field(default_factory=RoundRobin)
    started: list[str] = field(default_factory=list)

    def submit(self, *names: str, owner: str | None = None, cpus: float = 1, queue: str = "default") -> None:
        for number, name in enumerate(names):
            made = job(name, cpus, owner=owner, queue=queue)
            self.waiting.append(replace(made, job=name, created_at=self.now + number))
        self.now += len(names)

    def tick(self, passes: int = 1, length: int = 1) -> None:
        """Passes, after each of which gangs end that have run for ``length`` passes."""
        for _ in range(passes):
            self.now += 1000
            held = [gang for gang, _ in self.running.values()]
            hosts = [host(cpus=self.cpus, memory=1_000_000)]
            decided = decide(
                Snapshot(self.now, hosts, {"all": environment()}, self.queues, self.waiting, held, {}, turns=self.turns)
            )
            self.turns = decided.turns
            by_id = {each.job: each for each in self.waiting}
            for start in decided.starts:
                each = by_id[start.job]
                gang = RunningGang(
                    each.job, each.name, each.queue, None, 0, "all", start.placements, self.now, None, False, False
                )
                self.running[each.job] = gang, length
                self.started.append(each.job)
            self.waiting = [each for each in self.waiting if each.job not in self.running]
            self.running = {name: (gang, left - 1) for name, (gang, left) in self.running.items() if left > 1}

    def waits_for(self, name: str, most: int) -> int:
        """Passes until a job is started."""
        for passed in range(most):
            self.tick()
            if name in self.started:
                return passed + 1
        raise AssertionError(f"{name} was not started in {most} passes; started: {self.started[-20:]}")


def test_a_backlog_of_one_owner_does_not_hold_up_the_first_job_of_another() -> None:
    cluster = Cluster(cpus=1)
    cluster.submit(*[f"a{number}" for number in range(300)], owner="a")
    cluster.tick(3)
    cluster.submit("b0", "b1", owner="b")
    assert cluster.waits_for("b0", 2) <= 2 and cluster.waits_for("b1", 2) <= 2
    assert cluster.started == ["a0", "a1", "a2", "a3", "b0", "a4", "b1"], "the backlog has its turns, too, in its order"


def test_in_one_pass_owners_take_turns_by_the_age_of_their_oldest_job() -> None:
    first = [job(f"a{i}", owner="a", age=20 - i) for i in range(3)]
    waiting = [*first, job("b0", owner="b", age=10), job("none", age=15), job("b1", owner="b", age=9)]
    assert Pass([host(cpus=8)], waiting).started == "a0:a none:a b0:a a1:a b1:a a2:a"


def test_shares_are_not_split_by_owner() -> None:
    waiting = line(job("x", share="s", owner="a"), job("y", share="s", owner="a"), job("z", share="s", owner="b"))
    assert Pass([host()], waiting, queues=[queue(policy=FAIR)]).started == "x:a y:a z:a"


def test_a_backlog_of_a_queue_does_not_hold_up_another_queue_of_the_same_priority() -> None:
    for policy in (None, FairShare(600, 0, {})):
        cluster = Cluster(cpus=1, queues={"robots": queue("robots", policy=policy), "students": queue("students")})
        cluster.submit(*[f"r{number}" for number in range(300)], owner="a", queue="robots")
        cluster.tick(3)
        cluster.submit("s", "t", owner="b", queue="students")
        cluster.tick(4)
        assert cluster.started[3:] == ["r3", "s", "r4", "t"]


def test_a_queue_of_greater_priority_takes_no_turns_with_lower_ones() -> None:
    cluster = Cluster(cpus=1, queues={"high": queue("high", 2), "low": queue("low", 1)})
    cluster.submit("l0", owner="b", queue="low")
    cluster.submit("h0", "h1", owner="a", queue="high")
    cluster.tick(3)
    assert cluster.started == ["h0", "h1", "l0"]


def test_a_large_gang_keeps_its_place_while_small_jobs_of_its_owner_and_of_others_pass() -> None:
    """Else each small job that passes would give the reservation to another owner's head."""
    cluster = Cluster(cpus=4)
    cluster.submit("long", owner="c", cpus=1)
    cluster.tick(1, length=50)
    cluster.submit("large", owner="a", cpus=4)
    cluster.submit("other", owner="b", cpus=4)
    for number in range(45):
        cluster.submit(f"a{number}", owner="a", cpus=1)
        cluster.submit(f"b{number}", owner="b", cpus=1)
        cluster.tick()
    assert cluster.turns.heads["default"].job == "large"
    assert cluster.waits_for("large", 10) and "other" not in cluster.started


def test_a_job_that_can_never_start_does_not_cost_its_owner_the_turns_of_the_others() -> None:
    cluster = Cluster(cpus=1)
    cluster.submit("never", "nor", owner="a", cpus=9)
    cluster.submit("a0", "a1", owner="a")
    cluster.submit("b0", "b1", "b2", owner="b")
    cluster.tick(5)
    assert cluster.started == ["a0", "b0", "a1", "b1", "b2"]


@settings(max_examples=60)
@given(
    st.lists(st.tuples(st.sampled_from("pq"), st.sampled_from("abc"), st.sampled_from([1, 2, 4])), max_size=25),
    st.sampled_from("pq"),
    st.sampled_from("abc"),
    st.sampled_from([1, 4]),
)
def test_no_stream_of_other_jobs_keeps_a_job_waiting_for_ever(
    before: list[tuple[str, str, int]], line: str, owner: str, cpus: int
) -> None:
    """With two queues, three owners and an endless stream of small jobs, each turn costs a bounded number of others'."""
    cluster = Cluster(cpus=4, queues={"p": queue("p"), "q": queue("q")})
    for number, (name, who, size) in enumerate(before):
        cluster.submit(f"j{number}", owner=who, cpus=size, queue=name)
    cluster.submit("mine", owner=owner, cpus=cpus, queue=line)
    for number in range(12 * (len(before) + 2)):
        for who in "abc":
            for name in "pq":
                cluster.submit(f"{name}{who}{number}", owner=who, queue=name)
        cluster.tick()
        if "mine" in cluster.started:
            return
    raise AssertionError(f"it waits behind {cluster.started}")
