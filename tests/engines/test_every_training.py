"""A training that goes from engine to engine, loses a node on each of them, and ends with the bits of one that nothing happened to."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from orchestrator import specfile
from orchestrator.definition import compile_definition, compile_submission
from shared_store.layout import Store
from shared_store.metrics import read_metrics
from tests.conftest import REPOSITORY, Serving, wait_for
from tests.engines.conftest import PATH, SUPERVISED, host_files
from tests.engines.sites import kill_supervisor, processes

pytestmark = pytest.mark.cluster
SMALL = ("nodes=2", "train.worlds=16", "checkpoint.every=4", "resources.cpus=0.5")
STAGE = 16
"""Iterations on each engine."""


def submit(serving: Serving, run: str, engine: str, iterations: int, *more: str) -> str:
    """Go on with ``run`` until it has that many iterations; returns the job id."""
    changes = [*SMALL, f"train.iterations={iterations}", *more]
    spec = specfile.load(str(REPOSITORY / "job_specs" / "cartpole.yaml"), changes)
    queue = serving.client.get("/api/capacity")["engines"][engine]
    request = compile_definition(spec, str(REPOSITORY))
    container = request["nodeProperties"]["nodeRangeProperties"][0]["container"]
    container["environment"].append({"name": "MUSTER_RUN", "value": run})
    if engine == "docker":
        container |= {"image": SUPERVISED, **host_files()}
        container["environment"].append({"name": "PATH", "value": PATH})
    arn = serving.client.batch("RegisterJobDefinition", **request)["jobDefinitionArn"]
    submission = {**compile_submission(spec, arn), "jobQueue": queue}
    job: str = serving.client.batch("SubmitJob", **submission)["jobId"]
    return job


def test_a_run_that_goes_from_engine_to_engine_ends_with_the_bits_of_one_that_stays(
    docker_client: Any, ray_cluster: Any, slurm_cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    engines = ("docker", "slurm", "ray", "local")
    monkeypatch.setenv("SLURM_CONF", str(slurm_cluster.conf))
    serving = Serving(tmp_path, "--cpus", "4", *(part for engine in engines for part in ("--engine", engine)))
    run = Store(tmp_path / "store").run("far")

    def iterations() -> int:
        return len(read_metrics(run)) if run.path.exists() else 0

    try:
        for stage, engine in enumerate(engines):
            job = submit(serving, "far", engine, STAGE * (stage + 1))
            wait_for(lambda begun=STAGE * stage: iterations() >= begun + 5, 120, f"some iterations on {engine}")
            kill_supervisor(job, 1)
            done = serving.wait(job, timeout=180)
            assert done["status"] == "SUCCEEDED", (engine, done["statusReason"], serving.log(job)[-20:])
            assert [attempt["number"] for attempt in done["attempts"]] == [1, 2], engine
            assert any("resumed from checkpoint" in line for line in serving.log(job, attempt=2)), engine
            wait_for(lambda job=job: not processes(job), 30, f"nothing is left on {engine}")
        straight = submit(serving, "straight", "local", STAGE * len(engines))
        assert serving.wait(straight, timeout=180)["status"] == "SUCCEEDED"
    finally:
        serving.close()
    compared = subprocess.run(
        [sys.executable, "-P", "-m", "worker.compare", "far", "straight"],
        env={**os.environ, "MUSTER_STORE": str(tmp_path / "store")},
        capture_output=True,
        text=True,
    )
    assert compared.returncode == 0 and compared.stdout.startswith("equal: "), compared.stdout + compared.stderr
