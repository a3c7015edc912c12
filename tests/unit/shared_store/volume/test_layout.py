"""Where things lie on the shared volume, and what may be used as one."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from shared_store.volume.checkpoints import CheckpointWriter
from shared_store.volume.contents import archive
from shared_store.volume.evaluations import keep_for_evaluation
from shared_store.volume.layout import FORMAT, Run, Store, StoreError
from shared_store.volume.log_files import LogWriter
from shared_store.volume.metrics import MetricsWriter
from shared_store.volume.node_outcomes import Outcome, write_outcome


def test_a_new_store_is_made_where_there_was_nothing_and_opened_again_unchanged(tmp_path: Path) -> None:
    store = Store(tmp_path / "a" / "store").open()
    described = json.loads((store.path / "store.json").read_text())
    assert described == {"format": FORMAT, "id": store.identity()} and len(described["id"]) == 32
    assert os.listdir(store.path / "runs") == []
    store.run("ant").create({"seed": 1})
    assert [run.name for run in Store(store.path).open().runs()] == ["ant"]
    assert json.loads((store.path / "store.json").read_text()) == described


NOT_A_STORE = {
    f'{{"format": {FORMAT + 1}}}': f"has format {FORMAT + 1}, this Muster reads up to {FORMAT}; upgrade Muster",
    **dict.fromkeys(("", "{", "[]"), "store.json is damaged"),
}


@pytest.mark.parametrize("content", NOT_A_STORE)
def test_a_store_of_a_newer_format_or_a_damaged_one_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "store.json").write_text(content)
    with pytest.raises(StoreError) as caught:
        Store(tmp_path).open()
    assert str(caught.value).startswith(f"store {tmp_path}: {NOT_A_STORE[content]}")


def test_a_path_becomes_absolute_or_is_named_with_the_reason_why_it_can_be_no_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    path = tmp_path / "file" / "store"
    with pytest.raises(StoreError) as caught:
        Store(path).open()
    assert (
        str(caught.value)
        == f"store {path}: not writable (Not a directory); see whether its volume is mounted, or choose another with --store"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/someone")
    assert Store("store").path == tmp_path / "store"
    assert Store("~/store").path == Path("/home/someone/store")


@pytest.mark.parametrize("name", ["", ".", "..", ".hidden", "-x", "a/b", "../a", "a b", "ä", "a\n", "x" * 129])
def test_a_run_has_the_name_of_a_directory_and_can_t_leave_the_store_by_it(tmp_path: Path, name: str) -> None:
    for good in ("ant", "a", "0", "Ant_v2.1-b", "x" * 128):
        assert Store(tmp_path).run(good).path == tmp_path / "runs" / good
    with pytest.raises(StoreError, match="use letters, digits"):
        Store(tmp_path).run(name)


def test_runs_keep_their_descriptions_and_are_listed_by_name_only_if_they_were_created(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert store.runs() == [] and store.run("a").description() is None
    for name in ("b", "a"):
        for seed in (1, 2):
            store.run(name).create({"seed": seed})
        assert store.run(name).description() == {"seed": 1}
    (tmp_path / "runs" / "empty").mkdir()
    (tmp_path / "runs" / ".probe-1").write_text("")
    assert [run.name for run in store.runs()] == ["a", "b"]


DONE = Outcome(0, 1, 0, None, "done", None, 1e9, 1e9)


@pytest.mark.parametrize(
    "write",
    [
        lambda run: LogWriter(run.log("job", 1, 0)),
        lambda run: write_outcome(run, "job", 1, DONE),
        lambda run: MetricsWriter(run, 1, 0).close(),
        lambda run: CheckpointWriter(run, 1, 1),
        lambda run: keep_for_evaluation(run, "00000001-e1"),
        lambda run: archive(run, "key a"),
    ],
)
def test_nothing_of_a_run_is_made_in_the_mount_point_of_a_volume_that_is_gone(
    tmp_path: Path, write: Callable[[Run], object]
) -> None:
    with pytest.raises(OSError):
        write(Store(tmp_path).run("ant"))
    assert os.listdir(tmp_path) == []
