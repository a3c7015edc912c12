"""The Docker engine on a real one: containers, their network and limits, found again, stopped, and gone."""

from __future__ import annotations

import itertools
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from orchestrator.domain.hosts import Placement
from orchestrator.engines.api import EngineError, Gang
from orchestrator.engines.docker import engine as docker_engine
from orchestrator.engines.docker.engine import DockerEngine
from orchestrator.engines.toolkit.statuses import status_of
from shared_store import __version__
from shared_store.volume.log_files import LogWriter
from tests.conftest import REPOSITORY, wait_for
from tests.support.engines.bench import Bench
from tests.support.engines.images import PATH, PLAIN, SUPERVISED, host_files
from tests.support.engines.sites import STUBBORN, WAIT


class DockerBench(Bench):
    engine: DockerEngine

    def __init__(self, client: Any, home: Path) -> None:
        """``client``: of the Docker Engine, for the test."""
        self.client = client
        super().__init__(home)

    def new_engine(self) -> DockerEngine:
        return DockerEngine(self.home / "home", gpus=[])

    def gang(
        self,
        script: str = WAIT,
        nodes: int = 2,
        *,
        suffix: str = "",
        image: str = PLAIN,
        memory: int = 256,
        container: dict[str, Any] | None = None,
        **changes: Any,
    ) -> Gang:
        """``container``: more of the nodes' ``containerProperties``."""
        facts = {
            "environments": [{"PATH": PATH, "GREETING": "hello"}] * nodes,
            "placements": [Placement("here", (), 0.5, memory)] * nodes,
            "containers": [{"image": image, **host_files(), **(container or {})}] * nodes,
        }
        return super().gang(script, nodes, suffix=suffix, **{**facts, **changes})

    def left(self) -> tuple[int, int]:
        """Containers and networks of the gangs."""
        mine = {"label": "muster.gang"}
        containers = self.client.containers.list(all=True, filters=mine)
        networks = self.client.networks.list(filters=mine)
        return sum(self.job in c.labels["muster.gang"] for c in containers), sum(self.job in n.name for n in networks)

    def nothing_is_left(self) -> None:
        assert self.left() == (0, 0)


@pytest.fixture
def bench(docker_client: Any, tmp_path: Path) -> Iterator[DockerBench]:
    found = DockerBench(docker_client, tmp_path)
    yield found
    found.close()


def test_a_plain_image_runs_plainly_and_its_log_and_outcome_are_in_the_store(bench: DockerBench) -> None:
    script = 'echo "$GREETING from $AWS_BATCH_JOB_NODE_INDEX of $NNODES$MUSTER_BUS$MUSTER_BUS_TOKEN"; exit $NODE_RANK'
    handle = bench.launch(bench.gang(script, 3, bus="tcp/1", bus_token="no supervisor needs it"))
    status = bench.ended(handle)
    assert [node.exit_code for node in status] == [0, 1, 2]
    assert sorted(bench.log()) == [f"hello from {index} of 3" for index in range(3)]
    ends = [(outcome.exit_code, outcome.reason) for outcome in map(bench.outcome, range(3))]
    assert ends == [(0, "done"), *((code, f"container exited with code {code}") for code in (1, 2))]
    assert bench.stopped(handle) == [0, 1, 2], "reported to the end"


def test_nodes_meet_on_a_network_of_their_own_at_the_addresses_that_they_receive(bench: DockerBench) -> None:
    script = (
        "import os, socket, sys, time\n"
        "here, main = os.environ['MUSTER_ADDRESS'], os.environ['MASTER_ADDR']\n"
        "if os.environ['NODE_RANK'] == '0':\n"
        "    assert 'AWS_BATCH_JOB_MAIN_NODE_PRIVATE_IPV4_ADDRESS' not in os.environ and here == main\n"
        "    s = socket.create_server((here, int(os.environ['MASTER_PORT']))); c, peer = s.accept(); print('met', peer[0])\n"
        "else:\n"
        "    assert os.environ['AWS_BATCH_JOB_MAIN_NODE_PRIVATE_IPV4_ADDRESS'] == main != here\n"
        "    for _ in range(100):\n"
        "        try: socket.create_connection((main, int(os.environ['MASTER_PORT']))); break\n"
        "        except OSError: time.sleep(0.1)\n"
    )
    gang = bench.gang(f"exec python3 -c '{script.replace(chr(39), chr(34))}'", 2, main=1)
    handle = bench.launch(gang)
    assert [node.exit_code for node in bench.ended(handle)] == [0, 0], bench.log()
    addresses = handle.facts["addresses"]
    assert bench.log() == [f"met {addresses[0]}"] and addresses[0] != addresses[1]
    # a second gang has another network, and reaches nobody here
    other = bench.launch(bench.gang(attempt=2))
    assert not set(other.facts["addresses"]) & set(addresses)


@pytest.mark.parametrize("reported", [True, False], ids=["the gateway is reported", "an engine that leaves it out"])
def test_containers_reach_this_machine_where_the_engine_says(
    bench: DockerBench, monkeypatch: pytest.MonkeyPatch, reported: bool
) -> None:
    networks = type(bench.client.networks)
    requested = networks.get

    def get(self: Any, name: str) -> Any:
        network = requested(self, name)
        [config] = network.attrs["IPAM"]["Config"]
        gateway = config.pop("Gateway", config["Subnet"].rpartition(".")[0] + ".1")
        config.update({"Gateway": gateway} if reported else {})
        return network

    monkeypatch.setattr(networks, "get", get)
    address = bench.new_engine().address
    assert address
    with socket.create_server((address, 0)) as server:
        server.settimeout(30)
        port = server.getsockname()[1]
        say = f'import socket; socket.create_connection(("{address}", {port})).sendall(b"here")'
        handle = bench.launch(bench.gang(f"exec python3 -c '{say}'", 1))
        connection, _ = server.accept()
        with connection:
            assert connection.recv(4) == b"here"
    assert [node.exit_code for node in bench.ended(handle)] == [0]


def test_limits_volumes_and_the_rest_of_the_definition_hold(bench: DockerBench) -> None:
    (bench.home / "data").mkdir()
    (bench.home / "data" / "file").write_text("found")
    files: dict[str, Any] = host_files()
    files["volumes"] += [{"name": "d", "host": {"sourcePath": str(bench.home / "data")}}]
    files["volumes"] += [{"name": "efs", "efsVolumeConfiguration": {"fileSystemId": "fs-1"}}]
    files["mountPoints"] += [{"sourceVolume": "d", "containerPath": "/data", "readOnly": True}]
    files["mountPoints"] += [{"sourceVolume": "efs", "containerPath": "/mnt/efs"}]
    script = (
        "cat /data/file; echo; touch /data/x 2>/dev/null && echo writable; ls /mnt/efs; id -u; ulimit -n; "
        "df -k /dev/shm | tail -1 | tr -s ' ' | cut -d' ' -f2; touch /no 2>/dev/null || echo read-only"
    )
    device = {"hostPath": "/dev/zero", "containerPath": "/dev/nothing", "permissions": ["READ"]}
    files["linuxParameters"] = {"sharedMemorySize": 96, "maxSwap": 64, "devices": [device]}
    files["ulimits"] = [{"name": "nofile", "softLimit": 321, "hardLimit": 321}]
    limits = {"user": "1234", "readonlyRootFilesystem": True, **files}
    handle = bench.launch(bench.gang(script, 1, container=limits))
    [container] = bench.engine._containers(f"{bench.job}/1/1").values()
    host = container.attrs["HostConfig"]
    assert (host["NanoCpus"], host["Memory"]) == (500_000_000, 256 * 2**20)
    assert host["MemorySwap"] in (320 * 2**20, -1), "a kernel that counts no swap has no limit of it"
    [device] = host["Devices"]
    assert device == {"PathOnHost": "/dev/zero", "PathInContainer": "/dev/nothing", "CgroupPermissions": "r"}
    assert [node.exit_code for node in bench.ended(handle)] == [0]
    assert bench.log() == ["found", "runs", "store.json", "1234", "321", str(96 * 1024), "read-only"]


def test_a_controller_that_starts_again_finds_the_gang_and_its_log_once(bench: DockerBench) -> None:
    gang = bench.gang("for i in 1 2 3 4 5 6; do echo line $i; sleep 0.3; done", 2)
    handle = bench.launch(gang)
    wait_for(lambda: bench.log(), 10, "the first line")
    shared = {container.attrs["HostConfig"]["ShmSize"] for container in bench.engine._containers(gang.name).values()}
    assert shared == {128 * 2**20}, "half of the memory"
    successor = bench.new_engine()
    assert successor.launch(successor.plan(gang)) == handle, "found, not started twice"
    assert bench.left() == (2, 1)
    assert [node.exit_code for node in bench.ended(handle, successor)] == [0, 0]


def test_a_log_that_is_copied_anew_has_its_lines_whole_and_from_when_they_were_printed(bench: DockerBench) -> None:
    handle = bench.launch(bench.gang("echo early; sleep 2; echo late", 1))
    log = bench.run.log(bench.job, 1, 0)
    early = wait_for(lambda: log.exists() and log.read_text(), 10, "the first line")
    log.unlink()  # what the first controller still writes is lost with it
    log.write_text("half a li")  # as a disk that is full leaves it
    bench.ended(handle, bench.new_engine())
    lines = log.read_text()
    assert lines.startswith(early) and bench.log() == ["early", "late"], lines


def test_a_long_log_is_copied_with_its_head_and_its_tail(bench: DockerBench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("orchestrator.engines.docker.engine._LOOK", 0.0)  # it goes on at the next look
    handle = bench.launch(bench.gang("seq 100000 160000; echo the error; exit 1", 1, log_limit=1 << 20))
    bench.ended(handle)
    log = bench.log()
    assert log[0] == "100000" and log[-2:] == ["160000", "the error"]
    assert len(log) < 40_000 and sum("left out" in line.text for line in bench.lines()) == 1


@pytest.mark.parametrize("end", ["echo the error", "printf 'the error'"])
def test_a_log_read_slowly_is_copied_to_its_end(bench: DockerBench, monkeypatch: pytest.MonkeyPatch, end: str) -> None:
    """Docker Engine 20.10 cuts such a log off when its container ends: not always, so that three are read."""
    append, written = LogWriter.append, itertools.count()

    def slowly(writer: LogWriter, data: bytes) -> int:
        if next(written) % 500 == 0:
            time.sleep(0.01)
        return append(writer, data)

    monkeypatch.setattr(LogWriter, "append", slowly)
    handle = bench.launch(bench.gang(f"seq 100000 160000; {end}; exit 1", 3))
    bench.ended(handle)
    lines = bench.lines()
    for node in range(3):
        assert [line.text for line in lines if line.node == node] == [*map(str, range(100_000, 160_001)), "the error"]


def test_a_log_that_can_t_be_written_is_copied_once_it_can(bench: DockerBench) -> None:
    log = bench.run.log(bench.job, 1, 0)
    log.mkdir(parents=True)
    long = "x" * 40_000  # Docker keeps it in pieces of 16 KiB
    handle = bench.launch(bench.gang(f"echo {long}; echo done; exit 3", 1))

    def refused() -> bool:
        try:
            return not status_of(bench.engine, handle)
        except IsADirectoryError:
            return True

    wait_for(refused, 20, "the store's error")
    log.rmdir()
    [node] = wait_for(lambda: not refused() and bench.ended(handle), 20, "the end")
    assert node.exit_code == 3 and bench.log() == [long, "done"]


def test_the_log_of_a_gang_that_is_stopped_is_whole(bench: DockerBench) -> None:
    script = "echo ready; trap 'seq 100000 160000; exit 75' TERM; while :; do sleep 0.05; done"
    bench.stopped(bench.ready(bench.gang(script, 1)), 30.0)
    assert bench.log() == ["ready", *map(str, range(100_000, 160_001))]


def test_a_gang_that_does_not_heed_sigterm_gets_sigkill_after_the_grace(bench: DockerBench) -> None:
    stubborn = bench.ready(bench.gang(STUBBORN, 1))
    started = time.monotonic()
    assert bench.stopped(stubborn, 1.0) == [137]
    assert time.monotonic() - started > 0.9


@pytest.mark.parametrize("blow", [lambda c: c.kill(), lambda c: c.remove(force=True)])
def test_a_killed_or_removed_container_is_a_node_that_ended(bench: DockerBench, blow: Callable[[Any], None]) -> None:
    handle = bench.launch(bench.gang(nodes=2))
    blow(bench.engine._containers(f"{bench.job}/1/1")[1])
    wait_for(lambda: not status_of(bench.engine, handle)[1].running, 10, "its end is seen")
    assert status_of(bench.engine, handle)[0].running
    assert status_of(bench.engine, handle)[1].exit_code in (137, None)


def test_an_image_without_muster_or_with_another_one_is_refused_before_anything_starts(bench: DockerBench) -> None:
    train = bench.gang(commands=[["python", "-P", "-m", "worker.train"]] * 2)
    with pytest.raises(EngineError) as refused:
        bench.engine.launch(bench.engine.plan(train))
    output = f"image {PLAIN} has no Muster in it (no label muster.version), which worker.train needs: "
    assert str(refused.value) == f"{output}build it FROM the image of containers/Dockerfile"
    old = "muster-test-old:1"
    made = {"repository": "muster-test-old", "tag": "1", "changes": ["LABEL muster.version=0.0.1"]}
    bench.client.api.import_image_from_data(bytes(1024), **made)
    try:
        with pytest.raises(EngineError) as refused:
            bench.engine.launch(bench.engine.plan(bench.gang(image=old)))
    finally:
        bench.client.images.remove(old)
    output = f"image {old} has Muster 0.0.1, the controller {__version__}"
    assert str(refused.value) == f"{output}: build it anew with the controller's version"
    assert bench.left() == (0, 0)


def test_an_image_that_has_no_command_either_is_refused(bench: DockerBench) -> None:
    for image in (PLAIN, SUPERVISED):
        with pytest.raises(EngineError, match=f"No command specified: image {image} has neither ENTRYPOINT nor CMD"):
            bench.engine.launch(bench.engine.plan(bench.gang(image=image, commands=[()] * 2)))
    assert bench.left() == (0, 0)


def test_images_that_are_built_here_say_the_controller_s_version() -> None:
    output = (REPOSITORY / "containers" / "Dockerfile").read_text()
    assert f"muster.version={__version__} " in output and f"image.version={__version__} " in output


@pytest.mark.parametrize(
    ("url", "name", "here"),
    [
        ("http+docker://localhost", "in-another-container", True),
        ("http://127.0.0.1:2375", "elsewhere", True),
        ("http://gpu-1:2375", "gpu-1", False),
        ("http+docker://ssh", "gpu-1", False),
        ("http+docker://ssh", socket.gethostname(), True),
    ],
)
def test_a_docker_engine_of_this_machine_is_known_as_such(url: str, name: str, here: bool) -> None:
    assert docker_engine._is_here(url, name) is here


def test_a_command_that_is_not_in_the_image_fails_and_leaves_nothing(bench: DockerBench) -> None:
    gang = bench.gang(commands=[["no-such-program"]] * 2)
    with pytest.raises(EngineError, match=r"CannotStartContainerError: Error response from daemon: .*no-such-program"):
        bench.engine.launch(bench.engine.plan(gang))
    assert bench.left() == (0, 0)


@pytest.mark.parametrize("image", [PLAIN, SUPERVISED])
def test_docker_creates_the_containers_of_the_plan(bench: DockerBench, image: str) -> None:
    gang = bench.gang("exec sleep 600", 2, image=image, container={"linuxParameters": {"initProcessEnabled": True}})
    plan = bench.engine.plan(gang)
    handle = bench.launch(gang)
    addresses = handle.facts["addresses"]
    kernels = None if image == PLAIN else bench.engine._kernels
    for index, planned in enumerate(plan.request):
        sent = planned.at(addresses[index], addresses[0]).arguments((), (), kernels)
        found = bench.client.containers.get(sent["name"]).attrs
        config, host = found["Config"], found["HostConfig"]
        assert (config["Cmd"], config["Entrypoint"]) == (sent["command"], sent["entrypoint"])
        assert {*config["Env"]} == {f"{name}={value}" for name, value in sent["environment"].items()}
        assert config["Labels"].items() >= sent["labels"].items() and config["Hostname"] == sent["hostname"]
        assert (host["NanoCpus"], host["Memory"]) == (sent["nano_cpus"], 256 * 2**20)
        assert (host["Init"], host["ShmSize"]) == (True, 128 * 2**20)
        mounts = {(m["Source"], m["Target"]) for m in sent["mounts"]}
        assert {(m["Source"], m["Destination"]) for m in found["Mounts"]} == mounts
