"""Where things lie on the shared volume, and what may be used as one."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from shared_store.files import write_json
from shared_store.layout import FORMAT, Store, StoreError


def test_a_new_store_is_made_where_there_was_nothing(tmp_path: Path) -> None:
    store = Store(tmp_path / "a" / "store").open()
    assert json.loads((store.path / "store.json").read_text()) == {"format": FORMAT}
    assert os.listdir(store.path / "runs") == []


def test_opening_a_store_again_changes_nothing(tmp_path: Path) -> None:
    Store(tmp_path).open().run("ant").create({"seed": 1})
    Store(tmp_path).open()
    assert [run.name for run in Store(tmp_path).runs()] == ["ant"]


def test_a_store_of_a_newer_format_is_refused(tmp_path: Path) -> None:
    write_json(tmp_path / "store.json", {"format": FORMAT + 1})
    with pytest.raises(StoreError) as caught:
        Store(tmp_path).open()
    assert str(caught.value) == (
        f"store {tmp_path}: has format {FORMAT + 1}, this Muster reads up to {FORMAT}; upgrade Muster"
    )


@pytest.mark.parametrize("content", ["", "{", "[]"])
def test_a_damaged_description_is_named(tmp_path: Path, content: str) -> None:
    (tmp_path / "store.json").write_text(content)
    with pytest.raises(StoreError, match=f"^store {tmp_path}: store.json is damaged"):
        Store(tmp_path).open()


def test_a_path_that_can_not_be_a_directory_is_named_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError) as caught:
        Store(tmp_path / "file" / "store").open()
    assert str(caught.value) == (
        f"store {tmp_path}/file/store: not writable (Not a directory); choose another with --store"
    )


def test_a_relative_path_and_a_home_directory_become_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/somebody")
    assert Store("store").path == tmp_path / "store"
    assert Store("~/store").path == Path("/home/somebody/store")


@pytest.mark.parametrize("name", ["ant", "a", "0", "Ant_v2.1-b", "x" * 128])
def test_a_run_may_have_the_name_of_a_directory(tmp_path: Path, name: str) -> None:
    assert Store(tmp_path).run(name).path == tmp_path / "runs" / name


@pytest.mark.parametrize("name", ["", ".", "..", ".hidden", "-x", "a/b", "../a", "a b", "ä", "a\n", "x" * 129])
def test_a_run_can_not_leave_the_store_by_its_name(tmp_path: Path, name: str) -> None:
    with pytest.raises(StoreError, match="use letters, digits"):
        Store(tmp_path).run(name)


def test_everything_of_a_run_lies_where_the_design_says(tmp_path: Path) -> None:
    run = Store(tmp_path).run("ant")
    base = tmp_path / "runs" / "ant"
    assert run.checkpoints == base / "checkpoints"
    assert run.metrics == base / "metrics"
    assert run.evaluations == base / "evaluations"
    assert run.exports == base / "exports"
    assert run.log("job", 2, 1) == base / "logs" / "job" / "2" / "node-1.log"
    assert run.outcome("job", 2, 1) == base / "outcomes" / "job" / "2" / "node-1.json"
    assert list(tmp_path.iterdir()) == [], "asking for a path creates nothing"


def test_a_run_keeps_the_description_that_it_was_created_with(tmp_path: Path) -> None:
    run = Store(tmp_path).run("ant")
    assert run.description() is None
    run.create({"seed": 1})
    run.create({"seed": 2})
    assert run.description() == {"seed": 1}


def test_runs_are_listed_by_name_and_only_if_they_were_created(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert store.runs() == []
    for name in ("b", "a"):
        store.run(name).create({})
    (tmp_path / "runs" / "empty").mkdir()
    (tmp_path / "runs" / ".probe-1").write_text("")
    assert [run.name for run in store.runs()] == ["a", "b"]
