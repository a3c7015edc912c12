"""The rows of log groups: how many there may be, and where the nodes of an attempt log."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator.domain.errors import RequestError
from orchestrator.persistence import log_groups
from orchestrator.persistence.batch_models import Node
from orchestrator.persistence.own_models import LogGroup
from tests.support.definitions import container
from tests.support.orchestrator.rows import job


def names(session: Session) -> list[str]:
    return list(session.scalars(select(LogGroup.name).order_by(LogGroup.name)))


def test_each_key_has_room_for_a_thousand_groups_and_for_those_that_are_there(session: Session) -> None:
    log_groups.check_room(session, ["/a"], "key alice")
    session.add_all(LogGroup(name=f"/{number}", owner="key alice") for number in range(log_groups.MOST))
    log_groups.check_room(session, ["/1", "/2"], "key alice")
    log_groups.check_room(session, [], "key alice")
    with pytest.raises(RequestError, match="key alice has 1000 log groups, and may have 1000"):
        log_groups.check_room(session, ["/1", "/a"], "key alice")
    log_groups.check_room(session, ["/a"], "key bob")


def test_a_new_attempt_records_where_each_node_logs_and_makes_a_deleted_group_again(session: Session) -> None:
    def part(target: str, **options: str) -> dict[str, Any]:
        log = {"logDriver": "awslogs", "options": options}
        return {"targetNodes": target, "container": {**container(["true"], "1", {}), "logConfiguration": log}}

    ranges = [
        part("0", **{"awslogs-group": "/aws/batch/job"}),
        part("1", **{"awslogs-group": "/own", "awslogs-stream-prefix": "p"}),
        part("2", **{"awslogs-stream-prefix": ""}),
    ]
    known = job("j", owner="alice", node_properties={"numNodes": 3, "mainNode": 0, "nodeRangeProperties": ranges})
    nodes = [Node(index=index, host="h") for index in range(2)]  # an elastic gang may have fewer
    log_groups.record_logs(session, known, nodes)
    log_groups.record_logs(session, known, nodes)
    assert [(node.log_group, node.log_prefix) for node in nodes] == [(None, None), ("/own", "p")]
    assert names(session) == ["/own"] and session.get_one(LogGroup, "/own").owner == "alice"
    assert known.gang.log_groups == {"/own"} and known.gang.nodes[2].log_prefix is None
