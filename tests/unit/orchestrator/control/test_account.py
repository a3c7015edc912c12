"""The account and the region in a controller's ARNs."""

from __future__ import annotations

from typing import Any

import pytest

from orchestrator.control.account import DEFAULT, Account, recognise
from orchestrator.control.compute_environments import ensure_compute_environments
from orchestrator.domain.errors import UsageError
from orchestrator.persistence.batch_models import Job, JobDefinition, JobQueue
from orchestrator.persistence.own_models import LogGroup
from orchestrator.persistence.session import Database
from tests.support.orchestrator.rows import job


def start(database: Database, account: str | None = None, region: str | None = None) -> Account:
    with database.session() as session:
        return recognise(session, account, region)


def test_the_first_start_settles_both(database: Database) -> None:
    mine = start(database, "123456789012", "eu-central-1")
    assert mine == Account("123456789012", "eu-central-1", "aws")
    assert start(database) == start(database, "123456789012") == start(database, None, "eu-central-1") == mine
    for account, region in ((None, "us-east-1"), ("000000000000", None), ("123456789012", "eu-west-1")):
        with pytest.raises(UsageError, match=r"account 123456789012 in eu-central-1 since its first start.*begin anew"):
            start(database, account, region)


def test_without_options_the_arns_are_those_of_before(database: Database) -> None:
    assert start(database) == DEFAULT == Account("000000000000", "us-east-1", "aws")
    with pytest.raises(UsageError, match=r"--account-id 123456789012: .*000000000000 in us-east-1"):
        start(database, "123456789012")


@pytest.mark.parametrize("account", ["1", "12345678901a", "1234567890123", "１２３４５６７８９０１２"])
def test_a_malformed_account_settles_nothing(database: Database, account: str) -> None:
    with pytest.raises(UsageError, match="expected 12 digits"):
        start(database, account)
    assert start(database, "123456789012").id == "123456789012"


def temporary(database: Database) -> Account:
    with database.session() as session:
        return recognise(session, None, None, temporary=True)


def definition(name: str, environment: list[dict[str, str]]) -> JobDefinition:
    return JobDefinition(name=name, revision=1, document={"containerProperties": {"environment": environment}})


def test_a_temporary_controller_settles_nothing_and_its_jobs_go_along(database: Database) -> None:
    assert temporary(database) == DEFAULT
    with database.session() as session:
        ensure_compute_environments(session, ["local", "docker"])
        session.add(definition("own", [{"name": "MUSTER_SPEC", "value": "{}"}]))
        session.add(job("j", definition="arn:aws:batch:us-east-1:000000000000:job-definition/own:1"))
    mine = start(database, "123456789012", "cn-north-1")
    assert mine == temporary(database) == Account("123456789012", "cn-north-1", "aws-cn")
    with database.session() as session:
        found = session.get_one(Job, "j").definition
    assert found == "arn:aws-cn:batch:cn-north-1:123456789012:job-definition/own:1"


@pytest.mark.parametrize(
    "made",
    [definition("theirs", []), JobQueue(name="robots", compute_environments=["local"]), LogGroup(name="/g", tags={})],
)
def test_what_a_batch_client_has_made_meanwhile_settles_it(database: Database, made: Any) -> None:
    temporary(database)
    with database.session() as session:
        session.add(made)
    with pytest.raises(UsageError, match="000000000000 in us-east-1 since its first start"):
        start(database, "123456789012")
    assert start(database) == DEFAULT
