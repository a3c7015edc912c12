"""Two hosts and a bad wire: lost packets and long ways cost time and nothing else; a cut is found, with its reason."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from orchestrator.domain.gang import gang_needs
from orchestrator.domain.hosts import Placement
from orchestrator.engines.api import node_plans
from orchestrator.spec import file as specfile
from orchestrator.spec.compile import compile_definition
from shared_store.volume.epoch import raise_epoch
from shared_store.volume.layout import Store
from shared_store.volume.log_view import LogView
from shared_store.volume.metrics import read_metrics
from shared_store.volume.node_outcomes import read_outcome
from tests.conftest import PATIENCE, REPOSITORY, wait_for
from tests.support.engines.bench import make_gang
from tests.support.faults.link import ADDRESSES, Link
from tests.support.processes import processes_of

SMALL = (
    *("nodes=2", "train.worlds=16", "train.iterations=100000", "checkpoint.every=100000", "stall_timeout=8s"),
    *("train.ppo.epochs=1", "train.ppo.minibatches=1"),
)


@pytest.fixture
def link() -> Iterator[Link]:
    try:
        found = Link(f"m{os.getpid() % 100000}-")
    except OSError as error:
        pytest.skip(f"NO NETWORK NAMESPACES: bad networks are not tested ({error})")
    yield found
    found.close()


def test_loss_and_delay_cost_time_and_a_cut_is_found_and_named(link: Link, tmp_path: Path) -> None:
    store = Store(tmp_path / "store").open()
    run = store.run("r")
    run.create({"run": "r"})
    raise_epoch(run, 1)
    request = compile_definition(specfile.load(str(REPOSITORY / "job_specs" / "cartpole.yaml"), SMALL), str(REPOSITORY))
    needs = gang_needs(request["nodeProperties"])
    gang = make_gang(
        store.path,
        run="r",
        commands=[node.command for node in needs.nodes],
        environments=[node.environment for node in needs.nodes],
        placements=[Placement("localhost", (), 1.0, 512)] * 2,
        stall_timeout=8.0,
    )
    nodes = []
    try:
        for plan in node_plans(gang, ADDRESSES, 29500):
            inherited = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
            command = [sys.executable, "-P", "-m", "worker.supervisor", "--", *plan.command]
            env = {**inherited, **plan.environment, **plan.contract.to_env()}
            nodes.append(subprocess.Popen(link.inside(plan.contract.node_index, command), env=env, cwd=REPOSITORY))

        def reach(more: int) -> None:
            goal = len(read_metrics(run)) + more if run.metrics.exists() else more
            wait_for(lambda: run.metrics.exists() and len(read_metrics(run)) >= goal, 60, f"{more} more iterations")

        reach(3)
        link.order("loss 0.05")
        reach(10)
        link.order("clear")
        link.order("delay 0.2")
        reach(3)
        link.order("cut")
        codes = [node.wait(90 * PATIENCE) for node in nodes]
    finally:
        for node in nodes:
            node.kill()
    outcomes = [read_outcome(run, "job", 1, index) for index in (0, 1)]
    assert all(codes) and all(outcomes), (codes, outcomes)
    stalls = [outcome.reason for outcome in outcomes if outcome and "made no progress for" in outcome.reason]
    assert stalls and "it waits, perhaps for another rank" in stalls[0], outcomes
    log = [line.text for line in LogView.of(run, "job").drain()]
    assert any("stall: rank" in line for line in log) and any("all_reduce" in line for line in log), log[-30:]
    assert not processes_of(tmp_path)
