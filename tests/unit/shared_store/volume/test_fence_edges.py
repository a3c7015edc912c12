"""Edges of epochs and checkpoints, beside test_epoch.py and test_checkpoints.py."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

import pytest

from shared_store.volume import epoch as module
from shared_store.volume.checkpoints import (
    FORMAT,
    Checkpoint,
    CheckpointWriter,
    DamagedCheckpoint,
    NewerFormat,
    best_checkpoint,
    checkpoint_called,
    list_checkpoints,
    newest_checkpoint,
    retain,
    set_aside,
    sweep,
)
from shared_store.volume.epoch import Claim, StaleEpoch, close_claim, find_epoch, raise_epoch, read_claim, take_epoch
from shared_store.volume.files import DamagedFile, write_json
from shared_store.volume.layout import Run, StoreError
from tests.support.shared_store.operations import durable_operations


@pytest.fixture
def run(tmp_path: Path) -> Run:
    (tmp_path / "runs" / "ant").mkdir(parents=True)
    return Run(tmp_path / "runs" / "ant")


def commit(run: Run, iteration: int, epoch: int = 1, keep: int | None = None, **facts: Any) -> Checkpoint:
    writer = CheckpointWriter(run, iteration, epoch)
    (writer.path / "rank-0.pt").write_bytes(b"state")
    return writer.commit(facts, keep)


def iterations(run: Run) -> list[int]:
    return [each.iteration for each in list_checkpoints(run)]


# -- epochs -----------------------------------------------------------------------------------------------------------


def test_a_node_starts_on_the_volume_on_which_its_epoch_is_published(run: Run) -> None:
    raise_epoch(run, 5)
    find_epoch(run, 5, patience=0)
    with pytest.raises(StaleEpoch, match="this attempt has epoch 4, the run now belongs to epoch 5"):
        find_epoch(run, 4, patience=0)
    with pytest.raises(StoreError, match="is not the controller's: run ant has epoch 5 there, not 6") as caught:
        find_epoch(run, 6, patience=0)
    assert str(caught.value).startswith(f"store {run.path.parent.parent} on ")


def test_a_node_looks_again_at_the_directories_until_its_epoch_is_there(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    listed: list[Path] = []

    def sleep(seconds: float) -> None:
        assert 0 < seconds < 1
        raise_epoch(run, 7)

    monkeypatch.setattr(module.time, "sleep", sleep)
    monkeypatch.setattr(module.os, "listdir", lambda path: listed.append(path) or [])
    find_epoch(run, 7)
    assert listed[:2] == [run.path.parent, run.path]


def test_the_last_64_claims_are_kept_and_other_files(run: Run) -> None:
    for number in (1, 35, 36, 99):
        (run.path / f"EPOCH.{number}").touch()
    (run.path / "EPOCH.1.old").touch()
    raise_epoch(run, 100)
    kept = {"EPOCH", "EPOCH.1.old", "EPOCH.36", "EPOCH.99", "EPOCH.100"}
    assert set(os.listdir(run.path)) == kept


def test_a_number_is_durable_before_it_is_used(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = durable_operations(monkeypatch)
    raise_epoch(run, 3, Claim("a", "job", 2))
    claim, directory = ("fsync", str(run.path / "EPOCH.3")), ("fsync", str(run.path))
    assert seen.index(claim) < seen.index(directory) < seen.index(("rename", str(run.path / "EPOCH")))
    assert read_claim(run, 3) == Claim("a", "job", 2)
    seen.clear()
    close_claim(run, 3)
    assert seen == [claim] and read_claim(run, 3) is None


def test_a_run_that_is_a_link_is_neither_read_nor_claimed(run: Run, tmp_path: Path) -> None:
    raise_epoch(run, 1)
    link = Run(tmp_path / "link")
    link.path.symlink_to(run.path)
    for act in (
        lambda: module.read_epoch(link),
        lambda: raise_epoch(link, 2),
        lambda: close_claim(link, 1),
        lambda: module._create(link, 2, None),
    ):
        with pytest.raises(DamagedFile):
            act()


def test_a_claim_is_awaited_for_a_second_and_what_is_published_meanwhile_counts(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, slept = [100.0], []

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        clock[0] += seconds

    monkeypatch.setattr(module.time, "sleep", sleep)
    monkeypatch.setattr(module.time, "monotonic", lambda: clock[0])
    (run.path / "EPOCH.1").write_text('{"controller": "b", "job": "j", "attempt": 1}')
    assert take_epoch(run, 0, Claim("a", "j", 1)) == 2
    assert 1.0 <= sum(slept) < 1.1 and max(slept) <= 0.1


# -- checkpoints ------------------------------------------------------------------------------------------------------

SIZE = {"size": 5, "sha256": hashlib.sha256(b"state").hexdigest()}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"files": {"rank-0.pt": {**SIZE, "size": -1}}}, "has no size and digest of rank-0.pt"),
        ({"files": {"rank-0.pt": {**SIZE, "size": True}}}, "has no size and digest of rank-0.pt"),
        ({"files": {"rank-0.pt": {**SIZE, "size": 2**63}}}, "has no size and digest of rank-0.pt"),
        ({"files": {"rank-0.pt": {**SIZE, "sha256": 7}}}, "has no size and digest of rank-0.pt"),
        ({"files": {"x" * 201: SIZE}}, "which is no file of it"),
        ({"files": {".rank": SIZE}}, "which is no file of it"),
        ({"format": "1"}, "manifest.json has no format"),
        *(({key: "many"}, f"manifest.json: {key} is not a number") for key in ("created", "reward", "score")),
        *(({key: {}}, f"manifest.json: {key} is not a number") for key in ("score_error", "worlds", "world_size")),
    ],
)
def test_a_manifest_that_says_nonsense_is_damaged(run: Run, changes: dict[str, Any], said: str) -> None:
    path = commit(run, 5).path
    write_json(path / "manifest.json", {"format": FORMAT, "files": {"rank-0.pt": SIZE}, **changes})
    with pytest.raises(DamagedCheckpoint) as caught:
        list_checkpoints(run)[0].verify()
    assert said in str(caught.value) and not isinstance(caught.value, NewerFormat)


def test_the_edges_of_what_a_manifest_may_say(run: Run) -> None:
    path = commit(run, 5).path
    largest = {"size": 2**63 - 1, "sha256": ""}
    write_json(path / "manifest.json", {"format": 0, "files": {"x" * 200: largest, "y": {**largest, "size": 0}}})
    assert list_checkpoints(run)[0].size == 2**63 - 1
    write_json(path / "manifest.json", {"format": FORMAT + 1, "files": {}})
    with pytest.raises(NewerFormat):
        list_checkpoints(run)[0].verify()


def test_names_have_eight_digits_and_an_epoch(run: Run) -> None:
    found = checkpoint_called(run.checkpoints, "00000012-e345")
    assert found is not None and (found.iteration, found.epoch, found.name) == (12, 345, "00000012-e345")
    for name in ("0000012-e1", "00000012", "00000012-e", "00000012-e1.damaged", "x00000012-e1"):
        assert checkpoint_called(run.checkpoints, name) is None


def test_a_choice_counts_before_the_job_s_own_checkpoints_alone_and_a_newer_one_must_verify(run: Run) -> None:
    commit(run, 1)
    own = commit(run, 2, epoch=3)
    (own.path / "rank-0.pt").write_bytes(b"other")
    seen: list[str] = []
    found = newest_checkpoint(
        run, chosen="00000001-e1", chosen_since=3, damaged=lambda each, error: seen.append(each.name)
    )
    assert found is not None and found.name == "00000001-e1" and seen == ["00000002-e3"]
    assert newest_checkpoint(run).iteration == 1
    (run.checkpoints / "00000001-e1" / "rank-0.pt").unlink()
    assert newest_checkpoint(run) is None
    assert newest_checkpoint(Run(run.path / "none")) is None
    (run.path / "file").mkdir()
    (run.path / "file" / "checkpoints").touch()
    assert list_checkpoints(Run(run.path / "file")) == []


def test_the_best_has_the_greatest_score_that_is_a_number_and_of_equals_it_is_the_later(run: Run) -> None:
    assert best_checkpoint(run) is None
    commit(run, 1, reward=9.0)
    assert best_checkpoint(run) is None
    for iteration, score in ((2, -5.0), (3, 1), (4, 1.0), (5, 0.5), (6, None)):
        commit(run, iteration, score=score)
    assert best_checkpoint(run).iteration == 4
    for name, text in (("2", '{"files": {}, "format": 1, "score": Infinity}'), ("4", "{")):
        (run.checkpoints / f"0000000{name}-e1" / "manifest.json").write_text(text)
    assert best_checkpoint(run).iteration == 3


def test_checkpoints_that_were_saved_only_for_long_iterations_and_those_with_exports_are_kept_apart(run: Run) -> None:
    for iteration, scheduled in ((1, True), (2, True), (3, True), (4, False), (5, False)):
        commit(run, iteration, scheduled=scheduled)
    assert [each.is_scheduled for each in list_checkpoints(run)] == [True, True, True, False, False]
    (run.exports / "00000001-e1").mkdir(parents=True)
    assert retain(run, 1) == ["00000002-e1", "00000004-e1"] and iterations(run) == [1, 3, 5]
    (run.checkpoints / "00000005-e1" / "manifest.json").write_text("{")
    assert list_checkpoints(run)[-1].is_scheduled


def test_a_commit_takes_its_writers_digests_and_publishes_no_notes(run: Run) -> None:
    writer = CheckpointWriter(run, 3, 2)
    (writer.path / "rank-0.pt").write_bytes(b"state")
    (writer.path / ".note").touch()
    (writer.path / "manifest.json").write_text("of an earlier try")
    there = CheckpointWriter(run, 3, 2)
    made = there.commit({}, digests={"rank-0.pt": SIZE})
    made.verify()
    assert sorted(os.listdir(made.path)) == ["manifest.json", "rank-0.pt"] and made.manifest["created"] > 1e9
    assert (made.path.name, made.iteration, made.epoch) == ("00000003-e2", 3, 2)
    again = CheckpointWriter(run, 4, 2)
    (again.path / "manifest.json").write_text("of an earlier try")
    assert again.commit({}).manifest["files"] == {}
    with pytest.raises(FileNotFoundError):
        CheckpointWriter(Run(run.path / "gone"), 1, 1)


def test_a_commit_sweeps_what_is_older_than_itself(run: Run) -> None:
    for iteration, epoch in ((9, 1), (4, 2), (5, 2), (6, 2), (1, 3)):
        CheckpointWriter(run, iteration, epoch)
    (run.checkpoints / ".LATEST.1.tmp").touch()
    assert sorted(sweep(run, up_to=(2, 5))) == [
        ".00000004-e2.tmp",
        ".00000005-e2.tmp",
        ".00000009-e1.tmp",
        ".LATEST.1.tmp",
    ]
    commit(run, 7, epoch=2)
    assert sorted(os.listdir(run.checkpoints)) == [".00000001-e3.tmp", "00000007-e2", "LATEST"]


def test_what_is_set_aside_is_durable(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint = commit(run, 5)
    seen = durable_operations(monkeypatch)
    moved = set_aside(checkpoint)
    assert seen == [("rename", str(moved)), ("fsync", str(run.checkpoints))]


def test_an_attempt_that_lost_its_run_in_the_rename_prunes_nothing(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    commit(run, 1)
    raise_epoch(run, 1)
    rename = os.rename

    def frozen(old: Path, new: Path) -> None:
        rename(old, new)
        raise_epoch(run, 2)

    monkeypatch.setattr(os, "rename", frozen)
    commit(run, 2, keep=1)
    assert iterations(run) == [1, 2] and (run.checkpoints / "LATEST").read_text() == "00000001-e1\n"
