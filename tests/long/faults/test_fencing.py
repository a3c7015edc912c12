"""Law 4a: a gang that was frozen through a whole restart and then wakes stops by itself and can't touch the run."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

from orchestrator.domain.gang import gang_needs
from orchestrator.domain.hosts import Placement
from orchestrator.engines.api import Gang
from orchestrator.engines.local.engine import LocalEngine
from orchestrator.engines.toolkit.statuses import status_of
from orchestrator.spec import file as specfile
from orchestrator.spec.compile import compile_definition
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.epoch import raise_epoch
from shared_store.volume.layout import Store
from shared_store.volume.metrics import read_metrics
from tests.conftest import REPOSITORY, wait_for
from tests.support.engines.bench import make_gang
from tests.support.processes import end_all, processes_of, signal_all

STALE, SUCCESSOR = (f"{name}-{os.getpid()}" for name in ("stale", "successor"))
"""A job's id is nobody else's on a machine: an engine takes up what it finds of it."""


def gang(store: Store, job: str, epoch: int) -> Gang:
    """One node that trains the cart-pole for ever on run ``r``."""
    small = ["nodes=1", "train.worlds=16", "train.iterations=100000", "checkpoint.every=3", "checkpoint.keep=3"]
    spec = specfile.load(str(REPOSITORY / "job_specs" / "cartpole.yaml"), small)
    needs = gang_needs(compile_definition(spec, str(REPOSITORY))["nodeProperties"])
    node = needs.nodes[0]
    return make_gang(
        store.path,
        job=job,
        epoch=epoch,
        job_epoch=epoch,
        run="r",
        commands=[node.command],
        environments=[node.environment],
        placements=[Placement("localhost", (), node.resources.cpus, node.resources.memory)],
        grace=30.0,
        directory=str(REPOSITORY),
    )


def test_a_gang_that_wakes_after_its_successor_started_stops_and_writes_nothing(tmp_path: Path) -> None:
    store = Store(tmp_path).open()
    run = store.run("r")
    run.create({"run": "r"})
    engine = LocalEngine(tmp_path / "home")
    raise_epoch(run, 1)
    stale = engine.launch(engine.plan(gang(store, STALE, 1)))
    try:
        wait_for(lambda: len(list_checkpoints(run)) >= 2, 180, "checkpoints of the first gang")
        frozen = processes_of(store.path, MUSTER_JOB_ID=STALE)
        assert len(frozen) == 4, "shim, supervisor, rank and writer"
        signal_all(frozen, signal.SIGSTOP)

        raise_epoch(run, 2)
        successor = engine.launch(engine.plan(gang(store, SUCCESSOR, 2)))
        wait_for(lambda: sum(c.epoch == 2 for c in list_checkpoints(run)) >= 2, 180, "checkpoints of its successor")
        log = run.log(STALE, 1, 0)
        before = (log.stat().st_size, (run.metrics / "metrics-e1.jsonl").stat().st_size)
        signal_all(frozen, signal.SIGCONT)
        wait_for(lambda: not processes_of(store.path, MUSTER_JOB_ID=STALE), 10, "the end of the gang that woke")

        wait_for(lambda: not status_of(engine, stale)[0].running, 5, "its supervisor's end")
        assert status_of(engine, stale)[0].exit_code == 3
        assert (log.stat().st_size, (run.metrics / "metrics-e1.jsonl").stat().st_size) == before
        assert not run.outcome(STALE, 1, 0).exists()
        assert status_of(engine, successor)[0].running
        newest = list_checkpoints(run)[-1]
        wait_for(lambda: list_checkpoints(run)[-1].iteration > newest.iteration + 3, 60, "undisturbed progress")
        assert all(checkpoint.epoch == 2 for checkpoint in list_checkpoints(run)[-3:])
        for checkpoint in list_checkpoints(run)[-2:-1]:
            checkpoint.verify()
        iterations = [record["iteration"] for record in read_metrics(run)]
        assert iterations == list(range(1, len(iterations) + 1))
        engine.stop(successor, 30)
        assert json.loads(run.outcome(SUCCESSOR, 1, 0).read_text())["exit_code"] == 75
    finally:
        end_all(store.path)
