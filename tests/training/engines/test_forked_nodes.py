"""Nodes that are forked from a process which has imported what ranks need: the same as started ones, to the engine and to the bit."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from orchestrator.engines.api import Gang, Handle
from orchestrator.engines.local import forks
from orchestrator.engines.local.engine import LocalEngine
from orchestrator.engines.local.forks import ForkServer
from orchestrator.start import runs_job
from shared_store.process.forking import early, module_of
from shared_store.process.processes import marked
from tests.conftest import PATIENCE, wait_for
from tests.support import processes
from tests.support.engines.bench import Bench
from tests.support.engines.training import same_bits

RANK = ["python", "-P", "-m", "worker.train"]


class TrainingBench(Bench):
    engine: LocalEngine

    def new_engine(self) -> LocalEngine:
        return LocalEngine(self.home / "home", cpus=8, gpus=[])

    def training(self, nodes: int = 2, iterations: int = 100_000, **changes: Any) -> Gang:
        """A gang that trains Cartpole."""
        train = {"task": "Cartpole", "worlds": 8, "iterations": iterations, "seed": 1}
        spec = {"name": "cartpole", "nodes": nodes, "train": train, "checkpoint": {"every": 5}}
        environment = {"MUSTER_SPEC": json.dumps(spec), "MUSTER_PICTURE": "0", **changes.pop("environment", {})}
        own = {"commands": [RANK] * nodes, "environments": [environment] * nodes, "directory": str(self.home)}
        return self.gang(nodes=nodes, **{**own, **changes})

    def trained(self, gang: Gang) -> tuple[Handle, list[int]]:
        """Launch it; the pids of its ranks once these train."""
        handle = self.launch(gang)
        wait_for(
            lambda: any(line.startswith("iteration") for line in self.log(run=gang.run)), 120 * PATIENCE, "training"
        )
        return handle, [each.pid for each in processes.gang_members(self.store.path, "rank")]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[TrainingBench]:
    found = TrainingBench(tmp_path)
    yield found
    processes.end_all(found.store.path)


def test_a_forked_rank_has_the_place_of_a_started_one(bench: TrainingBench) -> None:
    gang = bench.training()
    handle, ranks = bench.trained(gang)
    assert len(ranks) == 2 and {process.pid for process in marked([f"MUSTER_GANG={gang.name}"])} >= {*ranks}
    for rank in ranks:
        supervisor = processes.parent(rank)
        assert processes.command(rank)[:4] == RANK
        assert processes.command(supervisor)[3:6] == ["worker.supervisor", "--", "python"]
        assert processes.parent(supervisor) in [node["pid"] for node in handle.facts["nodes"]], "its shim"
        assert os.getsid(rank) == rank and os.readlink(f"/proc/{rank}/cwd") == str(bench.home)
        group = [Path(f"/proc/{pid}/cgroup").read_text() for pid in (rank, supervisor)]
        assert group[0] == group[1]
        signals = [processes.has_signal(rank, "SigIgn", number) for number in (signal.SIGPIPE, signal.SIGHUP)]
        assert signals == [True, False], "as in a new interpreter"
    assert all(status.running for status in bench.engine.observe([handle])[0])
    assert bench.stopped(handle, grace=60 * PATIENCE) == [75, 75], "it checkpoints and leaves"


@pytest.mark.parametrize("role", ["shim", "supervisor", "rank"])
def test_what_is_killed_takes_the_forked_node_with_it(bench: TrainingBench, role: str) -> None:
    handle, (first, _) = bench.trained(bench.training())
    supervisor = processes.parent(first)
    os.kill({"shim": processes.parent(supervisor), "supervisor": supervisor, "rank": first}[role], signal.SIGKILL)
    wait_for(lambda: not processes.alive(first) and not processes.alive(supervisor), 30 * PATIENCE, "the node's end")
    bench.stopped(handle)


def test_forked_and_started_ranks_end_with_the_same_bits(bench: TrainingBench) -> None:
    forked, started = bench.training(1, 10), bench.training(1, 10, suffix="-2", run="run-2")
    bench.store.run("run-2").create({"run": "run-2"})
    forks.prepare()
    codes = []
    for engine, gang in ((bench.new_engine(), forked), (bench.engine, started)):
        handle = bench.launch(gang, engine)
        assert (handle.facts["nodes"][0]["pid"] in engine._children) == (gang is started)
        codes += [node.exit_code for node in bench.ended(handle, engine)]
    assert codes == [0, 0], bench.log()
    same_bits(bench.store.path, "run", "run-2")


def test_a_node_is_started_where_it_cannot_be_forked(bench: TrainingBench) -> None:
    """A library has read another value of a variable, the server has ended, or the program is another one."""
    server = ForkServer()
    fits = {**server._early, "MUSTER_RUN": "run", "CUDA_VISIBLE_DEVICES": "0"}
    assert server.fits(fits) and not server.fits({**fits, "OMP_NUM_THREADS": "3"})
    server.close()
    assert not server.fits(fits)
    assert module_of(RANK) == "worker.train" and module_of([*RANK, "--option"]) is None
    assert module_of(["python", "-m", "worker.train"]) is None and module_of(["sh", "-c", "echo", "a"]) is None
    assert early({"PATH": "/bin", "MUSTER_RUN": "a"}) == {"PATH": "/bin"}
    engine = bench.new_engine()
    forks._prepared.append(server)
    handle = bench.launch(bench.training(1, 1), engine)
    assert [node.exit_code for node in bench.ended(handle, engine)] == [0]


def test_only_commands_that_run_a_job_prepare_for_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MUSTER_HOME", str(tmp_path))
    monkeypatch.delenv("MUSTER_URL", raising=False)
    assert runs_job(["run", "job.yaml"]) and runs_job(["evaluate", "run-1"])
    assert not runs_job([]) and not runs_job(["list"]) and not runs_job(["run", "--help"])
    assert not runs_job(["run", "job.yaml", "--dry-run"])
    monkeypatch.setenv("MUSTER_URL", "http://127.0.0.1:1")
    assert not runs_job(["run", "job.yaml"]), "another controller runs it"
