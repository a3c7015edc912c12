"""The supervisor as engines start it: what it starts, what it gives, and what it writes down. All of it is real."""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from shared_store.volume.logs import parse_line
from tests.conftest import PATIENCE, wait_for
from tests.support.faults.full_disk import full_volume
from tests.support.worker.node import Node, Nodes

# -- output -----------------------------------------------------------------------------------------------------------


def test_the_output_of_all_ranks_is_merged_with_rank_and_stream(node: Nodes) -> None:
    n = node(node_index=1, node_count=2, ranks_per_node=2)
    assert n.shell('echo "to out"; echo "to err" >&2') == 0
    output = {(rank, *each) for rank in (2, 3) for each in (("e", "to err"), ("o", "to out"))}
    assert set(n.lines()[:-1]) == output and len(n.lines()) == 5
    assert n.lines()[-1] == (None, "o", "node 1 ended: done")
    outcome = n.ended()
    assert (outcome.node, outcome.epoch, outcome.exit_code, outcome.reason) == (1, 1, 0, "done")
    assert (outcome.signal, outcome.error) == (None, None)
    assert time.time() - 20 * PATIENCE < outcome.started < outcome.ended <= time.time()


def test_lines_are_in_the_log_while_the_rank_still_runs_and_none_before_its_end_is_lost(node: Nodes) -> None:
    n = node()
    numbers = "for i in range(5000): print(f'{i:020d}')\nprint('no newline', end='')"
    n.start(sys.executable, "-c", f"import time; print('now', flush=True); time.sleep(1)\n{numbers}")
    n.wait_for_output("now")
    assert n.process.poll() is None
    assert n.wait() == 0
    assert n.output() == ["now", *(f"{i:020d}" for i in range(5000)), "no newline"]


def test_a_line_of_any_length_is_kept_whole_or_cut_but_never_lost(node: Nodes) -> None:
    n = node()
    assert n.python("print('x' * 400_000); print('after'); print('y' * 70_000, end='')") == 0
    output = n.output()
    after = output.index("after")
    assert set("".join(output[:after])) == {"x"}
    assert len("".join(output[:after])) == 400_000
    assert "".join(output[after + 1 :]) == "y" * 70_000


@pytest.mark.parametrize("locale", ["C.UTF-8", "C", "POSIX"])
def test_bytes_other_than_text_are_replaced_and_of_a_progress_bar_the_last_state_is_kept(
    node: Nodes, locale: str
) -> None:
    n = node()
    script = r"printf 'a\377\376b\ngr\303\274n\n\000\n10%%\r20%%\r30%%\nwindows\r\n50%%\r60%%\r'"
    assert n.shell(script, LC_ALL=locale, PYTHONUTF8="0", PYTHONCOERCECLOCALE="0") == 0
    assert n.output() == ["a\ufffd\ufffdb", "grün", "\0", "30%", "windows", "60%"]


def test_a_log_that_cannot_be_written_does_not_stop_the_ranks(node: Nodes) -> None:
    n = node()
    with full_volume(n.run.log("job", 1, 0).parent):
        assert n.python("for _ in range(5000): print('x' * 100)\nraise SystemExit(5)") == 5
        assert n.ended().exit_code == 5
    assert n.stderr.read_text() == "log of node 0 can't be written: No space left on device\n"


def test_the_exit_code_is_the_ranks_even_if_nothing_can_be_written(node: Nodes) -> None:
    n = node()
    (n.run.path / "outcomes").write_text("a file where a directory should be")
    assert n.shell("exit 6") == 6
    assert n.stderr.read_text() == "outcome of node 0 can't be written: Not a directory\n"
    n.stderr.unlink()
    n.stderr.symlink_to("/dev/full")
    shutil.rmtree(n.run.log("job", 1, 0).parent)
    with full_volume(n.run.log("job", 1, 0).parent):
        assert n.python("print('x')\nraise SystemExit(5)") == 5


def test_when_the_volume_has_room_again_the_log_goes_on_with_whole_lines(node: Nodes) -> None:
    n = node()
    write, least = "import time\nfor i in range(150): print(f'{i:03d}', 'x' * 100, 'end'); time.sleep(0.01)", 5000
    limit = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({least}, -1))"
    main = "import sys; from worker.node.supervisor import main; sys.exit(main(sys.argv[1:]))"
    # Python itself must write nothing meanwhile: it takes a module that it could cache by half for whole
    n.start(sys.executable, "-uc", write, program=("-c", f"{limit}; {main}"), PYTHONDONTWRITEBYTECODE="1")
    wait_for(lambda: "can't be written" in n.stderr.read_text(), 10, "a refused write")
    time.sleep(0.2)
    resource.prlimit(n.process.pid, resource.RLIMIT_FSIZE, (-1, -1))
    assert n.wait() == 0
    raw = n.run.log("job", 1, 0).read_text().split("\n")
    texts = [line.text for text in raw if (line := parse_line(text, 1, 0))]
    numbers = [int(text[:3]) for text in texts if re.fullmatch(r"\d{3} x{100} end", text)]
    assert numbers[-1] == 149
    assert numbers == sorted(set(numbers))
    other = [text for text in raw[:-1] if not re.search(r"(\d{3} x{100} end|ended: done)$", text)]
    assert len(other) == 1 and f" {150 - len(numbers)} lines (" in other[0] and "left out" in other[0]


def test_a_flooded_log_keeps_both_ends_and_counts_the_middle(node: Nodes) -> None:
    n = node(log_limit=1 << 20)
    assert n.python("for i in range(60_000): print(f'{i:020d}')\nraise SystemExit('the error')") == 1
    output = [text for text in n.output() if text.isdigit()]
    assert output[0] == f"{0:020d}" and output[-1] == f"{59_999:020d}" and len(output) < 40_000
    [gap] = [text for _, _, text in n.lines() if text.startswith("…")]
    assert gap.startswith(f"… {60_000 - len(output):,} lines (")
    assert "the error" in n.output() and n.lines()[-1][2].startswith("node 0 ended")
    assert sum(path.stat().st_size for path in n.run.logs("job", 1).iterdir()) <= 1 << 20


# -- environment ------------------------------------------------------------------------------------------------------

PRINT_ENVIRONMENT = "import json, os; print(json.dumps(dict(os.environ)))"


def environment_of_ranks(n: Node, **env: str) -> list[dict[str, str]]:
    assert n.python(PRINT_ENVIRONMENT, **env) == 0
    return sorted(map(json.loads, n.output()), key=lambda found: int(found["RANK"]))


def test_ranks_have_exactly_the_environment_that_torchrun_gives(node: Nodes) -> None:
    n = node(node_index=0, node_count=3, main_index=1, ranks_per_node=2, attempt=4, cpus=8.0)
    first, second = environment_of_ranks(n)
    for local, found in enumerate((first, second)):
        error_file = found.pop("TORCHELASTIC_ERROR_FILE")
        assert Path(error_file).name == f"error-{local}.json"
        assert found.pop("MUSTER_PROGRESS_FD").isdigit()
        added = {name: value for name, value in found.items() if n.environment.get(name) != value}
        assert added == {
            "RANK": str(2 + local),  # the main node is index 1 and has ranks 0 and 1
            "LOCAL_RANK": str(local),
            "WORLD_SIZE": "6",
            "LOCAL_WORLD_SIZE": "2",
            "GROUP_RANK": "1",
            "GROUP_WORLD_SIZE": "3",
            "ROLE_NAME": "default",
            "ROLE_RANK": str(2 + local),
            "ROLE_WORLD_SIZE": "6",
            "TORCHELASTIC_RUN_ID": "job",
            "TORCHELASTIC_RESTART_COUNT": "3",
            "TORCHELASTIC_MAX_RESTARTS": "0",
            "TORCHELASTIC_USE_AGENT_STORE": "False",
            "TORCH_NCCL_ASYNC_ERROR_HANDLING": "1",
            "OMP_NUM_THREADS": "4",
            "PYTHONUNBUFFERED": "1",
            "NCCL_SOCKET_IFNAME": "lo",
            "GLOO_SOCKET_IFNAME": "lo",
        }
        assert (found["MASTER_ADDR"], found["MASTER_PORT"]) == ("127.0.0.1", "29500")


def test_variables_of_the_user_are_kept_except_those_of_the_ranks_placement(node: Nodes) -> None:
    n = node(cpus=4.0)
    [found] = environment_of_ranks(n, OMP_NUM_THREADS="3", NCCL_SOCKET_IFNAME="ib0", RANK="7", WORLD_SIZE="9")
    assert (found["OMP_NUM_THREADS"], found["NCCL_SOCKET_IFNAME"]) == ("3", "ib0")
    assert (found["RANK"], found["WORLD_SIZE"]) == ("0", "1")


def test_a_rank_that_reads_its_standard_input_finds_it_at_its_end(node: Nodes) -> None:
    assert node().call("cat") == 0


# -- what can't be started --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "problem"), [("no-such-program", "No such file or directory"), ("/tmp", "Permission denied")]
)
def test_a_command_that_cannot_be_started_is_reported_with_a_remedy(node: Nodes, command: str, problem: str) -> None:
    n = node(ranks_per_node=2)
    assert n.call(command, "argument") == 127
    reason = f"can't start {command!r}: {problem}; is it installed, and is the path right?"
    assert (n.ended().exit_code, n.ended().reason, n.ended().cannot_start) == (127, reason, True)
    assert n.lines() == [(None, "e", reason)]


BY_ENGINE = "a node is started by one of Muster's engines"


@pytest.mark.parametrize(
    ("change", "output"),
    [
        ({"EPOCH": ""}, "RUN/EPOCH: expected an integer of at most 15 digits, found ''"),
        ({"MUSTER_JOB_ID": None}, f"MUSTER_JOB_ID is missing; {BY_ENGINE}"),
        ({"MUSTER_STORE": None}, f"MUSTER_STORE is missing; {BY_ENGINE}"),
        ({"MUSTER_EPOCH": "x"}, f"MUSTER_EPOCH is 'x', not an integer; {BY_ENGINE}"),
        ({"MUSTER_GRACE_SECONDS": "x"}, f"MUSTER_GRACE_SECONDS is 'x', not a number; {BY_ENGINE}"),
        (
            {"MUSTER_RUN": "../x"},
            "run name '../x': use letters, digits, '.', '_' and '-' only, at most 128 of them, the first a letter or digit",
        ),
        ({"MUSTER_STORE": "/dev/null"}, "store: Not a directory: /dev/null/runs/run/EPOCH"),
    ],
)
def test_a_broken_contract_is_one_line(node: Nodes, tmp_path: Path, change: dict[str, str | None], output: str) -> None:
    n = node()
    for name, value in change.items():
        if value is None:
            del n.environment[name]
        elif name == "EPOCH":
            (n.run.path / name).write_text(value)
        else:
            n.environment[name] = value
    assert n.call("touch", str(tmp_path / "started")) == 2
    assert n.stderr.read_text() == f"muster supervisor: {output.replace('RUN', str(n.run.path))}\n"
    assert not (tmp_path / "started").exists()


def test_a_store_that_is_not_the_controllers_is_reported_before_any_start(node: Nodes, tmp_path: Path) -> None:
    n = node(epoch=3)
    (tmp_path / "other" / "runs").mkdir(parents=True)
    main = "import sys; from shared_store.volume import epoch; epoch.find_epoch.__defaults__ = (0.5,); "
    main += "from worker.node.supervisor import main; sys.exit(main(sys.argv[1:]))"
    n.start("touch", str(tmp_path / "started"), program=("-c", main), MUSTER_STORE=str(tmp_path / "other"))
    assert n.wait() == 2
    assert n.stderr.read_text() == (
        f"muster supervisor: store {tmp_path}/other on {socket.gethostname()} is not the controller's: run run has epoch 0 there, "
        "not 3; mount the same volume at this path on every node\n"
    )
    assert not (tmp_path / "started").exists() and not list((tmp_path / "other" / "runs").iterdir())


@pytest.mark.parametrize("arguments", [[], ["--"], ["sleep", "60"]])
def test_a_wrong_call_prints_the_usage(arguments: list[str]) -> None:
    command = [sys.executable, "-P", "-m", "worker.supervisor", *arguments]
    called = subprocess.run(command, capture_output=True, text=True, timeout=20 * PATIENCE)
    assert (called.returncode, called.stderr) == (2, "usage: python -m worker.supervisor -- COMMAND [ARG …]\n")


def test_nothing_is_left_in_the_temporary_directory(node: Nodes, tmp_path: Path) -> None:
    n = node()
    (tmp_path / "scratch").mkdir()
    assert n.shell("exit 1", TMPDIR=str(tmp_path / "scratch")) == 1
    assert os.listdir(tmp_path / "scratch") == []
    shutil.rmtree(tmp_path / "scratch")
