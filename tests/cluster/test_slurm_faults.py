"""The Slurm engine when something dies: a rank, a supervisor, Slurm's own processes, a node; limits and preemption."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from pathlib import Path

from orchestrator.engines.toolkit.statuses import status_of
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.node_outcomes import read_outcome
from tests.conftest import MUSTER, PATIENCE, Serving, wait_for
from tests.support.engines.sites import POLITE
from tests.support.engines.slurm_bench import SlurmBench, slurm_bench
from tests.support.processes import command, environment, parent, signal_all

bench = slurm_bench


def ranks(bench: SlurmBench) -> list[int]:
    return bench.processes("sleep\x00600")


def test_a_rank_a_supervisor_and_slurm_s_own_process_are_killed(bench: SlurmBench) -> None:
    handle = bench.ready(bench.gang(nodes=3))
    parents = {pid: parent(pid) for pid in ranks(bench)}
    nodes = {environment(pid)["AWS_BATCH_JOB_NODE_INDEX"]: pid for pid in parents}
    os.kill(nodes["0"], signal.SIGKILL)
    wait_for(lambda: not status_of(bench.engine, handle)[0].running, 20, "its end is seen")
    outcome = bench.outcome(0)
    assert (outcome.exit_code, outcome.reason) == (137, "rank 0 was killed by SIGKILL")
    assert [node.running for node in status_of(bench.engine, handle)] == [False, True, True], "the others go on"
    os.kill(parents[nodes["1"]], signal.SIGKILL)
    wait_for(lambda: not status_of(bench.engine, handle)[1].running, 20, "its end is seen")
    assert status_of(bench.engine, handle)[1].exit_code == 137 and read_outcome(bench.run, bench.job, 1, 1) is None
    wait_for(lambda: ranks(bench) == [nodes["2"]], 5, "its rank went with it")
    step = parent(parent(parents[nodes["2"]]))  # between them is the shim
    assert "slurmstepd" in command(step)[0]
    os.kill(step, signal.SIGKILL)
    wait_for(lambda: not ranks(bench), 5, "supervisor and rank went with it")


LIVES_ON = """
import os, pathlib, signal, time
from shared_store.volume.checkpoints import CheckpointWriter
from shared_store.volume.layout import Store
signal.signal(signal.SIGTERM, signal.SIG_IGN)
run = Store(os.environ["MUSTER_STORE"]).run("run")
print("ready", flush=True)
for number in range(1, 100000):
    time.sleep(0.02)
    print(f"line {number}", flush=True)
    if os.environ["RANK"] == "1":
        try:
            CheckpointWriter(run, number, int(os.environ["MUSTER_EPOCH"])).commit({})
        except Exception as error:
            (run.path / "refused").write_text(str(error))
"""


def test_a_rank_that_lives_on_under_a_dead_slurmd_writes_nothing_once_the_next_attempt_has_begun(
    bench: SlurmBench,
) -> None:
    commands = [["python", "-c", LIVES_ON]] * 2
    first = bench.ready(bench.gang(nodes=2, commands=commands))
    bench.cluster.kill("n2")
    try:
        child = bench.ended(first)[1]
        assert bench.state(first) == "NODE_FAIL" and child.words.startswith("Slurm lost a node of n[1-2] (job ")
        bench.engine.stop(first, 5.0)
        alive = bench.processes()
        assert len(alive) == 2, "the shim and the supervisor on n2 live on: Slurm can't reach them"
        log = bench.run.log(bench.job, 1, 1)
        before = log.stat().st_size
        wait_for(lambda: log.stat().st_size > before, 10, "and it still writes")
        # its machine hangs while the next attempt begins
        existing = [*alive, *bench.processes("for number in range")]
        signal_all(existing, signal.SIGSTOP)
        time.sleep(1.1)
        second = bench.ready(bench.gang(nodes=2, attempt=2, options={"exclude": "n2"}))
        size, checkpoints = log.stat().st_size, [checkpoint.name for checkpoint in list_checkpoints(bench.run)]
        signal_all(reversed(existing), signal.SIGCONT)
        wait_for(lambda: not set(existing) & set(bench.cluster.processes()), 20, "it has read the new epoch and left")
        assert log.stat().st_size == size, "not a line"
        assert [checkpoint.name for checkpoint in list_checkpoints(bench.run)] == checkpoints, "and no checkpoint"
        assert read_outcome(bench.run, bench.job, 1, 1) is None
        assert all(node.running for node in status_of(bench.engine, second))
    finally:
        bench.cluster.start("n2")


def test_a_stop_that_began_without_slurmctld_leaves_the_whole_grace_from_when_the_nodes_were_asked(
    bench: SlurmBench,
) -> None:
    handle = bench.ready(bench.gang(POLITE, 2))
    bench.saved(handle)
    bench.cluster.kill("slurmctld")
    stopping = threading.Thread(target=bench.engine.stop, args=(handle, 5.0))
    stopping.start()
    time.sleep(6.0)
    bench.cluster.start("slurmctld")
    stopping.join(60 * PATIENCE)
    assert [node.exit_code for node in status_of(bench.engine, handle)] == [75, 75] and bench.log().count("saved") == 2


def test_a_frozen_slurmctld_is_named_by_the_gangs_that_run_and_by_those_that_are_stopped(
    bench: SlurmBench, tmp_path: Path
) -> None:
    served = Serving(tmp_path / "home", "--engine", "slurm")
    daemon = bench.cluster.daemons["slurmctld"]
    try:
        job = served.gang("import time; print('ready', flush=True); time.sleep(600)", env={"MUSTER_DIRECTORY": "/tmp"})
        served.wait(job, "RUNNING")
        runs = "attempt 1 runs on 1 node"

        def says(words: str) -> bool:
            reason: str = served.detail(job)["statusReason"]
            assert reason.startswith(runs), reason
            return words in reason if words else reason == runs

        wait_for(lambda: says(""), 20, "it runs")
        daemon.send_signal(signal.SIGSTOP)
        wait_for(lambda: says("; Slurm: slurmctld "), 40, "its engine does not answer")
        daemon.send_signal(signal.SIGCONT)
        wait_for(lambda: says(""), 40, "it answers again")
        daemon.send_signal(signal.SIGSTOP)
        command = [MUSTER, "stop", job]
        stopping = subprocess.Popen(
            command, env={**os.environ, "MUSTER_HOME": str(served.home)}, stderr=subprocess.PIPE, text=True
        )
        assert stopping.stderr is not None
        assert "stopped by the user; " in stopping.stderr.readline()
        waits = "stopped by the user; waits for Slurm: slurmctld "
        wait_for(lambda: waits in served.detail(job)["statusReason"], 40, "that the stop says for what it waits")
        daemon.send_signal(signal.SIGCONT)
        assert stopping.wait(120 * PATIENCE) == 0 and served.detail(job)["status"] == "FAILED"
    finally:
        daemon.send_signal(signal.SIGCONT)
        served.close()


def test_the_time_limit_is_announced_so_that_the_nodes_save_and_leave(bench: SlurmBench) -> None:
    # Slurm announces up to a minute early: with 90 s of notice, a limit of one minute is announced at once
    handle = bench.launch(bench.gang(POLITE, 2, options={"time": "1"}))
    assert [node.exit_code for node in bench.ended(handle)] == [75, 75]
    assert bench.log().count("saved") == 2 and "TIMEOUT" not in bench.state(handle)


def test_a_partition_with_priority_preempts_and_the_nodes_save_and_leave(bench: SlurmBench) -> None:
    low = bench.ready(bench.gang(POLITE, 3, cpus=4))
    high = bench.gang(nodes=3, cpus=4, suffix="2", options={"partition": "urgent"})
    bench.launch(high)
    assert [node.exit_code for node in bench.ended(low)] == [75, 75, 75]
    assert bench.log().count("saved") == 3
    bench.ready(high)
