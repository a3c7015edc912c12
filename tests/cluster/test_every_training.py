"""A training loses a node on each engine in turn, resumes on the next one, and ends with the same bits as an undisturbed run."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from shared_store.volume.layout import Run, Store
from tests.conftest import Serving, wait_for
from tests.support.engines.sites import SITES
from tests.support.engines.training import same_bits, submit
from tests.support.processes import kill_supervisor, processes_of_job

LAST = 120
"""Iterations in all. Each engine trains for some of them and seldom gets beyond ten before it loses its node."""


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The undisturbed run."""
    home = tmp_path_factory.mktemp("straight")
    with Serving(home, "--cpus", "4") as serving:
        done = serving.wait(submit(serving, "straight", "local", LAST), timeout=180)
        assert done["status"] == "SUCCEEDED", done["statusReason"]
    return Store(home / "store").run("straight")


def same_as(straight: Run, run: Run) -> None:
    """Check that the run, in any store, has the same bits as the straight one."""
    store = run.path.parent.parent
    shutil.copytree(straight.path, store / "runs" / straight.name)
    same_bits(store, run.name, straight.name)


def lose_a_node(serving: Serving, job: str, run: Run, epoch: int = 1) -> None:
    """Kill the supervisor of node 1 once the attempt of ``epoch`` has trained for five iterations."""
    records = run.metrics / f"metrics-e{epoch}.jsonl"

    def trains() -> bool:
        assert (now := serving.detail(job))["status"] != "FAILED", now["statusReason"]
        return records.exists() and records.read_text().count("\n") > 5

    wait_for(trains, 120, "some iterations")
    kill_supervisor(job, 1)


def test_a_run_that_loses_a_node_on_one_engine_after_the_other_ends_with_the_bits_of_one_that_stays(
    straight: Run,
    docker_client: Any,
    ray_cluster: Any,
    slurm_cluster: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """That each of them starts again what it lost is proven by :class:`EveryEngine`; by a training below, and in ``tests/long/faults``."""
    monkeypatch.setenv("SLURM_CONF", str(slurm_cluster.conf))
    engines = [part for engine in ("docker", "slurm", "ray", "local") for part in ("--engine", engine)]
    run = Store(tmp_path / "store").run("far")
    with Serving(tmp_path, "--cpus", "4", *engines) as serving:
        for epoch, engine in enumerate(("docker", "slurm", "ray"), 1):
            job = submit(serving, "far", engine, LAST, "retry.attempts=1")
            lose_a_node(serving, job, run, epoch)
            lost = serving.wait(job, timeout=180)
            assert lost["status"] == "FAILED" and len(lost["attempts"]) == 1, (engine, lost["statusReason"])
            assert epoch == 1 or any("resumed from checkpoint" in line for line in serving.log(job)), engine
            wait_for(lambda job=job: not processes_of_job(job), 30, f"nothing is left on {engine}")
        job = submit(serving, "far", "local", LAST)
        done = serving.wait(job, timeout=180)
        assert done["status"] == "SUCCEEDED", (done["statusReason"], serving.log(job)[-20:])
        assert any("resumed from checkpoint" in line for line in serving.log(job))
    same_as(straight, run)


def test_a_training_on_aws_that_loses_a_node_ends_with_the_bits_of_one_that_does_not(
    straight: Run, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """Its volume is one that the controller does not see, so it can't be a stage of the run above."""
    with SITES["aws-batch"](tmp_path, request) as site:
        job = submit(site.serving, "lost", "aws-batch", LAST)
        run = Store(site.volume).run("lost")
        lose_a_node(site.serving, job, run)
        done = site.serving.wait(job, timeout=180)
        assert done["status"] == "SUCCEEDED", (done["statusReason"], site.serving.log(job)[-20:])
        assert [attempt["number"] for attempt in done["attempts"]] == [1, 2]
        assert any("resumed from checkpoint" in line for line in site.serving.log(job, attempt=2))
        same_as(straight, run)
