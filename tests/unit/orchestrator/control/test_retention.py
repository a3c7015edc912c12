"""Retention on a database and a store: what a pass takes, what a death at each step leaves, and who is in its way."""

from __future__ import annotations

import logging
import os
import re
import shutil
from collections.abc import Callable, Iterable
from math import inf
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from orchestrator.control import retention as module
from orchestrator.control.retention import RunNeeded
from orchestrator.control.retention_facts import Requester
from orchestrator.control.run_users import RunUsers
from orchestrator.domain.retention import A_DAY
from orchestrator.persistence import retention_rows
from orchestrator.persistence.batch_models import (
    Attempt,
    Dependency,
    JobDefinition,
    JobQueue,
    Node,
    RunRecord,
    now,
)
from orchestrator.persistence.keyset import Cursor
from orchestrator.persistence.own_models import RetentionStart, RunUse, ShareUsage
from shared_store.volume import contents, trash
from shared_store.volume.files import sync_directory, write_json
from shared_store.volume.layout import Store
from tests.support.orchestrator.retention import LONG_AGO, World
from tests.support.orchestrator.rows import job

ARN = "arn:aws:batch:us-east-1:000000000000:job-definition/"


def of_absent_plugin(store: Store) -> None:
    """Leave a folder of a plug-in that is not installed."""
    write_json(store.path / "plugins.json", {"absent": ["cards"]})
    (store.path / "cards").mkdir()


def test_a_pass_takes_old_jobs_of_the_batch_api_with_their_runs_and_nothing_else(world: World) -> None:
    world.ended("old")
    world.ended("young", stopped_at=now())
    world.ended("native", from_yaml=True)
    world.ended("never-ran", directory=False)
    world.add(job("waits", status="RUNNABLE", run="waits"))
    totals = world.retention().take_all()
    assert (totals.jobs, totals.runs, totals.bytes > 1000) == (2, 1, True)
    assert world.jobs() == ["native", "waits", "young"] and world.runs() == ["native", "young"]
    assert world.trashed() == []
    with world.database.session() as session:
        assert sorted(session.scalars(select(RunRecord.name))) == ["native", "young"]
        assert sorted(session.scalars(select(Node.job_id))) == sorted(session.scalars(select(Attempt.job_id)))


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda w: w.add(job("next", run="old", status="PENDING")), "job next has not ended"),
        (lambda w: w.add(job("reads", status="RUNNABLE"), RunUse(job_id="reads", run="old")), "job reads needs it"),
        (
            lambda w: w.add(job("later", status="PENDING"), Dependency(job_id="later", on_id="old")),
            "job later waits for it",
        ),
        (lambda w: contents.archive(w.store.run("old"), "key a"), "archived"),
        (lambda w: (w.store.run("old").path / "metrics").symlink_to("/"), "can't be read"),
        (lambda w: of_absent_plugin(w.store), "plug-in 'absent' is not installed, so what its folder .*/cards needs"),
    ],
)
def test_a_run_that_something_needs_is_kept_with_its_jobs(
    world: World, make: Callable[[World], object], reason: str
) -> None:
    world.ended("old")
    make(world)
    before = world.rows()
    assert re.search(reason, world.reasons()["old"])
    world.retention().take_all()
    assert world.rows() == before and (world.store.run("old").path / "logs" / "old").is_dir()
    with pytest.raises(RunNeeded, match=reason):
        world.retention().delete("old")
    assert (world.store.run("old").path / "logs" / "old").is_dir()


def test_a_job_whose_run_is_gone_is_kept_while_a_plug_in_is_absent(world: World) -> None:
    world.ended("old", directory=False)
    of_absent_plugin(world.store)
    assert world.retention().take_all().jobs == 0 and world.jobs() == ["old"]
    (world.store.path / "cards").rmdir()
    assert world.retention().take_all().jobs == 1 and world.jobs() == []


def test_a_job_that_uses_a_run_is_one_of_its_open_jobs(world: World) -> None:
    world.ended("old")
    assert world.retention().open_job("old") is None
    world.add(job("reader", status="RUNNABLE"), RunUse(job_id="reader", run="old"))
    assert world.retention().open_job("old") == "reader"


def test_the_jobs_of_an_array_go_when_all_of_them_are_old_enough(world: World) -> None:
    world.ended("p", kind="array", directory=False)
    for index in range(3):
        world.ended(f"p:{index}", parent="p", run=f"p-{index}", node_properties=None)
    for young in ("p", "p:2"):
        world.change(young, stopped_at=now())
        if young == "p":
            assert world.retention().take_all().jobs == 0 and world.reasons() == {}, "its children wait for it"
        world.change(young, stopped_at=LONG_AGO + 5)
    assert world.retention().take_all().jobs == 4
    assert world.jobs() == [] and world.runs() == []


def test_an_array_stays_with_the_last_of_its_children_and_is_not_counted(world: World) -> None:
    world.ended("p", kind="array", directory=False, stopped_at=LONG_AGO + 5)
    for index in range(3):
        world.ended(f"p:{index}", parent="p", run=f"p-{index}", node_properties=None)
    contents.archive(world.store.run("p-1"), "key a")
    totals = world.retention().take_all()
    assert (totals.jobs, totals.runs) == (2, 2) and world.jobs() == ["p", "p:1"]
    assert world.retention().take_all().jobs == 0
    contents.unarchive(world.store.run("p-1"))
    assert world.retention().take_all().jobs == 2 and world.jobs() == []


def test_children_of_an_array_that_has_not_ended_are_kept(world: World) -> None:
    world.add(job("p", kind="array", status="PENDING"))
    world.ended("p:0", parent="p", run="p-0", node_properties=None)
    assert world.retention().take_all().jobs == 0
    with pytest.raises(RunNeeded, match="it belongs to array p, which has not ended"):
        world.retention().delete("p-0")
    world.change("p", status="SUCCEEDED", stopped_at=now())
    assert world.retention().delete("p-0")["files"] == 3, "a person need not wait for a rule"


def test_steps_go_past_what_is_kept_and_count_each_job_once(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_REST", 0.0)
    for number in range(17):
        world.ended(f"j{number:02}", stopped_at=LONG_AGO + number // 5)
        if number % 4 == 0:
            contents.archive(world.store.run(f"j{number:02}"), "key a")
    place: Cursor | None = Cursor()
    seen: list[str] = []
    while place is not None:
        steps, place = world.step(place, take=False, most=3)
        place = None if place is None else Cursor.read(str(place))
        seen += [each["run"] for each in steps]
    assert sorted(seen) == [f"j{number:02}" for number in range(17)]
    place = Cursor()
    while place is not None:
        _, place = world.step(place, take=True, most=3)
    assert world.jobs() == world.runs() == [f"j{number:02}" for number in range(0, 17, 4)]
    counts = world.database.counts
    with world.database.session() as session:
        before = counts.by_status()
        counts.load(session)
    assert before == counts.by_status() == {"SUCCEEDED": 5}, "each was counted off once"


def test_the_use_of_shares_is_forgotten_once_nothing_is_left_of_it(world: World) -> None:
    with world.database.session() as session:
        for share, as_of in (("old", 1), ("new", now() - 80 * A_DAY)):
            session.add(ShareUsage(queue="default", share=share, seconds=9.0, as_of=as_of))
    world.retention(default=inf)._pass()
    with world.database.session() as session:
        assert {each.share for each in session.scalars(select(ShareUsage))} == {"new"}


class Killed(BaseException):
    """The controller dies."""


@pytest.mark.parametrize("step", range(1, 12))
@pytest.mark.parametrize("whole", [True, False])
def test_a_death_at_any_step_leaves_the_run_or_the_trash_and_the_next_pass_ends_it(
    world: World, monkeypatch: pytest.MonkeyPatch, step: int, whole: bool
) -> None:
    """At each of the calls that change something, before it and after it."""
    world.ended("old")
    if not whole:
        (world.store.run("old").path / "results.csv").write_text("1")
    calls = [0]

    def dying(body: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            for part in (None, lambda: body(*arguments, **named)):
                calls[0] += 1
                if calls[0] == step:
                    raise Killed
                result = part() if part else None
            return result

        return call

    with monkeypatch.context() as patched:
        patched.setattr("shared_store.volume.trash.os.rename", dying(os.rename))
        patched.setattr("shared_store.volume.trash.sync_directory", dying(sync_directory))
        patched.setattr("shared_store.volume.trash.shutil.rmtree", dying(shutil.rmtree))
        patched.setattr("orchestrator.persistence.retention_rows.forget_jobs", dying(retention_rows.forget_jobs))
        try:
            world.retention().take_all()
        except Killed:
            run = world.store.run("old").path
            if whole:
                in_place, in_trash = run.exists(), [each for each in world.trashed() if "old" in each]
                assert in_place != bool(in_trash) or (not in_place and calls[0] > 6)
                if in_place:
                    assert sorted(os.listdir(run)) == ["logs", "outcomes", "run.json"], "nothing of it is missing"
            else:
                assert (run / "results.csv").is_file()
    world.access.users = RunUsers()  # another process
    later: list[Callable[[], object]] = []
    following = world.retention()
    following.start(later.append)
    for each in later:
        each()
    following.take_all()
    assert world.jobs() == [] and world.trashed() == []
    assert world.runs() == ([] if whole else ["old"])
    with world.database.session() as session:
        assert session.scalars(select(RunRecord.name)).all() == ([] if whole else ["old"])


def test_a_controller_that_ends_amid_a_step_leaves_the_rows_to_the_next_one(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.ended("old")
    ending, throw = world.retention(), trash.discard

    def late(store: Store, paths: Iterable[Path]) -> list[Path]:
        ending._is_closing.set()
        return throw(store, paths)

    with monkeypatch.context() as patched:
        patched.setattr(trash, "discard", late)
        ending._pass()
    ending.close()
    assert world.jobs() == ["old"] and world.runs() == [] and len(world.trashed()) == 1
    following = world.retention()
    following._empty_trash()
    following.take_all()
    assert world.jobs() == [] and world.trashed() == []


# -- rules, owners, definitions -----------------------------------------------------------------------------------------


def test_rules_of_queues_and_of_the_controller(world: World) -> None:
    day = now() - A_DAY
    for queue, tags in (
        ("short", {"muster:retention": "2h"}),
        ("kept", {"muster:retention": "off"}),
        ("bad", {"muster:retention": "x"}),
    ):
        world.add(JobQueue(name=queue, compute_environments=["local"], tags=tags))
    # with a queue that was deleted its rule went, which may have been to keep its jobs
    for queue in ("default", "short", "kept", "bad", "deleted"):
        world.ended(queue, queue=queue, stopped_at=day, from_yaml=True)
    assert world.retention(default=inf).take_all().jobs == 1 and world.jobs() == ["bad", "default", "deleted", "kept"]
    assert world.retention(default=2 * 86_400).take_all().jobs == 0
    steps, _ = world.step(take=True, default=A_DAY // 2)
    assert [each["jobs"] for each in steps] == [["default"]]
    world.ended("default", stopped_at=day, from_yaml=True)
    assert world.retention(default=3600).take_all().jobs == 1 and world.jobs() == ["bad", "deleted", "kept"]
    world.add(JobQueue(name="deleted", compute_environments=["local"], tags={"muster:retention": "1m"}))
    assert world.retention().take_all().jobs == 1 and world.jobs() == ["bad", "kept"], "created again, with a rule"


def test_a_switch_turns_it_off(world: World) -> None:
    world.ended("old")
    calls: list[Callable[[], object]] = []
    off, on = world.retention(default=inf), world.retention()
    for each in (off, on):
        each._next = 0.0
        each.when_due(calls.append)
        each.when_due(calls.append)
    assert len(calls) == 2, "one pass of each at a time"
    calls[0]()
    assert world.jobs() == ["old"]
    calls[1]()
    assert world.jobs() == []
    on.when_due(calls.append)
    assert len(calls) == 2, "the next pass comes later"


def test_in_the_first_days_after_an_upgrade_it_only_logs(world: World, caplog: pytest.LogCaptureFixture) -> None:
    world.ended("old")
    world.add(RetentionStart(id=1, since=now() - 2 * A_DAY))
    with caplog.at_level(logging.WARNING):
        world.retention()._pass()
    assert "has taken nothing yet" in caplog.text and "1 jobs and 1 runs" in caplog.text
    assert world.jobs() == ["old"] and world.runs() == ["old"]
    with world.database.session() as session:
        session.get_one(RetentionStart, 1).since = now() - 30 * A_DAY
    world.retention()._pass()
    assert world.jobs() == ["old"], "its time counts from the upgrade on"
    with world.database.session() as session:
        session.get_one(RetentionStart, 1).since = now() - 91 * A_DAY
    world.retention()._pass()
    assert world.jobs() == [] and world.runs() == []


def test_a_key_with_some_queues_takes_only_what_is_its_own(world: World) -> None:
    mine = Requester("key a", frozenset({"default"}))
    world.ended("own")
    world.ended("others", owner="key b")
    world.ended("elsewhere", queue="lab")
    world.ended("shared")
    world.ended("shared-by-b", run="shared", owner="key b")  # its record says key b from now on
    world.ended("of-b", owner="key b")
    world.ended("in-run-of-b", run="of-b")
    with world.database.session() as session:
        session.get_one(RunRecord, "shared").owner = "key a"
        session.get_one(RunRecord, "of-b").owner = "key b"
    steps, _ = world.step(take=True, by=mine)
    gone = sorted(name for each in steps for name in each["jobs"])
    assert gone == ["own", "shared"]
    assert world.runs() == ["elsewhere", "of-b", "others", "shared"]
    assert not (world.store.run("shared").path / "logs" / "shared").exists()
    assert (world.store.run("shared").path / "logs" / "shared-by-b").is_dir()


def test_definitions_go_with_their_last_job_where_no_user_needs_them(world: World) -> None:
    ours = [{"name": "MUSTER_DIRECTORY", "value": "/"}, {"name": "MUSTER_SPEC", "value": "{}"}]
    compiled = {"nodeProperties": {"nodeRangeProperties": [{"container": {"environment": ours}}]}}
    for name, revision, document, status in (
        ("submitted", 1, compiled, "ACTIVE"),
        ("used", 1, compiled, "ACTIVE"),
        ("client", 1, {}, "INACTIVE"),
        ("client", 2, {}, "ACTIVE"),
        ("client", 3, {}, "INACTIVE"),
    ):
        world.add(JobDefinition(name=name, revision=revision, document=document, status=status))
        world.ended(f"{name}-{revision}", definition=f"{ARN}{name}:{revision}")
    world.add(job("open", status="RUNNABLE", definition=f"{ARN}used:1"))
    world.retention().take_all()
    with world.database.session() as session:
        left = [(each.name, each.revision) for each in session.scalars(select(JobDefinition))]
    assert sorted(left) == [("client", 2), ("client", 3), ("used", 1)], "no number of a client's is given twice"
