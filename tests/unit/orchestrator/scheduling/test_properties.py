"""What holds of every pass, and of a cluster on which many passes follow one another."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from math import inf

from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from orchestrator.domain.gang import Shape
from orchestrator.domain.hosts import Host
from orchestrator.scheduling.decisions import Decisions, decide
from orchestrator.scheduling.order import decayed
from orchestrator.scheduling.placement import less, place
from orchestrator.scheduling.snapshot import (
    ComputeEnvironment,
    FairShare,
    Queue,
    RoundRobin,
    RunningGang,
    Snapshot,
    TimeLimit,
    Waiting,
)
from tests.support.orchestrator.scheduling import NOW, environment, gang, host, node, queue, seats

nodes = st.builds(node, st.sampled_from([0.5, 1, 2, 3]), st.integers(0, 2), st.sampled_from([100, 500, 2000]))
equal = st.builds(lambda each, count: gang(*[each] * count), nodes, st.integers(1, 4))


@st.composite
def shapes(draw: st.DrawFn) -> Shape:
    """Gangs of equal and of unlike nodes, some elastic."""
    members = draw(
        st.one_of(st.lists(nodes, min_size=1, max_size=3), st.builds(lambda n, k: [n] * k, nodes, st.integers(1, 4)))
    )
    return gang(*members, minimum=draw(st.integers(1, len(members))))


def started(
    job: Waiting, compute_environment: str, placements: object, now: int, preemptible: bool = False
) -> RunningGang:
    return RunningGang(
        job.job, job.name, job.queue, job.share, job.priority, compute_environment, placements, now, job.timeout, preemptible, False
    )  # fmt: skip


def check_capacity(
    hosts: Iterable[Host], compute_environments: Mapping[str, ComputeEnvironment], running: Iterable[RunningGang]
) -> None:
    """Nothing is given out twice, and every gang is where its compute environment allows."""
    running = list(running)
    for each in hosts:
        here = [placement for gang in running for placement in gang.placements if placement.host == each.name]
        assert sum(placement.cpus for placement in here) <= each.cpus + 1e-6
        assert sum(placement.memory for placement in here) <= each.memory
        gpus = Counter(gpu for placement in here for gpu in placement.gpus)
        assert set(gpus) <= set(each.gpus) and all(count == 1 for count in gpus.values())
    for pool in compute_environments.values():
        used = [placement for gang in running if gang.compute_environment == pool.name for placement in gang.placements]
        assert pool.max_cpus is None or sum(placement.cpus for placement in used) <= pool.max_cpus + 1e-6
        if pool.hosts is not None:
            assert {placement.host for placement in used} <= set(pool.hosts)


def check_pass(snapshot: Snapshot, decisions: Decisions) -> None:
    """Whole gangs, on hosts that exist and in compute environments of their queue; a reason for everybody else."""
    by_id = {job.job: job for job in snapshot.waiting}
    running = list(snapshot.running)
    for start in decisions.starts:
        job = by_id[start.job]
        members = job.shape.nodes
        assert job.shape.minimum <= len(start.placements) <= len(members)
        for placement, expected in zip(start.placements, members, strict=False):
            assert placement.resources == expected
        assert start.compute_environment in snapshot.queues[job.queue].compute_environments
        assert snapshot.compute_environments[start.compute_environment].enabled
        assert {placement.host for placement in start.placements} <= {each.name for each in snapshot.hosts}
        running.append(started(job, start.compute_environment, start.placements, snapshot.now))
    check_capacity(snapshot.hosts, snapshot.compute_environments, running)
    gone = {start.job for start in decisions.starts} | {cancel.job for cancel in decisions.cancels}
    assert len(gone) == len(decisions.starts) + len(decisions.cancels)
    waits = [job for queue in snapshot.queues for job in decisions.report.order(queue)]
    assert sorted(waits) == sorted(by_id.keys() - gone)
    for job_id in waits:
        reason = decisions.report.reason(job_id).aws
        assert 20 < len(reason) < 1024 and "\n" not in reason
    by_job = {gang.job: gang for gang in snapshot.running}
    for preempt in decisions.preempts:
        assert by_job[preempt.job].preemptible and not by_job[preempt.job].ending
        assert preempt.by in waits
        assert decisions.report.reason(preempt.by).aws.startswith("CAPACITY:")
    assert len({preempt.job for preempt in decisions.preempts}) == len(decisions.preempts)


def equal_decisions(one: Decisions, two: Decisions, queues: Iterable[str]) -> bool:
    reasons = [{job: each.report.reason(job) for q in queues for job in each.report.order(q)} for each in (one, two)]
    return (
        (one.starts, one.preempts, one.cancels) == (two.starts, two.preempts, two.cancels)
        and reasons[0] == reasons[1]
        and all(list(one.report.order(queue)) == list(two.report.order(queue)) for queue in queues)
    )


# -- the head's reservation -------------------------------------------------------------------------------------------


def earliest(shape: Shape, hosts: Sequence[Host], running: Sequence[RunningGang], now: int) -> float:
    """When the shape fits if gangs end at their timeouts and nothing else starts [ms]."""

    def end(gang: RunningGang) -> float:
        assert gang.started_at is not None
        return inf if gang.timeout is None else gang.started_at + 1000 * gang.timeout

    for time in sorted({now, *map(end, running)}):
        left = [placement for each in running if end(each) > time or end(each) == inf for placement in each.placements]
        free = [less(each, [p for p in left if p.host == each.name]) for each in hosts]
        if seats(shape.nodes[0], free) >= len(shape.nodes):
            return time
    return inf


hosts_strategy = st.lists(
    st.tuples(st.sampled_from([2, 4, 6]), st.integers(0, 3), st.sampled_from([1000, 4000])), min_size=1, max_size=3
).map(lambda each: [host(f"h{i}", cpus, gpus, memory) for i, (cpus, gpus, memory) in enumerate(each)])


def jobs(prefix: str, timeouts: st.SearchStrategy[int | None], size: int) -> st.SearchStrategy[list[Waiting]]:
    """Gangs of equal nodes, each created a millisecond after the one before."""
    return st.lists(st.tuples(equal, timeouts), max_size=size).map(
        lambda each: [
            Waiting(f"{prefix}{i}", f"{prefix}{i}", "default", shape, 0, None, NOW + i, NOW, timeout)
            for i, (shape, timeout) in enumerate(each)
        ]
    )


def snapshot_of(
    hosts: Sequence[Host], waiting: Sequence[Waiting], running: Sequence[RunningGang], now: int
) -> Snapshot:
    return Snapshot(now, hosts, {"all": environment()}, {"default": queue()}, waiting, running, {})


some_timeouts = st.one_of(st.none(), st.sampled_from([60, 100, 200, 300, 1000]))


ages_strategy = st.lists(st.integers(0, 200), min_size=6, max_size=6)


@settings(max_examples=150)
@given(hosts_strategy, jobs("r", some_timeouts, 6), jobs("w", some_timeouts, 8), ages_strategy)
def test_jobs_that_pass_the_head_do_not_delay_it(
    hosts: list[Host], earlier: list[Waiting], waiting: list[Waiting], ages: list[int]
) -> None:
    first = decide(snapshot_of(hosts, earlier, [], NOW))
    by_id = {job.job: job for job in earlier + waiting}
    running = [
        started(by_id[start.job], start.compute_environment, start.placements, NOW - 1000 * age)
        for start, age in zip(first.starts, ages, strict=False)
        if by_id[start.job].timeout is None or by_id[start.job].timeout > age
    ]
    snapshot = snapshot_of(hosts, waiting, running, NOW)
    decisions = decide(snapshot)
    check_pass(snapshot, decisions)
    report = decisions.report
    heads = [by_id[job] for job in report.order("default") if report.reason(job).aws.startswith("CAPACITY")]
    if not heads:
        return
    reservation = heads[0]
    starts = [started(by_id[start.job], start.compute_environment, start.placements, NOW) for start in decisions.starts]
    before = [each for each in starts if by_id[each.job].created_at < reservation.created_at]
    promised = earliest(reservation.shape, hosts, [*running, *before], NOW)
    assert promised > NOW
    assert earliest(reservation.shape, hosts, [*running, *starts], NOW) <= promised


@settings(max_examples=60)
@given(
    hosts_strategy,
    jobs("w", st.sampled_from([60, 100, 200, 300]), 12),
    st.lists(st.floats(0.1, 1), min_size=12, max_size=12),
)
def test_every_job_starts_no_later_than_was_promised_when_it_first_was_the_head(
    hosts: list[Host], waiting: list[Waiting], fractions: list[float]
) -> None:
    """All ends are known, but gangs may end sooner; every gang that can ever start does."""
    now, running = NOW, list[RunningGang]()
    ends: dict[str, int] = {}
    promised: dict[str, float] = {}
    left = {job.job: job for job in waiting}
    lengths = {job.job: int(1000 * (job.timeout or 0) * part) for job, part in zip(waiting, fractions, strict=False)}
    while True:
        decisions = decide(snapshot_of(hosts, list(left.values()), running, now))
        for start in decisions.starts:
            assert now <= promised.get(start.job, inf)
            ends[start.job] = now + lengths[start.job]
            running.append(started(left.pop(start.job), start.compute_environment, start.placements, now))
        for job in decisions.report.order("default"):
            if decisions.report.reason(job).aws.startswith("CAPACITY"):
                promised.setdefault(job, earliest(left[job].shape, hosts, running, now))
        if not running:
            break
        now = min(ends[gang.job] for gang in running)
        running = [gang for gang in running if ends[gang.job] > now]
    assert all(not place(job.shape, hosts) for job in left.values())


# -- a cluster that lives ---------------------------------------------------------------------------------------------

HOSTS = {name: host(name, cpus, gpus, memory) for name, cpus, gpus, memory in
         [("a", 4, 2, 4000), ("b", 6, 0, 8000), ("c", 3, 3, 2000)]}  # fmt: skip
QUEUES = {
    "high": Queue("high", 5, ("ab",), None, ()),
    "fair": Queue("fair", 3, ("bc", "ab"), FairShare(100, 40, {"s": 0.5}), ()),
    "low": Queue("low", 1, ("all", "bc"), None, (TimeLimit("CAPACITY:INSUFFICIENT_INSTANCE_CAPACITY", 600),)),
    "also low": Queue("also low", 1, ("bc", "ab"), None, ()),
}
COMPUTE_ENVIRONMENTS = {
    each.name: each
    for each in [
        environment("ab", ("a", "b")),
        environment("bc", ("b", "c"), max_cpus=5),
        environment("all", max_cpus=9),
    ]
}


class Cluster(RuleBasedStateMachine):
    """Jobs come and end, time passes, compute environments are switched and hosts come and go; after every step there is a pass."""

    @initialize()
    def begin(self) -> None:
        self.now = NOW
        self.hosts, self.compute_environments = dict(HOSTS), dict(COMPUTE_ENVIRONMENTS)
        self.waiting: dict[str, Waiting] = {}
        self.running: dict[str, RunningGang] = {}
        self.jobs: dict[str, tuple[Waiting, bool]] = {}
        """Every job ever, and whether it may be preempted."""
        self.usage: dict[tuple[str, str], float] = {}
        self.turns = RoundRobin()
        self.decisions: Decisions | None = None

    @rule(
        queue=st.sampled_from(sorted(QUEUES)),
        shape=shapes(),
        priority=st.integers(0, 2),
        share=st.sampled_from("stu"),
        owner=st.sampled_from([None, "o", "p"]),
        timeout=st.one_of(st.none(), st.integers(60, 500)),
        preemptible=st.booleans(),
        count=st.integers(1, 3),
    )
    def submit(
        self,
        queue: str,
        shape: Shape,
        priority: int,
        share: str,
        owner: str | None,
        timeout: int | None,
        preemptible: bool,
        count: int,
    ) -> None:
        for _ in range(count):
            name = f"j{len(self.jobs)}"
            shared = share if queue == "fair" else None
            job = Waiting(name, name, queue, shape, priority, shared, self.now, self.now, timeout, owner)
            self.jobs[name] = (job, preemptible)
            self.waiting[name] = job
        self.run_pass()

    @rule(seconds=st.integers(1, 300))
    def let_time_pass(self, seconds: int) -> None:
        for key, used in self.usage.items():
            self.usage[key] = decayed(used, seconds, 100)
        for each in self.running.values():
            if each.queue == "fair":
                key = ("fair", each.share or "")
                self.usage[key] = self.usage.get(key, 0.0) + seconds * sum(p.cpus for p in each.placements)
        self.now += 1000 * seconds
        for each in list(self.running.values()):
            assert each.started_at is not None
            if each.ending:
                self.requeue(each.job)
            elif each.timeout is not None and each.started_at + 1000 * each.timeout <= self.now:
                del self.running[each.job]
        self.run_pass()

    @precondition(lambda self: self.running)
    @rule(data=st.data())
    def end_a_gang(self, data: st.DataObject) -> None:
        del self.running[data.draw(st.sampled_from(sorted(self.running)))]
        self.run_pass()

    @rule(name=st.sampled_from(sorted(COMPUTE_ENVIRONMENTS)))
    def switch_a_pool(self, name: str) -> None:
        pool = self.compute_environments[name]
        self.compute_environments[name] = dataclasses.replace(pool, enabled=not pool.enabled)
        self.run_pass()

    @rule(name=st.sampled_from(sorted(HOSTS)))
    def a_host_comes_or_goes(self, name: str) -> None:
        if name in self.hosts:
            del self.hosts[name]
            for each in list(self.running.values()):
                if any(placement.host == name for placement in each.placements):
                    self.requeue(each.job)
        else:
            self.hosts[name] = HOSTS[name]
        self.run_pass()

    @invariant()
    def nothing_is_supplied_out_twice(self) -> None:
        check_capacity(self.hosts.values(), COMPUTE_ENVIRONMENTS, self.running.values())

    def teardown(self) -> None:
        """With all compute environments and hosts back, every job runs that can; only what never fits or is kept out remains."""
        if not hasattr(self, "now"):
            return
        self.hosts, self.compute_environments = dict(HOSTS), dict(COMPUTE_ENVIRONMENTS)
        for _ in range(10 * len(self.jobs) + 10):
            self.run_pass()
            if ending := [each.job for each in self.running.values() if each.ending]:
                self.requeue(ending[0])
            elif self.running:
                del self.running[min(self.running)]
            else:
                break
        assert not self.running
        for name in self.waiting:
            assert self.decisions is not None
            reason = self.decisions.report.reason(name).aws
            assert reason.startswith("MISCONFIGURATION:") or "is kept for shares that are not active" in reason

    def requeue(self, name: str) -> None:
        del self.running[name]
        self.waiting[name] = dataclasses.replace(self.jobs[name][0], since=self.now)

    def run_pass(self) -> None:
        """Decide, check that the order of the snapshot does not matter, and carry the decisions out."""
        waiting, running = list(self.waiting.values()), list(self.running.values())
        hosts = [self.hosts[name] for name in sorted(self.hosts)]
        snapshot = Snapshot(
            self.now, hosts, self.compute_environments, QUEUES, waiting, running, self.usage, turns=self.turns
        )
        turned = dataclasses.replace(snapshot, waiting=waiting[::-1], running=running[::-1])
        self.decisions = decide(snapshot)
        assert equal_decisions(self.decisions, decide(turned), QUEUES)
        check_pass(snapshot, self.decisions)
        self.turns = self.decisions.turns
        for start in self.decisions.starts:
            job, preemptible = self.jobs[start.job]
            self.running[start.job] = started(job, start.compute_environment, start.placements, self.now, preemptible)
            del self.waiting[start.job]
        for preempt in self.decisions.preempts:
            assert QUEUES[self.jobs[preempt.by][0].queue].priority >= QUEUES[self.running[preempt.job].queue].priority
            self.running[preempt.job] = dataclasses.replace(self.running[preempt.job], ending=True)
        for cancel in self.decisions.cancels:
            del self.waiting[cancel.job]


TestCluster = Cluster.TestCase
TestCluster.settings = settings(max_examples=60, stateful_step_count=30)
