"""A node's shim: whatever the node does, and however it ends, nothing of it is left; nothing else is touched. All of it is real."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from shared_store.process.cgroups import kill_group, members, own_group, remove_abandoned_groups, remove_group
from shared_store.process.node_processes import NodeProcesses, end_nodes
from shared_store.process.processes import await_marks, end_all, find_process, marked
from shared_store.process.shim import SCRATCH, STUCK, exit_code_in, group_of, make_exit_file, shimmed
from tests.conftest import PATIENCE, wait_for
from tests.support.processes import alive, await_end, frozen, processes_running, signal_all

ESCAPE = (
    "env -i setsid sh -c 'echo $$ >>{pids}; exec sleep 600' & "
    "(env -i setsid sh -c 'setsid sleep 600 & echo $! >>{pids}; exit' &) ; "
    "while [ $(cat {pids} 2>/dev/null | wc -l) -lt 2 ]; do sleep 0.01; done; "
)
"""Starts two processes in sessions of their own, without the node's environment, and one of them without its parent."""


@pytest.fixture
def control_group() -> Iterator[str]:
    """The path of one that may be made."""
    if not (groups := own_group()):
        pytest.skip("this process can't make control groups: run the test as root, or in a delegated group")
    path = f"{groups}/muster-test-{os.getpid()}"
    yield path
    remove_group(path)
    assert not os.path.exists(path)


@pytest.fixture(params=["control group", "subreaper alone"])
def group(request: pytest.FixtureRequest) -> str:
    """The control group to use; empty for none."""
    return "" if request.param == "subreaper alone" else str(request.getfixturevalue("control_group"))


@pytest.fixture
def pids(tmp_path: Path) -> Iterator[Path]:
    """A file that a node writes pids into; they are ended after a test that failed."""
    path = tmp_path / "pids"
    yield path
    signal_all(read(path), signal.SIGKILL)


def read(path: Path) -> list[int]:
    return [int(line) for line in path.read_text().split()] if path.exists() else []


def start(script: str, group: str, tied_to: int = 0, **env: str) -> subprocess.Popen[str]:
    command, pipe = shimmed(["sh", "-c", script], group, tied_to=tied_to), subprocess.PIPE
    return subprocess.Popen(command, env={**os.environ, **env}, stderr=pipe, text=True, start_new_session=True)


def known(shim: subprocess.Popen[str], group: str) -> NodeProcesses:
    process = find_process(shim.pid)
    return NodeProcesses(shim.pid, process.start if process else "", group)


@pytest.mark.parametrize(("end", "code"), [("exit 0", 0), ("exit 75", 75), ("kill -9 $$", 137), ("kill -TERM $$", 143)])
def test_escaped_processes_are_gone_when_the_supervisor_has_ended(group: str, pids: Path, end: str, code: int) -> None:
    shim = start(ESCAPE.format(pids=pids) + end, group)
    assert shim.wait(20 * PATIENCE) == code
    assert len(read(pids)) == 2 and not any(alive(pid) for pid in read(pids))


def test_the_exit_code_is_left_in_a_file_also_on_a_full_volume(tmp_path: Path) -> None:
    path = str(tmp_path / "exit")
    make_exit_file(path)
    inode, size = os.stat(path).st_ino, os.stat(path).st_size
    assert exit_code_in(path) is None
    subprocess.run(shimmed(["sh", "-c", "exit 75"], exit_file=path))
    assert exit_code_in(path) == 75
    assert (os.stat(path).st_ino, os.stat(path).st_size) == (inode, size), "it is written in place"
    assert subprocess.run(shimmed(["true"], exit_file=str(tmp_path / "forgotten"))).returncode == 0
    assert exit_code_in(str(tmp_path / "forgotten")) is None


def test_a_child_that_kills_its_parent_does_not_outlive_it(group: str, pids: Path) -> None:
    script = ESCAPE.format(pids=pids) + "setsid sh -c 'kill -9 $PPID; exec sleep 600' & wait"
    shim = start(script, group)
    assert shim.wait(20 * PATIENCE) == 137
    assert not any(alive(pid) for pid in read(pids))


def test_the_node_ends_when_its_shim_s_parent_dies(group: str, pids: Path) -> None:
    inner = f"{ESCAPE.format(pids=pids)}exec sleep 600"
    owner = (
        "import os, subprocess, sys; from shared_store.process.shim import shimmed;"
        "shim = subprocess.Popen(shimmed(['sh', '-c', sys.argv[1]], sys.argv[2], tied_to=os.getpid()));"
        "print(shim.pid, flush=True); shim.wait()"
    )
    with subprocess.Popen([sys.executable, "-c", owner, inner, group], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        shim = int(process.stdout.readline())
        wait_for(lambda: len(read(pids)) == 2, 20, "two processes that escaped")
        process.kill()
    await_end(shim)
    assert not any(alive(pid) for pid in read(pids))


def test_with_a_control_group_a_job_that_kills_the_shim_leaves_nothing_either(control_group: str, pids: Path) -> None:
    shim = start(ESCAPE.format(pids=pids) + "exec sleep 600", control_group)
    wait_for(lambda: len(read(pids)) == 2, 20, "two processes that escaped")
    node = known(shim, control_group)
    shim.kill()
    shim.wait()
    assert any(alive(pid) for pid in read(pids)), "there is something to end"
    assert not end_nodes([node], ["MUSTER_GANG=no-such-gang/1/1"])
    assert not any(alive(pid) for pid in read(pids))
    assert not os.path.exists(control_group)


def test_without_a_group_marked_processes_are_found_and_others_are_left_alone(pids: Path) -> None:
    gang = f"shim-{os.getpid()}/1/1"
    script = f"setsid sleep 600 & echo $! >>{pids}; exec sleep 600"
    shim, other = start(script, "", MUSTER_GANG=gang), start(script, "", MUSTER_GANG=f"{gang}1")
    wait_for(lambda: len(read(pids)) == 2, 20, "two processes in sessions of their own")
    node, of_the_other = known(shim, ""), known(other, "")
    shim.kill()
    shim.wait()
    assert not end_nodes([node], [f"MUSTER_GANG={gang}"])
    assert sorted(alive(pid) for pid in read(pids)) == [False, True] and alive(other.pid)
    assert not end_nodes([of_the_other], [f"MUSTER_GANG={gang}1"])
    other.wait(20 * PATIENCE)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_requests_reach_the_supervisor_also_where_a_job_stopped_it(number: int, pids: Path) -> None:
    script = f"trap 'exit 75' TERM INT HUP; echo $$ >{pids}; while :; do sleep 0.02; done"
    shim = start(script, "")
    wait_for(lambda: read(pids), 20, "the supervisor")
    os.kill(read(pids)[0], signal.SIGSTOP)
    shim.send_signal(number)
    assert shim.wait(20 * PATIENCE) == 75


def test_what_the_shim_was_started_to_ignore_is_not_ignored_below_it() -> None:
    script = "grep SigIgn /proc/$$/status >&2; exit 3"
    shell = ["sh", "-c", 'trap "" HUP INT QUIT PIPE CHLD USR1 ALRM; exec "$@"', "sh"]
    shim = subprocess.run([*shell, *shimmed(["sh", "-c", script])], stderr=subprocess.PIPE, text=True)
    assert shim.returncode == 3, "known although SIGCHLD was ignored"
    resettable = sum(1 << number - 1 for number in signal.valid_signals())  # the C library keeps 32 and 33
    assert int(shim.stderr.split()[1], 16) & resettable == 0


def test_a_shim_stopped_by_a_job_still_ends(group: str, pids: Path) -> None:
    shim = start(ESCAPE.format(pids=pids) + "exec sleep 600", group)
    wait_for(lambda: len(read(pids)) == 2, 20, "two processes that escaped")
    shim.send_signal(signal.SIGSTOP)
    assert not end_nodes([known(shim, group)], ["MUSTER_GANG=no-such-gang/1/1"])
    assert shim.wait(20 * PATIENCE) == 137
    assert not any(alive(pid) for pid in read(pids))


def test_a_killed_supervisor_s_temporary_directory_is_removed_and_no_other(pids: Path) -> None:
    other = Path(tempfile.mkdtemp(prefix=SCRATCH.format(pid=1)))
    script = f"mkdir {tempfile.gettempdir()}/{SCRATCH.format(pid='$$')}abc; echo $$ >{pids}; kill -9 $$"
    assert start(script, "").wait(20 * PATIENCE) == 137
    assert not list(Path(tempfile.gettempdir()).glob(SCRATCH.format(pid=read(pids)[0]) + "*"))
    assert other.exists()
    other.rmdir()


def test_a_shim_is_distinguished_from_other_commands_by_its_command_line() -> None:
    line = [word.encode() for word in shimmed(["python", "-m", "worker.supervisor"], "/sys/fs/cgroup/x")]
    assert group_of(line) == "/sys/fs/cgroup/x"
    assert group_of([word.encode() for word in shimmed(["python"])]) == ""
    assert group_of([b"python", b"-P", b"-m", b"worker.supervisor", b"--", b"sleep", b"1"]) is None


def test_an_unkillable_process_is_named_and_waited_for(pids: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shim = start(f"setsid sleep 600 & echo $! >{pids}; while :; do sleep 0.02; done", "")
    node = known(shim, "")
    wait_for(lambda: read(pids), 20, "the process")
    [stubborn] = read(pids)
    wait_for(lambda: (process := find_process(stubborn)) and process.name == "sleep", 20, "it sleeps")
    with frozen(stubborn):
        monkeypatch.setattr(
            "shared_store.process.node_processes.end_all", lambda find, strike: end_all(find, 0.5, strike)
        )
        [left] = end_nodes([node], ["MUSTER_GANG=no-such-gang/1/1"])
        assert left.pid == stubborn and left.state == "D"
        wait_for(lambda: node.shim and node.shim.name == STUCK, 20, "the shim says that it is stuck")
    assert shim.wait(20 * PATIENCE) == 137
    assert shim.stderr is not None
    message = shim.stderr.read()
    wait = "in an uninterruptible wait"
    assert message.startswith(f"muster: SIGKILL does not end process {stubborn} (sleep), state D: {wait}")
    assert message.count("\n") == 1, "reported once"


CHAIN = """
import os, time
end = time.time() + 60
while time.time() < end:
    if os.fork():
        os._exit(0)
    os.setsid()
    time.sleep(0.002)
"""
"""A process that replaces itself by a child in a session of its own, again and again, for a minute at most."""


def test_processes_that_replace_themselves_all_the_time_are_ended(group: str, pids: Path, tmp_path: Path) -> None:
    (tmp_path / "chain.py").write_text(CHAIN)
    chain = f"{sys.executable} -I -S {tmp_path}/chain.py"
    shim = start(f"for i in 1 2 3 4; do {chain} & done; sleep 0.5; kill -9 $$", group)
    assert shim.wait(60 * PATIENCE) == 137
    assert not processes_running(str(tmp_path))


@pytest.mark.parametrize("marks", [[], ["MUSTER_GANG="], ["MUSTER_GANG"], ["MUSTER_GANG=job/1/1", ""]])
def test_marks_that_would_fit_every_process_are_refused(marks: list[str]) -> None:
    with pytest.raises(ValueError, match="no process can be identified by the marks"):
        marked(marks)


def test_a_child_that_was_just_started_is_found_by_its_marks() -> None:
    for number in range(50):  # without the wait about every third would not be
        mark = f"MUSTER_GANG=just-started/{number}/{os.getpid()}"
        with subprocess.Popen(["sleep", "600"], env=dict([mark.split("=")])) as child:
            await_marks(child.pid)
            found = [process.pid for process in marked([mark])]
            child.kill()
        assert found == [child.pid]
    await_marks(child.pid)  # of one that is gone it returns


def test_the_kernel_ends_a_whole_control_group_at_once_even_one_that_keeps_forking(control_group: str) -> None:
    group = control_group
    os.mkdir(group)
    if not os.path.exists(f"{group}/cgroup.kill"):
        pytest.skip(f"kernel {os.uname().release} has no cgroup.kill (Linux 5.14 and later)")
    script = f'echo $$ > {group}/cgroup.procs; while :; do setsid sh -c "sleep 600 & sleep 0.01" & sleep 0.01; done'
    with subprocess.Popen(["sh", "-c", script]) as forking:
        wait_for(lambda: len(members(group)) > 5, 20, "processes in the group")
        kill_group(group)  # and nothing else: no pid is looked for
        assert forking.wait(20 * PATIENCE) == -signal.SIGKILL
        wait_for(lambda: not members(group), 20, "an empty group")


def test_only_abandoned_groups_are_removed(control_group: str, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = control_group
    os.mkdir(directory)
    shim = start("exec sleep 600", f"{directory}/muster-busy")
    node = known(shim, directory)
    wait_for(lambda: os.path.exists(f"{directory}/muster-busy/cgroup.procs"), 20, "the group")
    wait_for(lambda: Path(f"{directory}/muster-busy/cgroup.procs").read_text(), 20, "a process in the group")
    os.mkdir(f"{directory}/muster-empty")
    remove_abandoned_groups(directory)
    assert os.path.exists(f"{directory}/muster-empty"), "it is new"
    monkeypatch.setattr("shared_store.process.cgroups._NEW", -60.0)
    remove_abandoned_groups(directory)
    assert not os.path.exists(f"{directory}/muster-empty") and os.path.exists(f"{directory}/muster-busy")
    assert not end_nodes([node], ["MUSTER_GANG=no-such-gang/1/1"])
    shim.wait(20 * PATIENCE)
    assert not os.path.exists(directory)
