"""A training that goes from engine to engine, loses a node on each of them, and ends with the bits of one that nothing happened to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from shared_store.layout import Store
from shared_store.metrics import read_metrics
from tests.conftest import Serving, wait_for
from tests.support.engines.sites import SITES
from tests.support.engines.training import same_bits, submit
from tests.support.processes import kill_supervisor, processes_of_job

STAGE = 16
"""Iterations on each engine."""


def test_a_run_that_goes_from_engine_to_engine_ends_with_the_bits_of_one_that_stays(
    docker_client: Any, ray_cluster: Any, slurm_cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    engines = ("docker", "slurm", "ray", "local")
    monkeypatch.setenv("SLURM_CONF", str(slurm_cluster.conf))
    serving = Serving(tmp_path, "--cpus", "4", *(part for engine in engines for part in ("--engine", engine)))
    run = Store(tmp_path / "store").run("far")
    try:
        for stage, engine in enumerate(engines):
            job = submit(serving, "far", engine, STAGE * (stage + 1))
            wait_for(
                lambda begun=STAGE * stage: len(read_metrics(run)) >= begun + 5, 120, f"some iterations on {engine}"
            )
            kill_supervisor(job, 1)
            done = serving.wait(job, timeout=180)
            assert done["status"] == "SUCCEEDED", (engine, done["statusReason"], serving.log(job)[-20:])
            assert [attempt["number"] for attempt in done["attempts"]] == [1, 2], engine
            assert any("resumed from checkpoint" in line for line in serving.log(job, attempt=2)), engine
            wait_for(lambda job=job: not processes_of_job(job), 30, f"nothing is left on {engine}")
        straight = submit(serving, "straight", "local", STAGE * len(engines))
        assert serving.wait(straight, timeout=180)["status"] == "SUCCEEDED"
    finally:
        serving.close()
    same_bits(tmp_path / "store", "far", "straight")


def test_a_training_on_aws_that_loses_a_node_ends_with_the_bits_of_one_that_does_not(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """On its own volume, which the controller does not see: so it is no stage of the run above."""
    with SITES["aws-batch"](tmp_path, request) as site:
        job = submit(site.serving, "lost", "aws-batch", STAGE)
        run = Store(site.volume).run("lost")
        wait_for(lambda: len(read_metrics(run)) >= 5, 120, "some iterations")
        kill_supervisor(job, 1)
        done = site.serving.wait(job, timeout=180)
        assert done["status"] == "SUCCEEDED", (done["statusReason"], site.serving.log(job)[-20:])
        assert [attempt["number"] for attempt in done["attempts"]] == [1, 2]
        assert any("resumed from checkpoint" in line for line in site.serving.log(job, attempt=2))
        straight = submit(site.serving, "straight", "aws-batch", STAGE)
        assert site.serving.wait(straight, timeout=180)["status"] == "SUCCEEDED"
    same_bits(site.volume, "lost", "straight")
