"""The line between a gang's nodes, and what a node of a Slurm job makes of its surroundings."""

from __future__ import annotations

import json
import socket
import time

import pytest

from shared_store.contract.node import NodeContract, job_variables
from tests.conftest import wait_for
from worker.node import aws_batch as lifeline
from worker.node.aws_batch import ChildEnd, Loss, MainEnd
from worker.node.slurm import environment_of


def contract(node: int, nodes: int, address: str) -> NodeContract:
    return NodeContract("job", 1, node, nodes, 0, address, 29500, "run", "/store", 1, 1, address=address)


def received(main: MainEnd) -> Loss:
    found: Loss = wait_for(main.lost, 10, "a loss")
    return found


def test_a_childs_last_message_counts_and_a_cut_connection_is_a_death() -> None:
    main = MainEnd(contract(0, 4, "127.91.0.1"))
    children = [ChildEnd(contract(node, 4, "127.91.0.1")) for node in (1, 2, 3)]
    for child in children:
        child.attach()
    del child
    assert main.lost() is None
    children[0].report(0, "done")
    children[1].report(75, "checkpointed and left on request")
    del children[0], children[0]
    assert main.lost() is None, "neither is a failure"
    children[0].report(3, "rank 3 exited with code 3")
    del children[0]
    assert received(main) == Loss("node 3: rank 3 exited with code 3", 3)
    assert main.lost() is None, "reported once"


def test_a_cut_connection_is_a_death_and_that_of_a_stranger_is_not() -> None:
    main = MainEnd(contract(0, 2, "127.91.0.2"))
    stranger = socket.create_connection(("127.91.0.2", lifeline.PORT))
    stranger.sendall(b"GET / HTTP/1.0\r\n\r\n[1]\n{}\n")
    child = ChildEnd(contract(1, 2, "127.91.0.2"))
    child.attach()
    stranger.close()
    assert main.lost() is None
    del child
    assert received(main).reason == "node 1 vanished: its supervisor or its host died"


def test_messages_that_no_child_sends_are_ignored() -> None:
    main, ours = MainEnd(contract(0, 2, "127.91.0.4")), contract(0, 2, "127.91.0.4").gang
    strangers = [
        *({"gang": ours}, {"gang": ours, "node": "1"}, {"gang": ours, "node": None, "code": 3}),
        *({"gang": ours, "code": "three", "reason": 3}, {"gang": ours, "more": 1}),
    ]
    for words in strangers:
        with socket.create_connection(("127.91.0.4", lifeline.PORT)) as stranger:
            stranger.sendall(json.dumps(words).encode() + b"\n")
    for _ in range(20):
        assert main.lost() is None
        time.sleep(0.01)
    with socket.create_connection(("127.91.0.4", lifeline.PORT)) as child:
        child.sendall(json.dumps({"gang": ours, "node": 1, "code": 3}).encode() + b"\n")
    assert received(main) == Loss("node 1: ", 3), "one that lost half of its last word"


def test_a_child_that_never_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lifeline, "_ARRIVAL", 0.2)
    main = MainEnd(contract(0, 3, "127.91.0.3"))
    child = ChildEnd(contract(1, 3, "127.91.0.3"))
    child.attach()
    assert received(main).reason.startswith("node 2 has not come within")


def test_a_node_gets_slurms_variables_but_not_the_token_that_its_controller_called_sbatch_with() -> None:
    contract = NodeContract("job", 1, 0, 1, 0, "127.0.0.1", 29500, "run", "/store", 1, 1)
    reported = {"kind": [0], "kinds": [{"environment": {"LEVEL": "3"}}]}
    found = environment_of(reported, contract, {"SLURM_JWT": "secret", "SLURM_NNODES": "2", "PATH": "/bin"})
    assert "secret" not in found.values()
    assert (found["SLURM_NNODES"], found["MUSTER_RUN"]) == ("2", "run")
    assert job_variables(found) == {"LEVEL": "3"}
