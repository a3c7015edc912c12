"""The rows of log groups: how many there may be, and where the nodes of an attempt log."""

from __future__ import annotations

import pytest
from sqlalchemy.orm import Session

from orchestrator.domain.errors import RequestError
from orchestrator.persistence import log_groups
from orchestrator.persistence.own_models import LogGroup


def test_each_key_has_room_for_a_thousand_groups_and_for_those_that_are_there(session: Session) -> None:
    log_groups.check_room(session, ["/a"], "key alice")
    session.add_all(LogGroup(name=f"/{number}", owner="key alice") for number in range(log_groups.MOST))
    log_groups.check_room(session, ["/1", "/2"], "key alice")
    log_groups.check_room(session, [], "key alice")
    with pytest.raises(RequestError, match="key alice has 1000 log groups, and may have 1000"):
        log_groups.check_room(session, ["/1", "/a"], "key alice")
    log_groups.check_room(session, ["/a"], "key bob")
