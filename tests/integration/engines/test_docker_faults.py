"""The Docker engine through a controller: a stop while an image is pulled, a bus that reaches into containers, a node that is cut off."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from pathlib import Path
from typing import Any

import pytest

from orchestrator.domain.errors import ApiError
from shared_store.layout import Store
from shared_store.metrics import read_metrics
from shared_store.outcomes import read_outcome
from tests.conftest import Serving, wait_for
from tests.support.engines.images import PATH, PLAIN, SUPERVISED, host_files, plain
from tests.support.engines.sites import POLITE, WAIT
from tests.support.engines.training import submit


@pytest.mark.usefixtures("docker_client")
def test_a_job_whose_image_is_being_pulled_can_be_stopped_and_a_node_answers_on_the_bus(tmp_path: Path) -> None:
    with Serving(tmp_path, "--engine", "docker") as served:
        with socket.create_server(("127.0.0.1", 0)) as registry:  # takes connections, and never answers
            image = f"127.0.0.1:{registry.getsockname()[1]}/far:1"
            job = plain(served, image, "true")
            wait_for(lambda: served.detail(job)["statusReason"] == f"pulling image {image}", 30, "the pull")
            served.client.batch("TerminateJob", jobId=job, reason="no time for that")
            assert served.wait(job, timeout=10)["statusReason"] == "no time for that"
        environment = [{"name": "PATH", "value": PATH}]
        job = plain(served, SUPERVISED, WAIT, environment=environment, **host_files())
        wait_for(lambda: "ready" in served.log(job), 30, "its start")
        [node] = wait_for(lambda: ask_stacks(served, job), 30, "an answer from inside the container")
        assert "rank 0:" in node["stacks"]
        served.client.batch("TerminateJob", jobId=job, reason="enough")
        served.wait(job)


class Relay:
    """A socket that leads to this machine's Docker Engine, and can be cut off: an engine that is restarted, to whoever uses it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._open: list[socket.socket] = []

    def open(self) -> None:
        listener = socket.socket(socket.AF_UNIX)
        listener.bind(str(self.path))
        listener.listen(64)
        self._open.append(listener)
        threading.Thread(target=self._accept, args=(listener,), daemon=True).start()

    def cut(self) -> None:
        self.path.unlink()
        for each in self._open:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()
        self._open.clear()

    def _accept(self, listener: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, far = listener.accept()[0], socket.socket(socket.AF_UNIX)
                far.connect("/var/run/docker.sock")
                self._open += [near, far]
                for source, target in (near, far), (far, near):
                    threading.Thread(target=self._copy, args=(source, target), daemon=True).start()

    @staticmethod
    def _copy(source: socket.socket, target: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while chunk := source.recv(1 << 16):
                target.sendall(chunk)
            target.shutdown(socket.SHUT_WR)


@pytest.mark.skipif(not Path("/var/run/docker.sock").exists(), reason="NO /var/run/docker.sock: nothing to cut off")
def test_a_docker_engine_is_waited_for(docker_client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    relay = Relay(tmp_path / "docker.sock")
    relay.open()
    monkeypatch.setenv("DOCKER_HOST", f"unix://{relay.path}")
    served = Serving(tmp_path, "--engine", "docker", "--cpus", "4")
    away = "no Docker Engine answers (No such file or directory); start it (systemctl start docker), or set DOCKER_HOST"

    def says(job: str, status: str, reason: str) -> bool:
        found = served.detail(job)
        assert found["status"] != "FAILED", found["statusReason"]
        return (found["status"], found["statusReason"]) == (status, reason)

    try:
        first, second = (plain(served, PLAIN, POLITE, **host_files()) for _ in range(2))
        for job in (first, second):
            wait_for(lambda job=job: says(job, "RUNNING", "attempt 1 runs on 1 node"), 30, "its start")
        relay.cut()
        third = plain(served, PLAIN, "echo here", **host_files())
        wait_for(lambda: says(first, "RUNNING", away) and says(third, "STARTING", away), 20, "the reason")
        served.client.batch("TerminateJob", jobId=first, reason="enough")
        refused = f"attempt 1 can't be stopped: {away}; trying again"
        wait_for(lambda: says(first, "RUNNING", refused) and says(second, "RUNNING", away), 20, "a stop that is tried")
        relay.open()
        assert served.wait(first)["statusReason"] == "enough"
        assert served.wait(third)["status"] == "SUCCEEDED" and served.log(third) == ["here"]
        wait_for(lambda: says(second, "RUNNING", "attempt 1 runs on 1 node"), 20, "it is seen again")
        served.client.batch("TerminateJob", jobId=second, reason="enough")
        assert served.wait(second)["statusReason"] == "enough"
        assert served.log(second) == ["ready", "saved"], "its log goes on where it was"
    finally:
        served.close()
    assert served.process.stderr is not None
    said = served.process.stderr.read()
    assert said.count("no Docker Engine answers") <= 2 and "Traceback" not in said and "store" not in said, said


@pytest.mark.usefixtures("docker_client")
def test_memory_beyond_the_limit_is_named_under_a_supervisor_too(tmp_path: Path) -> None:
    with Serving(tmp_path, "--engine", "docker") as served:
        needs = [{"type": "VCPU", "value": "0.1"}, {"type": "MEMORY", "value": "128"}]
        environment = [{"name": "PATH", "value": PATH}]
        script = "exec python3 -c 'x = bytearray(300 << 20); print(len(x))'"
        files = {**host_files(), "resourceRequirements": needs}
        job = plain(served, SUPERVISED, script, environment=environment, **files)
        if served.wait(job)["status"] == "SUCCEEDED":
            pytest.skip("THIS KERNEL DOES NOT LIMIT MEMORY")
        [node] = served.detail(job)["attempts"][0]["nodes"]
        assert node["reason"] == "OutOfMemoryError: Container killed due to memory usage", (node, served.log(job))
        outcome = read_outcome(Store(tmp_path / "store").run(served.detail(job)["run"]), job, 1, 0)
        assert node["exitCode"] == 137 and outcome is not None and outcome.signal == "SIGKILL", (node, outcome)


def ask_stacks(served: Serving, job: str) -> Any:
    try:
        return served.client.get(f"/api/jobs/{job}/stacks")
    except ApiError:
        return None


@pytest.mark.skipif(not os.environ.get("MUSTER_LONG"), reason="three minutes: MUSTER_LONG=1, in make bits")
def test_a_node_that_is_cut_off_is_noticed_and_the_gang_goes_on(docker_client: Any, tmp_path: Path) -> None:
    docker = Serving(tmp_path, "--engine", "docker", "--cpus", "4")
    run = Store(tmp_path / "store").run("cut")
    job = ""
    try:
        job = submit(docker, "cut", "docker", 24, "stall_timeout=15s")
        wait_for(lambda: len(read_metrics(run)) >= 5, 120, "some iterations")
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
