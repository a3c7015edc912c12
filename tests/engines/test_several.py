"""One controller with two engines: a job goes where its queue, or ``--engine``, says."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from tests.conftest import Serving, wait_for
from tests.engines.images import PLAIN, host_files
from tests.engines.test_docker_faults import plain

SCRIPT = "echo on $(hostname)"
JOB = f"""
name: where
command: [sh, -c, "{SCRIPT}"]
resources: {{cpus: 0.1, memory: 64MiB}}
"""


def lines(served: Serving, *arguments: str) -> list[str]:
    done = served.muster(*arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.usefixtures("docker_client")
def test_the_cores_of_one_machine_are_handed_out_once(tmp_path: Path) -> None:
    served = Serving(tmp_path, "--engine", "local", "--engine", "docker", "--cpus", "1")
    try:
        first = served.gang("import time; time.sleep(300)", cpus="0.95")
        served.wait(first, "RUNNING")
        second = plain(served, PLAIN, SCRIPT, "docker", **host_files())  # wants a tenth of a core
        reason = wait_for(lambda: "needs" in (r := served.detail(second)["statusReason"]) and r, 20, "a reason")
        assert "; 0.05 CPUs, 0 GPUs, " in reason and reason.endswith(f" free until job test ({first[:8]}) ends"), reason
        served.client.batch("TerminateJob", jobId=first, reason="enough")
        assert served.wait(second)["status"] == "SUCCEEDED", served.detail(second)
        assert served.detail(second)["attempts"][0]["startedAt"] >= served.detail(first)["stoppedAt"]
    finally:
        served.close()


@pytest.mark.usefixtures("docker_client")
def test_a_job_goes_to_the_engine_that_it_names_and_else_to_the_first(tmp_path: Path) -> None:
    served = Serving(tmp_path, "--engine", "local", "--engine", "docker", "--cpus", "4")
    try:
        spec = tmp_path / "where.yaml"
        spec.write_text(JOB)
        capacity = served.client.get("/api/capacity")
        assert capacity["engines"] == {"local": "default", "docker": "docker"}
        local, docker = (host["name"] for host in capacity["hosts"])
        assert local == "localhost" and docker.startswith("docker/")
        assert "on the local engine, queue default" in lines(served, "submit", str(spec), "--dry-run")[0]
        shown = lines(served, "submit", str(spec), "--engine", "docker", "--dry-run")
        assert "on the docker engine, queue docker" in shown[0] and docker in shown[2]

        lines(served, "submit", str(spec))
        assert served.wait("where")["queue"] == "default" and served.log("where") == [
            f"on {socket.gethostname()}",
            "node 0 ended: done",
        ]
        job = plain(served, PLAIN, SCRIPT, "docker", **host_files())
        assert served.wait(job)["status"] == "SUCCEEDED", served.detail(job)
        assert served.log(job) == ["on node-0"]
        assert served.detail(job)["attempts"][0]["nodes"][0]["host"] == docker

        refused = served.muster("submit", str(spec), "--engine", "slurm")
        assert refused.returncode == 2 and refused.stderr == (
            "muster: --engine slurm: the controller has local, docker; start it with: muster serve "
            "--engine local --engine docker --engine slurm\n"
        )
        spec.write_text(JOB + "queue: default\n")
        assert served.muster("submit", str(spec), "--engine", "docker", "--dry-run").returncode == 0
    finally:
        served.close()
    # a queue that nobody changed follows the first engine; what was made for another engine stays
    served = Serving(tmp_path, "--engine", "docker")
    try:
        assert served.client.get("/api/capacity")["engines"] == {"docker": "default"}
        assert "on the docker engine, queue default" in lines(served, "submit", str(spec), "--dry-run")[0]
    finally:
        served.close()
