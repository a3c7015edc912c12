"""The database on SQLite and on a real PostgreSQL server: migrations, locks, history, and a controller on top."""

from __future__ import annotations

import json
import os
import shutil
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import httpx
import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import create_engine, select, text
from sqlalchemy.exc import IntegrityError

from orchestrator.control.account import DEFAULT, recognise
from orchestrator.control.usage import add_usage, charge, resource_seconds, usage_at
from orchestrator.control.work_queue import WorkQueue
from orchestrator.domain.errors import ApiError, RequestError, ServerError, UsageError
from orchestrator.persistence.access_keys import KeyStore, KeyUsageError
from orchestrator.persistence.batch_models import (
    Attempt,
    Base,
    ComputeEnvironment,
    Job,
    JobQueue,
    Node,
    now,
)
from orchestrator.persistence.own_models import RetentionStart, RunUse
from orchestrator.persistence.own_secrets import OwnSecrets
from orchestrator.persistence.queries import find_job
from orchestrator.persistence.schema import NEWEST
from orchestrator.persistence.session import Database, DatabaseError
from orchestrator.persistence.urls import shown
from orchestrator.server import Server
from tests.conftest import Serving, wait_for
from tests.support.orchestrator import postgres
from tests.support.orchestrator.databases import connected, lift_whole, make_older
from tests.support.orchestrator.rows import job


@pytest.fixture
def url(database_url: str) -> str:
    return database_url


@pytest.fixture
def opened(url: str) -> Iterator[Callable[[], Database]]:
    """Opens the database; all are closed at the end."""
    databases: list[Database] = []

    def make() -> Database:
        databases.append(Database(url))
        return databases[-1]

    yield make
    for database in databases:
        database.close()


def insert(url: str, table: str, rows: Iterable[Mapping[str, Any]]) -> None:
    """Rows of an older database, whose columns are known by their names alone."""
    with connected(url) as connection:
        for row in rows:
            columns, values = ", ".join(row), ", ".join(f":{name}" for name in row)
            connection.execute(text(f"INSERT INTO {table} ({columns}) VALUES ({values})"), dict(row))


OLD = {"name": "old", "queue": "default", "definition": "arn", "request": "{}", "node_properties": "{}"}
"""Of every old job."""


@pytest.mark.parametrize("history", ["new", "migrated"])
def test_a_new_and_a_migrated_database_match_the_tables(url: str, opened: Callable[[], Database], history: str) -> None:
    if history == "migrated":
        make_older(url, "0021")
    database = opened()
    with database.engine.connect() as connection:
        context = MigrationContext.configure(connection)
        assert compare_metadata(context, Base.metadata) == [] and context.get_current_revision() == NEWEST
    with database.session() as session:
        assert [queue.name for queue in session.scalars(select(JobQueue))] == ["default"]
        assert [each.name for each in session.scalars(select(ComputeEnvironment))] == ["local"]
        assert (session.get(RetentionStart, 1) is None) is (history == "new"), "a new one has nothing to count from"


def test_a_database_of_the_first_version_is_migrated_with_its_jobs(url: str, opened: Callable[[], Database]) -> None:
    make_older(url, "0001")
    facts = {**OLD, "run": "r", "status": "FAILED", "created_at": 5, "attempts_allowed": 3}
    insert(url, "jobs", [{"id": "j1", **facts}])
    insert(url, "attempts", [{"job_id": "j1", "number": 1, "epoch": 1, "nodes": "[]", "created_at": 5, "spent": True}])
    with connected(url) as connection:
        connection.execute(text("DROP TABLE alembic_version"))  # the first version had no migrations
    lift_whole(url)
    with opened().session() as session:
        old = session.get_one(Job, "j1")
        assert [attempt.number for attempt in old.attempts] == [1]
        assert (old.name, old.attempts_allowed, old.kind) == ("old", 3, "multinode")
        assert (old.tags, old.evaluate_on_exit) == ({}, [])
        assert recognise(session, None, None) == DEFAULT, "its clients know these ARNs"
        with pytest.raises(UsageError, match="000000000000 in us-east-1 since its first start"):
            recognise(session, "123456789012", None)


def test_keys_and_secrets_are_in_either_database_for_a_process_beside_its_controller(
    url: str, opened: Callable[[], Database], tmp_path: Path
) -> None:
    home = tmp_path / "home"
    home.mkdir()
    own = OwnSecrets(opened(), home)
    own["console"] = "a secret"
    keys = KeyStore(own)
    ann, bob = keys.create("ann", ["robots"]), keys.create("bob", share="lab")
    beside = Database(url, beside=True)
    try:
        existing = OwnSecrets(beside, home)
        others = KeyStore(existing)
        assert list(others.current().values()) == [ann, bob] and existing.get("console") == "a secret"
        others.delete("ann")
        with pytest.raises(KeyUsageError, match="there is a key bob already"):
            others.create("bob")
    finally:
        beside.close()
    assert list(keys.load().values()) == [bob]


def test_an_older_database_begins_with_retention_at_its_upgrade(url: str, opened: Callable[[], Database]) -> None:
    make_older(url, "0017")
    spec = {"train": {"rsl_rl": {"teacher_checkpoint": "teacher@3"}}, "evaluate": {"run": "read"}}
    pairs = [{"name": "MUSTER_SPEC", "value": json.dumps(spec)}, {"name": "MUSTER_PARENT", "value": "parent@9"}]
    properties = json.dumps({"nodeRangeProperties": [{"container": {"environment": pairs}}]})
    facts = {
        **OLD,
        "run": "r",
        "created_at": 5,
        "attempts_allowed": 1,
        "kind": "multinode",
        "priority": 0,
        "cancelled": False,
    }
    for name, status, own in (
        ("open", "RUNNABLE", properties),
        ("over", "FAILED", properties),
        ("batch", "FAILED", "{}"),
    ):
        insert(url, "jobs", [{**facts, "id": name, "status": status, "node_properties": own}])
    insert(url, "jobs", [{**facts, "id": "damaged", "status": "RUNNABLE", "node_properties": '{"MUSTER_SPEC": 1}'}])
    before = now()
    lift_whole(url)
    with opened().session() as session:
        start = session.get_one(RetentionStart, 1)
        assert before - 1 <= start.since <= now()
        native = dict(session.execute(select(Job.id, Job.from_yaml)).tuples().all())
        assert native == {"open": True, "over": True, "batch": False, "damaged": True}
        uses = {(each.job_id, each.run) for each in session.scalars(select(RunUse))}
        assert uses == {("open", "read"), ("open", "teacher"), ("open", "parent")}


def test_sqlite_watches_what_refers_to_what(tmp_path: Path) -> None:
    database = Database.at(tmp_path)
    with pytest.raises(IntegrityError), database.session() as session:
        session.add(Attempt(job_id="no such job", number=1, epoch=1, nodes=[]))
    database.close()


@pytest.mark.parametrize("revision", ["0020", "0001", None])
def test_an_older_database_is_refused_with_the_command_that_lifts_it(url: str, revision: str | None) -> None:
    make_older(url, revision or "0001")
    if revision is None:
        with connected(url) as connection:
            connection.execute(text("DROP TABLE alembic_version"))
    with pytest.raises(DatabaseError, match=r"is from before schema 0021; lift it, .* python -m docs") as refused:
        Database(url)
    assert str(refused.value).endswith(shown(url).removeprefix("sqlite:///"))
    lift_whole(url)
    lift_whole(url)
    Database(url).close()


def test_a_database_of_a_newer_version_is_refused_in_one_line(url: str, opened: Callable[[], Database]) -> None:
    first = opened()
    with first.engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    first.close()
    with pytest.raises(DatabaseError, match=r"written by a newer Muster \(schema 9999\); install that version"):
        Database(url)


def test_a_database_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(DatabaseError, match=r"^database sqlite:///.*nowhere/x.db: .*unable to open database file$"):
        Database(f"sqlite:///{tmp_path}/nowhere/x.db")
    with pytest.raises(DatabaseError) as refused:
        Database("postgresql+psycopg://muster:secret@127.0.0.1:1/none")
    assert "secret" not in str(refused.value) and "127.0.0.1:1/none" in str(refused.value)
    with pytest.raises(DatabaseError, match="nosuch"):
        Database("nosuch://x/y")


@pytest.mark.parametrize("how", ["{}", "sqlite:///{}"])
def test_a_database_file_of_any_path_is_private_and_has_one_controller(tmp_path: Path, how: str) -> None:
    path = tmp_path / "m.db"
    (tmp_path / "link.db").symlink_to(path)
    store = tmp_path / "store"
    before = os.umask(0o022)
    try:
        first = Server(tmp_path / "a", store=store, database=how.format(path))
        for other in (path, tmp_path / "link.db"):
            with pytest.raises(ServerError) as refused:
                Server(tmp_path / "b", store=store, database=how.format(other))
            output = f"database sqlite:///{other}: another controller has it; use that one, or stop it first"
            assert str(refused.value) == output
        modes = {name: (tmp_path / name).stat().st_mode & 0o777 for name in ("m.db", "m.db-wal", "m.db-shm")}
        assert set(modes.values()) == {0o600}, modes
        first.close()
        path.chmod(0o644)
        shutil.copy2(tmp_path / "a" / "sealing.key", tmp_path / "b")
        Server(tmp_path / "b", store=store, database=how.format(path)).close()
        assert path.stat().st_mode & 0o777 == 0o600
    finally:
        os.umask(before)


def test_a_controller_that_lost_its_database_refuses_writes_alone(postgresql: postgres.Server, tmp_path: Path) -> None:
    url = postgresql.new_database()
    losing = Server(tmp_path, database=url)
    losing.start()
    with pytest.raises(DatabaseError, match="another controller has it"):
        Database(url)
    other, waiter = create_engine(url).connect(), create_engine(url).connect()
    lock = f"SELECT pg_advisory_lock({0x6D7573746572})"
    waiting = threading.Thread(target=waiter.execute, args=(text(lock),), daemon=True)
    waiting.start()
    queued = text("SELECT count(*) FROM pg_locks WHERE locktype = 'advisory' AND NOT granted")
    wait_for(lambda: other.scalar(queued), 30, "the other one to wait for the lock")
    other.execute(text("SELECT pg_terminate_backend(pid) FROM pg_locks WHERE locktype = 'advisory' AND granted"))
    with httpx.Client(base_url=losing.url, timeout=60) as client:
        try:
            wait_for(lambda: losing.controller.trouble, 30, "that it notices")
            for operation, request in (
                ("canceljob", {"jobId": "x", "reason": "x"}),
                ("submitjob", {"jobName": "x", "jobQueue": "default", "jobDefinition": "x"}),
            ):
                answer = client.post(f"/v1/{operation}", json=request)
                assert answer.status_code == 503 and "another controller has it" in answer.json()["message"]
            assert client.post("/v1/listjobs", json={"jobQueue": "default"}).status_code == 200
            waiter.invalidate()
            waiter.close()
            wait_for(lambda: client.get("/healthz").status_code == 200, 30, "that it has the database again")
            answer = client.post("/v1/canceljob", json={"jobId": "x", "reason": "x"})
            assert answer.status_code == 400 and "does not exist" in answer.json()["message"]
        finally:
            waiter.close()
            other.close()
            losing.close()


def test_a_commit_tells_which_jobs_it_changed_and_a_rollback_tells_nothing(opened: Callable[[], Database]) -> None:
    database = opened()
    reported: list[set[str]] = []
    database.committed = lambda jobs: reported.append({each.id for each in jobs})
    with database.session() as session:
        session.add_all([job("a"), job("b")])
    with pytest.raises(RuntimeError), database.session() as session:
        session.get_one(Job, "a").stop_reason = "never"
        session.flush()
        raise RuntimeError
    with database.session() as session:
        session.get_one(Job, "b").status_reason = "changed"
    assert reported == [{"a", "b"}, {"b"}]


def test_the_work_queue_is_the_same_after_a_restart(opened: Callable[[], Database]) -> None:
    database, live = opened(), WorkQueue()
    database.committed = live.note
    with database.session() as session:
        states = ("SUBMITTED", "PENDING", "RUNNABLE", "STARTING", "RUNNING", "SUCCEEDED", "FAILED")
        session.add_all(job(status, status=status) for status in states)
        session.add(job("ending", status="RUNNABLE", stop_reason="enough"))
    fresh = WorkQueue()
    with database.session() as session:
        fresh.load(session)
    for work_queue, due in ((live, ["SUBMITTED", "ending"]), (fresh, ["PENDING", "SUBMITTED", "ending"])):
        assert [entry.job for entry in work_queue.waiting()] == ["RUNNABLE"]
        assert sorted(work_queue.active()) == ["RUNNING", "STARTING"]
        assert sorted(work_queue.take_due()) == due, "what was pending may have become ready while nobody looked"


def test_an_attempt_is_charged_for_its_use_and_losses(opened: Callable[[], Database]) -> None:
    def nodes() -> list[Node]:
        return [Node(host="h", gpus=gpus, cpus=4.0, memory=1) for gpus in (("0", "1"), ("2", "3"))]

    facts = {"job_id": "a", "created_at": 10_000}
    failed = Attempt(**facts, number=1, epoch=1, nodes=nodes(), stopped_at=70_000, ending="failed")
    charge(failed, None, 70_000)
    assert (failed.gpu_seconds, failed.cpu_seconds) == (240.0, 480.0)
    assert (failed.wasted_gpu_seconds, failed.wasted_cpu_seconds) == (240.0, 480.0), "it had saved nothing"
    done = Attempt(**facts, number=2, epoch=2, nodes=nodes(), stopped_at=20_000, ending="succeeded")
    charge(done, None, 20_000)
    assert (done.gpu_seconds, done.wasted_gpu_seconds) == (40.0, 0.0)
    assert resource_seconds(failed, 70_000) == 240.0


def test_the_use_of_a_share_halves_with_its_decay_time(opened: Callable[[], Database]) -> None:
    with opened().session() as session:
        add_usage(session, "default", "red", 100.0, 60, 1_000_000)
        add_usage(session, "default", "red", 10.0, 60, 1_060_000)
        assert usage_at(session, 1_060_000, {"default": 60}, []) == {("default", "red"): pytest.approx(60.0)}
        assert usage_at(session, 1_000_000, {"default": 60}, []) == {("default", "red"): pytest.approx(60.0)}
        assert usage_at(session, 1_060_000, {}, []) == {}


def test_a_job_is_found_by_id_name_or_beginning(opened: Callable[[], Database]) -> None:
    with opened().session() as session:
        session.add_all([job("aaaa1111", name="x"), job("aaaa2222", name="y"), job("aaaa2222:0", parent="aaaa2222")])
        session.flush()
        texts = ("aaaa1111", "y", "aaaa2", "aaa", "aaaa2222:0")
        found = [(each := find_job(session, text)) and each.id for text in texts]
        with pytest.raises(
            RequestError, match=r"^several .* starts with aaaa: aaaa1111 \(x\), aaaa2222 \(y\); write more of it$"
        ):
            find_job(session, "aaaa")
    assert found == ["aaaa1111", "aaaa2222", "aaaa2222", None, "aaaa2222:0"]


def test_a_controller_on_postgresql_runs_jobs_and_is_succeeded(postgresql: postgres.Server, tmp_path: Path) -> None:
    url = postgresql.new_database()
    with Serving(tmp_path / "home", "--cpus", "2", "--database", url) as serving:
        job = serving.gang("print('hello from', __import__('os').environ['MUSTER_RUN'])", nodes=2, name="on-postgres")
        assert serving.wait(job)["status"] == "SUCCEEDED"
        for operation, request in (("DescribeJobs", {"jobs": ["a\0"]}), ("ListJobs", {"jobQueue": "a\0"})):
            with pytest.raises(ApiError, match="the database refuses a value") as refused:
                serving.client.batch(operation, **request)
            assert refused.value.status == 400
        running = serving.gang("import time; time.sleep(600)", name="running")
        serving.wait(running, "RUNNING")
        with postgresql.absent():
            with pytest.raises(ApiError, match="database postgresql") as absent:
                serving.gang("pass")
            assert absent.value.status == 503
            health = f"{serving.url}/healthz"
            trouble = lambda: (a := httpx.get(health)).status_code == 503 and "postgresql" in a.json()["message"]  # noqa: E731
            wait_for(trouble, 30, "its trouble")
        wait_for(lambda: httpx.get(health).status_code == 200, 30, "that it serves again")
        assert serving.wait(serving.gang("print('again')"))["status"] == "SUCCEEDED"
        assert serving.detail(running)["status"] == "RUNNING"
        serving.client.batch("TerminateJob", jobId=running, reason="enough")
        serving.wait(running)
        serving.kill()
        serving.start()
        detail = serving.detail(job)
        assert detail["status"] == "SUCCEEDED" and detail["attempts"][0]["cpuSeconds"] > 0
        assert any("hello from on-postgres-" in line for line in serving.log(job))
        assert not (serving.home / "muster.db").exists()
