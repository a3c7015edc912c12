"""The bus: presence, commands, and each trap that Zenoh has laid before, with a test that would have caught it."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from orchestrator.control.bus import Bus, BusError
from shared_store.contract.bus import LEASE_MILLISECONDS, LONGEST_ANSWER
from shared_store.contract.node import NodeContract
from tests.conftest import PATIENCE, REPOSITORY, Serving, wait_for
from tests.support.faults.outages import cut, partition
from tests.support.processes import gang_members, processes_of
from tests.support.worker.cartpole import raw_iterations, submit, wait_for_iteration
from tests.support.worker.node import node_contract
from worker.node import bus as node_bus
from worker.node.bus import NodeBus

NODE = """
import os, sys, time
from shared_store.contract.node import NodeContract
from worker.node import bus as node_bus
from worker.node.bus import NodeBus
node_bus.LEASE_MILLISECONDS = {lease}
read, write = os.pipe2(os.O_NONBLOCK)
bus = NodeBus(NodeContract(job="j", attempt=1, node_index={index}, node_count=2, main_index=0, master_address="127.0.0.1",
    master_port=1, run="r", store="/", epoch=1, job_epoch=1, bus={endpoint!r}, bus_token={token!r}), write)
bus.tend(None)
"""


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[Bus]:
    bus = Bus(tmp_path, {})
    bus.open()
    bus.expect("j", 1, nodes=2)
    yield bus
    bus.close()


def start_node(bus: Bus, then: str, index: int = 0, lease: int = LEASE_MILLISECONDS) -> subprocess.Popen[bytes]:
    """A process with a node's session that goes on with ``then``."""
    script = NODE.format(index=index, endpoint=bus.endpoint, token=bus.token("j", 1), lease=lease) + then
    process = subprocess.Popen([sys.executable, "-c", script], cwd=REPOSITORY)
    wait_for(lambda: bus.presence.met(("j", 1, index)), 20, "the node's token")
    return process


def contract(bus: Bus, index: int = 0) -> NodeContract:
    return node_contract(bus.endpoint, bus.token("j", 1), index)


def test_a_killed_node_is_noticed_by_its_connection_long_before_its_lease_ends(bus: Bus) -> None:
    node = start_node(bus, "time.sleep(600)", lease=3_600_000)
    assert bus.presence.silence(("j", 1, 0), None) is None
    noticed = threading.Event()
    bus.changed = lambda job: noticed.set()
    node.kill()
    assert noticed.wait(20 * PATIENCE)
    assert bus.presence.silence(("j", 1, 0), None) is not None
    node.wait()


def test_a_frozen_node_is_noticed_by_its_lease_and_welcomed_back(bus: Bus) -> None:
    node = start_node(bus, "time.sleep(60)")
    node.send_signal(signal.SIGSTOP)
    wait_for(lambda: bus.presence.silence(("j", 1, 0), None) is not None, 6, "the loss of the frozen node")
    node.send_signal(signal.SIGCONT)
    wait_for(lambda: bus.presence.silence(("j", 1, 0), None) is None, 10, "its return")
    node.kill()
    node.wait()


def test_a_cut_network_takes_the_controller_s_own_session_away_with_its_only_node(bus: Bus) -> None:
    node = start_node(bus, "time.sleep(600)")
    assert bus.endpoint is not None
    bus.presence.lost_after = 4.0  # less than from the node's silence to Zenoh's own lease of 10 s
    with cut(bus.endpoint.rpartition(":")[2]):
        wait_for(lambda: bus.presence.silence(("j", 1, 0), 0.0) is not None, 6, "the silence of the node")
        for _ in range(80):
            silence = bus.presence.silence(("j", 1, 0), 0.0)
            assert silence is not None and not silence.is_lost
            time.sleep(0.1)
    wait_for(lambda: bus.presence.silence(("j", 1, 0), 0.0) is None, 20, "the node's return")
    node.kill()
    node.wait()


def test_a_cut_network_of_a_dozen_gangs_is_noticed_at_once_and_ends_none(tmp_path: Path) -> None:
    """By default Zenoh removes sessions that vanish two at a time, 10 s each: meanwhile the last ones would count as heard."""
    end = tmp_path / "end"
    script = f"import os, time\nwhile not os.path.exists({str(end)!r}): time.sleep(0.1)"
    server = Serving(tmp_path / "home", "--cpus", "16", "--lost-after", "10s")
    try:
        jobs = [server.gang(script) for _ in range(12)]
        for job in jobs:
            wait_for(lambda job=job: server.muster("stacks", job).returncode == 0, 60, "the node on the bus")
        with partition(SimpleNamespace(path=server.home)):
            wait_for(
                lambda: all("12 of 12 nodes fell silent within 10 s" in _reason(server, job) for job in jobs),
                40,
                "the cut",
            )
            time.sleep(15.0)  # longer than lost_after
        wait_for(lambda: not any("unreachable" in _reason(server, job) for job in jobs), 60, "their return")
        end.touch()
        ended = [server.wait(job) for job in jobs]
        assert [(each["status"], len(each["attempts"])) for each in ended] == [("SUCCEEDED", 1)] * 12
    finally:
        server.close()


def _reason(server: Serving, job: str) -> str:
    return str(server.detail(job)["statusReason"])


def test_a_node_whose_main_thread_fails_ends_at_once_with_its_own_exit_code(bus: Bus) -> None:
    node = start_node(bus, "time.sleep(0.5); raise SystemExit(7)")
    assert node.wait(5 * PATIENCE) == 7, "an open session must not keep a failed process alive"


def test_commands_arrive_while_nobody_reads_the_telemetry(bus: Bus) -> None:
    """A default channel that nobody reads blocks the whole session: ours have none, and commands only queue."""
    then = (
        "progress = {'iteration': 1, 'fill': 'x' * 1000}\n"
        "for i in range(5000): bus._next_progress = 0; bus.tend(progress)\n"
        "bus.commands.get().reply('heard'); time.sleep(60)"
    )
    node = start_node(bus, then)
    assert bus.command("j", 1, 0, "checkpoint", 20) == "heard"
    node.kill()
    node.wait()


def test_a_command_to_a_node_that_does_not_answer_ends_in_time_and_says_so(bus: Bus) -> None:
    node = start_node(bus, "time.sleep(60)")
    with pytest.raises(BusError, match="node 0 did not answer within 1 s"):
        bus.command("j", 1, 0, "stacks", 1)
    with pytest.raises(BusError, match="did not answer"):
        bus.command("nobody", 1, 0, "stacks", 1)
    node.kill()
    node.wait()


def test_an_answer_that_is_too_long_for_the_router_comes_in_part(bus: Bus) -> None:
    node = start_node(bus, "bus.commands.get().reply('é' * 5_000_000); time.sleep(60)")
    assert bus.command("j", 1, 0, "stacks", 20) == "é" * LONGEST_ANSWER
    node.kill()
    node.wait()


def test_publishing_never_waits_for_a_router_that_hangs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With blocking congestion control a slow reader stops the writer for 5 s, after which Zenoh gives the connection up; ours drops."""
    monkeypatch.setattr(node_bus, "LEASE_MILLISECONDS", 3_600_000)
    script = f"import sys, time; from pathlib import Path; from orchestrator.control.bus import Bus; b = Bus(Path({str(tmp_path)!r}), {{}}); b.open(); print(b.endpoint, b.token('j', 1), flush=True); time.sleep(60)"
    router = subprocess.Popen([sys.executable, "-c", script], cwd=REPOSITORY, stdout=subprocess.PIPE, text=True)
    assert router.stdout is not None
    endpoint, token = router.stdout.readline().split()
    _, write = os.pipe2(os.O_NONBLOCK)
    node = NodeBus(node_contract(endpoint, token), write)
    node.tend(None)
    router.send_signal(signal.SIGSTOP)
    for _ in range(3000):
        node._next_progress = 0.0
        node.tend({"iteration": 1, "fill": "x" * 10_000})
    assert node._session is not None and list(node._session.info.links()), "the connection was given up"
    router.kill()
    router.wait()
    node.close()


def test_the_router_listens_on_loopback_only_and_wants_the_password(bus: Bus) -> None:
    assert bus.endpoint is not None
    port = int(bus.endpoint.rpartition(":")[2])
    listening = []
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            address, state = line.split()[1], line.split()[3]
            if state == "0A" and int(address.rpartition(":")[2], 16) == port:
                listening.append(address.rpartition(":")[0])
    assert listening == ["0100007F"]
    node = NodeBus(node_contract(bus.endpoint, "wrong"), 1)
    node.tend(None)
    assert node._session is None
    assert (bus._home / "bus-users").stat().st_mode & 0o777 == 0o600


def test_two_routers_on_one_machine_do_not_see_each_others_nodes(bus: Bus, tmp_path: Path) -> None:
    other = Bus(tmp_path / "other", {})
    other._home.mkdir()
    other.open()
    other.expect("j", 1, nodes=2)
    nodes = [start_node(each, "time.sleep(600)", index) for index, each in enumerate((bus, other))]
    assert [[each.presence.met(("j", 1, index)) for index in (0, 1)] for each in (bus, other)] == [
        [True, False],
        [False, True],
    ]
    assert other.endpoint != bus.endpoint
    for node in nodes:
        node.kill()
        node.wait()
    other.close()


def test_processes_started_after_the_session_opened_work(bus: Bus) -> None:
    """A forked copy of a session receives nothing, and a second open hangs in it: everything we start is executed anew."""
    _, write = os.pipe2(os.O_NONBLOCK)
    node = NodeBus(contract(bus), write)
    node.tend(None)
    child = start_node(bus, "time.sleep(60)", index=1)
    assert bus.presence.silence(("j", 1, 1), None) is None
    child.kill()
    child.wait()
    node.close()


def test_training_does_not_notice_a_controller_that_is_killed_and_comes_back(server: Serving) -> None:
    # no save but the one that is asked for: a later one would end its retention
    job = submit(server, "train.iterations=100000", "nodes=1", "checkpoint.every=100000")
    wait_for_iteration(server, job["run"], 5)
    before = set(processes_of(server.home))
    server.kill()
    reached = _iteration(server, job["run"])
    wait_for(lambda: _iteration(server, job["run"]) > reached + 10, 30, "progress without a controller")
    server.start()
    wait_for(lambda: server.muster("stacks", job["id"]).returncode == 0, 30, "the node on the new router")
    message = server.muster("checkpoint", job["id"]).stdout
    saved = re.fullmatch(r"checkpoint (\d{8})-e1\n", message)
    assert saved, message
    names = [each["name"] for each in server.client.get(f"/api/runs/{job['run']}/checkpoints")]
    assert f"{saved[1]}-e1" in names
    stacks = server.muster("stacks", job["id"]).stdout
    assert "MainThread" in stacks and "(worker/train.py:" in stacks, stacks
    detail = server.detail(job["id"])
    assert len(detail["attempts"]) == 1 and set(processes_of(server.home)) == before
    assert server.muster("stop", job["id"]).returncode == 0


def test_after_a_restart_a_node_that_does_not_come_is_named_until_it_does(server: Serving) -> None:
    job = server.gang("import time; time.sleep(600)")
    server.wait(job, "RUNNING")
    wait_for(lambda: server.detail(job)["attempts"][0]["nodes"][0].get("met"), 30, "the node on the bus")
    [supervisor] = gang_members(server.home, "supervisor", 0)
    supervisor.strike(signal.SIGSTOP)
    server.kill()
    server.start()
    missing = r"attempt 1 runs on 1 node; the main node has been unreachable since [0-9:]{8} UTC \(it has not come to this controller"
    wait_for(lambda: re.match(missing, server.detail(job)["statusReason"]), 60, "the missing node")
    supervisor.strike(signal.SIGCONT)
    wait_for(lambda: server.detail(job)["statusReason"] == "attempt 1 runs on 1 node", 60, "the node")
    assert len(server.detail(job)["attempts"]) == 1
    assert server.muster("stop", job).returncode == 0


def test_a_training_that_still_starts_has_nothing_to_save(server: Serving) -> None:
    starts = {"MUSTER_STALL_TIMEOUT": "300", "MUSTER_ON_CHILD_FAILURE": "restart"}  # as a training has them
    job = server.gang("import time; time.sleep(600)", env=starts)
    server.wait(job, "RUNNING")
    wait_for(lambda: server.muster("stacks", job).returncode == 0, 30, "the node on the bus")
    message = server.muster("checkpoint", job)
    assert message.stdout == f"job {job[:8]} has not begun its first iteration: nothing to save yet\n"
    assert message.returncode == 1


def test_a_rank_that_freezes_is_found_with_its_stacks_and_the_gang_restarts(server: Serving) -> None:
    job = submit(server, "train.iterations=100000", "stall_timeout=4s")
    wait_for_iteration(server, job["run"], 6)
    [victim] = gang_members(server.home, "rank", 1)
    victim.strike(signal.SIGSTOP)
    wait_for(lambda: len(server.detail(job["id"])["attempts"]) == 2, 30, "the second attempt")
    first = server.detail(job["id"])["attempts"][0]
    assert re.search(
        r"node 1: rank 1 made no progress for \d+ s after iteration \d+: it is stopped by a signal",
        first["statusReason"],
    )
    log = "\n".join(server.log(job["id"], attempt=1))
    assert "its stacks:" in log and "worker/learning/loop.py" in log
    wait_for_iteration(server, job["run"], _iteration(server, job["run"]) + 2)
    assert server.muster("stop", job["id"]).returncode == 0


def test_without_the_bus_jobs_run_and_commands_say_why_they_cannot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUSTER_BUS_OFF", "1")
    server = Serving(tmp_path / "home")
    try:
        job = server.gang("import os, time; print('up'); time.sleep(20)")
        server.wait(job, "RUNNING")
        wait_for(lambda: server.log(job) == ["up"], what="the rank's line")
        refused = server.muster("checkpoint", job)
        assert refused.returncode == 1 and "the bus is off" in refused.stderr and "Traceback" not in refused.stderr
        assert server.muster("stop", job).returncode == 0
        over = server.muster("stacks", job)
        assert over.returncode == 1 and "FAILED, not RUNNING" in over.stderr
    finally:
        server.close()


def _iteration(server: Serving, run: str) -> int:
    return raw_iterations(server, run)[-1]
