"""A training in containers: a node that is killed, a controller that is killed, and the same bits as on the local engine."""

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

CHANGES = ("nodes=2", "train.iterations=24", "train.worlds=16", "checkpoint.every=4", "resources.cpus=0.5")


def submit(serving: Serving, run: str, *changes: str) -> str:
    """Cart-pole on two nodes as run ``run``, in the image of this machine's files; returns the job id."""
    spec = specfile.load(str(REPOSITORY / "job_specs" / "cartpole.yaml"), [*CHANGES, *changes])
    request = compile_definition(spec, str(REPOSITORY))
    container = request["nodeProperties"]["nodeRangeProperties"][0]["container"]
    container |= {"image": SUPERVISED, **host_files()}
    container["environment"] += [{"name": "PATH", "value": PATH}, {"name": "MUSTER_RUN", "value": run}]
    arn = serving.client.batch("RegisterJobDefinition", **request)["jobDefinitionArn"]
    job: str = serving.client.batch("SubmitJob", **compile_submission(spec, arn))["jobId"]
    return job


@pytest.mark.usefixtures("docker_client")
def test_it_survives_the_loss_of_a_node_and_of_the_controller_with_the_bits_of_the_local_engine(
    docker_client: Any, tmp_path: Path
) -> None:
    docker = Serving(tmp_path, "--engine", "docker", "--cpus", "4")
    run = Store(tmp_path / "store").run("docked")

    def iterations() -> int:
        return len(read_metrics(run)) if run.path.exists() else 0

    try:
        job = submit(docker, "docked")
        mine = {"label": "muster.gang"}

        def nodes() -> list[Any]:
            found = docker_client.containers.list(filters=mine)
            return [container for container in found if container.labels["muster.gang"].startswith(job)]

        wait_for(lambda: iterations() >= 6, 120, "some iterations")
        saved = docker.client.post(f"/api/jobs/{job}/checkpoint", {})  # the bus reaches into containers
        assert "checkpoint 000000" in str(saved)
        [child] = [container for container in nodes() if container.labels["muster.node"] == "1"]
        child.kill()
        wait_for(
            lambda: docker.detail(job)["status"] == "RUNNING" and len(docker.detail(job)["attempts"]) == 2, 60, "again"
        )
        docker.kill()
        docker.start()
        done = docker.wait(job, timeout=180)
        assert done["status"] == "SUCCEEDED", (done["statusReason"], docker.log(job)[-20:])
        assert [attempt["number"] for attempt in done["attempts"]] == [1, 2]
        assert any("resumed from checkpoint" in line for line in docker.log(job))
        wait_for(lambda: not nodes(), 30, "no container is left")
        assert not [n for n in docker_client.networks.list(filters=mine) if job in n.name]
    finally:
        docker.close()
        for container in docker_client.containers.list(all=True, filters={"label": "muster.gang"}):
            if container.labels["muster.gang"].startswith(job):
                container.remove(force=True)
    local = Serving(tmp_path, "--cpus", "4")
    try:
        spec = specfile.load(str(REPOSITORY / "job_specs" / "cartpole.yaml"), list(CHANGES))
        request = compile_definition(spec, str(REPOSITORY))
        container = request["nodeProperties"]["nodeRangeProperties"][0]["container"]
        container["environment"].append({"name": "MUSTER_RUN", "value": "undocked"})
        arn = local.client.batch("RegisterJobDefinition", **request)["jobDefinitionArn"]
        job = local.client.batch("SubmitJob", **compile_submission(spec, arn))["jobId"]
        assert local.wait(job, timeout=180)["status"] == "SUCCEEDED"
    finally:
        local.close()
    compared = subprocess.run(
        [sys.executable, "-P", "-m", "worker.compare", "docked", "undocked"],
        env={**os.environ, "MUSTER_STORE": str(tmp_path / "store")},
        capture_output=True,
        text=True,
    )
    assert compared.returncode == 0 and compared.stdout.startswith("equal: "), compared.stdout + compared.stderr


@pytest.mark.skipif(not os.environ.get("MUSTER_LONG"), reason="three minutes: MUSTER_LONG=1, in make bits")
def test_a_node_that_is_cut_off_is_noticed_by_its_silence_and_the_gang_goes_on(
    docker_client: Any, tmp_path: Path
) -> None:
    docker = Serving(tmp_path, "--engine", "docker", "--cpus", "4")
    run = Store(tmp_path / "store").run("cut")
    job = ""
    try:
        job = submit(docker, "cut", "stall_timeout=15s")
        wait_for(lambda: run.path.exists() and len(read_metrics(run)) >= 5, 120, "some iterations")
        [network] = [n for n in docker_client.networks.list(filters={"label": "muster.gang"}) if job in n.name]
        network.reload()
        [child] = [c for c in network.containers if c.labels["muster.node"] == "1"]
        network.disconnect(child)
        done = docker.wait(job, timeout=240)
        assert done["status"] == "SUCCEEDED", (done["statusReason"], docker.log(job)[-20:])
        first = done["attempts"][0]["statusReason"]
        assert len(done["attempts"]) == 2 and "made no progress for 1" in first, first
    finally:
        docker.close()
        for container in docker_client.containers.list(all=True, filters={"label": "muster.gang"}):
            if job and container.labels["muster.gang"].startswith(job):
                container.remove(force=True)
