"""The node contract: what an engine sets is what a node reads, and AWS's names mean what they mean on AWS."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared_store.contract.node import ContractError, NodeContract, rank_variables, sealed, sealed_in_image
from tests.support.refusals import refusal


def contract(**changes: Any) -> NodeContract:
    facts = {
        "job": "1f2e",
        "attempt": 2,
        "node_index": 0,
        "node_count": 3,
        "main_index": 0,
        "master_address": "127.64.0.1",
        "master_port": 29500,
        "run": "ant",
        "store": "/store",
        "epoch": 7,
        "job_epoch": 6,
    }
    return NodeContract(**{**facts, **changes})


names = st.text("abcXYZ019-_.", min_size=1, max_size=20)
seconds = st.integers(0, 100_000).map(lambda n: n / 100)


@given(
    st.builds(
        NodeContract,
        job=names,
        attempt=st.integers(1, 10**6),
        node_index=st.integers(0, 249),
        node_count=st.integers(1, 250),
        main_index=st.integers(0, 249),
        master_address=names,
        master_port=st.integers(1, 65535),
        run=names,
        store=st.text(min_size=1).filter(lambda text: "\0" not in text),
        epoch=st.integers(1, 10**9),
        job_epoch=st.integers(1, 10**9),
        ranks_per_node=st.integers(1, 16),
        grace=seconds,
        queue=names,
        compute_environment=names,
        cpus=seconds,
        address=st.none() | names,
        bus=st.none() | names,
        bus_token=st.none() | names,
    )
)
def test_a_node_reads_its_engine_s_variables(supplied_contract: NodeContract) -> None:
    assert NodeContract.from_env(supplied_contract.to_env()) == supplied_contract


def test_aws_variables_are_exactly_those_of_aws_on_the_main_node() -> None:
    env = contract(queue="q", compute_environment="ce").to_env()
    assert {name: value for name, value in env.items() if name.startswith("AWS_")} == {
        "AWS_BATCH_JOB_ID": "1f2e#0",
        "AWS_BATCH_JOB_ATTEMPT": "2",
        "AWS_BATCH_JOB_NODE_INDEX": "0",
        "AWS_BATCH_JOB_NUM_NODES": "3",
        "AWS_BATCH_JOB_MAIN_NODE_INDEX": "0",
        "AWS_BATCH_CE_NAME": "ce",
        "AWS_BATCH_JQ_NAME": "q",
        "AWS_EXECUTION_ENV": "MUSTER",
    }


@pytest.mark.parametrize(
    ("main", "ranks"), [(0, [0, 1, 2, 3]), (1, [1, 0, 2, 3]), (2, [1, 2, 0, 3]), (3, [1, 2, 3, 0])]
)
def test_rank_zero_is_on_the_main_node_whatever_its_index_and_the_others_get_its_address(
    main: int, ranks: list[int]
) -> None:
    nodes = [contract(node_index=i, node_count=4, main_index=main) for i in range(4)]
    given = [node.to_env() for node in nodes]
    assert [node.node_rank for node in nodes] == ranks == [int(env["NODE_RANK"]) for env in given]
    assert {(env["MASTER_ADDR"], env["MASTER_PORT"], env["NNODES"]) for env in given} == {("127.64.0.1", "29500", "4")}
    result = [env.get("AWS_BATCH_JOB_MAIN_NODE_PRIVATE_IPV4_ADDRESS") for env in given]
    assert result == [None if index == main else "127.64.0.1" for index in range(4)]


def test_our_own_variables_name_the_job_the_run_and_the_attempt() -> None:
    env = contract(ranks_per_node=2, grace=12.5, cpus=0.5, address="127.64.0.2").to_env()
    assert {name: value for name, value in env.items() if name.startswith("MUSTER_")} == {
        "MUSTER_JOB_ID": "1f2e",
        "MUSTER_RUN": "ant",
        "MUSTER_STORE": "/store",
        "MUSTER_EPOCH": "7",
        "MUSTER_JOB_EPOCH": "6",
        "MUSTER_GANG": "1f2e/2/7",
        "MUSTER_RANKS_PER_NODE": "2",
        "MUSTER_GRACE_SECONDS": "12.5",
        "MUSTER_CPUS": "0.5",
        "MUSTER_LOG_LIMIT": "1073741824",
        "MUSTER_ADDRESS": "127.64.0.2",
    }
    assert contract(node_count=3, ranks_per_node=8).world_size == 24


MISSING = "missing; a node is started by one of Muster's engines"
WHOLE = ("AWS_BATCH_JOB_ATTEMPT", "AWS_BATCH_JOB_NODE_INDEX", "MASTER_PORT", "MUSTER_EPOCH")
MALFORMED = [
    *((name, {name: ""}, MISSING) for name in ("MUSTER_JOB_ID", "MUSTER_RUN", "MUSTER_STORE", "MUSTER_EPOCH")),
    *(
        (name, {name: v}, f"{v!r}, not an integer; ")
        for name in WHOLE
        for v in ("two", "1.5", "--5", "²", "1_000", " 1")
    ),
    *(
        (name, {name: v}, f"{v!r}, not a number; ")
        for name in ("MUSTER_GRACE_SECONDS", "MUSTER_CPUS")
        for v in ("soon", "", "nan", "inf", "-1")
    ),
]


@pytest.mark.parametrize(("name", "change", "message"), MALFORMED)
def test_a_missing_or_malformed_variable_is_named_with_its_value(
    name: str, change: dict[str, str], message: str
) -> None:
    whole = contract().to_env()
    for env in ({**whole, **change}, *([{k: v for k, v in whole.items() if k != name}] if message == MISSING else [])):
        assert refusal(NodeContract.from_env, env, error=ContractError).startswith(f"{name} is {message}")


def test_optional_variables_have_defaults_and_a_single_node_job_has_none_of_nodes() -> None:
    env = {"MUSTER_JOB_ID": "j", "MUSTER_RUN": "r", "MUSTER_STORE": "/s", "MUSTER_EPOCH": "4"}
    assert NodeContract.from_env(env) == NodeContract(
        "j", 1, 0, 1, 0, "127.0.0.1", 29500, "r", "/s", 4, 4, is_gang=False
    )
    env = contract(is_gang=False, array=(2, 5)).to_env()
    assert env["AWS_BATCH_JOB_ID"] == "1f2e" and not any("NODE" in name for name in env if name.startswith("AWS"))
    assert (env["AWS_BATCH_JOB_ARRAY_INDEX"], env["AWS_BATCH_JOB_ARRAY_SIZE"]) == ("2", "5")
    assert NodeContract.from_env(env).array == (2, 5)


def test_a_job_s_variables_pass_the_supervisor_unread_and_never_replace_the_contract() -> None:
    ours = contract().to_env()
    job = {"PYTHONPATH": "/mine", "LD_PRELOAD": "x.so", "PATH": "/mine/bin", "MUSTER_EPOCH": "99", "MINE": "\n="}
    supervisor = {"PATH": "/bin", "HOME": "/root", **sealed(job, ours)}
    assert [supervisor.get(name) for name in ("PYTHONPATH", "LD_PRELOAD", "PATH", "MINE")] == [None, None, "/bin", None]
    assert NodeContract.from_env(supervisor) == NodeContract.from_env(ours)
    assert rank_variables(supervisor) == {"HOME": "/root", **job, **ours}
    assert sealed_in_image(job, ours)["PATH"] == "/mine/bin", "where a container's Python is looked for"
