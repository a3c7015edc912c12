"""A training on a Ray cluster: a machine that is lost, a controller that is killed, and the same bits as on the local engine."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from orchestrator import specfile
from orchestrator.definition import compile_definition, compile_submission
from shared_store.layout import Store
from shared_store.metrics import read_metrics
from tests.conftest import REPOSITORY, Serving, processes_of, wait_for
from tests.engines.ray_cluster import RayCluster

CHANGES = ("nodes=2", "train.iterations=24", "train.worlds=16", "checkpoint.every=4", "resources.cpus=0.5")


def submit(serving: Serving, run: str) -> str:
    """Cart-pole on two nodes as run ``run``; returns the job id."""
    spec = specfile.load(str(REPOSITORY / "job_specs" / "cartpole.yaml"), [*CHANGES, "resources.memory=512MiB"])
    request = compile_definition(spec, str(REPOSITORY))
    container = request["nodeProperties"]["nodeRangeProperties"][0]["container"]
    container["environment"].append({"name": "MUSTER_RUN", "value": run})
    arn = serving.client.batch("RegisterJobDefinition", **request)["jobDefinitionArn"]
    job: str = serving.client.batch("SubmitJob", **compile_submission(spec, arn))["jobId"]
    return job


def test_it_survives_the_loss_of_a_machine_and_of_the_controller_with_the_bits_of_the_local_engine(
    ray_cluster: RayCluster, tmp_path: Path
) -> None:
    serving = Serving(tmp_path, "--engine", "ray")
    run = Store(tmp_path / "store").run("far")

    def iterations() -> int:
        return len(read_metrics(run)) if run.path.exists() else 0

    lost = ""
    try:
        too_large = serving.gang("print('never')", nodes=5)
        job = submit(serving, "far")
        wait_for(lambda: iterations() >= 6, 120, "some iterations")
        waiting = serving.detail(too_large)
        assert waiting["status"] == "RUNNABLE" and "5" in waiting["statusReason"], waiting["statusReason"]
        lost = serving.detail(job)["attempts"][0]["nodes"][1]["host"].removeprefix("ray/")
        ray_cluster.kill(lost)
        wait_for(
            lambda: serving.detail(job)["status"] == "RUNNING" and len(serving.detail(job)["attempts"]) == 2,
            90,
            "again",
        )
        serving.kill()
        serving.start()
        done = serving.wait(job, timeout=180)
        assert done["status"] == "SUCCEEDED", (done["statusReason"], serving.log(job)[-20:])
        assert [attempt["number"] for attempt in done["attempts"]] == [1, 2]
        assert any("resumed from checkpoint" in line for line in serving.log(job))
        wait_for(lambda: not processes_of(tmp_path / "store"), 30, "no process is left")
    finally:
        serving.close()
        if lost:
            ray_cluster.add(lost, PYTHONPATH=str(ray_cluster.modules))
    local = Serving(tmp_path, "--cpus", "4")
    try:
        job = submit(local, "near")
        assert local.wait(job, timeout=180)["status"] == "SUCCEEDED"
    finally:
        local.close()
    compared = subprocess.run(
        [sys.executable, "-P", "-m", "worker.compare", "far", "near"],
        env={**os.environ, "MUSTER_STORE": str(tmp_path / "store")},
        capture_output=True,
        text=True,
    )
    assert compared.returncode == 0 and compared.stdout.startswith("equal: "), compared.stdout + compared.stderr
