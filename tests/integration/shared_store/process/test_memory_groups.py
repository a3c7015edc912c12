"""The limit of a node's memory by a real control group, below a real shim."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from shared_store.contract.node import NodeContract
from shared_store.process.cgroups import own_group, remove_group
from shared_store.process.memory_groups import killed_for_memory, limits_memory, memory_group, memory_home
from shared_store.process.shim import shimmed
from shared_store.process.tether import tied
from tests.conftest import REPOSITORY
from worker.node.surroundings import MemoryLimit

NAME = f"muster-test-memory-{os.getpid()}"
SUPERVISOR = f"""
import subprocess, sys
sys.path.insert(0, {str(REPOSITORY)!r})
from shared_store.process.memory_groups import killed_for_memory, make_memory_group
from shared_store.process.tether import tied
path, *scripts = sys.argv[1:]
make_memory_group(path, 64 << 20)
large = bytearray(100 << 20)  # the supervisor's own is not the job's
for script in scripts:
    ended = subprocess.run(tied(["sh", "-c", script], group=path))
    print(ended.returncode, killed_for_memory(path), flush=True)
"""


@pytest.fixture
def group() -> Iterator[str]:
    """The memory group of a node; it is gone at the end."""
    if not (home := memory_home(own_group(), arrange=True)):
        pytest.skip("this process can't limit memory: run the test as root, or in a delegated group")
    path = memory_group(home, NAME)
    yield path
    assert not os.path.exists(path)
    remove_group(f"{own_group()}/{NAME}")


def run(group: str, *scripts: str) -> subprocess.Popen[str]:
    command = shimmed([sys.executable, "-c", SUPERVISOR, group, *scripts], f"{own_group()}/{NAME}")
    environment = {**os.environ, "MUSTER_MEMORY_GROUP": group}
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


def grow(mib: int) -> str:
    return f"exec {sys.executable} -c 'bytearray({mib} << 20)'"


def test_the_whole_tree_of_a_job_has_its_memory_and_its_supervisor_s_does_not_count(group: str) -> None:
    with run(group, "exit 3", grow(20), f"( {grow(300)} ); exit 4") as shim:
        assert shim.stdout is not None
        assert shim.stdout.read().splitlines() == ["3 False", "0 False", "4 True"]
    assert shim.returncode == 0


@pytest.mark.parametrize("end", ["exit 0", "kill -9 $PPID; sleep 600"])
def test_no_group_is_left_when_the_supervisor_has_ended(group: str, end: str) -> None:
    with run(group, "setsid sleep 600 & sleep 600 &", end):
        pass
    # the fixture looks


def test_a_group_that_can_t_be_made_is_reported_and_limits_nothing(tmp_path: Path) -> None:
    facts = {"node_index": 0, "node_count": 1, "main_index": 0, "master_address": "", "master_port": 1, "epoch": 1}
    contract = NodeContract(job="j", attempt=1, run="r", store="s", job_epoch=1, **facts)
    limit = MemoryLimit(contract)
    assert (limit.group, limit.problem, limit.is_used_up()) == ("", "", False)
    named = NodeContract(**{**vars(contract), "memory_group": str(tmp_path / "group"), "memory_limit": 64})
    limit = MemoryLimit(named)  # an ordinary directory has no limits
    path = tmp_path / "group" / "memory.limit_in_bytes"
    assert limit.problem == f"muster: memory is not limited to 64 MiB: No such file or directory: {path}"
    assert (limit.group, limit.is_used_up(), killed_for_memory(str(tmp_path))) == ("", False, False)


def test_a_rank_whose_group_is_gone_starts_all_the_same(tmp_path: Path) -> None:
    ended = subprocess.run(
        tied(["sh", "-c", "exit 7"], group=str(tmp_path / "gone")), stderr=subprocess.PIPE, text=True
    )
    assert ended.returncode == 7 and "cgroup.procs" in ended.stderr


def test_the_environment_is_passed_on_as_it_is(tmp_path: Path) -> None:
    """Also variables with names that a shell can't have, and those that it sets."""
    (tmp_path / "cgroup.procs").touch()
    sent = {
        "my.var": "1",
        "A b": "2",
        "BASH_FUNC_x%%": "() { :; }",
        "IFS": ":",
        "LC_ALL": "C.UTF-8",  # Python adds LC_CTYPE where the locale is C
        "PPID": "7",
        "PATH": os.environ["PATH"],
    }
    ended = subprocess.run(tied(["env", "-0"], group=str(tmp_path)), env=sent, stdout=subprocess.PIPE, text=True)
    assert dict(each.split("=", 1) for each in ended.stdout.split("\0")[:-1]) == sent
    assert (tmp_path / "cgroup.procs").read_text() == "0"


def test_what_the_doctor_says_is_so(group: str) -> None:
    assert limits_memory(own_group())
