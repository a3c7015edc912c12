"""One controller with two engines: a job goes where its queue, or ``--engine``, says."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Serving, wait_for
from tests.support.engines.images import PLAIN, host_files, plain
from tests.support.engines.sites import POLITE

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
def test_two_engines_on_one_machine_share_its_cores(tmp_path: Path) -> None:
    with Serving(tmp_path, "--engine", "local", "--engine", "docker", "--cpus", "1") as served:
        first = served.gang("import time; time.sleep(300)", cpus="0.95")
        served.wait(first, "RUNNING")
        second = plain(served, PLAIN, SCRIPT, "docker", **host_files())  # wants a tenth of a core
        reason = wait_for(lambda: "needs" in (r := served.detail(second)["statusReason"]) and r, 20, "a reason")
        assert "; 0.05 CPUs, 0 GPUs, " in reason and reason.endswith(f" free until job test ({first[:8]}) ends"), reason
        served.client.batch("TerminateJob", jobId=first, reason="enough")
        assert served.wait(second)["status"] == "SUCCEEDED", served.detail(second)
        assert served.detail(second)["attempts"][0]["startedAt"] >= served.detail(first)["stoppedAt"]


def test_a_gang_outlives_a_controller_that_does_not_serve_its_engine(docker_client: Any, tmp_path: Path) -> None:
    both = ("--engine", "local", "--engine", "docker")
    served = Serving(tmp_path, *both)

    def again(*options: str) -> None:
        served.client.close()
        served.kill()
        served.options = options
        served.start()

    def says(reason: str) -> bool:
        found = served.detail(job)
        return (found["status"], found["statusReason"]) == ("RUNNING", reason)

    def containers() -> list[Any]:
        mine: list[Any] = docker_client.containers.list(filters={"label": f"muster.gang={job}/1/1"})
        return mine

    try:
        job = plain(served, PLAIN, POLITE, "docker", **host_files())
        address = served.wait(job, "RUNNING")["attempts"][0]["nodes"][0]["address"]
        again("--engine", "local")
        away = "engine docker is not served now; start muster serve with --engine docker"
        wait_for(lambda: says(away), 20, "the reason")
        again(*both)
        wait_for(lambda: says("attempt 1 runs on 1 node"), 20, "it is seen again")
        again("--engine", "local")
        wait_for(lambda: says(away), 20, "the reason")
        served.client.batch("TerminateJob", jobId=job, reason="enough")
        wait_for(lambda: says(f"attempt 1 can't be stopped: {away}; trying again"), 20, "a stop that is tried")
        assert len(containers()) == 1
        assert served.detail(job)["attempts"][0]["nodes"][0]["address"] == address
        again(*both)
        done = served.wait(job)
        assert (done["status"], done["statusReason"]) == ("FAILED", "enough") and not containers()
    finally:
        served.close()
        for container in containers():
            container.remove(force=True)


@pytest.mark.usefixtures("docker_client")
def test_a_job_goes_to_the_engine_that_it_names_and_else_to_the_first(tmp_path: Path) -> None:
    with Serving(tmp_path, "--engine", "local", "--engine", "docker", "--cpus", "4") as served:
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
        assert served.wait("where")["queue"] == "default"
        assert served.log("where") == [f"on {socket.gethostname()}", "node 0 ended: done"]
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
    # a queue that nobody changed follows the first engine; what was made for another engine stays
    with Serving(tmp_path, "--engine", "docker") as served:
        assert served.client.get("/api/capacity")["engines"] == {"docker": "default"}
        assert "on the docker engine, queue default" in lines(served, "submit", str(spec), "--dry-run")[0]
