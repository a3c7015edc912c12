"""Names of tracks in jobs, and pictures of tracks."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from PIL import Image

from shared_store.layout import Store
from worker.racer.checks import BadTrack
from worker.racer.generator import make_random
from worker.racer.naming import keep, resolve
from worker.racer.picture import picture_of
from worker.racer.presets import make_preset


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store").open()


def test_a_name_means_a_preset_a_seed_or_a_track_of_the_store(store: Store) -> None:
    kept = make_random(5, "hills", length=40.0)
    keep(store, kept, {"seed": 5})
    assert resolve("oval", None).digest == make_preset("oval").digest
    assert resolve("random:7", None).digest == make_random(7).digest
    found = resolve("hills", store)
    assert (found.name, found.digest) == ("hills", kept.digest)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("ovall", "track 'ovall': there is no such track; did you mean oval?"),
        ("hils", "did you mean hills?"),
        ("random", "did you mean random:7?"),
        ("random:x", "after random: stands a whole number from 0 to 9223372036854775807, such as random:7"),
        ("random:-1", "after random: stands a whole number"),
        (f"random:{2**63}", "after random: stands a whole number"),
        ("random:" + "9" * 9999, "after random: stands a whole number"),
        ("../hills", "there is no such track"),
        ("q\nq", "track 'q\\nq': there is no such track; there are oval, rounded-rectangle, chicane, hills, random:7"),
    ],
)
def test_a_name_that_means_nothing_is_refused_with_the_nearest_one(store: Store, name: str, words: str) -> None:
    keep(store, make_preset("oval", "hills"), {})
    with pytest.raises(BadTrack) as told:
        resolve(name, store)
    assert words in str(told.value) and "\n" not in str(told.value)


def test_a_track_can_not_have_the_name_of_a_preset(store: Store) -> None:
    with pytest.raises(BadTrack, match="track oval: a preset is called so; choose another name"):
        keep(store, make_random(1, "oval"), {})


def test_a_picture_has_the_shape_of_its_track() -> None:
    long, tall = (Image.open(io.BytesIO(picture_of(make_preset(name)))) for name in ("chicane", "oval"))
    assert long.format == "PNG" and long.width > 1.4 * long.height
    assert tall.width / tall.height < long.width / long.height
    colours = {tuple(pixel) for _, pixel in long.convert("RGB").getcolors(1 << 20)}
    for drawn in ((0xD9, 0xDC, 0xE1), (0xC0, 0x20, 0x2A)):  # asphalt, start line
        assert min(sum(abs(a - b) for a, b in zip(drawn, each, strict=True)) for each in colours) < 24, drawn
