"""Engines through a controller: the Docker engine, two at once where a job goes to the one that it names, and wrong choices."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from orchestrator.domain.errors import ApiError
from orchestrator.engines.api import EngineError
from orchestrator.engines.ray.cluster import ray_environment
from orchestrator.engines.slurm import slurm_commands
from orchestrator.engines.toolkit.mounts import Mount, with_mounts
from shared_store.volume.layout import Store
from shared_store.volume.node_outcomes import read_outcome
from tests.conftest import Serving, call_muster, wait_for
from tests.support.engines.images import PATH, PLAIN, SUPERVISED, host_files, plain
from tests.support.engines.sites import POLITE, WAIT, Site
from tests.support.engines.slurm_cluster import need_slurm
from tests.support.processes import kill_rank


@pytest.fixture(scope="module")
def served(docker_client: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    with Serving(tmp_path_factory.mktemp("docker"), "--engine", "docker") as server:
        yield server


def test_a_job_whose_image_is_being_pulled_can_be_stopped_and_a_node_answers_on_the_bus(served: Serving) -> None:
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
    absent = (
        "no Docker Engine answers (No such file or directory); start it (systemctl start docker), or set DOCKER_HOST"
    )

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
        wait_for(lambda: says(first, "RUNNING", absent) and says(third, "STARTING", absent), 20, "the reason")
        served.client.batch("TerminateJob", jobId=first, reason="enough")
        refused = f"attempt 1 can't be stopped: {absent}; trying again"
        wait_for(
            lambda: says(first, "RUNNING", refused) and says(second, "RUNNING", absent), 20, "a stop that is tried"
        )
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
    output = served.process.stderr.read()
    assert output.count("no Docker Engine answers") <= 2 and "Traceback" not in output and "store" not in output, output


@pytest.mark.skipif(not Path("/var/run/docker.sock").exists(), reason="NO /var/run/docker.sock: nothing to cut off")
def test_a_node_that_ends_while_docker_is_away_is_not_silent(
    docker_client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    relay = Relay(tmp_path / "docker.sock")
    relay.open()
    monkeypatch.setenv("DOCKER_HOST", f"unix://{relay.path}")
    served = Serving(tmp_path, "--engine", "docker", "--cpus", "4", "--lost-after", "10s")
    site = Site("docker", served, tmp_path / "store", {"image": SUPERVISED, **host_files()}, {"PATH": PATH})
    job = site.submit("echo ready; while [ ! -e $MUSTER_STORE/go-$RANK ]; do sleep 0.05; done", nodes=2)

    def nodes() -> Any:
        found = served.detail(job)
        assert (found["status"], len(found["attempts"])) == ("RUNNING", 1), found["statusReason"]
        return found["attempts"][0]["nodes"]

    try:
        site.ready(job, 1, 2)
        served.wait(job, "RUNNING")
        wait_for(lambda: nodes()[1].get("met"), 30, "node 1 on the bus")
        relay.cut()
        (site.volume / "go-1").touch()
        wait_for(lambda: nodes()[1].get("exitCode") == 0, 30, "its outcome counts")
        time.sleep(12.0)
        assert [node.get("exitCode") for node in nodes()] == [None, 0]
        (site.volume / "go-0").touch()
        wait_for(lambda: nodes()[0].get("exitCode") == 0, 30, "its outcome counts, too")
        relay.open()
        assert served.wait(job)["status"] == "SUCCEEDED"
    finally:
        served.close()
        for container in docker_client.containers.list(all=True, filters={"label": f"muster.gang={job}/1/1"}):
            container.remove(force=True)


def test_memory_beyond_the_limit_is_named_under_a_supervisor_too(served: Serving) -> None:
    needs = [{"type": "VCPU", "value": "0.1"}, {"type": "MEMORY", "value": "128"}]
    environment = [{"name": "PATH", "value": PATH}]
    script = "exec python3 -c 'x = bytearray(300 << 20); print(len(x))'"
    files = {**host_files(), "resourceRequirements": needs}
    job = plain(served, SUPERVISED, script, environment=environment, **files)
    if served.wait(job)["status"] == "SUCCEEDED":
        pytest.skip("THIS KERNEL DOES NOT LIMIT MEMORY")
    [node] = served.detail(job)["attempts"][0]["nodes"]
    assert node["reason"] == "OutOfMemoryError: Container killed due to memory usage", (node, served.log(job))
    outcome = read_outcome(Store(served.home / "store").run(served.detail(job)["run"]), job, 1, 0)
    assert node["exitCode"] == 137 and outcome is not None and outcome.signal == "SIGKILL", (node, outcome)


def ask_stacks(served: Serving, job: str) -> Any:
    try:
        return served.client.get(f"/api/jobs/{job}/stacks")
    except ApiError:
        return None


# -- two engines -------------------------------------------------------------------------------------------------------


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
        assert "; 0.05 CPUs, 0 GPUs, " in reason and f"waits for job test ({first[:8]}) to end: " in reason, reason
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
        absent = "engine docker is not served now; start muster serve with --engine docker"
        wait_for(lambda: says(absent), 20, "the reason")
        again(*both)
        wait_for(lambda: says("attempt 1 runs on 1 node"), 20, "it is seen again")
        again("--engine", "local")
        wait_for(lambda: says(absent), 20, "the reason")
        served.client.batch("TerminateJob", jobId=job, reason="enough")
        wait_for(lambda: says(f"attempt 1 can't be stopped: {absent}; trying again"), 20, "a stop that is tried")
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


@pytest.mark.usefixtures("docker_client")
def test_the_order_of_the_engines_moves_no_job(tmp_path: Path) -> None:
    served = Serving(tmp_path, "--engine", "local", "--engine", "docker")
    try:
        job = served.gang("import time; time.sleep(600)", attempts=2)
        served.wait(job, "RUNNING")
        served.client.close()
        served.kill()
        served.options = ("--engine", "docker", "--engine", "local")
        served.start()
        assert served.client.get("/api/capacity")["engines"] == {"local": "default", "docker": "docker"}
        kill_rank(job, 0)
        wait_for(lambda: len(served.detail(job)["attempts"]) == 2, 30, "the second attempt")
        attempts = served.wait(job, "RUNNING")["attempts"]
        assert [each["nodes"][0]["host"] for each in attempts] == ["localhost"] * 2
        served.client.batch("TerminateJob", jobId=job, reason="enough")
        served.wait(job)
    finally:
        served.close()
    assert served.process.stderr is not None
    assert "queue default stays with engine local: 1 job in it has not ended" in served.process.stderr.read()
    with Serving(tmp_path, *served.options) as served:
        assert served.client.get("/api/capacity")["engines"] == {"docker": "default", "local": "local"}


# -- engines that can't be had, or can't do what is asked --------------------------------------------------------------


def refused(home: Path, engine: str, code: int = 1, **env: str) -> str:
    """The one line with which ``muster serve`` is refused with an engine."""
    done = call_muster("serve", "--port", "0", "--engine", engine, home=home, **env)
    assert done.returncode == code and done.stderr.count("\n") == 1, done.stderr
    return done.stderr


def test_an_engine_that_is_not_there_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    assert refused(tmp_path, "dokcer", 2) == "muster: --engine dokcer: unknown engine; did you mean docker?\n"
    assert not (tmp_path / "muster.db").exists()
    output = "muster: no Docker Engine answers (No such file or directory); start it (systemctl start docker), or set DOCKER_HOST\n"
    assert refused(tmp_path, "docker", DOCKER_HOST="unix:///nowhere.sock") == output
    output = refused(tmp_path, "slurm", PATH="/nowhere")
    assert output.startswith("muster: scontrol is not installed here: the slurm engine uses the cluster's own")


@pytest.mark.usefixtures("docker_client")
@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives a directory away")
def test_a_store_that_containers_could_not_write_is_refused(tmp_path: Path) -> None:
    store = Store(tmp_path / "store").open()
    os.chown(store.path, 1234, 1234)
    assert refused(tmp_path, "docker").startswith(
        f"muster: store {store.path}: it belongs to user 1234, as whom containers run, and they can't write what this controller "
    )
    assert os.listdir(store.path / "runs") == []


def test_without_slurm_s_controller_nothing_starts(tmp_path: Path) -> None:
    need_slurm()
    configuration = tmp_path / "slurm.conf"
    configuration.write_text(
        "ClusterName=away\nSlurmctldHost=localhost\nSlurmctldPort=1\nAuthType=auth/none\nCredType=cred/none\n"
        "NodeName=n1\nPartitionName=p Nodes=n1\nMessageTimeout=2\n"
    )
    output = refused(tmp_path, "slurm", SLURM_CONF=str(configuration))
    assert output.startswith("muster: slurmctld does not answer (") and output.endswith("see `scontrol ping`\n")


def test_a_missing_configuration_of_slurm_is_reported_as_such(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need_slurm()
    if Path("/etc/slurm/slurm.conf").exists():
        pytest.skip("this machine belongs to a cluster")
    monkeypatch.delenv("SLURM_CONF", raising=False)
    bad = call_muster("doctor", "--engine", "slurm", home=tmp_path)
    assert bad.returncode == 1
    assert "Slurm is installed but has no configuration here: put the cluster's slurm.conf at /etc/slurm/" in bad.stdout
    bad = call_muster("doctor", "--engine", "slurm", home=tmp_path, SLURM_CONF="/no/slurm.conf")
    assert "SLURM_CONF is /no/slurm.conf, which does not exist; set it to the cluster's slurm.conf" in bad.stdout


@pytest.mark.parametrize("engine", ["local", "ray"])
def test_an_engine_that_may_not_mount_says_so_by_its_name(engine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    output = f"^volume /mnt: the {engine} engine mounts only as root; start `muster serve`"
    with pytest.raises(EngineError, match=output):
        with_mounts(["true"], [Mount("/data", "/mnt")], engine)


@pytest.mark.parametrize(
    ("source", "target"),
    [
        ("-h", "/mnt"),
        ("--", "/mnt"),
        ("data", "/mnt"),
        ("/data", "--"),
        ("/data", "mnt"),
        ("/data", "/"),
        ("/a/../b", "/m"),
    ],
)
def test_source_and_target_of_a_mount_must_be_absolute_paths(source: str, target: str) -> None:
    with pytest.raises(EngineError, match=r"^volume .*: two absolute paths without '..' are needed$"):
        with_mounts(["true"], [Mount(source, target)])


def test_jobs_inherit_no_secrets_of_other_engines_from_an_engine_s_commands(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "RAY_AUTH_TOKEN", "SLURM_JWT"):
        monkeypatch.setenv(name, "secret")
    assert {name for name, value in slurm_commands.environment().items() if value == "secret"} == {"SLURM_JWT"}
    found = {name for name, value in ray_environment("h:1").items() if value == "secret"}
    assert found == {"RAY_AUTH_TOKEN"}
    monkeypatch.setenv("MUSTER_INHERIT", "HF_TOKEN")
    assert ray_environment("h:1")["MUSTER_INHERIT"] == "HF_TOKEN", "its driver hands the names to the nodes"
