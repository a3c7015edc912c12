"""The local engine: real supervisors on this machine, found again, distinguished, and gone when they are stopped."""

from __future__ import annotations

import ipaddress
import json
import os
import signal
import socket
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from orchestrator.domain.hosts import Placement
from orchestrator.engines.api import Cause, EngineError, Gang, Handle
from orchestrator.engines.local.engine import LocalEngine
from orchestrator.engines.toolkit.statuses import status_of
from shared_store.process.processes import children, end_all, find_process, marked
from shared_store.volume.epoch import raise_epoch
from tests.conftest import wait_for
from tests.support import processes
from tests.support.engines.bench import Bench
from tests.support.engines.sites import STUBBORN, WAIT
from tests.support.processes import alive, command, frozen

_JOB = f"local-engine-job-{os.getpid()}"
"""One for all tests of this process and no other, since the engine finds gangs by their names on the whole machine."""


class LocalBench(Bench):
    engine: LocalEngine

    def __init__(self, home: Path) -> None:
        super().__init__(home, job=_JOB)

    def new_engine(self) -> LocalEngine:
        return LocalEngine(self.home / "home", cpus=8, gpus=["0", "1", "2", "3"])

    def gang(self, script: str = WAIT, nodes: int = 2, *, suffix: str = "", **changes: Any) -> Gang:
        return super().gang(script, nodes, suffix=suffix, **{"directory": str(self.home), **changes})

    def printed(self, attempt: int = 1) -> list[tuple[int, str]]:
        """(node, text) of what the ranks printed."""
        return [(line.node, line.text) for line in self.lines(attempt) if line.rank is not None]

    def environments(self, gang: Gang) -> list[dict[str, str]]:
        """What a gang that prints its environment as JSON printed, by node index."""
        found: dict[int, dict[str, str]] = {node: json.loads(text) for node, text in self.printed(gang.attempt)}
        return [found[index] for index in range(len(gang.nodes))]

    def close(self) -> None:
        """End all that is left, without the engine: a test may have broken it."""
        processes.end_all(self.store.path)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[LocalBench]:
    found = LocalBench(tmp_path)
    yield found
    found.close()


def pids(handle: Handle) -> list[int]:
    return [node["pid"] for node in handle.facts["nodes"]]


def test_what_is_started_is_the_request_of_the_plan(bench: LocalBench) -> None:
    gang = bench.gang(nodes=2, placements=[Placement("localhost", ("2",), 1, 64), Placement("localhost", (), 1, 64)])
    plan = bench.engine.plan(gang)
    handle = bench.ready(gang)
    for pid, node in zip(pids(handle), plan.request, strict=True):
        raw = Path(f"/proc/{pid}/environ").read_bytes().decode().split("\0")
        found = dict(item.split("=", 1) for item in raw if item)
        # the port is the first free one, of those that begin with the planned one
        assert found.pop("MASTER_PORT") >= node.environment["MASTER_PORT"]
        assert found == {name: value for name, value in node.environment.items() if name != "MASTER_PORT"}
        assert Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")[:-1] == list(node.command)
        assert os.readlink(f"/proc/{pid}/cwd") == node.directory


def test_a_supervisor_that_has_not_begun_yet_is_not_taken_for_its_shim(bench: LocalBench, tmp_path: Path) -> None:
    """Between its fork and its exec it has the shim's command line and environment."""
    gang = bench.gang(nodes=1)
    request = bench.engine.plan(gang).request[0]
    program = tmp_path / "shim.py"
    program.write_text("import os, time\nif os.fork(): os.wait()\nelse: time.sleep(600)\n")
    line = [*request.command[:3], str(program), *request.command[4:]]
    shim = subprocess.Popen(line, env={**request.environment, "MASTER_PORT": "1"}, start_new_session=True)
    try:
        [child] = wait_for(lambda: children(shim.pid), 20, "the fork")
        found = LocalEngine(tmp_path).launch(bench.engine.plan(gang))
        assert pids(found) == [shim.pid] != [child]
    finally:
        end_all(lambda: marked([f"MUSTER_GANG={gang.name}"]))
        shim.wait()


# -- capacity and plan ------------------------------------------------------------------------------------------------


def test_the_machine_is_the_only_host_with_its_configured_resources(monkeypatch: pytest.MonkeyPatch) -> None:
    [host] = LocalEngine(Path("/nowhere"), cpus=6, gpus=["2", "5"]).capacity().machines
    assert (host.name, host.cpus, host.gpus) == ("localhost", 6, ("2", "5"))
    assert host.memory == os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20
    for visible, gpus in (("1,3", ("1", "3")), ("", ())):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
        [host] = LocalEngine(Path("/nowhere")).capacity().machines
        assert (host.cpus, host.gpus) == (float(os.cpu_count() or 1), gpus), "the machine's own"


def test_every_node_has_a_loopback_address_of_its_own_and_all_know_the_main_node_s(bench: LocalBench) -> None:
    gang = bench.gang(nodes=4, main=2)
    plan = bench.engine.plan(gang)
    contracts = [node.contract for node in plan.nodes]
    addresses = [contract.address or "" for contract in contracts]
    assert len(set(addresses)) == 4 and {contract.master_address for contract in contracts} == {addresses[2]}
    for address in addresses:
        with socket.socket() as probe:
            probe.bind((address, 0))
    another = bench.engine.plan(bench.gang(attempt=2)).nodes
    assert not {node.contract.address for node in another} & set(addresses)
    many = {node.contract.address or "" for node in bench.engine.plan(bench.gang(nodes=1000)).nodes}
    assert len(many) == 1000 and all(ipaddress.IPv4Address(each).is_loopback for each in many), "Batch allows no more"
    ports = {bench.engine.plan(bench.gang(suffix=f"-{i}")).nodes[0].contract.master_port for i in range(2)}
    assert len(ports) == 2, "gangs that start at once"
    assert bench.engine.plan(gang) == plan and bench.processes() == [], "a plan starts nothing"


# -- what a node gets -------------------------------------------------------------------------------------------------

PRINT_ENVIRONMENT = "import json, os; print(json.dumps(dict(os.environ)))"


def test_nodes_get_contract_environment_and_gpus(bench: LocalBench, monkeypatch: pytest.MonkeyPatch) -> None:
    own = (
        *("MUSTER_TOKEN", "MUSTER_URL", "MUSTER_DATABASE", "PGPASSWORD"),
        *("AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "RAY_AUTH_TOKEN", "SLURM_JWT"),  # of the other engines
        "UNKNOWN",
    )
    for name in own:
        monkeypatch.setenv(name, "/the/controller's/own")
    monkeypatch.setenv("INHERITED", "yes")
    monkeypatch.setenv("MUSTER_INHERIT", "INHERITED PGPASSWORD")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "the controller's")
    gang = bench.gang(
        nodes=2,
        main=1,
        commands=[["python", "-c", PRINT_ENVIRONMENT]] * 2,
        environments=[
            {"MINE": "first", "AWS_ACCESS_KEY_ID": "the job's", "MUSTER_EPOCH": "99", "RANK": "99"},
            {"MINE": "second", "INHERITED": "no"},
        ],
        placements=[Placement("localhost", ("3", "1"), 2, 64), Placement("localhost", (), 0.5, 64)],
        attempt=4,
        epoch=7,
        job_epoch=5,
        queue="gpu",
    )
    bench.ended(bench.launch(gang))
    plan = bench.engine.plan(gang)
    for index, found in enumerate(bench.environments(gang)):
        expected = plan.nodes[index].contract.to_env()
        del expected["MASTER_PORT"]
        assert {name: found.get(name) for name in expected} == expected
        assert not found.keys() & set(own)
        assert "WARP_CACHE_PATH" in found
    first, second = bench.environments(gang)
    assert (first["MINE"], second["MINE"]) == ("first", "second")
    assert (first["INHERITED"], second["INHERITED"]) == ("yes", "no")
    assert (first["AWS_ACCESS_KEY_ID"], second.get("AWS_ACCESS_KEY_ID")) == ("the job's", None)
    assert (first["CUDA_VISIBLE_DEVICES"], second["CUDA_VISIBLE_DEVICES"]) == ("3,1", "")
    assert (first["RANK"], second["RANK"]) == ("1", "0"), "the main node has rank 0, whatever its index"
    assert first["MUSTER_EPOCH"] == "7", "a job's environment can't replace the contract"
    assert first["MASTER_PORT"] == second["MASTER_PORT"]
    main = "AWS_BATCH_JOB_MAIN_NODE_PRIVATE_IPV4_ADDRESS"
    assert (first.get(main), second.get(main)) == (first["MASTER_ADDR"], None)


def test_a_gang_starts_completely_or_not_at_all(bench: LocalBench) -> None:
    with pytest.raises(ValueError, match="null"):
        bench.launch(bench.gang(commands=[["sh", "-c", WAIT], ["sh", "-c", "a zero byte: \0"]]))
    assert bench.processes() == []


def test_one_rank_is_started_for_each_gpu_of_a_native_job(bench: LocalBench) -> None:
    gang = bench.gang("echo $RANK of $WORLD_SIZE", ranks=[2, 2])
    bench.ended(bench.launch(gang))
    assert sorted(bench.printed()) == [(0, "0 of 4"), (0, "1 of 4"), (1, "2 of 4"), (1, "3 of 4")]


def test_a_job_s_directory_and_modules_are_its_own_and_hide_none_of_ours(bench: LocalBench, tmp_path: Path) -> None:
    directory = tmp_path / "mine"
    (directory / "worker").mkdir(parents=True)
    (directory / "worker" / "__init__.py").write_text("raise SystemExit('the wrong worker')")
    (tmp_path / "queue.py").write_text("MINE = True")
    script, variables = "pwd; python -c 'import queue; print(queue.MINE)'", {"PYTHONPATH": str(tmp_path)}
    bench.ended(bench.launch(bench.gang(script, nodes=1, directory=str(directory), environments=[variables])))
    assert bench.printed() == [(0, str(directory)), (0, "True")]


def test_a_directory_that_is_not_there_is_refused_before_anything_starts(bench: LocalBench) -> None:
    with pytest.raises(EngineError, match=r"^working directory /no/such/place is not on this machine$"):
        bench.launch(bench.gang(directory="/no/such/place"))
    assert bench.processes() == []


@pytest.mark.parametrize("address", ["127.0.0.1", ""])
def test_a_port_that_is_in_use_at_any_address_is_not_given_to_the_gang(bench: LocalBench, address: str) -> None:
    gang = bench.gang("echo $MASTER_PORT")
    first = bench.engine.plan(gang).nodes[0].contract.master_port
    with socket.socket() as taken:  # a program that calls init_process_group listens at all addresses
        taken.bind((address, first))
        taken.listen()
        bench.ended(bench.launch(gang))
    assert sorted(bench.printed()) == [(0, f"{first + 1}"), (1, f"{first + 1}")]


# -- launching and observing ------------------------------------------------------------------------------------------


def test_launching_again_starts_only_the_node_that_is_missing(bench: LocalBench) -> None:
    gang = bench.gang(nodes=2)
    handle = bench.ready(gang)
    before = sorted(bench.processes())
    assert bench.launch(gang) == handle == bench.launch(gang, bench.new_engine()), "none is, here"
    assert sorted(bench.processes()) == before
    os.kill(pids(handle)[1], signal.SIGKILL)
    wait_for(lambda: not status_of(bench.engine, handle)[1].running, 5, "the end of node 1")
    again = bench.launch(gang)
    assert pids(again)[0] == pids(handle)[0]
    assert pids(again)[1] != pids(handle)[1]
    assert [node.running for node in status_of(bench.engine, again)] == [True, True]


def test_a_node_that_is_started_later_gets_the_port_of_those_that_run(bench: LocalBench) -> None:
    listen = (
        "import os, socket, time; s = socket.socket(); s.bind((os.environ['MASTER_ADDR'], int(os.environ['MASTER_PORT'])))"
        " if os.environ['RANK'] == '0' else None; s.listen() if os.environ['RANK'] == '0' else None;"
        " print('port', os.environ['MASTER_PORT'], flush=True); time.sleep(600)"
    )
    gang = bench.gang(commands=[["python", "-c", listen]] * 2)
    handle = bench.launch(gang)
    wait_for(lambda: len(bench.printed()) == 2, 10, "two nodes")
    os.kill(pids(handle)[1], signal.SIGKILL)
    wait_for(lambda: not status_of(bench.engine, handle)[1].running, 5, "the end of node 1")
    bench.launch(gang)
    wait_for(lambda: len(bench.printed()) == 3, 10, "node 1 again")
    assert len({text for _, text in bench.printed()}) == 1


def test_a_pid_that_was_given_to_another_process_is_not_taken_for_the_node(bench: LocalBench) -> None:
    handle = bench.ready(bench.gang(nodes=1))
    [node] = handle.facts["nodes"]
    other = replace(handle, facts={"nodes": [{**node, "start": "1"}]})
    assert not status_of(bench.new_engine(), other)[0].running


def test_output_of_a_supervisor_before_it_reaches_the_store_is_reported(bench: LocalBench) -> None:
    raise_epoch(bench.run, 5)
    handle = bench.launch(bench.gang(nodes=1, epoch=4))
    [node] = bench.ended(handle)
    output = "muster supervisor: run run: this attempt has epoch 4, the run now belongs to epoch 5; leaving"
    assert (node.exit_code, node.words) == (3, output)
    assert status_of(bench.new_engine(), handle) == [node], "a later controller knows it, too"


# -- stopping ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stopper", [lambda bench: bench.engine, LocalBench.new_engine], ids=["same", "new"])
def test_stopping_leaves_no_process_at_all(bench: LocalBench, stopper: Callable[[LocalBench], LocalEngine]) -> None:
    stubborn = f'setsid sh -c "trap \\"\\" TERM; sleep 600" & (setsid sleep 600 &); {STUBBORN}'
    handle = bench.ready(bench.gang(stubborn))
    assert len(bench.processes()) >= 8
    stopper(bench).stop(handle, 0.5)
    assert bench.processes() == []


def test_stopping_ends_what_a_dead_supervisor_left_behind(bench: LocalBench) -> None:
    handle = bench.ready(bench.gang(f"setsid sleep 600 & {WAIT}", nodes=1))
    os.kill(pids(handle)[0], signal.SIGKILL)
    [node] = bench.ended(handle)
    assert (node.exit_code, node.cause) == (137, Cause.SIGNAL)
    assert [pid for pid in bench.processes() if "600" in command(pid)], "there is something to end"
    bench.engine.stop(handle, 5.0)
    assert bench.processes() == []


def test_stopping_ends_what_took_the_gang_s_name_out_of_its_environment(bench: LocalBench) -> None:
    escape = "env -i setsid sh -c 'echo escaped $$; exec sleep 600' & (env -i setsid sh -c 'echo escaped $$; exec sleep 600' &) ; "
    handle = bench.ready(bench.gang(f"{escape}{STUBBORN}", nodes=1))
    wait_for(lambda: len(escaped(bench)) == 2, 10, "two processes that escaped")
    bench.engine.stop(handle, 0.5)
    assert bench.processes() == [] and not any(alive(pid) for pid in escaped(bench))


def escaped(bench: LocalBench) -> list[int]:
    return [int(text.split()[1]) for _, text in bench.printed() if text.startswith("escaped ")]


def test_a_gang_with_an_unkillable_process_is_not_stopped(bench: LocalBench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shared_store.process.node_processes.end_all", lambda find, strike: end_all(find, 0.5, strike))
    handle = bench.ready(bench.gang(f"env -i setsid sh -c 'echo escaped $$; exec sleep 600' & {WAIT}", nodes=1))
    wait_for(lambda: escaped(bench), 10, "the process")
    [stubborn] = escaped(bench)
    wait_for(lambda: (process := find_process(stubborn)) and process.name == "sleep", 10, "it sleeps")
    with frozen(stubborn):
        for _ in range(2):  # it is asked again
            with pytest.raises(EngineError, match=rf"^SIGKILL does not end process {stubborn} \(sleep\), state D"):
                bench.engine.stop(handle, 1.0)
    bench.engine.stop(handle, 5.0)
    assert not alive(stubborn) and bench.processes() == []


def test_nothing_is_kept_of_a_gang_that_was_stopped(bench: LocalBench) -> None:
    raise_epoch(bench.run, 5)
    gangs = [bench.gang(), *(bench.gang(nodes=1, epoch=epoch, suffix=f"-{epoch}") for epoch in (5, 4))]
    handles = [bench.launch(gang) for gang in gangs]
    bench.ended(handles[2])
    for handle in handles:
        bench.engine.stop(handle, 5.0)
    assert status_of(bench.engine, handles[2])[0].words.startswith(
        "muster supervisor: run run: this attempt has epoch 4"
    )
    assert list((bench.home / "home" / "supervisors").iterdir()) == []
    assert not bench.engine._children


# -- memory -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("blow", ["none", "supervisor", "shim", "shim and supervisor"])
def test_no_memory_group_is_left_whatever_dies(bench: LocalBench, blow: str) -> None:
    gang = bench.gang(nodes=2, isolated=True, directory=None)
    groups = [node.contract.memory_group for node in bench.engine.plan(gang).nodes]
    if not all(groups):
        pytest.skip("this process can't limit memory: run the test as root, or in a delegated group")
    handle = bench.ready(gang)
    assert all(os.path.isdir(group) for group in groups) and len(set(groups)) == 2
    shim = pids(handle)[0]
    [supervisor] = children(shim)
    killed = {"supervisor": [supervisor], "shim": [shim], "shim and supervisor": [shim, supervisor]}.get(blow, [])
    for pid in killed:
        os.kill(pid, signal.SIGKILL)
    bench.engine.stop(handle, 1.0)
    assert [group for group in groups if os.path.exists(group)] == [] and bench.processes() == []


def test_a_gang_of_a_job_from_yaml_is_not_limited(bench: LocalBench) -> None:
    assert {node.contract.memory_group for node in bench.engine.plan(bench.gang()).nodes} == {""}
