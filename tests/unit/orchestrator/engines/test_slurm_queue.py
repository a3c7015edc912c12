"""How often the Slurm engine asks squeue, what it sees between two answers, and who cancelled a job."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from orchestrator import machine
from orchestrator.cli.serving import _squeue_interval
from orchestrator.domain.errors import SpecError
from orchestrator.engines.api import Cause, Handle, NodePhase, NodeStatus
from orchestrator.engines.installed import check_tags
from orchestrator.engines.slurm import engine as slurm
from orchestrator.engines.slurm import slurm_commands
from shared_store.volume.layout import Store
from shared_store.volume.node_outcomes import Outcome, write_outcome

MEETING = 'muster: meeting {"nodes": ["n1"], "addresses": ["10.0.0.1"], "port": 1}\n'


class Machine(machine.Machine):
    """Its clock goes where a test puts it."""

    time = 1000.0

    def monotonic(self) -> float:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += seconds


class Cluster:
    """Slurm's commands, and the jobs that they know."""

    def __init__(self, store: Path) -> None:
        self.machine, self.store = Machine(), Store(store).open()
        self.states: dict[str, str] = {}
        """Of each job, by its number."""
        self.requested = 0
        """Number of calls of squeue."""
        self.absent = False

    def call(self, *command: str, **_: Any) -> str:
        if self.absent:
            raise slurm_commands.SlurmUnreachable("slurmctld does not answer")
        if command[0] == "scancel" and len(command) == 2:
            self.states[command[1]] = "CANCELLED"
        if command[0] != "squeue":
            return ""
        self.requested += 1
        return "\n".join(f"{number}|{state}|None|n1|job{number}/1/1" for number, state in self.states.items())

    def handle(self, number: str) -> Handle:
        output = self.store.run(f"run{number}").logs(f"job{number}", 1) / "slurm.out"
        facts = {"job": f"job{number}", "attempt": 1, "epoch": 1, "run": f"run{number}", "store": str(self.store.path)}
        facts |= {"log_limit": None, "main": 0, "output": str(output), "slurm": number}
        return Handle("slurm", f"job{number}/1/1", 1, facts)

    def begin(self, number: str) -> None:
        """The job's script has started its nodes."""
        output = Path(self.handle(number).facts["output"])
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(MEETING)

    def end(self, number: str, code: int) -> None:
        """Its supervisor leaves an outcome."""
        outcome = Outcome(0, 1, code, None, "left on request", None, 1.0, 2.0)
        write_outcome(self.store.run(f"run{number}"), f"job{number}", 1, outcome)


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    made = Cluster(tmp_path)
    monkeypatch.setattr(slurm_commands, "call", made.call)
    monkeypatch.setattr(slurm, "call", made.call)
    with machine.replaced_by(made.machine):
        yield made


def polls(engine: slurm.SlurmEngine, cluster: Cluster, seconds: float) -> int:
    """How often squeue is asked while the engine looks five times a second at all jobs, for so many seconds."""
    before, handles = cluster.requested, [cluster.handle(number) for number in cluster.states]
    for _ in range(round(5 * seconds)):
        cluster.machine.time += 0.2
        engine.observe(handles)
    return cluster.requested - before


def test_squeue_is_asked_once_a_second_for_few_gangs_and_twice_a_minute_for_many(cluster: Cluster) -> None:
    cluster.states = {str(number): "RUNNING" for number in range(10)} | {"77": "COMPLETED"}
    engine = slurm.SlurmEngine()
    assert 40 <= polls(engine, cluster, 60.0) <= 60
    cluster.states["10"] = "PENDING"
    polls(engine, cluster, 3.0)
    assert 1 <= polls(engine, cluster, 60.0) <= 3
    for number in ("0", "1", "2"):
        cluster.states[number] = "COMPLETED"
    polls(engine, cluster, 31.0)
    assert 40 <= polls(engine, cluster, 60.0) <= 60, "and often again once they are few"


def test_the_interval_of_squeue_can_be_set_and_a_failure_is_tried_again_sooner(cluster: Cluster) -> None:
    cluster.states = {"1": "RUNNING"}
    cluster.begin("1")
    engine = slurm.SlurmEngine(120.0)
    assert polls(engine, cluster, 600.0) in (4, 5)
    cluster.absent = True
    polls(engine, cluster, 121.0)
    [status] = engine.observe([cluster.handle("1")])
    assert isinstance(status, list) and status[0].stale == "Slurm: slurmctld does not answer"
    cluster.absent = False
    assert polls(engine, cluster, 6.0) == 1
    [status] = engine.observe([cluster.handle("1")])
    assert isinstance(status, list) and status[0].stale == ""


def seen(engine: slurm.SlurmEngine, cluster: Cluster, number: str) -> NodeStatus:
    [status] = engine.observe([cluster.handle(number)])
    assert not isinstance(status, BaseException)
    return status[0]


def test_between_two_calls_of_squeue_starts_and_ends_are_seen_by_what_the_job_leaves(cluster: Cluster) -> None:
    cluster.states = {"1": "PENDING", "2": "PENDING"}
    engine = slurm.SlurmEngine(240.0)
    assert seen(engine, cluster, "1").phase is NodePhase.QUEUED
    requested = cluster.requested
    cluster.begin("1")
    assert seen(engine, cluster, "1").phase is NodePhase.RUNNING
    cluster.end("1", 3)
    assert (seen(engine, cluster, "1").phase, seen(engine, cluster, "1").exit_code) == (NodePhase.ENDED, 3)
    assert seen(engine, cluster, "2").phase is NodePhase.QUEUED and cluster.requested == requested


def test_a_job_that_others_cancelled_says_so_and_one_that_muster_cancelled_does_not(cluster: Cluster) -> None:
    cluster.states = {"1": "RUNNING", "2": "PENDING"}
    for number in cluster.states:
        cluster.begin(number)
    engine = slurm.SlurmEngine()
    cluster.end("1", 75)
    cluster.states["1"] = "CANCELLED"
    engine.stop(cluster.handle("2"), 0.0)
    assert cluster.states["2"] == "CANCELLED"
    cluster.end("2", 75)
    cluster.machine.time += 2.0
    by_others, by_muster = seen(engine, cluster, "1"), seen(engine, cluster, "2")
    assert (by_others.cause, by_others.exit_code) == (Cause.CANCELLED, 75)
    assert by_others.words == "cancelled in Slurm (scancel), not by Muster (job 1)"
    assert (by_muster.cause, by_muster.exit_code) == (Cause.EXIT, 75)


def test_the_settings_are_checked(cluster: Cluster) -> None:
    assert _squeue_interval(None, ["local"]) is None and _squeue_interval("1m", ["slurm"]) == 60.0
    for text, engines, words in (
        ("60s", ["local"], "only the slurm engine calls squeue"),
        ("0.5s", ["slurm"], "expected 1s to 240s"),
        ("1h", ["slurm"], "expected 1s to 240s"),
    ):
        with pytest.raises(SpecError, match=words):
            _squeue_interval(text, engines)
    check_tags({"muster:cancellations": "5"}, ["slurm"])
    with pytest.raises(ValueError, match="not an integer"):
        check_tags({"muster:cancellations": "often"}, ["slurm"])
