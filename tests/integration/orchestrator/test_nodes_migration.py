"""Databases of schema 0008, brought up to date: nothing is lost, and their jobs continue.

Since then the nodes of attempts, then JSON, have become rows, and two columns say that they hold compute environments.

``schema_0008.sql`` was written by the version that had that schema: its controller had run jobs into every state when it was
killed. The row of job ``submitted`` is a copy of that of ``runnable``, and ``starting`` lacks the handle of its gang, as where the
controller dies between the record of an attempt and its launch.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select, text

from orchestrator.domain.hosts import Placement
from orchestrator.persistence.batch_models import Attempt, Job, Node
from orchestrator.persistence.session import Database
from shared_store.volume.epoch import Claim, take_epoch
from shared_store.volume.layout import Store
from tests.support.orchestrator.databases import connected, lift_whole, make_older
from tests.support.orchestrator.jobs import await_status, detail, serving

DUMP = Path(__file__).parents[2] / "support" / "orchestrator" / "schema_0008.sql"
BEFORE = {name: name.upper() for name in ("submitted", "pending", "runnable", "starting", "running", "failed")}
BEFORE |= {"done": "SUCCEEDED", "array": "SUCCEEDED"}
"""State of each job in the dump."""


@pytest.fixture
def old(database_url: str) -> str:
    """URL of the database of the dump."""
    make_older(database_url, "0008")
    with connected(database_url) as connection:
        for line in DUMP.read_text().splitlines():
            if line.startswith("INSERT"):
                connection.exec_driver_sql(line)
    return database_url


def nodes_as_json(url: str) -> dict[tuple[str, int], list[dict[str, Any]]]:
    """The nodes of each attempt of a database of schema 0008."""
    with connected(url) as connection:
        rows = connection.execute(text("SELECT job_id, number, CAST(nodes AS VARCHAR) FROM attempts")).all()
    return {(job, number): json.loads(nodes) for job, number, nodes in rows}


def test_every_node_is_a_row_that_says_what_the_json_held(old: str) -> None:
    reported = nodes_as_json(old)
    lift_whole(old)
    database = Database(old)
    with database.session() as session:
        attempts = session.scalars(select(Attempt)).all()
        assert {(each.job_id, each.number): [node.shown() for node in each.nodes] for each in attempts} == reported
        assert {each.compute_environment for each in attempts} == {"local"}
        assert len(reported) == 7 and sum(len(nodes) for nodes in reported.values()) == 11
        main = session.scalars(select(Job).where(Job.name == "failed")).one().attempts[0].nodes[0]
        assert main.placement == Placement("localhost", (), 0.1, 16)
        assert (main.exit_code, main.error, main.met) == (1, 'RuntimeError: it\'s "over"', True)
        launched = session.scalars(select(Job).where(Job.name == "running")).one().attempts[0].nodes[1]
        assert (launched.exit_code, launched.stopped_at, launched.address) == (None, None, "127.98.96.2")
    database.close()


@pytest.mark.parametrize(
    "damaged",
    ["[1]", '[{"index": 0, "host": "h", "gpus": 1}]', "{}", '[{"index": 0, "host": "h"}, {}]'],
)
def test_nodes_of_older_and_damaged_attempts_are_read_as_far_as_they_can_be(old: str, damaged: str) -> None:
    reported = {"gpus": ["GPU-a", "GPU-b"], "devices": ["7"], "exitCode": 1, "reason": "a\0b\ud800"}
    kept = [{"index": 0, "host": "h", **reported}, {"index": 1, "host": "h"}]
    written = {1: json.dumps(kept), 2: damaged}
    with connected(old) as connection:
        which = "WHERE number = :number AND job_id = (SELECT id FROM jobs WHERE name = 'failed')"
        for number, nodes in written.items():
            connection.execute(text(f"UPDATE attempts SET nodes = :nodes {which}"), {"nodes": nodes, "number": number})
    lift_whole(old)
    database = Database(old)
    with database.session() as session:
        first, second = session.scalars(select(Job).where(Job.name == "failed")).one().attempts
        placements = [Placement("h", gpus, 0.0, 0) for gpus in (("GPU-a", "GPU-b"), ())]
        assert [node.placement for node in first.nodes] == placements
        assert (first.nodes[0].devices, first.nodes[0].reason) == (("7",), "a\\x00b\\ud800")
        assert first.nodes[1].devices is None
        assert second.nodes == []
    database.close()


def test_jobs_in_every_state_continue_where_the_older_controller_left_them(old: str, tmp_path: Path) -> None:
    (tmp_path / "home").mkdir(mode=0o700)
    store = Store(tmp_path / "home" / "store").open()
    before = nodes_as_json(old)
    with connected(old) as connection:
        jobs = dict(connection.execute(text("SELECT name, id FROM jobs WHERE parent IS NULL")).all())
        assert dict(connection.execute(text("SELECT name, status FROM jobs WHERE parent IS NULL")).all()) == BEFORE
    for name in ("starting", "running"):  # as the killed controller had made their runs
        run = store.run(f"{name}-{jobs[name][:8]}")
        run.create({"run": run.name, "queue": "default"})
        take_epoch(run, 0, Claim("killed", jobs[name], 1))
    lift_whole(old)
    with serving(tmp_path / "home", database=old) as client:
        for name in ("submitted", "pending", "runnable", "starting", "running"):
            ended = await_status(client, jobs[name], "SUCCEEDED", "FAILED")
            assert ended["status"] == "SUCCEEDED", f"{name}: {ended['statusReason']}"
        lost, again = detail(client, jobs["running"])["attempts"]
        assert (lost["ending"], again["ending"]) == ("failed", "succeeded"), "its processes were gone"
        assert [node["exitCode"] for node in again["nodes"]] == [0, 0]
        [started] = detail(client, jobs["starting"])["attempts"]
        assert started["ending"] == "succeeded", "the attempt that was recorded, launched now"
        over = [detail(client, jobs[name])["status"] for name in ("done", "failed", "array")]
        assert over == ["SUCCEEDED", "FAILED", "SUCCEEDED"]
        [done] = detail(client, jobs["done"])["attempts"]
        assert done["computeEnvironment"] == "local"
        answered = [{key: value for key, value in node.items() if key != "log"} for node in done["nodes"]]
        assert answered == [{**node, "progress": None, "running": False} for node in before[jobs["done"], 1]]


def test_a_text_that_no_column_can_hold_is_written_out() -> None:
    assert Node(reason="a\0b").reason == "a\\x00b"
    assert Node(error="\ud800 é").error == "\\ud800 é"
