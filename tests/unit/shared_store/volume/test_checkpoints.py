"""Checkpoints are committed whole or not at all, verified when they are read, and kept while they are needed."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from shared_store.volume.checkpoints import (
    FORMAT,
    Checkpoint,
    CheckpointWriter,
    DamagedCheckpoint,
    best_checkpoint,
    list_checkpoints,
    newest_checkpoint,
    retain,
    set_aside,
    sweep,
)
from shared_store.volume.epoch import StaleEpoch, raise_epoch
from shared_store.volume.files import sync_file
from shared_store.volume.layout import Run, Store
from tests.support.shared_store.crashes import killed_at_every_step
from tests.support.shared_store.operations import durable_operations


@pytest.fixture
def run(tmp_path: Path) -> Run:
    run = Store(tmp_path / "store").open().run("ant")
    run.path.mkdir()
    return run


def commit(run: Run, done: int, epoch: int = 1, keep: int | None = None, **facts: Any) -> Checkpoint:
    """A checkpoint of two ranks, as training commits it."""
    writer = CheckpointWriter(run, done, epoch)
    for name in ("learner.pt", "rank-0.pt", "rank-1.pt"):
        (writer.path / name).write_bytes(f"{name} at {done}\n".encode() * 100)
        sync_file(writer.path / name)
    return writer.commit(facts, keep)


def names(run: Run) -> list[str]:
    return [checkpoint.name for checkpoint in list_checkpoints(run)]


def newest(run: Run, **choice: Any) -> str:
    found = newest_checkpoint(run, **choice)
    return found.name if found else ""


def commit_another(root: Path) -> None:
    commit(Run(root), 75, keep=2, reward=1.0)


def set_newest_aside(root: Path) -> None:
    set_aside(list_checkpoints(Run(root))[-1])


def sweep_up(root: Path) -> None:
    sweep(Run(root))


def test_a_committed_checkpoint_lists_its_contents(run: Run) -> None:
    checkpoint = commit(run, 25, epoch=3, world_size=2, worlds=64, iteration=7, files={})
    assert (checkpoint.name, checkpoint.iteration, checkpoint.epoch) == ("00000025-e3", 25, 3)
    checkpoint.verify()
    manifest = checkpoint.manifest
    assert (manifest["iteration"], manifest["epoch"], manifest["format"]) == (25, 3, FORMAT), "its own entries stay"
    assert (manifest["world_size"], manifest["worlds"]) == (2, 64)
    content = (checkpoint.path / "rank-1.pt").read_bytes()
    assert manifest["files"]["rank-1.pt"] == {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    assert sorted(manifest["files"]) == ["learner.pt", "rank-0.pt", "rank-1.pt"]
    assert checkpoint.size == sum(path.stat().st_size for path in checkpoint.path.iterdir() if path.suffix == ".pt")
    assert (run.checkpoints / "LATEST").read_text() == "00000025-e3\n"


def test_a_commit_killed_at_any_step_leaves_whole_checkpoints_and_the_next_attempt_commits_over_what_else_is_left(
    run: Run, tmp_path: Path
) -> None:
    commit(run, 25, reward=9.0)
    commit(run, 50, reward=2.0)
    found = []
    for left in killed_at_every_step(commit_another, run.path, tmp_path / "work"):
        crashed = Run(left)
        for checkpoint in list_checkpoints(crashed):
            checkpoint.verify()
        assert names(crashed)[:2] == ["00000025-e1", "00000050-e1"]  # the best and, of the two newest, the older
        found.append(newest(crashed))
        assert (crashed.checkpoints / "LATEST").read_text().strip() in names(crashed)
        sweep(crashed)
        assert not [name for name in os.listdir(crashed.checkpoints) if name.startswith(".")]
        commit(crashed, 75, epoch=2).verify()
        assert names(crashed)[-1] == "00000075-e2"
    assert found == sorted(found) and set(found) == {"00000050-e1", "00000075-e1"}


def test_a_checkpoint_is_durable_before_it_gets_its_name(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = CheckpointWriter(run, 25, 1)
    (writer.path / "rank-0.pt").write_bytes(b"state")
    seen = durable_operations(monkeypatch)
    writer.commit({})
    published = seen.index(("rename", str(run.checkpoints / "00000025-e1")))
    before, after = seen[:published], seen[published + 1 :]
    assert before.index(("rename", str(writer.path / "manifest.json"))) < before.index(("fsync", str(writer.path)))
    assert after[0] == ("fsync", str(run.checkpoints))
    assert ("rename", str(run.checkpoints / "LATEST")) in after


def test_a_commit_that_ended_after_its_rename_is_finished_by_the_next_one_which_writes_nothing_twice(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    commit(run, 24)
    first = commit(run, 25)
    before = (first.path / "rank-0.pt").read_bytes()
    (run.checkpoints / "LATEST").write_text("00000024-e1\n")
    writer = CheckpointWriter(run, 25, 1)
    (writer.path / "rank-0.pt").write_bytes(b"something else")
    seen = durable_operations(monkeypatch)
    assert writer.commit({}) == first
    assert [what for what, _ in seen] and not [path for _, path in seen if str(path).endswith("manifest.json")]
    first.verify()
    assert (first.path / "rank-0.pt").read_bytes() == before
    assert sorted(os.listdir(run.checkpoints)) == ["00000024-e1", "00000025-e1", "LATEST"]
    assert (run.checkpoints / "LATEST").read_text() == "00000025-e1\n"


def test_a_commit_with_an_old_epoch_is_refused_and_publishes_nothing(run: Run) -> None:
    raise_epoch(run, 1)
    commit(run, 25)
    writer = CheckpointWriter(run, 50, 1)
    (writer.path / "rank-0.pt").write_bytes(b"late")
    raise_epoch(run, 2)
    with pytest.raises(StaleEpoch, match="epoch 1, the run now belongs to epoch 2"):
        writer.commit({}, keep=2)
    assert names(run) == ["00000025-e1"]
    assert (run.checkpoints / "LATEST").read_text() == "00000025-e1\n"
    commit(run, 50, epoch=2)
    assert names(run) == ["00000025-e1", "00000050-e2"]


def test_an_uncommitted_checkpoint_is_not_listed_and_one_that_is_gone_can_t_be_committed(run: Run) -> None:
    assert list_checkpoints(run) == [] and newest_checkpoint(run) is None
    CheckpointWriter(run, 25, 1)
    (run.checkpoints / "notes.txt").write_text("a person's")
    (run.checkpoints / "25-e1").mkdir()
    assert list_checkpoints(run) == []
    writer = CheckpointWriter(run, 10, 1)
    shutil.rmtree(writer.path)
    with pytest.raises(OSError):
        writer.commit({})
    assert list_checkpoints(run) == []


def test_nothing_is_committed_into_the_mount_point_of_a_volume_that_is_gone(run: Run) -> None:
    writer = CheckpointWriter(run, 50, 1)
    absent = run.path.rename(run.path.with_name("away"))
    with pytest.raises(FileNotFoundError):
        writer.commit({}, None, {"rank-0.pt": {"size": 0, "sha256": ""}})
    assert not run.path.exists()
    absent.rename(run.path)
    assert commit(run, 50).name == "00000050-e1"


def test_latest_is_only_a_hint_and_a_later_epoch_is_newer_whatever_its_iteration(run: Run) -> None:
    commit(run, 25)
    commit(run, 50)
    (run.checkpoints / "LATEST").write_text("00000025-e1\n")
    assert newest(run) == "00000050-e1"
    (run.checkpoints / "LATEST").unlink()
    assert newest(run) == "00000050-e1"
    for iteration, epoch in ((25, 2), (100, 1), (5, 10)):
        commit(run, iteration, epoch)
    assert names(run) == ["00000025-e1", "00000050-e1", "00000100-e1", "00000025-e2", "00000005-e10"]


def test_a_chosen_checkpoint_stands_until_the_job_has_one_of_its_own(run: Run) -> None:
    commit(run, 25)
    commit(run, 50)
    assert newest(run, chosen="00000025-e1", chosen_since=2) == "00000025-e1"
    commit(run, 30, epoch=2)
    assert newest(run, chosen="00000025-e1", chosen_since=2) == "00000030-e2"


def test_a_choice_that_is_missing_or_damaged_is_never_replaced_by_a_guess(run: Run) -> None:
    damaged, _ = commit(run, 25), commit(run, 50)
    with pytest.raises(DamagedCheckpoint, match="checkpoint 00000033-e1: not in run ant"):
        newest_checkpoint(run, chosen="00000033-e1", chosen_since=2)
    (damaged.path / "rank-0.pt").unlink()
    with pytest.raises(DamagedCheckpoint, match=r"00000025-e1: rank-0.pt is missing"):
        newest_checkpoint(run, chosen="00000025-e1", chosen_since=2)


def edit(**changes: Any) -> Callable[[Path], Any]:
    """Change entries of the manifest."""

    def harm(path: Path) -> None:
        manifest = json.loads((path / "manifest.json").read_text())
        (path / "manifest.json").write_text(json.dumps({**manifest, **changes}))

    return harm


def cut(name: str, size: int) -> Callable[[Path], Any]:
    return lambda path: os.truncate(path / name, size)


def delete(name: str) -> Callable[[Path], Any]:
    return lambda path: (path / name).unlink()


def flip_a_bit(path: Path) -> None:
    content = bytearray((path / "rank-1.pt").read_bytes())
    content[7] ^= 1
    (path / "rank-1.pt").write_bytes(content)


def replace_by_pipe(path: Path) -> None:
    edit(files={"rank-0.pt": {"size": 0, "sha256": "0"}})(path)
    (path / "rank-0.pt").unlink()
    os.mkfifo(path / "rank-0.pt")


def replace_by_directory(path: Path) -> None:
    (path / "manifest.json").unlink()
    (path / "manifest.json").mkdir()


def nest(path: Path) -> None:
    (path / "manifest.json").write_text('{"files": ' + "[" * 5000 + "]" * 5000 + "}")


ENTRY, UNREADABLE = "manifest.json has no size and digest of rank-0.pt", "manifest.json can't be read"
ONE = {"size": 1, "sha256": "0"}
STATE = {"size": 5, "sha256": hashlib.sha256(b"state").hexdigest()}
DAMAGES = {
    "a bit flipped": (flip_a_bit, "the content of rank-1.pt was altered (SHA-256 differs)"),
    "a file cut short": (cut("rank-1.pt", 10), "rank-1.pt has 10 bytes, 1600 were written"),
    "a file emptied": (cut("learner.pt", 0), "learner.pt has 0 bytes, 1700 were written"),
    "a file deleted": (delete("rank-0.pt"), "rank-0.pt is missing"),
    "a file that is a pipe": (replace_by_pipe, "rank-0.pt is not a regular file"),
    "no manifest": (delete("manifest.json"), "manifest.json is missing"),
    "an empty manifest": (cut("manifest.json", 0), UNREADABLE),
    "half a manifest": (cut("manifest.json", 40), UNREADABLE),
    "a manifest nested deep": (nest, UNREADABLE),
    "a manifest that is a directory": (replace_by_directory, UNREADABLE),
    "a manifest that leads elsewhere": (
        edit(files={"../../etc/passwd": ONE}),
        "manifest.json names '../../etc/passwd', which is not a file of it",
    ),
    "a zero byte in a name": (edit(files={"a\0b": ONE}), r"manifest.json names 'a\x00b', which is not a file of it"),
    "a negative size": (edit(files={"rank-0.pt": {**ONE, "size": -1}}), ENTRY),
    "a size that is a truth value": (edit(files={"rank-0.pt": {**ONE, "size": True}}), ENTRY),
    "a size that no volume has": (edit(files={"rank-0.pt": {**ONE, "size": 2**63}}), ENTRY),
    "a digest that is a number": (edit(files={"rank-0.pt": {**ONE, "sha256": 7}}), ENTRY),
    "a hidden name": (edit(files={".rank": ONE}), "manifest.json names '.rank', which is not a file of it"),
    "no format": (edit(format="1"), "manifest.json has no format"),
    "worlds that are an object": (edit(worlds={}), "manifest.json: worlds is not a number"),
    "a size that is a string": (edit(files={"rank-0.pt": {"size": "x", "sha256": "0"}}), ENTRY),
    "half an entry": (edit(files={"rank-0.pt": {"size": 1600}}), ENTRY),
    "an entry that is none": (edit(files={"rank-0.pt": None}), ENTRY),
    "a manifest without files": (edit(files=None), "manifest.json lists no files"),
    "a reward that is a list": (edit(reward=[1]), "manifest.json: reward is not a number"),
    "a newer format": (
        edit(format=FORMAT + 1),
        f"has format {FORMAT + 1}, this Muster reads up to {FORMAT}; upgrade Muster",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_is_named_and_the_checkpoint_before_it_is_used(run: Run, damage: str) -> None:
    harm, output = DAMAGES[damage]
    commit(run, 25)
    harm(commit(run, 50).path)
    named: list[tuple[str, str]] = []
    result = newest(run, damaged=lambda checkpoint, error: named.append((checkpoint.name, str(error))))
    [(name, message)] = named
    assert (result, name) == ("00000025-e1", "00000050-e1")
    assert message.startswith(f"checkpoint 00000050-e1: {output}")


def test_a_damaged_checkpoint_is_set_aside_durably_under_a_name_of_its_own_and_not_deleted(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    for expected in ("00000050-e1.damaged", "00000050-e1.damaged-2", "00000050-e1.damaged-3"):
        checkpoint, seen = commit(run, 50), durable_operations(monkeypatch)
        moved = set_aside(checkpoint)
        monkeypatch.undo()
        assert seen == [("rename", str(moved)), ("fsync", str(run.checkpoints))]
        assert moved.name == expected and (moved / "rank-0.pt").exists() and list_checkpoints(run) == []
    commit(run, 50).verify()


def test_setting_aside_killed_at_any_step_loses_nothing(run: Run, tmp_path: Path) -> None:
    commit(run, 25)
    commit(run, 50)
    for left in killed_at_every_step(set_newest_aside, run.path, tmp_path / "work"):
        found = {name for name in os.listdir(left / "checkpoints") if name.startswith("0")}
        assert found in ({"00000025-e1", "00000050-e1"}, {"00000025-e1", "00000050-e1.damaged"})


def test_sweeping_deletes_only_leftovers_of_crashes(run: Run) -> None:
    assert sweep(run) == []
    commit(run, 25)
    set_aside(commit(run, 50))
    CheckpointWriter(run, 75, 1)
    (run.checkpoints / ".00000005-e1.0a1b2c3d.trash").mkdir()
    (run.checkpoints / ".00000005-e1.0a1b2c3d.trash" / "rank-0.pt").write_bytes(b"half deleted")
    (run.checkpoints / ".LATEST.0a1b2c3d.tmp").write_text("0000")
    (run.checkpoints / ".nfs0001").write_text("the file system's own")
    assert sorted(sweep(run)) == [".00000005-e1.0a1b2c3d.trash", ".00000075-e1.tmp", ".LATEST.0a1b2c3d.tmp"]
    assert sorted(os.listdir(run.checkpoints)) == [".nfs0001", "00000025-e1", "00000050-e1.damaged", "LATEST"]
    assert sweep(run) == []


def test_sweeping_killed_at_any_step_spares_committed_checkpoints(run: Run, tmp_path: Path) -> None:
    commit(run, 25)
    writer = CheckpointWriter(run, 50, 1)
    (writer.path / "rank-0.pt").write_bytes(b"half written")
    for left in killed_at_every_step(sweep_up, run.path, tmp_path / "work"):
        crashed = Run(left)
        list_checkpoints(crashed)[-1].verify()
        sweep(crashed)
        assert sorted(os.listdir(crashed.checkpoints)) == ["00000025-e1", "LATEST"]


NAN = float("nan")
RETAINED: dict[str, tuple[list[dict[str, Any]], int | None, list[int]]] = {
    "the newest and the best": ([{"reward": each} for each in (3.0, 9.0, 1.0, 2.0, 4.0)], 2, [20, 40, 50]),
    "the best score, whatever the last iteration brought": (
        [
            {"score": score, "reward": reward}
            for score, reward in ((None, 99.0), (9.0, 1.0), (3.0, 50.0), (2.0, 2.0), (4.0, 4.0))
        ],
        2,
        [20, 40, 50],
    ),
    "the newest whatever is asked for": ([{}] * 3, 0, [30]),
    "all where all are to be kept": ([{}] * 4, None, [10, 20, 30, 40]),
    **{
        f"a reward of {reward} is never the best": (
            [{"reward": each} for each in (reward, 5.0, *[reward] * 3)],
            2,
            [20, 40, 50],
        )
        for reward in (NAN, None, "high")
    },
}


@pytest.mark.parametrize("case", RETAINED)
def test_retention_keeps(run: Run, case: str) -> None:
    facts, keep, kept = RETAINED[case]
    for number, each in enumerate(facts, 1):
        commit(run, 10 * number, keep=keep, **each)
    assert names(run) == [f"{iteration:08d}-e1" for iteration in kept]


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
    assert retain(run, 1) == ["00000002-e1", "00000004-e1"] and [each.iteration for each in list_checkpoints(run)] == [
        1,
        3,
        5,
    ]
    (run.checkpoints / "00000005-e1" / "manifest.json").write_text("{")
    assert list_checkpoints(run)[-1].is_scheduled


def test_a_commit_takes_its_writers_digests_and_publishes_no_notes(run: Run) -> None:
    writer = CheckpointWriter(run, 3, 2)
    (writer.path / "rank-0.pt").write_bytes(b"state")
    (writer.path / ".note").touch()
    (writer.path / "manifest.json").write_text("of an earlier try")
    existing = CheckpointWriter(run, 3, 2)
    made = existing.commit({}, digests={"rank-0.pt": STATE})
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


def test_an_attempt_that_lost_its_run_in_the_rename_prunes_nothing(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    commit(run, 1)
    raise_epoch(run, 1)
    rename = os.rename

    def frozen(old: Path, new: Path) -> None:
        rename(old, new)
        raise_epoch(run, 2)

    monkeypatch.setattr(os, "rename", frozen)
    commit(run, 2, keep=1)
    assert [each.iteration for each in list_checkpoints(run)] == [1, 2] and (
        run.checkpoints / "LATEST"
    ).read_text() == "00000001-e1\n"
