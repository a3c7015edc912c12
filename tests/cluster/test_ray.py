"""The Ray engine on a real cluster: gangs placed, observed, stopped, lost and found again; nothing is left of them."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from orchestrator.engines.api import EngineError
from orchestrator.engines.ray.engine import RayEngine
from orchestrator.engines.ray.folder import Folder
from orchestrator.engines.toolkit.statuses import status_of
from shared_store import __version__
from shared_store.volume.epoch import raise_epoch
from shared_store.volume.node_outcomes import read_outcome
from tests.conftest import wait_for
from tests.support.engines.ray_bench import RayBench
from tests.support.engines.ray_cluster import RAY, RayCluster
from tests.support.engines.sites import POLITE, STUBBORN, WAIT
from tests.support.processes import await_end, parent, processes_of


@pytest.fixture
def bench(ray_cluster: RayCluster, tmp_path: Path) -> Iterator[RayBench]:
    found = RayBench(ray_cluster, tmp_path)
    yield found
    found.close()


def addresses(bench: RayBench) -> dict[str, str]:
    return {node["name"]: node["address"] for node in bench.engine._watch.seen["nodes"]}


def drain(bench: RayBench, node: str) -> None:
    """Announce that the machine with that id goes away in a minute."""
    notice = ["--reason=DRAIN_NODE_REASON_PREEMPTION", "--reason-message=spot", "--deadline-remaining-seconds=60"]
    command = [RAY, "drain-node", f"--address={bench.cluster.address}", f"--node-id={node}", *notice]
    subprocess.run(command, check=True, capture_output=True)


def test_hosts_are_the_nodes_that_have_cpus(bench: RayBench) -> None:
    hosts = {host.name: host for host in bench.engine.capacity().machines}
    assert sorted(hosts) == ["ray/n1", "ray/n2", "ray/n3"]
    assert (hosts["ray/n1"].cpus, hosts["ray/n1"].gpus, hosts["ray/n1"].memory) == (2.0, ("0", "1"), 1907)
    assert hosts["ray/n1"].single and bench.engine.address is None


def test_a_gang_starts_main_node_first_with_exactly_its_contract_and_its_ends_are_reported(bench: RayBench) -> None:
    script = (
        "env > $MUSTER_STORE/env-$AWS_BATCH_JOB_NODE_INDEX; pwd; "
        "shim=$(sed 's/.*) //' /proc/$PPID/stat | cut -d' ' -f2); "  # the supervisor's parent: what the engine started
        "sed 's/.*) //' /proc/$shim/stat | cut -d' ' -f20 > $MUSTER_STORE/start-$NODE_RANK; exit $NODE_RANK"
    )
    gang = bench.gang(script, main=1, gpus=("1",), directory=str(bench.home))
    plan = bench.engine.plan(gang)
    assert "# node 1, the main node, on ray/n2\n" in plan.document and plan.document.count("ray.io/node-id") == 3
    handle = bench.launch(gang)
    status = bench.ended(handle)
    assert [node.exit_code for node in status] == [1, 0, 2]
    at = addresses(bench)
    assert [node.address for node in status] == [at["n1"], at["n2"], at["n3"]]
    assert bench.log().count(str(bench.home)) == 3
    for index in range(3):
        lines = (bench.store.path / f"env-{index}").read_text().splitlines()
        found = dict(line.split("=", 1) for line in lines if "=" in line)
        reported = plan.nodes[index].contract.to_env()
        reported["MASTER_PORT"] = found["MASTER_PORT"]
        assert {name: found.get(name) for name in reported} == reported
        assert found["MASTER_ADDR"] == at["n2"] and found["GREETING"] == "hello"
        assert not [name for name in found if name.startswith("RAY_")], "the cluster's token is not for jobs"
        assert found["CUDA_VISIBLE_DEVICES"] in ("0", "1") and status[index].gpus == (found["CUDA_VISIBLE_DEVICES"],)
    assert [bench.outcome(index).exit_code for index in range(3)] == [1, 0, 2]
    started = [int((bench.store.path / f"start-{rank}").read_text()) for rank in range(3)]
    assert started[0] == min(started), "the main node is started first"
    assert bench.stopped(handle) == [1, 0, 2]


def test_asked_to_leave_then_made_to_and_the_next_attempt_finds_its_place_kept(bench: RayBench) -> None:
    first = bench.ready(bench.gang(POLITE))
    driver = bench.driver()
    assert bench.stopped(first) == [75, 75, 75]
    assert bench.log().count("saved") == 3
    # meanwhile the place is kept: the driver and its placement group are those of the next attempt
    second = bench.ready(bench.gang(STUBBORN, 2, attempt=2))
    assert bench.driver() == driver
    assert bench.stopped(second, 0.5) == [137, 137]


def test_what_the_driver_reads_is_the_request_of_the_plan(bench: RayBench) -> None:
    gang = bench.gang(nodes=2, main=1, bus="tcp/127.0.0.1:1", bus_token="the credential")
    plan = bench.engine.plan(gang)
    bench.ready(gang)
    reported = json.loads(Folder.of(bench.engine.home, gang.job).plan(gang.name).read_bytes())
    assert reported == json.loads(json.dumps(plan.request.document())) and reported["nodes"][0]["contract"]["bus_token"]
    for node in reported["nodes"]:
        assert f'{{"ray.io/node-id": "{node["pin"]}"}}' in plan.document
    assert "the credential" not in plan.document


def test_it_waits_in_words_for_room_that_others_hold_and_starts_when_they_leave(bench: RayBench) -> None:
    other = bench.ready(bench.gang(hosts=("n2",), suffix="-other", cpus=2.0))
    handle = bench.launch(bench.gang(nodes=2))
    reason = "waits for room on ray/n2: other work of the Ray cluster holds it"
    wait_for(lambda: [node.words for node in status_of(bench.engine, handle)] == [reason] * 2, 30, "it says why")
    bench.engine.stop(other, 1.0)
    wait_for(lambda: status_of(bench.engine, handle) and bench.log().count("ready") == 2, 60, "it starts")
    assert not any(node.words for node in status_of(bench.engine, handle))
    waiting = bench.launch(bench.gang(nodes=2, suffix="-third", cpus=2.0))
    wait_for(lambda: "holds it" in status_of(bench.engine, waiting)[0].words, 30, "a third one waits")
    bench.engine.stop(waiting, 1.0)
    assert not any(node.running for node in status_of(bench.engine, waiting)), "one that waits can be stopped"


def test_what_is_missing_on_a_node_is_one_clear_line_and_nothing_runs(bench: RayBench) -> None:
    handle = bench.launch(bench.gang(nodes=1, directory="/nowhere/at/all"))
    [node] = bench.ended(handle)
    assert node.words == (
        "node 0 on ray/n1: working directory /nowhere/at/all is not there: it has to be on a volume that all nodes share"
    )
    bench.engine.stop(handle, 1.0)
    fake = bench.cluster.modules / "shared_store"
    fake.mkdir(parents=True)
    (fake / "__init__.py").write_text('__version__ = "0.0.1"\n')
    try:
        status = bench.ended(bench.launch(bench.gang(hosts=("n1", "n3"), attempt=2)))
        assert status[0].words == (
            f"node 1 on ray/n3 has Muster 0.0.1, the controller {__version__}: install the same on both"
        )
        (fake / "__init__.py").write_text("raise ImportError('nothing of it')\n")
        [node] = bench.ended(bench.launch(bench.gang(hosts=("n3",), attempt=3, suffix="-third")))
        assert "Muster is not installed there for " in node.words
        assert bench.lines(attempt=2) == []
    finally:
        shutil.rmtree(fake)


def test_a_node_with_another_volume_at_the_store_s_path_is_named_and_nothing_runs(bench: RayBench) -> None:
    # what such a node finds: not the epoch that the controller has written
    handle = bench.start(bench.gang(hosts=("n2",), epoch=2))
    [node] = bench.ended(handle)
    assert node.words.startswith(f"node 0 on ray/n2: store {bench.store.path} on "), node
    assert "is not the controller's: run run has epoch 1 there, not 2; mount the same volume" in node.words
    assert bench.lines() == [] and read_outcome(bench.run, bench.job, 1, 0) is None


@pytest.mark.parametrize("killed", ["actor", "shim"])
def test_an_actor_or_a_shim_that_is_killed_takes_what_its_rank_started_with_it(bench: RayBench, killed: str) -> None:
    script = f"[ $NODE_RANK = 0 ] || {{ setsid sleep 577 & echo $! > $MUSTER_STORE/apart; }}; echo $PPID > $MUSTER_STORE/supervisor-$NODE_RANK; {WAIT}"
    handle = bench.ready(bench.gang(script, 2))
    apart = int((bench.store.path / "apart").read_text())
    supervisor = int((bench.store.path / "supervisor-1").read_text())
    wait_for(lambda: os.getsid(apart) == apart, 5, "a session of its own")
    shim = parent(supervisor)
    os.kill(shim if killed == "shim" else parent(shim), signal.SIGKILL)
    wait_for(lambda: not status_of(bench.engine, handle)[1].running, 30, "the node's end is seen")
    await_end(apart)  # nothing of the node is left
    assert status_of(bench.engine, handle)[0].running, "the other node goes on"
    bench.engine.stop(handle, 5.0)


def test_a_driver_that_is_killed_takes_its_gang_with_it(bench: RayBench) -> None:
    handle = bench.ready(bench.gang())
    os.kill(bench.driver(), signal.SIGKILL)
    assert [node.exit_code for node in bench.ended(handle)] == [None] * 3
    wait_for(lambda: not processes_of(bench.store.path), 30, "Ray ends its actors")
    bench.engine.stop(handle, 1.0)
    again = bench.ready(bench.gang(attempt=2))
    assert bench.stopped(again) == [143, 143, 143]


def test_a_driver_or_an_actor_that_dies_before_anything_was_started_costs_no_attempt(bench: RayBench) -> None:
    other = bench.ready(bench.gang(hosts=("n2",), suffix="-other", cpus=2.0))
    waiting = bench.launch(bench.gang(nodes=2))
    wait_for(lambda: "waits for room" in status_of(bench.engine, waiting)[0].words, 30, "it is placed")
    state = Folder.of(bench.home / "home", bench.job).state(waiting.gang)
    driver = json.loads(state.read_text())["driver"]
    os.kill(driver, signal.SIGKILL)
    died = "its driver died before it had started anything ("
    wait_for(lambda: status_of(bench.engine, waiting)[0].words.startswith(died), 10, "its end is seen")
    bench.engine.stop(other, 1.0)
    wait_for(lambda: status_of(bench.engine, waiting) and bench.log().count("ready") == 2, 60, "another one starts it")
    assert bench.stopped(waiting) == [143, 143]
    # what an actor imports first kills it, once
    fake = bench.cluster.modules / "shared_store"
    fake.mkdir(parents=True)
    (fake / "__init__.py").write_text(
        "import os, shutil, signal\nshutil.rmtree(os.path.dirname(__file__))\nos.kill(os.getpid(), signal.SIGKILL)\n"
    )
    handle = bench.ready(bench.gang(hosts=("n1", "n3"), attempt=2))
    assert not fake.exists() and bench.stopped(handle) == [143, 143]


def test_a_machine_that_is_lost_is_noticed_and_no_host_any_more(bench: RayBench) -> None:
    handle = bench.ready(bench.gang())
    bench.cluster.kill("n3")
    wait_for(lambda: not status_of(bench.engine, handle)[2].running, 60, "its end is seen")
    assert [node.running for node in status_of(bench.engine, handle)] == [True, True, False]
    assert bench.stopped(handle)[:2] == [143, 143]
    wait_for(lambda: len(bench.engine.capacity().machines) == 2, 60, "the host is gone")
    bench.cluster.add("n3", PYTHONPATH=str(bench.cluster.modules))
    wait_for(lambda: len(bench.engine.capacity().machines) == 3, 20, "it is back")


def test_a_node_that_has_to_leave_has_the_gang_save_and_leave(bench: RayBench) -> None:
    [node] = [node["id"] for node in bench.engine._watch.seen["nodes"] if node["name"] == "n2"]
    handle = bench.ready(bench.gang(POLITE, 2))
    drain(bench, node)
    assert [node.exit_code for node in bench.ended(handle)] == [75, 75]
    assert bench.log().count("saved") == 2
    wait_for(lambda: len(bench.engine.capacity().machines) == 2, 20, "no more a host")
    bench.cluster.kill("n2")
    bench.cluster.add("n2")
    wait_for(lambda: len(bench.engine.capacity().machines) == 3, 20, "its successor is one")


def test_the_next_attempt_does_not_go_to_a_machine_that_has_to_leave(bench: RayBench) -> None:
    [node] = [node["id"] for node in bench.engine._watch.seen["nodes"] if node["name"] == "n2"]
    at = addresses(bench)
    # a machine that drains stays until its last job has ended
    other = bench.ready(bench.gang(STUBBORN, hosts=("n2",), suffix="-other", run="other"))
    handle = bench.ready(bench.gang(POLITE, 2))
    following = bench.gang(POLITE, 2, attempt=2)
    plan = bench.engine.plan(following)  # before it is known that the machine leaves
    drain(bench, node)
    assert [node.exit_code for node in bench.ended(handle)] == [75, 75]
    bench.engine.stop(handle, 5.0)  # its driver keeps the place
    raise_epoch(bench.store.run(following.run), following.epoch)
    second = bench.engine.launch(plan)
    bench.handles.append(second)
    wait_for(lambda: status_of(bench.engine, second) and bench.log(2).count("ready") == 2, 30, "it starts elsewhere")
    assert {node.address for node in status_of(bench.engine, second)} == {at["n1"], at["n3"]}
    assert status_of(bench.engine, other)[0].running, "it did not wait for the machine's end"
    for each in (second, other):
        bench.engine.stop(each, 0.5)
    bench.cluster.kill("n2")
    bench.cluster.add("n2")
    wait_for(lambda: len(bench.engine.capacity().machines) == 3, 20, "its successor is a host")


def test_a_driver_that_has_to_end_has_its_gang_save_and_leaves_one_that_waits_to_the_next_driver(
    bench: RayBench,
) -> None:
    handle = bench.ready(bench.gang(POLITE, cpus=2.0))
    waiting = bench.launch(bench.gang(POLITE, cpus=2.0, suffix="-2"))  # for room
    wait_for(lambda: "waits for room" in status_of(bench.engine, waiting)[0].words, 20, "it is placed")
    for driver in processes_of(bench.home / "home"):
        os.kill(driver, signal.SIGTERM)
    wait_for(lambda: bench.log().count("saved") == 3, 30, "all have saved")
    successor = bench.new_engine()
    assert [node.exit_code for node in bench.ended(handle, successor)] == [75, 75, 75]
    successor.close()
    bench.ready(bench.gang(POLITE, cpus=2.0, suffix="-2"))


def test_a_head_that_is_killed_and_comes_back_costs_nothing(bench: RayBench) -> None:
    bench.cluster.add("controller", cpus=0, gpus=0)  # a driver on the head's own node would go with it
    wait_for(lambda: bench.engine._watch.seen["join"] == addresses(bench).get("controller"), 20, "it is seen")
    handle = bench.ready(bench.gang(POLITE))
    driver = bench.driver()
    bench.cluster.kill("head")
    wait_for(bench.engine._watch.problem, 30, "it is missed")
    late = bench.gang(suffix="-late")
    with pytest.raises(EngineError, match=r"^the Ray head at .* does not answer; waiting for it$"):
        bench.engine.launch(bench.engine.plan(late))
    assert all(node.running for node in status_of(bench.engine, handle))
    bench.cluster.start_head()
    wait_for(lambda: not bench.engine._watch.problem(), 60, "it is back")
    assert all(node.running for node in status_of(bench.engine, handle)) and bench.driver() == driver
    assert len(bench.engine.capacity().machines) == 3
    assert bench.stopped(handle) == [75, 75, 75]
    after = bench.ready(bench.gang(attempt=2))
    assert bench.stopped(after) == [143, 143, 143]
    bench.cluster.kill("controller")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"RAY_ADDRESS": "127.0.0.1:1"},
            r"no Ray head answers at 127.0.0.1:1 \(Connection refused\); set RAY_ADDRESS to its host:port",
        ),
        (
            {"RAY_ADDRESS": "ray://head:10001"},
            r"RAY_ADDRESS is 'ray://head:10001'; the host:port of the cluster's head is needed",
        ),
        (
            {"RAY_AUTH_TOKEN": "another-token-of-someone"},
            "wants its token, and another one is set here: RAY_AUTH_MODE=token with",
        ),
        ({"RAY_AUTH_MODE": "disabled"}, "wants its token, and none is set here"),
        (
            {"MUSTER_RAY_GROWS_TO": "4 machines"},
            r"MUSTER_RAY_GROWS_TO: '4' is not like 4\*\{cpus:4,memory:8GiB,gpus:1\}",
        ),
    ],
)
def test_a_cluster_that_can_t_be_used_is_one_line_before_anything_starts(
    ray_cluster: RayCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, str], message: str
) -> None:
    for name, value in change.items():
        monkeypatch.setenv(name, value)
    if "RAY_AUTH_TOKEN" in change:
        monkeypatch.delenv("RAY_AUTH_TOKEN_PATH")
    with pytest.raises(EngineError, match=message) as refused:
        RayEngine(tmp_path)
    assert "\n" not in str(refused.value)


def test_other_versions_and_no_ray_at_all_are_one_line_each(
    ray_cluster: RayCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sitecustomize.py").write_text("import ray\nray.__version__ = '2.59.0'\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(EngineError, match=r"runs Ray 2\.60\.0 on Python 3\.\d+, this is Ray 2\.59\.0 on Python"):
        RayEngine(tmp_path)
    (tmp_path / "sitecustomize.py").write_text("import sys\nsys.modules['ray'] = None\n")
    (tmp_path / "ray.py").write_text("raise ModuleNotFoundError(\"No module named 'ray'\")\n")
    (tmp_path / "sitecustomize.py").unlink()
    with pytest.raises(EngineError, match=r"^the ray engine is not installed: pip install 'muster\[ray\]'$"):
        RayEngine(tmp_path)


def test_a_raylet_that_freezes_is_given_up_and_what_it_ran_ends(bench: RayBench) -> None:
    handle = bench.ready(bench.gang())
    raylet = bench.cluster.raylet("n3")
    os.kill(raylet, signal.SIGSTOP)
    try:
        wait_for(lambda: not status_of(bench.engine, handle)[2].running, 100, "Ray gives it up")
        assert bench.stopped_existing(handle) == [143, 143]
        wait_for(lambda: not processes_of(bench.store.path), 40, "the node that nobody reaches ends itself")
    finally:
        os.kill(raylet, signal.SIGCONT)
        bench.cluster.kill("n3")
        bench.cluster.add("n3", PYTHONPATH=str(bench.cluster.modules))
