"""The cluster of containers/compose.yaml, for real: a training on three workers, of which two and the controller are killed."""

from __future__ import annotations

import json
import os
import random
import secrets
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from orchestrator.client import Client
from orchestrator.domain.attempt import SHORTEST_REQUEUE
from orchestrator.domain.errors import ApiError, Unreachable
from tests.conftest import MUSTER, PATIENCE, REPOSITORY, wait_for
from tests.support.engines.images import PATH, SUPERVISED, host_files
from tests.support.engines.ray_cluster import IMPATIENT
from tests.support.engines.sites import POLITE
from tests.support.worker.ranks import free_port

NODES = 3


class Cluster:
    """A project of docker-compose: the file that users get, over an image made of this machine's files."""

    def __init__(self, folder: Path) -> None:
        self.port, self.token = free_port(), secrets.token_hex(16)
        self.project = f"mustertest{os.getpid()}"
        mounts = host_files()
        sources = {volume["name"]: volume["host"]["sourcePath"] for volume in mounts["volumes"]}
        volumes = [f"{sources[point['sourceVolume']]}:{point['containerPath']}:ro" for point in mounts["mountPoints"]]
        changes: dict[str, Any] = {
            "image": SUPERVISED,
            "volumes": volumes,
            "environment": {"PATH": PATH, "MUSTER_PICTURE": "0", "RAY_worker_niceness": "0"},
        }
        # the kernels of this machine: nothing is compiled again
        worker = {**changes, "volumes": [*volumes, f"{os.environ['WARP_CACHE_PATH']}:/muster/kernels"]}
        # the others wait until it is healthy
        quick = {"healthcheck": {"interval": "1s", "retries": 120}}
        head = {**changes, **quick, "environment": {**changes["environment"], **IMPATIENT}}
        services = {"head": head, "controller": changes, "worker": worker}
        (folder / "override.yaml").write_text(yaml.safe_dump({"services": services}))
        environment = {
            "RAY_AUTH_TOKEN": secrets.token_hex(16),
            "MUSTER_TOKEN": self.token,
            "MUSTER_WORK": str(REPOSITORY),
            "MUSTER_PORT": str(self.port),
            "MUSTER_SUBNET": f"10.{random.randrange(160, 190)}.{random.randrange(256)}",
            "MUSTER_WORKER_CPUS": "1",
            "MUSTER_WORKER_MEMORY": "1000000000",
        }
        (folder / "environment").write_text("".join(f"{name}={value}\n" for name, value in environment.items()))
        files = ("-f", str(REPOSITORY / "containers" / "compose.yaml"), "-f", str(folder / "override.yaml"))
        options = ("--project-name", self.project, "--env-file", str(folder / "environment"))
        self._command = [*compose(), *options, *files]

    def compose(self, *arguments: str) -> str:
        done = subprocess.run([*self._command, *arguments], capture_output=True, text=True, timeout=100 * PATIENCE)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def up(self, workers: int = NODES) -> None:
        self.compose("up", "--detach", "--scale", f"worker={workers}")

    def muster(self, *arguments: str) -> str:
        """The command on this machine, as a user has it."""
        env = {
            **os.environ,
            "MUSTER_URL": f"http://127.0.0.1:{self.port}",
            "MUSTER_TOKEN": self.token,
            "COLUMNS": "200",
        }
        done = subprocess.run(
            [MUSTER, *arguments], env=env, cwd=REPOSITORY, capture_output=True, text=True, timeout=60 * PATIENCE
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def ask(self, path: str, **query: Any) -> Any:
        """What the controller answers; None where there is none just now."""
        try:
            with Client(f"http://127.0.0.1:{self.port}", self.token) as client:
                return client.get(path, **query)
        except (Unreachable, ApiError):
            return None

    def hosts(self) -> list[str]:
        return [host["name"] for host in (self.ask("/api/capacity") or {"hosts": []})["hosts"]]


def compose() -> list[str]:
    """The command of whichever compose is here."""
    if shutil.which("docker") and subprocess.run(["docker", "compose", "version"], capture_output=True).returncode == 0:
        return ["docker", "compose"]
    if found := shutil.which("docker-compose"):
        return [found]
    pytest.skip("NO DOCKER COMPOSE: the cluster of containers/compose.yaml is not tested")


@pytest.fixture
def cluster(docker_client: Any, tmp_path: Path) -> Iterator[Cluster]:
    found = Cluster(tmp_path)
    try:
        found.up()
        yield found
    finally:
        found.compose("down", "--volumes", "--timeout", "5")
    mine = {"label": f"com.docker.compose.project={found.project}"}
    assert docker_client.containers.list(all=True, filters=mine) == []
    assert docker_client.networks.list(filters=mine) == []


def test_a_training_survives_two_workers_and_the_controller(cluster: Cluster, docker_client: Any) -> None:
    wait_for(lambda: len(cluster.hosts()) == NODES, 90, "the workers")
    small = ("train.iterations=24", "train.worlds=16", "train.config.episode_seconds=0.5", "checkpoint.every=4")
    needs = ("resources.cpus=1", "resources.memory=256MiB", f"nodes={NODES}")
    changes = [part for change in (*small, *needs) for part in ("--set", change)]
    job = json.loads(cluster.muster("submit", "job_specs/cartpole.yaml", *changes, "--json"))["jobId"]

    def iteration() -> int:
        return ((cluster.ask(f"/api/jobs/{job}") or {}).get("progress") or {}).get("iteration", 0)

    run = wait_for(lambda: cluster.ask(f"/api/jobs/{job}"), 60, "the job")["run"]
    wait_for(lambda: iteration() >= 5 and cluster.ask(f"/api/runs/{run}/checkpoints"), 180, "a checkpoint")
    mine = {"label": [f"com.docker.compose.project={cluster.project}", "com.docker.compose.service=worker"]}
    first, second = random.sample(docker_client.containers.list(filters=mine), 2)
    os.kill(first.attrs["State"]["Pid"], signal.SIGKILL)  # a crash: the container comes back by itself
    second.kill()  # a user's `docker kill`: it does not
    wait_for(lambda: len(cluster.hosts()) == NODES - 1, 120, "one is noticed to be gone for good")
    cluster.compose("kill", "controller")
    cluster.up()
    wait_for(lambda: len(cluster.hosts()) == NODES, 120, "all workers and the controller are back")
    done = wait_for(
        lambda: (d := cluster.ask(f"/api/jobs/{job}")) and d["status"] in ("SUCCEEDED", "FAILED") and d, 240, "the end"
    )
    assert done["status"] == "SUCCEEDED", done["statusReason"]
    assert len(done["attempts"]) >= 2 and iteration() == 24
    assert "resumed from checkpoint" in cluster.muster("logs", job)


def test_what_is_scaled_down_restarted_or_taken_down_has_its_jobs_save_and_spends_no_attempt(
    cluster: Cluster, tmp_path: Path
) -> None:
    wait_for(lambda: len(cluster.hosts()) == NODES, 90, "the workers")
    job = {"name": "polite", "nodes": NODES, "command": ["sh", "-c", POLITE], "retry": {"attempts": 1}}
    spec = tmp_path / "polite.yaml"
    spec.write_text(yaml.safe_dump({**job, "resources": {"cpus": 1, "memory": "64MiB"}}))
    polite = json.loads(cluster.muster("submit", str(spec), "--json"))["jobId"]

    def attempts() -> list[dict[str, Any]]:
        found = cluster.ask(f"/api/jobs/{polite}") or {"attempts": [], "status": ""}
        assert found["status"] != "FAILED", found["statusReason"]
        attempts: list[dict[str, Any]] = found["attempts"]
        return attempts

    def ready(number: int) -> bool:
        lines = cluster.ask(f"/api/jobs/{polite}") and cluster.muster("logs", polite, "--attempt", str(number))
        return (lines or "").count("ready") == NODES

    def saved(number: int) -> bool:
        found = attempts()
        return len(found) >= number and [node.get("exitCode") for node in found[number - 1]["nodes"]] == [75] * NODES

    blows = (
        lambda: cluster.up(NODES - 1),
        lambda: cluster.compose("restart", "controller"),
        lambda: cluster.compose("down"),
    )
    for number, blow in enumerate(blows, start=1):
        wait_for(lambda number=number: len(attempts()) == number and ready(number), 120, f"attempt {number}")
        time.sleep(SHORTEST_REQUEUE / 1000)
        blow()
        cluster.up()
        wait_for(lambda number=number: saved(number), 120, f"the end of attempt {number}")
    assert [each["spent"] for each in attempts()[: len(blows)]] == [False] * len(blows)
