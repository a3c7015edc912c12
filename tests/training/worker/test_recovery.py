"""Recordings with damaged bytes: what passes its checksum is kept, what is lost is named, and nothing wrong is kept."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from mcap.reader import make_reader

from tests.support.worker.in_process import call_worker
from tests.training.worker.test_recording import Recorded
from worker.telemetry.live import main
from worker.telemetry.recording import Recording
from worker.telemetry.recovering import recover
from worker.telemetry.replay import Replay

Messages = dict[str, list[tuple[int, bytes]]]
LARGEST = 110
"""Messages of a chunk, at most."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of 30 steps in about ten chunks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("worker.telemetry.recording.CHUNK", 8 << 10)
        return Recorded(tmp_path_factory.mktemp("damaged") / "two.mcap").path


def messages_of(path: Path) -> Messages:
    """Time and content of every message by topic, read with all checksums."""
    found: Messages = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for _, channel, message in reader.iter_messages(log_time_order=False):
            found.setdefault(channel.topic, []).append((message.log_time, message.data))
    return found


def metadata_of(path: Path) -> list[dict[str, str]]:
    with path.open("rb") as file:
        return [each.metadata for each in make_reader(file).iter_metadata()]


def chunks_of(path: Path) -> list[tuple[int, int]]:
    """Offset and length of each chunk."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [(each.chunk_start_offset, each.chunk_length) for each in summary.chunk_indexes]


def recovered(damaged: bytes, folder: Path, original: Messages) -> tuple[int, int, str]:
    """Recover bytes by the command: exit code, number of messages kept, lines. Each message is one of the original."""
    partial, target = folder / "f.mcap.partial", folder / "f.mcap"
    target.unlink(missing_ok=True)
    partial.write_bytes(damaged)
    done = call_worker(main, {}, "--recover", str(partial))
    assert "Traceback" not in done.stderr and done.stderr.count("\n") <= 1
    if not target.exists():
        return done.returncode, 0, done.stdout + done.stderr
    kept = messages_of(target)
    for topic, rows in kept.items():
        assert set(rows) <= set(original[topic]), topic
    return done.returncode, sum(map(len, kept.values())), done.stdout + done.stderr


def test_flipped_bits_never_become_values_and_cost_one_chunk_at_most(whole: Path, tmp_path: Path) -> None:
    data, original = whole.read_bytes(), messages_of(whole)
    total, chance = sum(map(len, original.values())), random.Random(1)
    for _ in range(60):
        flipped = bytearray(data)
        flipped[chance.randrange(8, len(data) - 8)] ^= 1 << chance.randrange(8)
        code, kept, lines = recovered(bytes(flipped), tmp_path, original)
        assert code == 1 and "damaged at 1 place" in lines and kept >= total - LARGEST, lines


def test_flipped_bits_of_a_cut_file_are_found_too(whole: Path, tmp_path: Path) -> None:
    data, original = whole.read_bytes(), messages_of(whole)
    chance = random.Random(2)
    begin, cut = chunks_of(whole)[0][0], data[: chunks_of(whole)[-2][0] + 100]
    code, without, _ = recovered(cut, tmp_path, original)
    assert code == 0
    for _ in range(60):
        flipped = bytearray(cut)
        flipped[chance.randrange(begin, len(cut) - 200)] ^= 1 << chance.randrange(8)
        code, kept, lines = recovered(bytes(flipped), tmp_path, original)
        # an index of a chunk holds nothing that is kept
        assert kept == without or (code == 1 and kept >= without - LARGEST), lines


def test_a_page_of_zeros_costs_its_chunks_and_their_messages_are_counted(whole: Path, tmp_path: Path) -> None:
    data, original = whole.read_bytes(), messages_of(whole)
    start, length = chunks_of(whole)[3]
    zeroed = data[: start + 60] + bytes(length - 60) + data[start + length :]
    code, kept, lines = recovered(zeroed, tmp_path, original)
    lost = sum(map(len, original.values())) - kept
    assert code == 1 and f"at least {lost} messages lost" in lines and 0 < lost < 120
    later = max(time for time, _ in original["/tf"])
    assert later in [time for time, _ in messages_of(tmp_path / "f.mcap")["/tf"]]


def test_a_damaged_first_chunk_costs_its_messages_alone(whole: Path, tmp_path: Path) -> None:
    """It holds the table of channels."""
    data, original = whole.read_bytes(), messages_of(whole)
    start, length = chunks_of(whole)[1]
    for first, end in ((chunks_of(whole)[0][0], start), (start, start + length)):
        zeroed = data[: first + 9] + bytes(end - first - 9) + data[end:]
        code, kept, _ = recovered(zeroed, tmp_path, original)
        assert code == 1 and kept > 0.7 * sum(map(len, original.values()))


def test_a_cut_anywhere_keeps_all_whole_chunks_and_is_no_damage(whole: Path, tmp_path: Path) -> None:
    data, original = whole.read_bytes(), messages_of(whole)
    chunks, chance = chunks_of(whole), random.Random(3)
    for _ in range(20):
        end = chance.randrange(chunks[2][0], len(data) - 1)
        code, kept, lines = recovered(data[:end], tmp_path, original)
        assert code == 0, lines
        assert kept > 0


def test_damaged_metadata_of_an_episode_is_left_out(whole: Path, tmp_path: Path) -> None:
    data, original = whole.read_bytes(), metadata_of(whole)
    place = data.index(b"return") + 12
    flipped = data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]
    (tmp_path / "f.mcap.partial").write_bytes(flipped)
    made = recover(tmp_path / "f.mcap.partial")
    assert made is not None and made.losses
    kept = metadata_of(made.path)
    assert len(kept) == len(original) - 1 and all(each in original for each in kept)


def test_the_view_shows_what_is_left_of_a_damaged_file(whole: Path, tmp_path: Path) -> None:
    data = whole.read_bytes()
    start, length = chunks_of(whole)[3]
    path = tmp_path / "zeroed.mcap"
    path.write_bytes(data[:start] + bytes(length) + data[start + length :])
    replay = Replay(path)
    steps = sum(len(part.times) for part in replay.parts())
    assert 20 < steps < 30 and "damaged at 1 place" in replay.losses


def test_a_recovered_file_of_a_whole_one_is_not_made_and_meshes_take_space_once(whole: Path, tmp_path: Path) -> None:
    from worker.tasks.go1 import Go1Flat
    from worker.telemetry.stage import Stage

    sizes = []
    for worlds in (1, 4):
        stage = Stage(Go1Flat, Go1Flat.config_type(), worlds)
        sizes.append(Recording(tmp_path / f"{worlds}.mcap", stage, {}, {}).finish().stat().st_size)
    assert sizes[1] < 1.1 * sizes[0]
