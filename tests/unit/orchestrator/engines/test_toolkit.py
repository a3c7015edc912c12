"""The toolkit of engines: the environment of started processes, waiting with an end, and outcomes and logs in a supervisor's place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from orchestrator.engines.api import Handle
from orchestrator.engines.testing.rigs import make_gang
from orchestrator.engines.toolkit import log_copy
from orchestrator.engines.toolkit.environment import PRIVATE, inherited
from orchestrator.engines.toolkit.log_copy import LogCopy
from orchestrator.engines.toolkit.outcomes import all_recorded, log_of, record, recorded, seen, store_facts
from orchestrator.engines.toolkit.waiting import wait_until
from shared_store.layout import Store
from shared_store.log_files import LIMIT, LogWriter


def test_a_started_process_inherits_all_variables_but_the_controller_s_own(monkeypatch: pytest.MonkeyPatch) -> None:
    ours = dict.fromkeys(PRIVATE, "secret")
    monkeypatch.setattr("os.environ", {**ours, "HOME": "/root", "PGHOST": "db", "A": "1"})
    assert inherited() == {"HOME": "/root", "PGHOST": "db", "A": "1"}
    assert inherited(["A"], ("PG",), kept=["RAY_AUTH_TOKEN"]) == {"HOME": "/root", "RAY_AUTH_TOKEN": "secret"}
    assert inherited(["A"], ("PG",), kept=["PGHOST"]) == {"HOME": "/root", "PGHOST": "db"}


def test_waiting_ends_when_the_condition_holds_or_the_time_is_over() -> None:
    looks = iter([False, False, True])
    assert wait_until(lambda: next(looks), 60.0, 0.0) and next(looks, None) is None
    assert not wait_until(lambda: False, 0.0)
    assert wait_until(lambda: True, 0.0), "it looks once at least"


@pytest.fixture
def handle(tmp_path: Path) -> Handle:
    """Of a gang of two nodes whose run is in the store."""
    gang = make_gang("job", str(tmp_path), 2, "fake/host", ["any"])
    Store(tmp_path).open().run(gang.run).create({"run": gang.run})
    return Handle("fake", gang.name, 2, store_facts(gang))


def test_the_outcome_of_a_node_is_written_once_and_not_over_a_supervisor_s(handle: Handle) -> None:
    assert recorded(handle, 1) is None and all_recorded(handle) == {}
    record(handle, seen(handle, 1, 3, "", 1e9))
    record(handle, seen(handle, 1, 0, "later", 2e9))
    found = recorded(handle, 1)
    assert found is not None and all_recorded(handle) == {1: found}
    assert (found.exit_code, found.reason, found.ended) == (3, "container exited with code 3", 1e9)
    assert seen(handle, 0, 0, "", 1e9).reason == "done" and seen(handle, 0, 137, "OOM", 1e9).reason == "OOM"


def test_no_outcome_is_written_for_a_run_that_is_gone_or_through_a_link_in_its_place(
    handle: Handle, tmp_path: Path
) -> None:
    gone = replace(handle, facts={**handle.facts, "run": "gone"})
    record(gone, seen(gone, 0, 0, "", 1e9))
    assert recorded(gone, 0) is None and not Store(tmp_path).run("gone").path.exists()
    folder = Store(tmp_path).run(handle.facts["run"]).outcome("job", 1, 0).parent
    folder.parent.mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    folder.symlink_to(tmp_path / "elsewhere")
    record(handle, seen(handle, 0, 0, "", 1e9))
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_a_copied_log_has_each_line_once_whoever_copies(handle: Handle) -> None:
    path, limit = log_of(handle, 0)
    assert limit == LIMIT
    lines = [f"line {number} \udcff\n" for number in range(7)]
    with LogCopy(path, limit) as copy:
        copy.append(lines[:3])
        copy.append(lines[3:4])
    with LogCopy(path, limit) as copy:  # by a controller that starts from the beginning, in other pieces
        copy.append(lines[:2])
        copy.append(lines[2:6])
        copy.append(lines[6:])
    assert path.read_text() == "".join(f"line {number} \\udcff\n" for number in range(7))


def test_lines_for_which_there_was_no_room_are_written_later(handle: Handle, monkeypatch: pytest.MonkeyPatch) -> None:
    path, limit = log_of(handle, 0)
    room = [4]  # bytes

    class Full(LogWriter):
        def append(self, data: bytes) -> int:
            part = data[: room[0]]
            written = super().append(part[: part.rfind(b"\n") + 1])
            self.error = OSError(28, "No space left on device") if written < len(data) else None
            return written

    monkeypatch.setattr(log_copy, "LogWriter", Full)
    with LogCopy(path, limit) as copy:
        with pytest.raises(OSError, match="No space left"):
            copy.append(["a\n", "b\n", "c\n"])
        assert not copy.is_whole and path.read_text() == "a\nb\n"
        room[0] = 100
        copy.append(["d\n"])
        assert copy.is_whole
    assert path.read_text() == "a\nb\nc\nd\n"
