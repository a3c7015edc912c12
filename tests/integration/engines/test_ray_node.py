"""The work of Ray's actor on a node, without Ray: it starts the supervisor, and nothing of the node outlives its stop or its own death."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from orchestrator.engines.ray.node import Node
from shared_store.contract.node import NodeContract
from shared_store.process.processes import end_all, find_process
from shared_store.volume.epoch import raise_epoch
from shared_store.volume.layout import Store
from shared_store.volume.log_view import LogView
from shared_store.volume.node_outcomes import read_outcome
from tests.conftest import wait_for
from tests.support.processes import alive, await_end, frozen

ESCAPE = "echo $$; env -i setsid sh -c 'echo $$; exec sleep 600' & exec sleep 600"
ACTOR = """
import json, sys, time
from orchestrator.engines.ray.node import Node
node = Node({"MUSTER_GANG": "ray-node/1/1", "NODE_RANK": "0"}, 1e9)
print(node.start([], sys.argv[2:], {}, json.loads(sys.argv[1]), 0, None), flush=True)
time.sleep(600)
"""


@pytest.fixture
def contract(tmp_path: Path) -> NodeContract:
    store = Store(tmp_path).open()
    raise_epoch(store.run("run"), 1)
    facts = {"node_index": 0, "node_count": 1, "main_index": 0, "master_address": "127.0.0.1", "master_port": 29500}
    facts |= {"job": "ray-node", "attempt": 1, "run": "run", "store": str(tmp_path), "epoch": 1, "job_epoch": 1}
    return NodeContract(**facts, grace=5.0)


def pids(contract: NodeContract) -> list[int]:
    """The process ids that the rank and its escaped process printed."""

    def both() -> list[int] | None:
        lines = [line.text for line in LogView.of(Store(contract.store).run("run"), "ray-node").drain()]
        found = [int(line) for line in lines if line.isdigit()]
        return found if len(found) == 2 else None

    found: list[int] = wait_for(both, 20, "two processes")
    return found


def test_a_stopped_node_leaves_nothing_and_names_a_process_that_can_t_be_killed(
    contract: NodeContract, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shared_store.process.node_processes.end_all", lambda find, strike: end_all(find, 0.5, strike))
    node = Node({"MUSTER_GANG": contract.gang, "NODE_RANK": "0"}, 1e9)
    user = {"PYTHONPATH": str(tmp_path), "MUSTER_EPOCH": "9"}
    (tmp_path / "queue.py").write_text("MINE = True")
    assert node.start([], ["sh", "-c", ESCAPE], user, contract.to_env(), 0, None) == ""
    _, escaped = found = pids(contract)
    wait_for(lambda: (process := find_process(escaped)) and process.name == "sleep", 20, "it sleeps")
    with frozen(escaped):
        assert node.stop(1.0).startswith(f"SIGKILL does not end process {escaped} (sleep), state D")
    assert node.stop(5.0) == ""
    assert not any(alive(pid) for pid in found)
    node.wait()


PRINT_ENVIRONMENT = "import os; print(*sorted(os.environ))"


def test_a_node_has_of_its_machine_s_variables_what_programs_need_and_what_a_user_names(
    contract: NodeContract, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("HF_TOKEN", "WANDB_API_KEY", "KUBECONFIG", "RAY_JOB_ID", "NCCL_DEBUG"):
        monkeypatch.setenv(name, "value")
    monkeypatch.setenv("MUSTER_INHERIT", "KUBECONFIG")
    node = Node({"MUSTER_GANG": contract.gang, "NODE_RANK": "0"}, 1e9)
    command = [sys.executable, "-c", PRINT_ENVIRONMENT]
    assert node.start([], command, {"MINE": "1"}, contract.to_env(), 0, None, ["HF_TOKEN"]) == ""
    assert node.wait() == (0, "")
    printed = [line.text for line in LogView.of(Store(contract.store).run("run"), "ray-node").drain()]
    found = {name for line in printed for name in line.split()}
    assert {"HF_TOKEN", "KUBECONFIG", "NCCL_DEBUG", "MINE", "PATH"} <= found
    assert not found & {"WANDB_API_KEY", "RAY_JOB_ID", "MUSTER_INHERIT"}
    node.stop(1.0)


def test_a_node_leaves_nothing_when_its_actor_is_killed(contract: NodeContract) -> None:
    command = [sys.executable, "-P", "-c", ACTOR, json.dumps(contract.to_env()), "sh", "-c", ESCAPE]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as actor:
        found = pids(contract)
        actor.kill()
    await_end(*found)
    assert read_outcome(Store(contract.store).run("run"), "ray-node", 1, 0) is None
