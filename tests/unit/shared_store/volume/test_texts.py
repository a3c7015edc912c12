"""Long texts of jobs: referred to by their digests, read back whole or refused by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from shared_store.volume import texts
from shared_store.volume.run_settings import merged
from shared_store.volume.texts import IN_DEFINITION, Reference, TextError, beside, digest_of, references
from tests.support.refusals import refusal

SHORT = {"file": "short.py", "text": "x = '½'\n"}
LONG = {"file": "long.py", "text": "y = '½'\n" * 4000}
DIGEST = digest_of(LONG["text"])
REFERENCE = Reference("train.config.reward_function", "long.py", DIGEST)


def spec(value: Any, section: str = "train") -> dict[str, Any]:
    return {"name": "job", section: {"task": "elsewhere.mine:Task", "config": {"level": 3, "reward_function": value}}}


@pytest.mark.parametrize("section", ["train", "evaluate"])
def test_a_long_text_is_referred_to_and_a_short_one_stays(section: str) -> None:
    shortened, found = beside(spec(LONG, section))
    assert shortened == spec({"file": "long.py", "sha256": DIGEST}, section)
    assert found == {Reference(f"{section}.config.reward_function", "long.py", DIGEST): LONG["text"]}
    assert references(shortened) == list(found)
    assert beside(spec(SHORT, section)) == (spec(SHORT, section), {})
    assert beside(shortened) == (shortened, {})


def test_what_is_not_a_reference_is_left_alone(tmp_path: Path) -> None:
    for value in (
        SHORT,
        "path.py",
        3,
        None,
        {"file": "a"},
        {"file": "a", "sha256": "abc"},
        {"file": 3, "sha256": DIGEST},
    ):
        assert references(spec(value)) == []
        assert (
            texts.resolved(spec(value)["train"]["config"], tmp_path, "train.config") == spec(value)["train"]["config"]
        )
    for broken in (None, {}, {"train": None}, {"train": {"config": 3}}, {"train": []}):
        assert references(broken) == []


def test_a_kept_text_is_read_back_in_the_place_of_its_digest(tmp_path: Path) -> None:
    assert texts.keep(tmp_path / "texts", LONG["text"].encode()) == DIGEST
    assert texts.keep(tmp_path / "texts", LONG["text"].encode()) == DIGEST
    shortened, _ = beside(spec(LONG))
    found = texts.resolved(shortened["train"]["config"], tmp_path / "texts", "train.config")
    assert found == spec(LONG)["train"]["config"]
    assert texts.resolved_spec(shortened, tmp_path / "elsewhere", tmp_path / "texts") == spec(LONG)
    assert texts.resolved_spec(shortened, tmp_path / "elsewhere") == shortened
    assert [each.name for each in (tmp_path / "texts").iterdir()] == [DIGEST]


def test_a_missing_or_altered_text_is_refused_with_its_place_and_the_remedy(tmp_path: Path) -> None:
    path = tmp_path / DIGEST
    begins = f"train.config.reward_function: long.py (sha256 {DIGEST}): the text kept at {path} is "
    ends = "; submit the job again with the file"
    assert refusal(texts.read, tmp_path, REFERENCE, error=TextError) == f"{begins}missing{ends}"
    path.write_bytes(LONG["text"].encode()[:-1])
    altered = f"{begins}altered: its content has another digest{ends}"
    assert refusal(texts.read, tmp_path, REFERENCE, error=TextError) == altered
    path.unlink()
    (tmp_path / "there").write_bytes(LONG["text"].encode())
    path.symlink_to(tmp_path / "there")
    assert refusal(texts.read, tmp_path, REFERENCE, error=TextError) == f"{begins}not a regular file{ends}"


def test_either_of_two_places_gives_the_text(tmp_path: Path) -> None:
    texts.keep(tmp_path / "store", LONG["text"].encode())
    assert texts.read_either(tmp_path / "run", tmp_path / "store", REFERENCE) == LONG["text"]
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / DIGEST).write_text("altered")
    assert texts.read_either(tmp_path / "run", tmp_path / "store", REFERENCE) == LONG["text"]


def test_the_limit_counts_bytes_of_the_definition() -> None:
    quoted = {"file": "q.py", "text": '"' * (IN_DEFINITION // 4)}  # each is \\\" there
    assert beside(spec(quoted))[1]
    assert not beside(spec({"file": "q.py", "text": "x" * (IN_DEFINITION // 4)}))[1]


def test_a_text_with_half_of_a_character_is_left_to_those_who_refuse_it() -> None:
    half = spec({"file": "h.py", "text": "\ud83d" + "x" * IN_DEFINITION})
    assert beside(half) == (half, {})


def test_another_file_replaces_a_file_whole_in_whichever_form() -> None:
    short, long = {"reward_function": SHORT}, beside(spec(LONG))[0]["train"]["config"]
    assert merged(short, long)["reward_function"] == {"file": "long.py", "sha256": DIGEST}
    assert merged(long, short)["reward_function"] == SHORT


def test_a_text_goes_beside_a_job_that_does_not_fit_with_it_and_the_longest_goes_first() -> None:
    medium, short = ({"file": f"{size}.py", "text": "x" * size} for size in (12_000, 3_000))
    actions = {"action_space": [{"steering_angle": angle, "speed": 1.0} for angle in range(200)]}
    whole = spec(medium)
    whole["train"]["config"] |= {"other": short}
    assert beside(whole) == (whole, {})
    whole["train"]["config"] |= actions
    shortened, found = beside(whole)
    assert [each.file for each in found] == ["12000.py"] and shortened["train"]["config"]["other"] == short
    whole = {**spec(medium), "environment": {"NOTE": "n" * 5000}}
    assert [each.file for each in beside(whole)[1]] == ["12000.py"], "a definition has the environment twice"


@pytest.mark.parametrize("value", [{"sha256": DIGEST}, {"sha256": DIGEST, "text": ""}])
def test_a_digest_without_a_name_or_with_an_empty_text_stands_for_the_text(
    value: dict[str, str], tmp_path: Path
) -> None:
    [found] = references(spec(value))
    assert (found.file, found.sha256) == ("reward_function", DIGEST)
    texts.keep(tmp_path, LONG["text"].encode())
    config = texts.resolved({"reward_function": value}, tmp_path, "train.config")
    assert config == {"reward_function": {"file": "reward_function", "text": LONG["text"]}}
