"""Pages of the list of jobs, and the counts beside them: against a plain list, whatever happens between two pages."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Sequence
from typing import Any

import pytest
from sqlalchemy import delete, event, select, text
from sqlalchemy.orm import Session

from orchestrator.domain.errors import RequestError
from orchestrator.domain.job import Status
from orchestrator.persistence.batch_models import Attempt, Job, Node
from orchestrator.persistence.job_counts import ArrayRole, JobCounts, note_rows
from orchestrator.persistence.job_pages import contains, count, place_of, read_page
from orchestrator.persistence.keyset import Cursor
from orchestrator.persistence.session import Database

QUEUES = [f"queue-{number}" for number in range(60)]


def job(name: str, created_at: int, queue: str = "default", status: str = "RUNNABLE", **more: Any) -> Job:
    plain = {"definition": "d", "request": {}, "own_node_properties": {}, "run": more.pop("run", name)}
    return Job(id=name, name=name, queue=queue, status=status, created_at=created_at, **plain, **more)


def fill(database: Database, number: int, queues: Sequence[str] = QUEUES) -> list[Job]:
    """So many jobs, of which several are created in the same millisecond, and two children each of an array; the newest first."""
    draw = random.Random(number)
    made = [
        job(f"j{i:04}", draw.randrange(number // 3), draw.choice(queues), draw.choice(list(Status)))
        for i in range(number)
    ]
    with database.session() as session:
        session.add_all(made)
        session.add_all(
            job(f"{each.id}:{i}", each.created_at, each.queue, each.status, parent=each.id)
            for each in made
            for i in (0, 1)
        )
    return sorted(made, key=lambda each: (each.created_at, each.id), reverse=True)


def ids(jobs: Sequence[Job]) -> list[str]:
    return [each.id for each in jobs]


@pytest.mark.parametrize(
    ("queues", "statuses"),
    [
        (None, ()),
        (None, ("RUNNABLE", "FAILED", "FAILED")),
        (QUEUES[:3], ()),
        (QUEUES[:3], ("RUNNABLE", "SUCCEEDED")),
        (QUEUES, ("RUNNABLE", "SUCCEEDED")),  # more parts than are read one by one
        (["no such queue"], ()),
        ([], ()),
    ],
)
@pytest.mark.parametrize("most", [7, 100])
def test_pages_in_both_directions_are_the_whole_list_once(
    database: Database, queues: Sequence[str] | None, statuses: Sequence[str], most: int
) -> None:
    listed = fill(database, 300)
    expected = [each.id for each in listed if queues is None or each.queue in queues]
    expected = [each.id for each in listed if each.id in set(expected) and (not statuses or each.status in statuses)]
    with database.session() as session:
        forth, page = [], read_page(session, most, queues, statuses)
        assert page.is_first
        forth.append(page)
        while not page.is_last:
            page = read_page(session, most, queues, statuses, after=place_of(page.jobs[-1]))
            assert not page.is_first
            forth.append(page)
        assert [each for page in forth for each in ids(page.jobs)] == expected
        assert all(len(page.jobs) == most for page in forth[:-1])
        back = []
        while not page.is_first and page.jobs:
            page = read_page(session, most, queues, statuses, before=place_of(page.jobs[0]))
            back.append(page)
        assert [ids(page.jobs) for page in back] == [ids(page.jobs) for page in forth[-2::-1]]


def test_jobs_that_come_meanwhile_move_no_page_and_are_on_the_one_before(database: Database) -> None:
    listed = ids(fill(database, 90))
    with database.session() as session:
        first = read_page(session, 30)
        session.add_all(job(f"new-{i}", 1000 + i) for i in range(40))
        session.flush()
        second = read_page(session, 30, after=place_of(first.jobs[-1]))
        assert ids(second.jobs) == listed[30:60]
        session.execute(delete(Job).where(Job.id == second.jobs[-1].id))
        third = read_page(session, 30, after=place_of(second.jobs[-1]))
        assert ids(third.jobs) == listed[60:] and third.is_last, "the place of a job that is gone is still a place"
        beyond = read_page(session, 30, after=place_of(third.jobs[-1]))
        assert (beyond.jobs, beyond.is_last) == ([], True)
        newer = read_page(session, 30, before=place_of(first.jobs[0]))
        assert ids(newer.jobs) == [f"new-{i}" for i in range(29, -1, -1)] and not newer.is_first
        newest = read_page(session, 30, before=place_of(newer.jobs[0]))
        assert ids(newest.jobs) == [f"new-{i}" for i in range(39, 29, -1)] and newest.is_first


def test_a_place_is_read_as_it_was_written_and_nothing_else_is(database: Database) -> None:
    place = Cursor(1795911386873, "0f0f-1")
    assert Cursor.read(str(place)) == place
    for wrong in ("x", "-", "5", "5-", "-5-j", "٣-j", "1" * 16 + "-j", "5-\0", "5-\ud800", "5-é"):
        with pytest.raises(RequestError, match="is not a place in the list of jobs"):
            Cursor.read(wrong)


def test_a_search_finds_names_runs_owners_and_beginnings_of_ids_in_any_case(database: Database) -> None:
    with database.session() as session:
        session.add_all(
            [job("a-1", 1, owner="key Lab"), job("b-1", 2, run="LABor"), job("Laboratory", 3), job("c_1", 4)]
        )
        session.flush()

        def found(words: str) -> list[str]:
            return ids(read_page(session, 10, conditions=[contains(session, words)]).jobs)

        assert found("lab") == ["Laboratory", "b-1", "a-1"] and found("C_") == ["c_1"]
        assert found("-1") == ["b-1", "a-1"] and found("%") == found("zz") == []
        conditions = [contains(session, "1")]
        assert count(session, None, conditions, 10) == {"RUNNABLE": 3}
        assert count(session, None, conditions, 2) == {"RUNNABLE": 2} and count(session, ["x"], conditions, 10) == {}


def test_no_page_reads_rows_that_it_does_not_show_and_no_sort_of_the_table(database: Database) -> None:
    seen: list[tuple[str, Any]] = []
    event.listen(
        database.engine, "before_cursor_execute", lambda c, cursor, sql, values, *_: seen.append((sql, values))
    )
    place = Cursor(5, "j")
    with database.session() as session:
        for queues in (None, ["a"], ["a", "b"]):
            for statuses in ((), ("FAILED",), ("FAILED", "RUNNABLE")):
                read_page(session, 50, queues, statuses)
                read_page(session, 50, queues, statuses, after=place)
                read_page(session, 50, queues, statuses, before=place)
        count(session, None, [contains(session, "x")], 10)
        plans = [
            session.connection().exec_driver_sql(f"EXPLAIN QUERY PLAN {sql}", values) for sql, values in list(seen)
        ]
        steps = {row[3] for plan in plans for row in plan}
    scans = {step for step in steps if step.startswith("SCAN") and "jobs" in step}
    assert scans <= {"SCAN jobs USING COVERING INDEX ix_jobs_list"} and "SCAN jobs" not in steps, steps
    assert all("COVERING" in step for step in steps if "ix_jobs_list" in step), steps


def test_the_nodes_of_several_attempts_are_found_by_an_index(database: Database) -> None:
    seen: list[tuple[str, Any]] = []
    with database.session() as session:
        session.add_all(job(f"j{i}", i) for i in range(5))
        session.add_all(
            Attempt(job_id=f"j{i}", number=n, epoch=n, nodes=[Node(index=0, host=f"{i}.{n}")])
            for i in range(5)
            for n in (1, 2)
        )
    event.listen(
        database.engine, "before_cursor_execute", lambda c, cursor, sql, values, *_: seen.append((sql, values))
    )
    with database.session() as session:
        hosts = [[attempt.nodes[0].host for attempt in each.attempts] for each in read_page(session, 10).jobs]
        assert hosts == [[f"{i}.1", f"{i}.2"] for i in (4, 3, 2, 1, 0)]
        assert len(seen) == 3, "of the jobs, of all attempts, and of all nodes"
        sql, values = seen[2]
        (step, *_) = [row[3] for row in session.connection().exec_driver_sql(f"EXPLAIN QUERY PLAN {sql}", values)]
        assert step.startswith("SEARCH nodes USING INDEX")
        attempt = session.get_one(Attempt, ("j3", 2))
        session.expire(attempt, ["nodes"])
        assert [node.host for node in attempt.nodes] == ["3.2"], "also where those of one attempt alone are read again"


# -- counts ------------------------------------------------------------------------------------------------------------


def counted(session: Session) -> dict[str, int]:
    return dict(Counter(str(each) for each in session.scalars(select(Job.status).where(Job.parent.is_(None)))))


def gangs(session: Session) -> dict[tuple[str, str], int]:
    found = session.execute(select(Job.queue, Job.status).where(Job.kind != "array"))
    return dict(Counter((queue, str(status)) for queue, status in found))


def test_the_counts_follow_every_transaction_and_no_other(database: Database) -> None:
    fill(database, 50, ["a", "b"])
    database.counts.load(database.open())
    draw = random.Random(7)
    for turn in range(150):
        fails = draw.random() < 0.3
        try:
            with database.session() as session:
                for _ in range(draw.randrange(1, 6)):
                    change(session, draw, turn)
                if fails:
                    raise RequestError("no")
        except RequestError:
            pass
        with database.session() as session:
            assert database.counts.by_status() == counted(session), turn
            assert database.counts.gangs() == gangs(session), turn
    again = JobCounts()
    with database.session() as session:
        again.load(session)
    assert again.by_status() == database.counts.by_status() and again.by_status(["b"]) == database.counts.by_status(
        {"b"}
    )
    assert again.gangs() == database.counts.gangs()
    assert again.by_status(["a"]) != again.by_status() and again.by_status([]) == {}


def change(session: Session, draw: random.Random, turn: int) -> None:
    """One of the changes that the controller makes."""
    some = session.scalars(select(Job).order_by(Job.id)).all()
    one = draw.choice(some)
    match draw.randrange(6):
        case 0:
            name = f"t{turn}-{draw.randrange(10**9)}"
            kind = draw.choice(["array", "container"])
            session.add_all([job(name, turn, draw.choice("ab"), kind=kind), job(f"{name}:0", turn, "a", parent=name)])
        case 1:
            one.status = draw.choice(list(Status))
        case 2:
            one.status = draw.choice(list(Status))
            session.flush()
            one.status = draw.choice(list(Status))
        case 3:
            one.status_reason = "else"
            session.expire(one)
            one.status = draw.choice(list(Status))
        case 4:
            one.status = draw.choice(list(Status))  # what goes is the row that was
            session.delete(one)
        case 5:
            session.flush()
            rows = session.execute(select(Job.parent, Job.kind, Job.queue, Job.status).where(Job.id == one.id)).all()
            for parent, kind, queue, status in rows:
                note_rows(session, queue, status, ArrayRole.of(parent, kind), -1)
            session.expunge(one)
            session.execute(delete(Job).where(Job.id == one.id))


def test_a_commit_that_fails_counts_nothing(database: Database) -> None:
    with pytest.raises(Exception, match="constraint"), database.session() as session:
        session.add(job("one", 1))
        session.flush()
        session.execute(text("INSERT INTO attempts (job_id, number) VALUES ('none', 1)"))
    assert database.counts.by_status() == {}
