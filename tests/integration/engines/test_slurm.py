"""The Slurm engine on a real cluster of one slurmctld and three slurmd: submitted, placed, found again, stopped, and gone."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from orchestrator.domain.hosts import Placement
from orchestrator.engines.api import EngineError, Handle, NodeStatus, NotYet
from orchestrator.engines.slurm import slurm_commands
from orchestrator.engines.slurm.engine import SlurmEngine
from orchestrator.engines.slurm.slurm_commands import SlurmJob, list_hosts
from orchestrator.engines.slurm.states import waiting
from orchestrator.engines.toolkit.statuses import status_of
from tests.conftest import wait_for
from tests.support.engines.sites import STUBBORN, WAIT
from tests.support.engines.slurm_bench import SlurmBench, slurm_bench
from tests.support.engines.slurm_cluster import GPUS, NODES

bench = slurm_bench


def test_hosts_have_slurm_s_resources_and_drained_ones_are_away(bench: SlurmBench) -> None:
    hosts = bench.engine.capacity().machines
    found = [(host.name, host.cpus, host.gpus, host.memory, host.single) for host in hosts]
    assert found == [(f"slurm/{name}", 4.0, ("0", "1"), 8192, True) for name in NODES]
    bench.cluster.run("scontrol", "update", "nodename=n2", "state=drain", "reason=test")
    try:
        assert [host.unavailable for host in SlurmEngine().capacity().machines] == [False, True, False]
        handle = bench.launch(bench.gang(nodes=3))
        wait_for(lambda: "nodes that it needs are down" in status_of(bench.engine, handle)[0].words, 20, "it is queued")
        bench.engine.stop(handle, 0.0)
    finally:
        bench.cluster.run("scontrol", "update", "nodename=n2", "state=resume")


@pytest.mark.parametrize(
    ("state", "absent"),
    [
        ("IDLE", False),
        ("MIXED+PLANNED", False),
        ("IDLE+CLOUD+POWERED_DOWN", False),
        ("IDLE+CLOUD+POWERING_DOWN", False),
        ("ALLOCATED+CLOUD+NOT_RESPONDING+POWERING_UP", False),
        ("DOWN*", True),
        ("DOWN+CLOUD+POWERED_DOWN", True),
        ("IDLE+DRAIN", True),
        ("IDLE+NOT_RESPONDING", True),
        ("IDLE+MAINTENANCE", True),
    ],
)
def test_a_node_that_slurm_would_boot_is_a_host_others_are_away(
    state: str, absent: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = f"NodeName=n1 CPUTot=4 RealMemory=8192 State={state} Gres=gpu:2\nNodeName=n2 State=FUTURE\n"
    monkeypatch.setattr(slurm_commands, "call", lambda *command: line)
    assert [(host.name, host.unavailable) for host in list_hosts()] == [("slurm/n1", absent)]


def test_every_node_gets_its_contract_and_environment_whole(bench: SlurmBench, monkeypatch: pytest.MonkeyPatch) -> None:
    hard = "a'b\"c\nd $HOME `date` \\ é\tMUSTER\n@nodes@ %j"
    monkeypatch.setenv("MUSTER_TOKEN", "secret")
    monkeypatch.setenv("MUSTER_DATABASE", "secret")
    monkeypatch.setenv("SBATCH_PARTITION", "closed")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "7")
    monkeypatch.setenv("FROM_THE_CONTROLLER", "kept")
    monkeypatch.setenv("OF_THE_CONTROLLER", "not inherited")
    monkeypatch.setenv("MUSTER_INHERIT", "FROM_THE_CONTROLLER")
    show = "exec python3 -c \"import os, json; print(json.dumps({**os.environ, 'cwd': os.getcwd()}))\""
    variables = {"HARD": hard, "odd.name": "1", "MUSTER_ON_CHILD_FAILURE": "restart"}
    environments = [{**variables, "NODE": str(i)} for i in range(3)]
    gang = bench.gang(
        show, 3, main=1, environments=environments, directory="/usr/share", gpus=GPUS, title='a "job" \\ é $HOME #1'
    )
    handle = bench.launch(gang)
    assert [node.exit_code for node in bench.ended(handle)] == [0, 0, 0], Path(handle.facts["output"]).read_text()
    reported = sorted(
        (json.loads(line) for line in bench.log() if line.startswith("{")), key=lambda env: int(env["NODE"])
    )
    assert [env["AWS_BATCH_JOB_NODE_INDEX"] for env in reported] == ["0", "1", "2"]
    assert [env["RANK"] for env in reported] == ["1", "0", "2"], "rank 0 is on the main node"
    assert [env["SLURMD_NODENAME"] for env in reported] == ["n2", "n1", "n3"], "which comes first"
    addresses = bench.cluster.addresses
    assert [env["MUSTER_ADDRESS"] for env in reported] == [addresses[name] for name in ("n2", "n1", "n3")]
    assert [node.address for node in status_of(bench.engine, handle)] == [env["MUSTER_ADDRESS"] for env in reported]
    assert [node.host for node in status_of(bench.engine, handle)] == ["slurm/n2", "slurm/n1", "slurm/n3"]
    for env in reported:
        assert (env["HARD"], env["odd.name"], env["cwd"]) == (hard, "1", "/usr/share")
        assert env["SLURM_JOB_NAME"] == gang.title
        assert (env["MASTER_ADDR"], env["MASTER_PORT"]) == (addresses["n1"], reported[0]["MASTER_PORT"])
        assert env["CUDA_VISIBLE_DEVICES"] == "0,1", "as Slurm set it"
        assert env["FROM_THE_CONTROLLER"] == "kept" and env["MUSTER_GANG"] == f"{bench.job}/1/1"
        assert not {"MUSTER_TOKEN", "MUSTER_DATABASE", "SLURM_RESTART_COUNT", "OF_THE_CONTROLLER"} & set(env)
    assert "AWS_BATCH_JOB_MAIN_NODE_PRIVATE_IPV4_ADDRESS" not in reported[1]


def test_a_node_sees_its_gpus_alone_and_each_job_has_a_port(bench: SlurmBench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "7")
    script = f'echo "gpus[$CUDA_VISIBLE_DEVICES] port $MASTER_PORT"; {WAIT}'
    pin = {"nodelist": "n1"}
    gangs = [bench.gang(script, options=pin, suffix=suffix) for suffix in ("", "2")]
    for gang in gangs:
        bench.launch(gang)
    for gang in gangs:
        bench.ready(gang)
    lines = [bench.log(job=gang.job)[0] for gang in gangs]
    assert all(line.startswith("gpus[] port ") for line in lines) and lines[0] != lines[1], lines


def test_a_controller_that_was_killed_after_sbatch_finds_the_job_that_it_submitted(bench: SlurmBench) -> None:
    gang = bench.gang(nodes=2)
    handle = bench.launch(gang)
    successor = bench.new_engine()
    assert successor.launch(successor.plan(gang)) == handle, "found, not submitted twice"
    bench.ready(gang)
    assert all(node.running for node in status_of(SlurmEngine(), handle)) or wait_for(
        lambda: all(node.running and not node.words for node in status_of(successor, handle)), 10, "known by its handle"
    )
    bench.engine.stop(handle, 0.0)
    assert successor.launch(successor.plan(gang)) == handle, "an ended one, too"
    assert bench.cluster.run("squeue", "-h", "-t", "all", "-o", "%k").split().count(gang.name) == 1


def test_a_gang_that_slurm_has_forgotten_is_not_started_again_and_has_ended(bench: SlurmBench) -> None:
    handle = bench.launch(bench.gang("exit 0"))
    bench.ended(handle)
    facts = {**handle.facts, "slurm": "999999"}
    assert [node.exit_code for node in poll(Handle("slurm", "forgotten/1/1", 1, facts))] == [0]
    forgotten = Handle("slurm", "forgotten/1/1", 1, {**facts, "job": "another"})
    [node] = poll(forgotten)
    assert (node.running, node.words) == (False, "Slurm has forgotten the job, and the node left no outcome")
    bench.engine.stop(forgotten, 1.0)


def poll(handle: Handle) -> list[NodeStatus]:
    """The status that a new engine, without a memory, gets from Slurm."""
    engine = SlurmEngine()
    return wait_for(
        lambda: status if not (status := list(status_of(engine, handle)))[0].running else None, 10, "an answer"
    )


def test_a_gang_waits_for_room_with_slurm_s_reason(bench: SlurmBench) -> None:
    big = bench.ready(bench.gang(nodes=3, cpus=4))
    small = bench.launch(bench.gang(cpus=4, suffix="2"))

    def waits(text: str, handle: Handle = small) -> bool:
        [first, *_] = status_of(bench.engine, handle)
        return first.running and not first.address and text in first.words

    wait_for(lambda: waits("waits for nodes to become free (Resources; job"), 20, "its reason")
    many = bench.launch(bench.gang(nodes=4, suffix="4"))
    wait_for(lambda: waits("more nodes than the partition has", many), 20, "its reason")
    closed = bench.launch(bench.gang(suffix="5", options={"partition": "closed"}))
    wait_for(lambda: waits("the partition is down", closed), 20, "its reason")
    long = bench.launch(bench.gang(suffix="6", options={"partition": "short"}, timeout=3600))
    wait_for(lambda: waits("more time than the partition allows", long), 20, "its reason")
    bench.cluster.run("scancel", closed.facts["slurm"])
    [node] = bench.ended(closed)
    assert node.words.startswith("cancelled in Slurm (scancel), not by Muster (job "), node
    bench.engine.stop(small, 5.0)
    assert bench.state(small) == "CANCELLED" and not status_of(bench.engine, small)[0].running
    bench.engine.stop(big, 0.0)


UNEQUAL = {"nodes": 2, "placements": [Placement("a", (), 1, 64), Placement("b", (), 1, 128)]}
MOUNTED = {"volumes": [{"name": "v", "host": {"sourcePath": "/data"}}]}
MOUNTED["mountPoints"] = [{"sourceVolume": "v", "containerPath": "/mnt"}]


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        (
            {"options": {"partition": "gpu"}},
            "partition gpu: invalid partition specified: gpu; .*Invalid partition name",
        ),
        ({"gpus": 3}, "Slurm refuses the job: .*Requested node configuration is not available"),
        ({"cpus": 5}, "Slurm refuses the job: .*Requested node configuration is not available"),
        ({"options": {"nice": "much"}}, "muster:nice is 'much', not an integer"),
        ({"title": "a\nb"}, "title .* has a control character"),
        (UNEQUAL, "Slurm requires identical nodes, these differ .*64 MiB.*128 MiB"),
        ({"containers": [MOUNTED]}, "volume /mnt: the slurm engine mounts nothing"),
    ],
)
def test_a_gang_that_slurm_refuses_is_refused_in_one_line(bench: SlurmBench, changes: dict[str, Any], why: str) -> None:
    with pytest.raises(EngineError, match=why) as refused:
        bench.launch(bench.gang(**changes))
    assert "\n" not in str(refused.value) and not isinstance(refused.value, NotYet)
    assert not bench.cluster.run("squeue", "-h")


def test_the_script_has_the_options_of_the_queue_and_of_the_job(bench: SlurmBench) -> None:
    options = {"partition": "urgent", "qos": "high", "gpu": "a100", "nice": "100", "hosts": "x"}
    facts = {"timeout": 3600, "priority": 30, "title": 'my "job" é', "bus": "tcp/1", "bus_token": "secret"}
    gang = bench.gang(nodes=2, gpus=2, options=options, **facts)
    document = bench.engine.plan(gang).document
    for line in (
        *('--job-name="my \\"job\\" é"', f"--comment={gang.name}", "--nodes=2", "--ntasks-per-node=1", "--mem=64M"),
        *("--gpus-per-node=a100:2", "--partition=urgent", "--qos=high", "--nice=70", "--time=62"),
        *("--signal=B:USR1@35", "--open-mode=append", "--no-requeue"),
    ):
        assert f"#SBATCH {line}\n" in document, document
    assert "secret" not in document
    timed = dataclasses.replace(gang, options={"time": "0:20:00"})
    assert "#SBATCH --time=0:20:00\n" in bench.engine.plan(timed).document


def test_slurm_gets_the_script_of_the_plan(bench: SlurmBench) -> None:
    gang = bench.gang(nodes=2, bus="tcp/127.0.0.1:1", bus_token="the credential")
    plan = bench.engine.plan(gang)
    handle = bench.ready(gang)
    has = bench.cluster.run("scontrol", "write", "batch_script", handle.facts["slurm"], "-")
    assert has.strip() == plan.request.script.strip() and "the credential" in has
    assert handle.facts["output"] == plan.request.output
    assert plan.document == plan.request.script.replace("the credential", "\\u2026"), "all of it but the credential"


def test_a_gang_that_does_not_heed_sigterm_gets_sigkill_after_the_grace(bench: SlurmBench) -> None:
    stubborn = bench.ready(bench.gang(STUBBORN, grace=60.0))
    requested = time.monotonic()
    assert bench.stopped(stubborn, 1.0) == [137]
    assert time.monotonic() - requested > 0.9


def test_a_gang_that_is_stopped_while_it_starts_leaves_nothing(bench: SlurmBench) -> None:
    for number, pause in enumerate((0.0, 0.3, 0.6)):
        handle = bench.launch(bench.gang(nodes=2, suffix=str(number)))
        time.sleep(pause)
        bench.engine.stop(handle, 3.0)
        assert not bench.processes() and not any(n.running for n in status_of(bench.engine, handle))


def test_a_directory_missing_on_a_node_is_one_line_with_the_node_s_name(bench: SlurmBench) -> None:
    nowhere = bench.launch(bench.gang(nodes=2, directory="/no/such/place"))
    # what a node with another disk at the store's path finds: no such epoch
    other = bench.start(bench.gang(nodes=1, epoch=2, suffix="2"))
    for node, name in zip(bench.ended(nowhere), NODES, strict=False):
        assert node.exit_code == 2
        assert node.words == f"muster: node {name}: [Errno 2] No such file or directory: '/no/such/place'"
    [node] = bench.ended(other)
    assert node.exit_code == 2 and node.words.startswith(f"muster supervisor: store {bench.store.path} on "), node
    assert " is not the controller's: run run has epoch 1 there, not 2" in node.words


def test_a_first_node_without_python_or_store_is_one_line(bench: SlurmBench, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(sys, "executable", "/no/python")
        handle = bench.launch(bench.gang(nodes=2))
    for node in bench.ended(handle):
        assert not node.running and node.words.endswith("/no/python: No such file or directory"), node
    plan = bench.engine.plan(bench.gang(suffix="2"))
    elsewhere = plan.request.script.replace(plan.request.output, "/nowhere/slurm.out")
    request = dataclasses.replace(plan.request, script=elsewhere)
    [node] = bench.ended(bench.engine.launch(dataclasses.replace(plan, request=request)))
    assert node.words.startswith("Slurm could not start it on n1: is ")
    assert "file system that all nodes share" in node.words


LIMIT = "QOSMaxCpuPerUserLimit"
DOWN = "Slurm: nodes that it needs are down, drained or reserved"


@pytest.mark.parametrize(
    ("state", "reason", "words"),
    [
        ("PENDING", LIMIT, f"Slurm: a limit of the account or QOS is reached ({LIMIT}; job 5)"),
        ("PENDING", "ReqNodeNotAvail, UnavailableNodes:n1", DOWN),
        (
            "PENDING",
            "Nodes required for job are DOWN, DRAINED or reserved for jobs in higher priority partitions",
            DOWN,
        ),
        ("PENDING", "SomethingNew", "Slurm: waits (SomethingNew; job 5)"),
        ("CONFIGURING", "None", "Slurm: n1 is being made ready (job 5)"),
    ],
)
def test_slurm_s_reason_for_a_waiting_job_is_put_into_words(state: str, reason: str, words: str) -> None:
    assert waiting(SlurmJob("5", state, reason, "n1", "")).startswith(words)
