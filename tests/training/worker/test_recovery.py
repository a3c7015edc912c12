"""Recordings with damaged bytes: what passes its checksum is kept, what is lost is named, and nothing wrong is kept."""

from __future__ import annotations

import random
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader

from tests.support.worker.in_process import call_worker
from tests.training.worker.test_recording import Recorded
from worker.settings.errors import UserError
from worker.telemetry.intact_records import CHANNELS
from worker.telemetry.live_recording import main
from worker.telemetry.recording import recover
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


def metadata_of(path: Path) -> list[tuple[str, dict[str, str]]]:
    with path.open("rb") as file:
        return [(each.name, each.metadata) for each in make_reader(file).iter_metadata()]


def attachments_of(path: Path) -> list[tuple[object, ...]]:
    """All but the table of channels."""
    with path.open("rb") as file:
        found = [each for each in make_reader(file).iter_attachments() if each.name != CHANNELS]
        return [(each.name, each.media_type, each.log_time, each.create_time, each.data) for each in found]


def records_of(data: bytes, opcode: int) -> Iterator[tuple[int, int]]:
    """Offset and end of each record of a kind, in a whole file or one that is cut."""
    place = 8
    while place + 9 < len(data) - 8:
        end = place + 9 + struct.unpack_from("<Q", data, place + 1)[0]
        if data[place] == opcode:
            yield place, end
        place = end


def chunks_of(path: Path) -> list[tuple[int, int]]:
    """Offset and length of each chunk."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [(each.chunk_start_offset, each.chunk_length) for each in summary.chunk_indexes]


def recovered(damaged: bytes, folder: Path, original: Messages, whole: Path | None = None) -> tuple[int, int, str]:
    """Recover bytes by the command: exit code, number of messages kept, lines. Each message is one of the original.

    So are the metadata and attachments, where the original's path is given.
    """
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
    if whole is not None:
        assert all(each in metadata_of(whole) for each in metadata_of(target))
        assert all(each in attachments_of(whole) for each in attachments_of(target))
    return done.returncode, sum(map(len, kept.values())), done.stdout + done.stderr


def test_flipped_bits_never_become_values_and_cost_one_chunk_at_most(whole: Path, tmp_path: Path) -> None:
    data, original = whole.read_bytes(), messages_of(whole)
    total, chance = sum(map(len, original.values())), random.Random(1)
    for _ in range(60):
        damaged = flipped(data, chance.randrange(8, len(data) - 8), chance.randrange(8))
        code, kept, lines = recovered(damaged, tmp_path, original, whole)
        assert code == 1 and "damaged at 1 place" in lines and kept >= total - LARGEST, lines


def test_flipped_bits_of_a_cut_file_are_found_too(whole: Path, tmp_path: Path) -> None:
    data, original = whole.read_bytes(), messages_of(whole)
    chance = random.Random(2)
    begin, cut = chunks_of(whole)[0][0], data[: chunks_of(whole)[-2][0] + 100]
    code, without, _ = recovered(cut, tmp_path, original)
    assert code == 0
    for _ in range(60):
        damaged = flipped(cut, chance.randrange(begin, len(cut) - 200), chance.randrange(8))
        code, kept, lines = recovered(damaged, tmp_path, original, whole)
        # an index of a chunk holds nothing that is kept
        assert kept == without or (code == 1 and kept >= without - LARGEST), lines


def flipped(data: bytes, place: int, bit: int) -> bytes:
    """With another bit at a place."""
    return data[:place] + bytes([data[place] ^ 1 << bit]) + data[place + 1 :]


def kept_of(data: bytes, folder: Path) -> tuple[str, tuple[object, ...]]:
    """Losses, and all that a recovered file has."""
    (folder / "f.mcap").unlink(missing_ok=True)
    (folder / "f.mcap.partial").write_bytes(data)
    made = recover(folder / "f.mcap.partial")
    assert made is not None
    return made.losses, (messages_of(made.path), metadata_of(made.path), attachments_of(made.path))


def test_any_flipped_byte_of_an_episode_costs_that_episode_alone_and_is_named(whole: Path, tmp_path: Path) -> None:
    data = whole.read_bytes()
    cut = data[: chunks_of(whole)[-2][0] + 100]
    place, end = next(records_of(cut, 12))
    losses, (messages, metadata, attachments) = kept_of(cut, tmp_path)
    assert not losses and len(metadata) > 1
    for at in range(place, end):
        losses, kept = kept_of(flipped(cut, at, at % 8), tmp_path)
        assert kept == (messages, metadata[1:], attachments), at - place
        assert "damaged at 1 place" in losses and "the record of 1 episode lost" in losses, at - place


@pytest.mark.parametrize("opcode", [6, 7, 9, 12])
def test_a_flipped_opcode_or_length_costs_one_record_at_most_and_never_silently(
    whole: Path, tmp_path: Path, opcode: int
) -> None:
    data = whole.read_bytes()
    cut = data[: chunks_of(whole)[-2][0] + 100]
    before = kept_of(cut, tmp_path)[1]
    for place, end in list(records_of(cut, opcode))[:4]:
        if end > len(cut):
            continue
        for at in range(place, place + 9):
            losses, kept = kept_of(flipped(cut, at, at % 3), tmp_path)
            assert losses or kept == before
            if opcode in (6, 7):  # a chunk has its length twice, and an index holds nothing
                assert kept == before, losses
            missing = [len(old) - len(new) for old, new in zip(before[1:], kept[1:], strict=True)]
            assert sum(missing) <= 1 and kept[0] == before[0], losses


def test_a_length_that_leads_to_another_sound_record_hides_none(whole: Path, tmp_path: Path) -> None:
    """That of a chunk, in its record, in itself or in both, so that it seems to reach over the next one; that of an index."""
    data = whole.read_bytes()
    chunks, before = chunks_of(whole), None
    cut = data[: chunks[-2][0] + 100]
    before = kept_of(cut, tmp_path)[1]
    start, reach = chunks[2][0], chunks[4][0]
    for outer, inner in ((True, False), (False, True), (True, True)):
        changed = bytearray(cut)
        if outer:
            struct.pack_into("<Q", changed, start + 1, reach - start - 9)
        if inner:
            struct.pack_into("<Q", changed, start + 45, reach - start - 53)
        losses, (messages, *others) = kept_of(bytes(changed), tmp_path)
        assert others == list(before[1:])
        lost = sum(map(len, before[0].values())) - sum(map(len, messages.values()))
        assert lost == 0 or (outer and inner and f"at least {lost} messages lost" in losses)
    index = next(place for place, _ in records_of(cut, 7) if place > start)
    changed = bytearray(cut)
    struct.pack_into("<Q", changed, index + 1, reach - index - 9)
    losses, kept = kept_of(bytes(changed), tmp_path)
    assert kept == before and "nothing is known to be lost" in losses


def test_what_cannot_be_counted_is_an_unknown_number(whole: Path, tmp_path: Path) -> None:
    data = whole.read_bytes()
    (start, _), (end, _) = chunks_of(whole)[3:5]
    losses, _ = kept_of(data[:start] + bytes(end - start) + data[end:], tmp_path)
    assert "an unknown number of messages lost" in losses
    (tmp_path / "zeros.mcap.partial").write_bytes(bytes(5000))
    with pytest.raises(UserError, match="it has no readable record of an MCAP file"):
        recover(tmp_path / "zeros.mcap.partial")
    _, end = next(records_of(data, 9))
    losses, (_, _, attachments) = kept_of(flipped(data, end - 1, 0), tmp_path)
    assert "attachment job.json lost" in losses and len(attachments) == len(attachments_of(whole)) - 1


def test_a_page_of_zeros_costs_its_chunks_and_their_messages_are_counted(whole: Path, tmp_path: Path) -> None:
    data, original = whole.read_bytes(), messages_of(whole)
    start, length = chunks_of(whole)[3]
    zeroed = data[: start + 60] + bytes(length - 60) + data[start + length :]
    code, kept, lines = recovered(zeroed, tmp_path, original)
    lost = sum(map(len, original.values())) - kept
    assert code == 1 and f"at least {lost} messages lost" in lines and 0 < lost < 120
    later = max(time for time, _ in original["/tf"])
    assert later in [time for time, _ in messages_of(tmp_path / "f.mcap")["/tf"]]


def test_a_chunk_that_stands_there_twice_is_kept_once(whole: Path, tmp_path: Path) -> None:
    data, original = whole.read_bytes(), messages_of(whole)
    place, length = chunks_of(whole)[2]
    twice = data[: place + length] + data[place : place + length] + data[place + length :]
    code, kept, lines = recovered(twice, tmp_path, original, whole)
    assert (code, kept) == (1, sum(map(len, original.values()))) and "damaged at 1 place" in lines


def test_a_recording_without_its_meshes_is_recovered_and_the_view_says_that_it_can_t_draw_it(
    whole: Path, tmp_path: Path
) -> None:
    place, length = chunks_of(whole)[0]
    code, kept, _ = recovered(flipped(whole.read_bytes(), place + length // 2, 0), tmp_path, messages_of(whole))
    assert code == 1 and kept
    with pytest.raises(UserError, match="what its worlds look like"):
        Replay(tmp_path / "f.mcap")


def test_a_cut_anywhere_keeps_all_whole_chunks_and_does_not_count_as_damage(whole: Path, tmp_path: Path) -> None:
    data, original = whole.read_bytes(), messages_of(whole)
    chunks, chance = chunks_of(whole), random.Random(3)
    for _ in range(20):
        end = chance.randrange(chunks[2][0], len(data) - 1)
        code, kept, lines = recovered(data[:end], tmp_path, original)
        assert code == 0, lines
        assert kept > 0


def test_the_view_shows_what_is_left_of_a_damaged_file(whole: Path, tmp_path: Path) -> None:
    data = whole.read_bytes()
    start, length = chunks_of(whole)[3]
    path = tmp_path / "zeroed.mcap"
    path.write_bytes(data[:start] + bytes(length) + data[start + length :])
    replay = Replay(path)
    steps = sum(len(part.times) for part in replay.parts())
    assert 20 < steps < 30 and "damaged at 1 place" in replay.losses
