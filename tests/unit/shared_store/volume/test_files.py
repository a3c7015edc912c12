"""Files are replaced whole or not at all, whatever happens meanwhile."""

from __future__ import annotations

import os
import resource
import sys
from pathlib import Path

import pytest

from shared_store.volume.files import (
    DamagedFile,
    read_json,
    remove_tree,
    write_atomic,
    write_json,
)
from tests.support.shared_store.crashes import killed_at_every_step
from tests.support.shared_store.operations import durable_operations

OLD, NEW = b"old content\n", b"new content, which is longer\n" * 5000


def replace(root: Path) -> None:
    write_atomic(root / "file", NEW)


def remove(root: Path) -> None:
    remove_tree(root / "tree")


@pytest.mark.parametrize("old", [OLD, None])
def test_a_process_killed_at_any_step_leaves_the_old_content_or_the_new_one(tmp_path: Path, old: bytes | None) -> None:
    prepared = tmp_path / "prepared"
    prepared.mkdir()
    if old:
        (prepared / "file").write_bytes(old)
    found = list[bytes | None]()
    for left in killed_at_every_step(replace, prepared, tmp_path / "work"):
        visible = [name for name in os.listdir(left) if not name.startswith(".")]
        assert visible in ([], ["file"])
        found.append((left / "file").read_bytes() if visible else None)
    assert set(found) == {old, NEW} and (found[0], found[-1]) == (old, NEW)


def test_content_is_durable_before_it_gets_its_name_and_the_name_before_the_call_returns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = durable_operations(monkeypatch)
    write_atomic(tmp_path / "file", NEW)
    assert [operation for operation, _ in seen] == ["fsync", "rename", "fsync"]
    assert Path(seen[0][1]).name.startswith(".file.")
    assert [path for _, path in seen[1:]] == [str(tmp_path / "file"), str(tmp_path)]


@pytest.mark.parametrize("levels", [0, 1, 2])
def test_directories_are_made_up_to_a_level_and_above_it_none(tmp_path: Path, levels: int) -> None:
    with pytest.raises(FileNotFoundError):
        write_atomic(tmp_path.joinpath(*"abc"[: levels + 1], "file"), NEW, levels=levels)
    assert os.listdir(tmp_path) == []
    write_atomic(tmp_path.joinpath(*"abc"[:levels], "file"), NEW, levels=levels)


def test_a_failed_write_leaves_the_old_content_and_no_other_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # Python takes a module that it cached by half for whole
    (tmp_path / "file").write_bytes(OLD)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))  # what a full disk does, without filling one
    try:
        with pytest.raises(OSError, match="too large"):
            write_atomic(tmp_path / "file", NEW)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (tmp_path / "file").read_bytes() == OLD
    assert os.listdir(tmp_path) == ["file"]


def test_a_private_file_is_private_from_the_first_instant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    modes = []
    replace = os.replace

    def look(source: Path, target: Path) -> None:
        modes.append(os.stat(source).st_mode & 0o777)
        replace(source, target)

    monkeypatch.setattr(os, "replace", look)
    write_json(tmp_path / "secret.json", {"key": 1}, mode=0o600)
    write_json(tmp_path / "plain.json", {"key": 1})
    assert modes == [0o600, 0o666 & ~_umask()]
    assert (tmp_path / "secret.json").stat().st_mode & 0o777 == 0o600


def _umask() -> int:
    os.umask(value := os.umask(0o022))
    return value


def test_a_directory_whose_removal_is_killed_is_complete_or_hidden(tmp_path: Path) -> None:
    tree = tmp_path / "prepared" / "tree"
    tree.mkdir(parents=True)
    for name in "abc":
        (tree / name).write_text(name)
    lefts = killed_at_every_step(remove, tmp_path / "prepared", tmp_path / "work")
    seen = [sorted(os.listdir(left / "tree")) if (left / "tree").exists() else None for left in lefts]
    assert (seen[0], seen[-1]) == (["a", "b", "c"], None) and all(names in (seen[0], None) for names in seen)


def test_json_comes_back_as_it_was_written_from_directories_that_did_not_exist(tmp_path: Path) -> None:
    path, value = (
        tmp_path / "a" / "b.json",
        {"text": "Größe ✓", "number": 1.5, "nothing": None, "list": [1, {"a": True}]},
    )
    assert read_json(path) is None
    write_json(path, value)
    assert read_json(path) == value
    path.write_text('{"reward": NaN, "worst": -Infinity}')
    assert read_json(path) == {"reward": None, "worst": None}, "numbers that JSON lacks"


@pytest.mark.parametrize(
    "content",
    [
        *(b"", b"{", b"[1]", b'"text"', b"\xff\xfe\x00", b"\0" * 100, b'{"a": ' * 5000 + b"1" + b"}" * 5000),
        *(b'{"a":' * 101 + b"1" + b"}" * 101, b'{"a": 1e999}', b'{"a": "\\ud800"}', b'{"a": ' + b"9" * 5000 + b"}"),
        b'{"a": "%s"}' % (b"x" * 1000),
    ],
)
def test_json_that_is_not_a_plain_object_within_the_limits_is_damaged(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "value.json").write_bytes(content)
    with pytest.raises(DamagedFile, match=r"^[^\n]+$"):
        read_json(tmp_path / "value.json", largest=1000 if len(content) < 2000 else 100_000)


def test_json_that_is_not_a_regular_file_is_damaged_and_never_waited_for(tmp_path: Path) -> None:
    write_json(tmp_path / "other.json", {})
    (tmp_path / "directory").mkdir()
    (tmp_path / "link").symlink_to("other.json")
    os.mkfifo(tmp_path / "pipe")
    for name in ("directory", "link", "pipe"):
        with pytest.raises(DamagedFile, match="not a regular file"):
            read_json(tmp_path / name)
    assert read_json(tmp_path / "other.json" / "below a file") is None
