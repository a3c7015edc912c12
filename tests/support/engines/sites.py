"""Every engine in its place, for the tests that each of them passes: a controller that has it, and what it needs around it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Serving
from tests.support.definitions import container, multinode
from tests.support.engines.images import PATH, SUPERVISED, host_files
from tests.support.waiting import wait_for

WAIT = "echo ready; exec sleep 600"
POLITE = 'trap "echo saved; exit 75" TERM; echo ready; while :; do sleep 0.05; done'
STUBBORN = 'trap "" TERM; echo ready; while :; do sleep 0.05; done'


@dataclass
class Site:
    """One engine."""

    engine: str
    serving: Serving
    volume: Path
    """The nodes' store, as this machine sees it."""
    container: dict[str, Any] = field(default_factory=dict)
    """What a job's ``containerProperties`` need there."""
    environment: dict[str, str] = field(default_factory=dict)
    """What its environment needs."""

    def submit(self, script: str, nodes: int, attempts: int = 1, cpus: str = "0.25", **env: str) -> str:
        """A native gang of ``sh -c script``; returns the job id."""
        environment = {"MUSTER_ON_CHILD_FAILURE": "restart", **self.environment, **env}
        memory = [{"type": "VCPU", "value": cpus}, {"type": "MEMORY", "value": "128"}]
        needs = container(["sh", "-c", script], env=environment, **{"resourceRequirements": memory, **self.container})
        definition = multinode("suite", needs, nodes, retryStrategy={"attempts": attempts})
        registered = self.serving.client.batch("RegisterJobDefinition", **definition)["jobDefinitionArn"]
        job = {"jobName": "suite", "jobQueue": "default", "jobDefinition": registered}
        return str(self.serving.client.batch("SubmitJob", **job)["jobId"])

    def printed(self, job: str, attempt: int | None = None) -> list[str]:
        """What the job's ranks printed."""
        query = {} if attempt is None else {"attempt": attempt}
        return [line["text"] for line in self.serving.client.logs(job, **query) if line["rank"] is not None]

    def ready(self, job: str, attempt: int, nodes: int) -> None:
        wait_for(lambda: self.printed(job, attempt).count("ready") == nodes, 60, f"attempt {attempt} of {nodes} nodes")


@contextlib.contextmanager
def local(home: Path, request: pytest.FixtureRequest) -> Iterator[Site]:
    yield from _served("local", home, "--cpus", "8")


@contextlib.contextmanager
def docker(home: Path, request: pytest.FixtureRequest) -> Iterator[Site]:
    request.getfixturevalue("docker_client")
    image = {"image": SUPERVISED, **host_files()}
    yield from _served("docker", home, "--cpus", "8", container=image, environment={"PATH": PATH})


@contextlib.contextmanager
def ray(home: Path, request: pytest.FixtureRequest) -> Iterator[Site]:
    request.getfixturevalue("ray_cluster")
    yield from _served("ray", home)


@contextlib.contextmanager
def slurm(home: Path, request: pytest.FixtureRequest) -> Iterator[Site]:
    cluster = request.getfixturevalue("slurm_cluster")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SLURM_CONF", str(cluster.conf))
        yield from _served("slurm", home)


@contextlib.contextmanager
def aws_batch(home: Path, request: pytest.FixtureRequest) -> Iterator[Site]:
    """A second Muster plays AWS; its nodes write to a volume that the controller does not see."""
    from orchestrator.engines.aws_batch.config import AwsConfig, save_config

    with pytest.MonkeyPatch.context() as patch:
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            patch.setenv(name, "any")
        with Serving(home / "aws", "--cpus", "8") as aws:
            reported: dict[str, Any] = {
                "region": "us-east-1",
                "job_queue": "default",
                "image": "muster",
                "endpoint_url": aws.url,
            }
            config = AwsConfig(**reported, store=str(home / "volume"), store_is_shared=False, poll=0.1, quiet=1.0)
            for name in ("home", "volume"):
                (home / name).mkdir()
            # nothing is compiled again for a volume that was never used before
            (home / "volume" / "kernels").symlink_to(os.environ["WARP_CACHE_PATH"])
            save_config(home / "home", config)
            yield from _served("aws-batch", home / "home", volume=home / "volume")


def _served(engine: str, home: Path, *options: str, volume: Path | None = None, **needs: Any) -> Iterator[Site]:
    with Serving(home, "--engine", engine, "--lost-after", "20s", *options) as serving:
        yield Site(engine, serving, volume or home / "store", **needs)


SITES: dict[str, Callable[..., Any]] = {
    **{"local": local, "docker": docker, "ray": ray, "slurm": slurm, "aws-batch": aws_batch}
}
