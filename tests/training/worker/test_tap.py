"""The tap: what it keeps of a control step, what it loses, and that the worlds do not notice it."""

from __future__ import annotations

import os
import socket
import stat
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp

from shared_store.volume.files import read_json, write_json
from shared_store.volume.layout import Run
from tests.support.waiting import wait_for
from worker.learning.reporter import Gate
from worker.settings.cartpole import CartpoleConfig
from worker.tasks.library.cartpole import Cartpole
from worker.telemetry.rows import MARKS, Layout, Rows, Segment
from worker.telemetry.tap import LiveTap, Tap, TapReader
from worker.telemetry.tap_request import request_of, response_of

torch.set_num_threads(1)
SHORT = CartpoleConfig(episode_seconds=0.2)
"""Episodes of 12 steps."""


@pytest.fixture(scope="module")
def task() -> Cartpole:
    return Cartpole(SHORT, 6, seed=3)


def drawn(step: int, worlds: int = 6) -> torch.Tensor:
    return torch.rand(worlds, 1, generator=torch.Generator().manual_seed(step)) * 2.0 - 1.0


def opened(task: Cartpole, worlds: int) -> tuple[Tap, TapReader]:
    tap = Tap(task, worlds, rows=16)
    tap.open()
    return tap, TapReader(tap)


def test_a_row_holds_the_result_of_the_step(task: Cartpole) -> None:
    task.reset()
    tap, reading = opened(task, 4)
    ended = np.zeros(4, int)
    assert len(reading.take()) == 0
    for number in range(40):  # over the end of the ring twice, and over the ends of episodes
        task.step(drawn(number))
        rows = reading.take()
        assert (len(rows), rows.first, rows.lost) == (1, number, 0)
        np.testing.assert_array_equal(rows.coordinates[0], wp.to_torch(task.worlds.arrays.joint_q)[:4].numpy())
        np.testing.assert_array_equal(rows.velocities[0], wp.to_torch(task.worlds.arrays.joint_qd)[:4].numpy())
        np.testing.assert_array_equal(rows.observations[0], task.states[:4].numpy())
        np.testing.assert_array_equal(rows.actions[0], drawn(number)[:4].numpy())
        np.testing.assert_array_equal(rows.rewards[0], task.rewards[:4].numpy())
        np.testing.assert_allclose(rows.terms[0].sum(-1), task.rewards[:4].numpy(), rtol=1e-6)
        np.testing.assert_array_equal(rows.mark("age")[0], task.episode_length[:4].numpy())
        np.testing.assert_array_equal(rows.mark("done")[0], task.dones[:4].numpy())
        np.testing.assert_array_equal(rows.mark("time_out")[0], task.time_outs[:4].numpy())
        np.testing.assert_array_equal(rows.mark("episode")[0], ended)
        ended += task.dones[:4].numpy()
    assert ended.min() >= 3
    tap.close()
    task.step(drawn(0))
    assert len(reading.take()) == 0


def test_the_terms_of_the_step_that_ends_an_episode_are_kept(task: Cartpole) -> None:
    task.reset()
    tap, reading = opened(task, 2)
    wp.to_torch(task.worlds.arrays.joint_q)[0, 1] = 1.0  # beyond angle_limit, 0.4
    task.step(torch.zeros(6, 1))
    rows = reading.take()
    terms = dict(zip(rows.layout.terms, rows.terms[0].T, strict=True))
    assert rows.mark("done")[0].tolist() == [1, 0]
    assert rows.cause(0, 0) == "dropped_pole"
    assert terms["fall"].tolist() == [-2.0, 0.0] and terms["alive"].tolist() == [0.0, np.float32(0.1)]
    tap.close()


def test_rows_beyond_the_ring_are_counted_as_lost(task: Cartpole) -> None:
    tap, reading = opened(task, 1)
    for number in range(40):
        task.step(drawn(number))
    rows = reading.take()
    # the oldest of the 16 rows is the one that the device may be writing over
    assert (len(rows), rows.first, rows.lost) == (15, 25, 25)
    np.testing.assert_array_equal(rows.actions[:, 0], [drawn(number)[0].tolist() for number in range(25, 40)])
    tap.close()


def test_the_worlds_do_not_notice_that_they_are_watched() -> None:
    plain, watched = Cartpole(SHORT, 3, seed=5), Cartpole(SHORT, 3, seed=5)
    Tap(watched, 3, rows=8).open()
    for number in range(30):
        plain.step(drawn(number, 3))
        watched.step(drawn(number, 3))
    first, second = plain.state_dict(), watched.state_dict()
    assert first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize("worlds", [0, 7])
def test_worlds_that_do_not_exist_cannot_be_watched(task: Cartpole, worlds: int) -> None:
    with pytest.raises(ValueError, match=f"worlds is {worlds}; of these worlds 1 to 6 can be watched"):
        Tap(task, worlds)


LAYOUT = Layout(2, 8, 1, 1, ("seen",), ("done",), ("paid",), 50.0)


def numbered(first: int, count: int) -> Rows:
    """Rows whose every value is the number of the step."""
    values = np.broadcast_to(np.arange(first, first + count, dtype=np.float32)[:, None, None], (count, 2, LAYOUT.width))
    return Rows(LAYOUT, first, values, np.zeros((count, 2, len(MARKS)), np.int32), np.zeros((count, 2, 0), np.uint8))


def steps(segment: Segment) -> tuple[list[int], int]:
    """Numbers of the steps that are read, and how many are reported as lost."""
    found = list(segment.take())
    for rows in found:
        assert (rows.values == np.arange(rows.first, rows.first + len(rows))[:, None, None]).all()
    return [rows.first + index for rows in found for index in range(len(rows))], sum(rows.lost for rows in found)


def test_a_reader_of_shared_memory_gets_every_row_once_and_the_count_of_missed_ones() -> None:
    writer = Segment.create(LAYOUT)
    reader = Segment.open(writer.path, LAYOUT)
    assert stat.S_IMODE(os.stat(writer.path).st_mode) == 0o600
    writer.append(numbered(10, 3))
    assert steps(reader) == ([10, 11, 12], 0)
    assert steps(reader) == ([], 0)
    writer.append(numbered(13, 20))
    assert steps(reader) == (list(range(25, 33)), 12)
    writer.append(numbered(40, 2))  # the tap itself lost 33 to 39
    assert steps(reader) == ([40, 41], 7)
    writer.close()
    assert reader.closed and not writer.path.exists()


def test_rows_that_may_have_been_written_over_while_they_were_read_are_dropped() -> None:
    writer = Segment.create(LAYOUT)
    reader = Segment.open(writer.path, LAYOUT)
    writer.append(numbered(0, 8))
    writer._header[1] = 11  # at work on three more rows, in the places of the first three
    assert steps(reader)[0] == [3, 4, 5, 6, 7]
    writer.close()


def test_memory_of_another_layout_is_refused(tmp_path: Path) -> None:
    (tmp_path / "other").write_bytes(b"\0" * 100)
    with pytest.raises(ValueError, match="not the shared memory of such a tap"):
        Segment.open(tmp_path / "other", LAYOUT)


def test_a_training_answers_a_request_between_two_iterations_and_stops_when_the_reader_is_gone(
    task: Cartpole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("worker.telemetry.tap.POLL_SECONDS", 0.05)
    run = Run(tmp_path / "run")
    run.path.mkdir()
    tap = LiveTap()
    tap.serve(run, task, Gate())
    assert not tap.before_iteration()
    write_json(request_of(run), {"host": socket.gethostname(), "process": os.getpid(), "worlds": 40})
    assert wait_for(tap.before_iteration, 10, "the request")
    reported = wait_for(lambda: read_json(response_of(run)), 10, "the answer")
    layout = Layout.from_json(reported["layout"])
    assert layout.worlds == 6 and stat.S_IMODE(response_of(run).stat().st_mode) == 0o600
    segment = Segment.open(Path(reported["path"]), layout)
    task.step(drawn(1))
    (rows,) = wait_for(lambda: list(segment.take()), 10, "the row")
    np.testing.assert_array_equal(rows.actions[0], drawn(1).numpy())
    tap.close()
    assert segment.closed and not Path(reported["path"]).exists() and not response_of(run).exists()
    task.watch(None)


def test_a_request_from_another_machine_is_answered_with_the_reason(
    task: Cartpole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("worker.telemetry.tap.POLL_SECONDS", 0.05)
    run = Run(tmp_path / "run")
    run.path.mkdir()
    tap = LiveTap()
    tap.serve(run, task, Gate())
    write_json(request_of(run), {"host": "elsewhere", "process": 1, "worlds": 1})
    reported = wait_for(lambda: read_json(response_of(run)), 10, "the answer")
    assert reported["problem"] == f"the training runs on {socket.gethostname()}, and its rows do not leave that machine"
    assert not tap.before_iteration()
    tap.close()
