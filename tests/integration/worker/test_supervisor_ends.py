"""How a node ends: by itself, by a failure, on request, by force, and what is reported of it. All of it is real."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import sys
import time
from pathlib import Path

import pytest

from shared_store.contract.faults import Fault
from shared_store.contract.node import sealed
from shared_store.volume.epoch import raise_epoch
from shared_store.volume.node_outcomes import LONGEST_TEXT
from tests.conftest import PATIENCE, wait_for
from tests.support.faults.full_disk import full_volume
from tests.support.faults.outages import loop_volume
from tests.support.processes import alive, await_end
from tests.support.worker.node import Node, Nodes

# -- ends -------------------------------------------------------------------------------------------------------------


def test_an_exception_is_reported_with_its_traceback(node: Nodes) -> None:
    n = node()
    script = "import sys\nprint('a warning', file=sys.stderr)\ndef f():\n    raise ValueError('bad reward')\nf()"
    assert n.python(script) == 1
    outcome = n.ended()
    assert outcome.reason == "rank 0 exited with code 1: ValueError: bad reward"
    assert outcome.error
    assert (outcome.error.rank, outcome.error.message) == (0, "ValueError: bad reward")
    assert outcome.error.traceback.startswith("Traceback (most recent call last):\n")
    assert "in f" in outcome.error.traceback
    assert outcome.error.traceback.endswith("\nValueError: bad reward")
    assert outcome.error.fault == Fault("ValueError", "<string>", 4)
    assert n.lines()[-1] == (None, "o", f"node 0 ended: {outcome.reason}")


@pytest.mark.parametrize(
    ("output", "message"),
    [
        ("echo first >&2; echo 'fatal: no such device' >&2; echo >&2; echo out", "fatal: no such device"),
        (
            f"{sys.executable} -c 'import traceback\ntry: {{}}[1]\nexcept KeyError: traceback.print_exc()\nraise OSError(2)'",
            "OSError: 2",
        ),
        ("true", None),
    ],
)
def test_the_last_traceback_or_line_on_standard_error_is_the_error(
    node: Nodes, output: str, message: str | None
) -> None:
    n = node()
    assert n.shell(f"{output}; exit 9") == 9
    outcome = n.ended()
    assert outcome.reason == "rank 0 exited with code 9" + (f": {message}" if message else "")
    assert (outcome.error and outcome.error.message) == message


FAULTY = "import traceback\ntry: {}[1]\nexcept KeyError: traceback.print_exc()\nimport os, sys\nsys.stderr.flush()\n"


@pytest.mark.parametrize(
    ("how", "fault"),
    [
        ("sys.exit(1)", Fault("KeyError", "<string>", 2)),
        ("sys.exit(3)", None),
        ("os.kill(os.getpid(), 9)", None),
    ],
)
def test_a_traceback_is_the_fault_only_of_a_program_that_left_as_python_does_after_it(
    node: Nodes, how: str, fault: Fault | None
) -> None:
    n = node()
    assert n.python(FAULTY + how) != 0
    error = n.ended().error
    assert error is not None and error.message == "KeyError: 1" and error.fault == fault


EXTRA = {"py_callstack": "Traceback …", "timestamp": "1234"}


_OF_GLOO = (
    "RuntimeError: [../third_party/gloo/gloo/transport/tcp/pair.cc:534] Connection closed by peer [10.0.0.2]:5\n"
    "Exception raised from read at pair.cc:534 (most recent call first):\nframe #0: gloo::read()"
)


@pytest.mark.parametrize(
    ("content", "message", "traceback", "when"),
    [
        ({"message": {"message": "CUDA broke", "extraInfo": EXTRA}}, "CUDA broke", "Traceback …", 1234.0),
        ({"message": "just a text"}, "just a text", "", None),
        ({"message": 3}, "on stderr", "", None),
        ({"message": {"message": "m", "extraInfo": {"timestamp": "soon"}}}, "on stderr", "", None),
        ([], "on stderr", "", None),
        ("", "on stderr", "", None),
        ({"message": {"message": "m", "extraInfo": [1]}}, "on stderr", "", None),
        ({"message": {"message": "m", "extraInfo": {"time": -1e300}}}, "m", "", None),
        (
            {"message": {"message": _OF_GLOO, "extraInfo": {}}},
            "RuntimeError: Connection closed by peer [10.0.0.2]:5",
            "",
            None,
        ),
        ({"message": "x" * 100_000}, "x" * (LONGEST_TEXT - 64) + " … (83680 characters left out)", "", None),
    ],
)
def test_the_error_file_of_torchrun_is_honoured_if_it_holds_an_error(
    node: Nodes, content: object, message: str, traceback: str, when: float | None
) -> None:
    n = node()
    text = json.dumps(content) if content else ""
    script = f"import os, sys; open(os.environ['TORCHELASTIC_ERROR_FILE'], 'w').write({text!r}); sys.exit('on stderr')"
    assert n.python(script) == 1
    error = n.ended().error
    assert error
    assert (error.message, error.traceback) == (message, traceback)
    assert error.time == when if when else abs(error.time - time.time()) < 20


@pytest.mark.parametrize(
    ("write", "problem"),
    [
        ("file.write('[' * 200_000)", "nested too deep"),
        ("file.write('x' * 60_000_000)", "more than 1048576 bytes"),
        ("file.close(); os.remove(path); os.mkfifo(path)", "not a regular file"),
    ],
)
def test_an_unusable_error_file_costs_neither_the_exit_code_nor_time(node: Nodes, write: str, problem: str) -> None:
    n = node()
    begin = "import os, sys; path = os.environ['TORCHELASTIC_ERROR_FILE']; file = open(path, 'w'); "
    assert n.python(f"{begin}{write}; sys.exit(7)") == 7
    ended = n.ended()
    assert ended.error and ended.error.message.endswith(f"error-0.json: {problem}")
    assert ended.reason == f"rank 0 exited with code 7: {ended.error.message}"


def test_no_message_on_the_progress_pipe_ends_the_supervisor(node: Nodes) -> None:
    n = node(stall_timeout=600.0)
    objects = ('{"iteration": []}', '{"iteration": 1e400}', '{"message": {"a": 1}}')
    lines = ["[1]", "1", "null", '"x"', "{", "[" * 50_000, *objects]
    script = (
        "import os, resource\nfd = int(os.environ['MUSTER_PROGRESS_FD'])\nos.set_blocking(fd, True)\n"
        "def say(text):\n"
        "    data = text.encode()\n"
        "    while data: data = data[os.write(fd, data):]\n"
        f"for line in {lines!r}: say(line + '\\n')\n"
        "for name in range(20_000): say('{\"%d\": 1}\\n' % name)\n"
        "for _ in range(100): say('x' * 1_000_000)\n"
        "say('\\n{\"iteration\": 3}\\n')\n"
        "peak = [l for l in open(f'/proc/{os.getppid()}/status') if l.startswith('VmHWM')][0].split()[1]\n"
        "print(int(peak) < 100_000, peak)"
    )
    assert n.python(script) == 0
    assert n.output()[0].startswith("True"), n.output()


def test_torch_s_own_record_decorator_reports_through_the_supervisor(node: Nodes, tmp_path: Path) -> None:
    if importlib.util.find_spec("torch") is None:
        pytest.skip("torch is not installed")
    n = node()
    script = tmp_path / "script.py"
    script.write_text(
        "from torch.distributed.elastic.multiprocessing.errors import record\n"
        "@record\ndef main():\n    raise RuntimeError('recorded')\n"
        "if __name__ == '__main__':\n    main()\n"
    )
    assert n.call(sys.executable, str(script)) == 1
    error = n.ended().error
    assert error
    assert error.message == "RuntimeError: recorded"
    assert "script.py" in error.traceback


@pytest.mark.parametrize(("number", "name"), [(9, "SIGKILL"), (11, "SIGSEGV"), (15, "SIGTERM"), (40, "signal 40")])
def test_a_rank_killed_by_a_signal_is_reported_by_the_signal_s_name(node: Nodes, number: int, name: str) -> None:
    n = node()
    assert n.shell(f"kill -{number} $$") == 128 + number
    outcome = n.ended()
    assert (outcome.exit_code, outcome.signal) == (128 + number, name)
    assert outcome.reason == f"rank 0 was killed by {name}"


def test_it_is_recorded_whether_a_node_was_asked_to_end_or_failed_by_itself(node: Nodes) -> None:
    requested = node()
    requested.start("sh", "-c", "echo ready; exec sleep 60")
    requested.wait_for_output("ready")
    requested.process.terminate()
    assert (requested.wait(), requested.ended().requested) == (143, True)
    assert requested.ended().reason == "rank 0 was killed by SIGTERM"
    well = node(attempt=4)
    well.start("sh", "-c", "trap 'exit 0' TERM; echo set; while :; do sleep 0.1; done")
    well.wait_for_output("set")
    well.process.terminate()
    assert (well.wait(), well.ended().requested) == (0, True)
    failed = node(attempt=2)
    assert (failed.shell("exit 3"), failed.ended().requested) == (3, False)
    gang = node(attempt=3, ranks_per_node=3)
    assert gang.shell("if [ $RANK = 1 ]; then sleep 0.3; echo broken >&2; exit 3; fi; exec sleep 600") == 3
    ended = gang.ended()
    assert (ended.reason, ended.error.rank, ended.requested) == ("rank 1 exited with code 3: broken", 1, False)


def test_a_rank_that_its_engine_ended_before_the_supervisor_knew_was_asked(node: Nodes) -> None:
    n = node()
    n.start("sh", "-c", "echo $$; exec sleep 60")
    wait_for(lambda: len(n.output()) == 1, 10, "the rank")
    n.process.send_signal(signal.SIGSTOP)  # as under load: the rank is gone first
    os.kill(int(n.output()[0]), signal.SIGTERM)
    n.process.terminate()
    n.process.send_signal(signal.SIGCONT)
    assert (n.wait(), n.ended().requested) == (143, True)


def test_a_rank_that_ignores_the_failure_of_another_is_killed(node: Nodes) -> None:
    n = node(ranks_per_node=2)
    main = "import sys, worker.node.supervisor as s; s._PEER_GRACE = 0.5; sys.exit(s.main(sys.argv[1:]))"
    script = 'if [ $RANK = 0 ]; then sleep 0.5; exit 3; fi; trap "" TERM; while :; do sleep 0.1; done'
    n.start("sh", "-c", script, program=("-c", main))
    assert n.wait() == 3
    assert n.ended().reason == "rank 0 exited with code 3"


def test_one_rank_that_is_done_or_closes_its_output_ends_no_other(node: Nodes) -> None:
    n = node(ranks_per_node=2)
    script = "if [ $RANK = 0 ]; then exit 0; fi; sleep 0.5; echo still here; exec >&- 2>&-; sleep 0.3; exit 4"
    assert n.shell(script) == 4
    assert n.output() == ["still here"]


# -- being asked to leave ---------------------------------------------------------------------------------------------

LEAVES = 'trap "echo leaving; exit 75" TERM; echo ready; while :; do sleep 0.05; done'
STAYS = 'trap "" TERM; echo ready; while :; do sleep 0.05; done'


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_request_to_leave_reaches_the_ranks_and_exit_75_is_kept(node: Nodes, number: int) -> None:
    n = node(ranks_per_node=2)
    n.start("sh", "-c", LEAVES)
    wait_for(lambda: n.output() == ["ready"] * 2, 10, "two ranks")
    while n.process.poll() is None:  # again and again
        n.process.send_signal(number)
        time.sleep(0.001)
    assert n.wait() == 75
    assert [n.output().count(text) for text in ("ready", "leaving")] == [2, 2]
    outcome = n.ended()
    assert (outcome.exit_code, outcome.reason, outcome.error) == (75, "checkpointed and left on request", None)


def test_a_node_exits_on_request_if_its_ranks_are_done_or_exited_on_request(node: Nodes) -> None:
    n = node(ranks_per_node=2)
    assert n.shell("[ $RANK = 0 ] && exit 75; exit 0") == 75


def test_a_rank_that_does_not_exit_within_the_grace_time_is_killed(node: Nodes) -> None:
    n = node(grace=0.6)
    n.start("sh", "-c", STAYS)
    n.wait_for_output("ready")
    requested = time.monotonic()
    while n.process.poll() is None and time.monotonic() - requested < 10 * PATIENCE:
        n.process.terminate()  # again and again, which does not prolong the grace
        time.sleep(0.1)
    assert n.wait() == 137 and time.monotonic() - requested > 0.5
    outcome = n.ended()
    assert outcome.reason == "rank 0 did not leave within 0.6 s of SIGTERM and was killed"
    assert outcome.signal == "SIGKILL"


def test_a_request_that_comes_before_the_ranks_are_started_is_not_forgotten(node: Nodes) -> None:
    n = node(grace=30.0)
    script = (
        "import os, sys\n"
        "from shared_store.contract.node import NodeContract\n"
        "from shared_store.volume.layout import Store\n"
        "from worker.node.supervisor import Supervisor\n"
        "contract = NodeContract.from_env(os.environ)\n"
        "supervisor = Supervisor(contract, Store(contract.store).run(contract.run), sys.argv[2:])\n"
        "supervisor.stop('asked to leave', contract.grace)\n"
        "sys.exit(supervisor.supervise())\n"
    )
    n.start("sleep", "60", program=("-c", script))
    assert n.wait(10 * PATIENCE) == 143


# -- the job's own environment ----------------------------------------------------------------------------------------


def test_a_job_s_variables_take_effect_in_its_ranks_and_not_in_its_supervisor(node: Nodes, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "queue.py").write_text("MINE = True\n")
    nowhere = dict.fromkeys(("PYTHONHOME", "LD_LIBRARY_PATH", "TMPDIR"), "/nowhere")
    job = {"PYTHONPATH": str(tmp_path / "mine"), **nowhere, "RANK": "99", "MUSTER_EPOCH": "99"}
    n = node()
    script = "echo $PYTHONPATH $PYTHONHOME $LD_LIBRARY_PATH $TMPDIR $RANK $MUSTER_EPOCH; env | grep -c MUSTER_RANK_ENV_"
    assert n.shell(script, **sealed(job, n.contract.to_env())) == 1, "grep found none"
    assert n.output() == [f"{tmp_path}/mine /nowhere /nowhere /nowhere 0 1", "0"]


# -- nothing outlives the node ----------------------------------------------------------------------------------------


def test_descendants_in_sessions_and_environments_of_their_own_do_not_survive(node: Nodes) -> None:
    n = node()
    escape = 'setsid sh -c "echo \\$\\$; exec sleep 600" &'
    assert n.shell(f"{escape} (env -i {escape}) ; sleep 0.5; exit 0") == 0
    pids = [int(text) for text in n.output()]
    assert len(pids) == 2
    assert not any(alive(pid) for pid in pids), "they were ended before the supervisor left"
    assert n.ended().exit_code == 0


def test_ranks_die_when_their_supervisor_is_killed(node: Nodes) -> None:
    n = node(ranks_per_node=2)
    n.start("sh", "-c", 'trap "" TERM HUP; echo $$; while :; do sleep 0.05; done')
    wait_for(lambda: len(n.output()) == 2, 10, "two ranks")
    pids = [int(text) for text in n.output()]
    n.process.kill()
    n.process.wait()
    await_end(*pids)
    assert n.outcome is None


def test_a_newer_epoch_ends_everything_at_once_and_nothing_is_written(node: Nodes) -> None:
    n = node(grace=30.0)
    n.start("sh", "-c", f'setsid sh -c "echo \\$\\$; exec sleep 600" & echo $$; {STAYS}')
    wait_for(lambda: "ready" in n.output() and len(n.output()) == 3, 10, "the rank and its child")
    pids = [int(text) for text in n.output() if text.isdigit()]
    before = n.lines()
    raise_epoch(n.run, 2)
    assert n.wait(5 * PATIENCE) == 3
    await_end(*pids)
    assert n.lines() == before
    assert n.outcome is None
    left = "this attempt has epoch 1, the run now belongs to epoch 2; leaving"
    assert n.stderr.read_text() == f"muster supervisor: run run: {left}\n"


def test_a_node_of_an_old_attempt_does_not_even_start(node: Nodes, tmp_path: Path) -> None:
    n = node(epoch=1)
    raise_epoch(n.run, 2)
    assert n.call("touch", str(tmp_path / "started")) == 3
    assert not (tmp_path / "started").exists()
    assert {name.partition(".")[0] for name in os.listdir(n.run.path)} == {"EPOCH"}
    assert n.stderr.read_text().count("\n") == 1


def test_an_epoch_that_cannot_be_read_for_a_while_does_not_stop_the_ranks(node: Nodes) -> None:
    n = node()
    n.start("sh", "-c", "echo ready; sleep 2.5; echo done")
    n.wait_for_output("ready")
    (n.run.path / "EPOCH").unlink()
    (n.run.path / "EPOCH").mkdir()  # reading it fails, as it does on a volume that is away
    assert n.wait() == 0
    assert n.output() == ["ready", "done"]


# -- a store that can't be written --------------------------------------------------------------------------------------


def test_on_a_full_volume_the_outcome_is_written_again_until_it_stands(node: Nodes) -> None:
    n = node()
    outcomes = n.run.outcome("job", 1, 0).parent
    with full_volume(outcomes) as ballast:
        n.start("sh", "-c", "exit 4")
        wait_for(lambda: "No space left on device; trying again" in n.stderr.read_text(), 20, "a refused write")
        assert n.process.poll() is None and n.outcome is None
        ballast.unlink()
        assert n.wait() == 4
        assert n.ended().exit_code == 4
    assert n.stderr.read_text().count("outcome of node 0") == 1


def test_who_is_asked_to_leave_before_the_outcome_stands_leaves_with_the_true_exit_code(node: Nodes) -> None:
    n = node(grace=3.0)
    with full_volume(n.run.outcome("job", 1, 0).parent):
        n.start("sh", "-c", "exit 0")
        wait_for(lambda: "trying again" in n.stderr.read_text(), 20, "a refused write")
        n.process.send_signal(signal.SIGTERM)
        assert n.wait() == 0 and n.outcome is None


def test_while_the_store_is_away_the_node_waits_and_its_outcome_is_in_the_store_that_comes_back(tmp_path: Path) -> None:
    store, absent, go = tmp_path / "store", tmp_path / "away", tmp_path / "go"
    n = Node(store)
    n.stderr = tmp_path / "stderr"
    n.start("sh", "-c", f"echo ready; while [ ! -e {go} ]; do sleep 0.05; done; exit 3")
    try:
        n.wait_for_output("ready")
        store.rename(absent)
        store.mkdir()
        go.touch()
        wait_for(lambda: "trying again" in n.stderr.read_text(), 20, "a refused write")
        assert list(store.iterdir()) == []
        store.rmdir()
        absent.rename(store)
        assert n.wait() == 3 and n.ended().exit_code == 3
    finally:
        n.process.kill()
        n.process.wait()


FROZEN = """
import os, subprocess, time
fd = int(os.environ["MUSTER_PROGRESS_FD"])
def work(seconds):  # at work, and so no rank that waits for another one
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pass
for iteration in range(60):
    if iteration == 10:
        subprocess.run(["fsfreeze", "-f", os.environ["MUSTER_STORE"]], check=True)
        thaws = subprocess.Popen(["sh", "-c", 'sleep 4; exec fsfreeze -u "$MUSTER_STORE"'])
    print(iteration, flush=True)
    work(0.05)
    os.write(fd, b'{"iteration": %d}\\n' % iteration)
    work(0.05)
"""


def test_a_store_that_freezes_does_not_make_a_training_stall(tmp_path: Path) -> None:
    with loop_volume(tmp_path / "store") as volume:
        n = Node(volume, stall_timeout=1.0)
        n.stderr = tmp_path / "stderr"
        assert n.python(FROZEN) == 0
        assert n.output() == [str(iteration) for iteration in range(60)], n.lines()
