"""The long texts of jobs in the store: what may be kept, by whom, and how long."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Any

import pytest

from orchestrator import machine
from orchestrator.control import kept_texts
from orchestrator.control.kept_texts import DAYS, KeptTexts, TextRefused
from orchestrator.domain.job import Status
from orchestrator.persistence import batch_models
from orchestrator.persistence.batch_models import Job, JobDefinition
from orchestrator.persistence.session import Database
from orchestrator.spec.compile import compile_definition, long_texts
from orchestrator.spec.model import validate
from shared_store.volume.layout import Store
from shared_store.volume.texts import LARGEST, digest_of
from tests.support.refusals import refusal

TEXT = "def reward_function(params):\n    return 1.0\n"
DIGEST = digest_of(TEXT)
LONG = {"file": "long.py", "text": TEXT + "#" * (30 << 10)}
_TRAIN = {"task": "elsewhere.mine:Task", "worlds": 4, "iterations": 1, "config": {"reward_function": LONG}}


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store").open()


@pytest.fixture
def texts(database: Database, store: Store) -> KeptTexts:
    return KeptTexts(database, store, "here", threading.Lock())


def kept(store: Store) -> list[str]:
    return sorted(os.listdir(store.texts / "here"))


def later(monkeypatch: pytest.MonkeyPatch, days: float) -> None:
    """Let days pass."""
    moment = batch_models.now() + int(days * 24 * 3600 * 1000)
    for module in (batch_models, kept_texts):
        monkeypatch.setattr(module, "now", lambda: moment)


def naming(digest: str) -> dict[str, Any]:
    return {"environment": [{"name": "MUSTER_SPEC", "value": f'{{"a": {{"file": "a.py", "sha256": "{digest}"}}}}'}]}


def test_a_text_that_nothing_names_goes_after_some_days_and_each_upload_prolongs_that(
    texts: KeptTexts, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts.keep(TEXT.encode(), "key a")
    later(monkeypatch, DAYS - 1)
    assert texts.sweep() == [] and kept(store) == [DIGEST]
    texts.keep(TEXT.encode(), "key b")
    later(monkeypatch, DAYS - 1)
    assert texts.sweep() == []
    later(monkeypatch, 1.1)
    assert texts.sweep() == [DIGEST] and kept(store) == []
    texts.keep(TEXT.encode(), "key b")
    assert kept(store) == [DIGEST]


def test_a_text_stays_while_an_active_definition_or_a_job_that_has_not_ended_names_it(
    texts: KeptTexts, store: Store, database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    digests = [texts.keep(f"{TEXT}# {number}".encode(), "key a") for number in range(4)]
    active, inactive, running, ended = digests
    with database.session() as session:
        for name, digest, status in (("active", active, "ACTIVE"), ("inactive", inactive, "INACTIVE")):
            container = {**naming(digest), "command": ["sh", "-c", "cd $MUSTER_DIRECTORY"]}
            session.add(
                JobDefinition(name=name, revision=1, document={"containerProperties": container}, status=status)
            )
        for name, digest, state in (("running", running, Status.RUNNING), ("ended", ended, Status.FAILED)):
            properties = {"nodeRangeProperties": [{"container": naming(digest)}]}
            facts = {"queue": "default", "definition": "d", "request": {}, "node_properties": properties, "run": name}
            session.add(Job(id=name, name=name, status=state, **facts))
    later(monkeypatch, 100)
    assert sorted(texts.sweep()) == sorted([inactive, ended])
    assert kept(store) == sorted([active, running])
    with database.session() as session:
        for job in session.query(Job):
            job.status = Status.SUCCEEDED
        session.get(JobDefinition, ("active", 1)).status = "INACTIVE"  # type: ignore[union-attr]
    assert sorted(texts.sweep()) == sorted([active, running])


def test_a_definition_of_muster_s_own_submission_holds_no_text_once_its_jobs_have_ended(
    texts: KeptTexts, store: Store, database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = validate({"name": "own", "train": _TRAIN}, "job.yaml")
    compiled = compile_definition(spec, "/here")
    [digest] = [texts.keep(text.encode(), "key a") for text in long_texts(spec)]
    facts = {"queue": "default", "definition": "own:1", "request": {}, "run": "own-1"}
    with database.session() as session:
        session.add(JobDefinition(name="own", revision=1, document=compiled))
        session.add(Job(id="j", name="own", status=Status.RUNNING, node_properties=compiled["nodeProperties"], **facts))
    later(monkeypatch, 100)
    assert texts.sweep() == [] and kept(store) == [digest]
    with database.session() as session:
        session.get_one(Job, "j").status = Status.SUCCEEDED
    assert texts.sweep() == [digest] and kept(store) == []


def test_a_text_of_an_earlier_folder_goes_with_its_row(
    texts: KeptTexts, store: Store, database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    earlier = KeptTexts(database, store, "before", threading.Lock())
    old, used = earlier.keep(TEXT.encode(), "key a"), earlier.keep(b"used", "key a")
    later(monkeypatch, DAYS + 1)
    texts.prolong(used)
    assert texts.sweep() == [old] and os.listdir(store.texts / "before") == [used]


def test_the_look_for_what_nothing_needs_is_made_soon_after_a_start_and_then_rarely(
    texts: KeptTexts, monkeypatch: pytest.MonkeyPatch
) -> None:
    requested: list[Any] = []
    for seconds, polls in ((0, 0), (59, 0), (61, 1), (3600, 1), (3662, 2)):
        moment = machine.monotonic() + seconds
        with monkeypatch.context() as patch:
            patch.setattr(machine, "monotonic", lambda moment=moment: moment)
            texts.sweep_when_due(requested.append)
            texts.sweep_when_due(requested.append)
        assert requested == [texts.sweep] * polls, seconds


def test_leftovers_of_a_killed_upload_go_and_other_controllers_texts_stay(texts: KeptTexts, store: Store) -> None:
    texts.keep(TEXT.encode(), "key a")
    (store.texts / "here" / f".{DIGEST}.0123abcd.tmp").write_text("half")
    (store.texts / "there").mkdir()
    (store.texts / "there" / DIGEST).write_text(TEXT)
    assert texts.sweep() == [f".{DIGEST}.0123abcd.tmp"]
    assert kept(store) == [DIGEST] and (store.texts / "there" / DIGEST).exists()


def test_what_is_not_a_text_and_what_is_too_long_is_refused(texts: KeptTexts, store: Store) -> None:
    assert refusal(texts.keep, b"\xff\xfe", "key a", error=TextRefused) == "it is not a text (UTF-8)"
    too_long = refusal(texts.keep, b"x" * (LARGEST + 1), "key a", error=TextRefused)
    assert too_long == "the text has 1,048,577 bytes, and may have 1,048,576; shorten it"
    assert texts.keep(b"x" * LARGEST, "key a") in kept(store)


def test_a_key_may_upload_so_much_a_day_and_the_same_again_counts_once(
    texts: KeptTexts, database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept_texts, "A_DAY", 2 << 20)
    first, second = b"a" * LARGEST, b"b" * LARGEST
    for data in (first, second, first, second):
        texts.keep(data, "key a")
    refused = refusal(texts.keep, b"c", "key a", error=TextRefused)
    assert refused == "key a has uploaded 2 MiB of texts in 24 hours, which is the most; submit again later"
    texts.keep(b"c", "key b")
    later(monkeypatch, 1.01)
    texts.keep(b"d", "key a")
