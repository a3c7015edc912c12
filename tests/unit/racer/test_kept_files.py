"""Files that a job names in its task's configuration: read, checked and kept in the job when it is submitted."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from orchestrator.api.http import limits
from orchestrator.domain.errors import SpecError
from orchestrator.spec import file as specfile
from orchestrator.spec import kept_files, strict_yaml
from orchestrator.spec.changes import override
from orchestrator.spec.compile import compile_definition, long_texts
from orchestrator.spec.kept_files import changes_with_files, with_files
from orchestrator.spec.model import validate
from racer.control.track_orders import carry_out
from shared_store.volume.layout import Store
from shared_store.volume.texts import IN_DEFINITION, LARGEST, digest_of
from tests.support.refusals import refusal

GOOD = "# ½ 😀 \"quoted\" \\ and\ttabs\ndef reward_function(params):\n    return params['speed']\n"
METADATA = {"action_space": [{"steering_angle": angle, "speed": 1} for angle in (-20, 0, 20)]}
JOB = """name: racer
train:
  task: Racer
  worlds: 8
  iterations: 2
  config:
    reward_function: mine.py
"""


@pytest.fixture(autouse=True)
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(GOOD)
    (tmp_path / "space.json").write_text(json.dumps(METADATA))
    (tmp_path / "job.yaml").write_text(JOB)
    return tmp_path


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files are read, and not tried: that takes a process each."""
    monkeypatch.setattr(kept_files._Origin, "check", lambda *_: None)


def config(changes: list[str] | None = None) -> dict[str, Any]:
    spec = specfile.load("job.yaml", changes)
    assert spec.train is not None
    return spec.train.config


def test_a_job_has_the_text_of_the_files_that_it_names(directory: Path) -> None:
    found = config(["train.config.action_space=space.json"])
    assert found == {"reward_function": {"file": "mine.py", "text": GOOD}, "action_space": METADATA}
    whole = {"name": "again", "train": {**_train(), "config": found}}
    (directory / "kept.yaml").write_text(json.dumps(whole, ensure_ascii=False))
    (directory / "mine.py").unlink()
    again = specfile.load("kept.yaml").train
    assert again is not None and again.config == found


def no_text(text: str) -> None:
    raise AssertionError(f"{text[:20]} is short, and belongs into the assignment")


def _train() -> dict[str, Any]:
    return {"task": "Racer", "worlds": 8, "iterations": 2}


@pytest.mark.usefixtures("unchecked")
def test_a_change_of_a_run_has_the_text_of_the_file_whatever_is_in_it() -> None:
    def racer() -> dict[str, Any]:
        return {"train": {"task": "Racer"}}

    fields = ["train.iterations=9", "train.config.reward_function=mine.py", "train.config.track=chicane"]
    first, second, third = changes_with_files(racer, fields, no_text)
    assert (first, third) == (fields[0], fields[2]) and second.isascii()
    kept = {"file": "mine.py", "text": GOOD}
    assert override({}, [second]) == {"train": {"config": {"reward_function": kept}}}
    (whole,) = changes_with_files(racer, ["train.config={reward_function: mine.py, track: oval}"], no_text)
    assert override({}, [whole])["train"]["config"] == {"reward_function": kept, "track": "oval"}
    assert changes_with_files(lambda: {"train": {"task": "Ant"}}, fields, no_text) == fields


@pytest.mark.parametrize("train", [_train() | {"task": "elsewhere.mine:Task"}, {"config": 3}, None])
def test_no_file_is_read_for_fields_that_name_none(train: Any) -> None:
    if isinstance(train, dict) and "task" in train:
        train["config"] = {"reward_function": "missing.py"}
    assert with_files({"name": "other", "train": train}, "job.yaml") == {"name": "other", "train": train}


def test_an_error_in_a_file_is_reported_at_the_line_that_names_it(directory: Path) -> None:
    (directory / "mine.py").write_text("import os\n" + GOOD)
    refused = refusal(specfile.load, "job.yaml", error=SpecError)
    output = "mine.py:1: IMPORT_ERROR: os can't be imported; a reward function may import math, random, numpy, scipy, shapely"
    assert refused == f"job.yaml:7: train.config.reward_function: {output}"
    (directory / "mine.py").unlink()
    refused = refusal(specfile.load, "job.yaml", error=SpecError)
    here = f"a path is relative to the directory of the command, {directory}"
    assert refused == f"job.yaml:7: train.config.reward_function: mine.py: No such file or directory; {here}"


@pytest.mark.usefixtures("unchecked")
def test_a_text_that_does_not_fit_into_a_definition_is_kept_beside_the_job_with_a_note_for_the_submitter(
    directory: Path,
) -> None:
    (directory / "mine.py").write_text(GOOD + "#" * (IN_DEFINITION - 2000))
    short = specfile.load("job.yaml")
    assert (long_texts(short), short.notes) == ([], ())
    text = GOOD + "#" * IN_DEFINITION
    (directory / "mine.py").write_text(text)
    long = specfile.load("job.yaml")
    assert long_texts(long) == [text]
    message = f"train.config.reward_function: mine.py: {len(text.encode()):,} bytes: kept beside the job"
    assert long.notes == (message,)
    definition = json.dumps(compile_definition(long, ""))
    assert digest_of(text) in definition and len(definition) < 4096


@pytest.mark.usefixtures("unchecked")
def test_a_change_of_a_run_has_the_digest_of_a_long_text_which_is_kept_first(directory: Path) -> None:
    text, kept = GOOD + "#" * IN_DEFINITION, list[str]()
    (directory / "mine.py").write_text(text)
    racer = {"train": {"task": "Racer"}}
    (change,) = changes_with_files(lambda: racer, ["train.config.reward_function=mine.py"], kept.append)
    assert kept == [text]
    reference = {"file": "mine.py", "sha256": digest_of(text)}
    assert override({}, [change]) == {"train": {"config": {"reward_function": reference}}}


@pytest.mark.usefixtures("unchecked")
def test_a_file_beyond_the_limit_is_refused_with_that(directory: Path) -> None:
    (directory / "mine.py").write_text("#" * (LARGEST + 1))
    with pytest.raises(SpecError, match=r"job\.yaml:7: .*mine\.py: it has more than 1,048,576 bytes; shorten it"):
        specfile.load("job.yaml")
    (directory / "mine.py").write_text(GOOD)
    (directory / "space.json").write_text(json.dumps({"sensor": ["x" * IN_DEFINITION]}))
    words = r"space\.json: it takes 20,\d{3} bytes of the job's definition, and may take 20,480; shorten it"
    with pytest.raises(SpecError, match=words):
        config(["train.config.action_space=space.json"])


def test_a_digest_stands_for_a_text_and_never_beside_one() -> None:
    kept = {"file": "mine.py", "sha256": "0" * 64}
    changed = override(strict_yaml.load(JOB)[0], [f"train.config.reward_function={json.dumps(kept)}"])
    found = validate(changed, "job").train
    assert found is not None and found.config["reward_function"] == kept
    both = override(changed, [f"train.config.reward_function={json.dumps({**kept, 'text': 'x = 1'})}"])
    with pytest.raises(SpecError, match="it has both a text and a sha256; leave one of them out"):
        validate(both, "job")


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("content", "output"),
    [
        (b"{\n 1", r"space\.json:2: it is not JSON \(Expecting property name"),
        (b"\xff\xfe", r"space\.json: it is not a text file \(UTF-8\)"),
        (b'"other.json"', r"space\.json: expected a list or an object, found a string"),
        (b'{"action_space": [{"steering_angle": 0, "speed": "fast"}, {}]}', r"action_space\.0\.speed: expected"),
    ],
)
def test_an_action_space_is_checked_when_its_file_is_read(directory: Path, content: bytes, output: str) -> None:
    (directory / "space.json").write_bytes(content)
    with pytest.raises(SpecError, match=output):
        config(["train.config.action_space=space.json"])


def in_yaml(code: str) -> str:
    """The job with a text in the place of its path."""
    lines = "".join(f"        {line}\n" for line in code.splitlines())
    return JOB.replace("reward_function: mine.py\n", f"reward_function:\n      file: mine.py\n      text: |\n{lines}")


def test_a_request_brings_texts_and_no_path_of_the_servers_files() -> None:
    code = "def reward_function(params):\n    return params['speed']\n"
    found = specfile.from_text(in_yaml(code), "job").train
    assert found is not None and found.config["reward_function"] == {"file": "mine.py", "text": code}
    with pytest.raises(
        SpecError, match=r"^job:7: train\.config\.reward_function: found a path; .* \{file: NAME, text: …\}$"
    ):
        specfile.from_text(JOB, "job")
    with pytest.raises(SpecError, match=r"^job:7: train\.config\.action_space: found a path; .* the value in it$"):
        specfile.from_text(JOB.replace("reward_function: mine.py", "action_space: space.json"), "job")


def test_a_text_that_fails_on_a_sample_is_refused_under_the_name_of_its_file_where_it_is_tried() -> None:
    fails = in_yaml("def reward_function(params):\n    return params['sped']\n")
    assert specfile.from_text(fails, "job", whole=False).name == "racer"
    with pytest.raises(SpecError, match=r"^job:7: train\.config\.reward_function: mine\.py:2: TEST_FAILURE: .*sped"):
        specfile.from_text(fails, "job")


FAR = "def reward_function(params):\n    return params['waypoints'][140][0]\n"
SHORT = (
    "mine.py:2: TEST_FAILURE: the sample 'start': IndexError: list index out of range, on track oval with 133 waypoints"
)


def test_a_reward_function_is_tried_on_the_job_s_own_track(directory: Path) -> None:
    (directory / "mine.py").write_text(FAR)
    assert refusal(specfile.load, "job.yaml", error=SpecError) == f"job.yaml:7: train.config.reward_function: {SHORT}"
    assert "TEST_FAILURE" not in str(specfile.load("job.yaml", ["train.config.track=chicane"]).notes)
    with pytest.raises(
        SpecError, match=r"^job:7: train\.config\.reward_function: .* on track oval with 133 waypoints$"
    ):
        specfile.from_text(in_yaml(FAR), "job")


def test_a_track_of_the_store_is_tried_where_the_store_is_here_and_noted_where_it_is_not(directory: Path) -> None:
    (directory / "mine.py").write_text(FAR)
    store = Store(directory / "store").open()
    carry_out(
        {
            "action": "make",
            "name": "short",
            "preset": "oval",
            "seed": None,
            "measures": {"length": 12.0},
            "store": str(store.path),
        }
    )
    changes = ["train.config.track=short"]
    refused = refusal(specfile.load, "job.yaml", changes, lambda: str(store.path), error=SpecError)
    assert "IndexError: list index out of range, on track short with 80 waypoints" in refused
    notes = specfile.load("job.yaml", changes).notes
    assert any("mine.py: it is not tried on track short, but on the job's nodes" in note for note in notes)


def test_a_run_s_function_is_tried_anew_on_another_track() -> None:
    kept = {"file": "mine.py", "text": FAR}
    racer = {"train": {"task": "Racer", "config": {"track": "chicane", "reward_function": kept}}}
    changes = ["train.iterations=9", "train.config.track=oval"]
    refused = refusal(changes_with_files, lambda: racer, changes, no_text, error=SpecError)
    assert refused.endswith(SHORT) and "train.config.track" in refused
    same = ["train.config.speed_lag=0.1"]
    assert changes_with_files(lambda: racer, same, no_text) == same
    config = {"track": "oval"}
    for document in ({"evaluate": {"config": config}}, {"race": {"track": "oval"}}):
        with pytest.raises(SpecError, match="on track oval"):
            with_files(document, "evaluation of r", task="Racer", base=racer["train"]["config"])
    boxes = {"evaluate": {"config": {"obstacles": [{"distance": 3.0}]}}}
    assert with_files(boxes, "evaluation of r", task="Racer", base=racer["train"]["config"]) == boxes


def test_the_submitter_reads_why_a_function_is_not_compiled_whatever_the_command(directory: Path) -> None:
    remembers = (
        "class Memory:\n    last = 0.0\n\nmemory = Memory()\ndef reward_function(params):\n    return memory.last\n"
    )
    (directory / "mine.py").write_text(remembers)
    trained = {"train": {"task": "Racer", "config": {"reward_function": {"file": "mine.py", "text": remembers}}}}
    base: dict[str, Any] = trained["train"]["config"]  # type: ignore[assignment]
    set_, resumed, evaluated = "train.config.reward_function=mine.py", list[str](), list[str]()
    changes_with_files(lambda: {"train": {"task": "Racer"}}, [set_], no_text, note=resumed.append)
    document = {"evaluate": {"config": {"track": "oval"}}}
    with_files(document, "evaluation of r", task="Racer", base=base, note=evaluated.append)
    submitted, in_console = specfile.load("job.yaml").notes, specfile.from_text(in_yaml(remembers), "job").notes
    for notes in (submitted, in_console, resumed, evaluated):
        (note,) = [each for each in notes if "no sandbox" not in each]
        assert (
            note.startswith("mine.py: line 6: an object of the class Memory: ") and "Python workers, hundreds" in note
        )


def test_a_long_function_of_a_run_is_fetched_and_tried_anew_on_another_track() -> None:
    kept = {"file": "mine.py", "sha256": digest_of(FAR)}
    racer = {"train": {"task": "Racer", "config": {"track": "chicane", "reward_function": kept}}}
    texts, changes, notes = {digest_of(FAR): FAR}, ["train.config.track=oval"], list[str]()
    refused = refusal(changes_with_files, lambda: racer, changes, no_text, text_of=texts.get, error=SpecError)
    assert refused.endswith(SHORT)
    with pytest.raises(SpecError, match="on track oval"):
        with_files({"race": {"track": "oval"}}, "r", task="Racer", base=racer["train"]["config"], text_of=texts.get)
    assert changes_with_files(lambda: racer, changes, no_text, note=notes.append) == changes
    assert notes == ["mine.py: its text is not in the run: it is not tried here, but on the job's nodes"]


@pytest.mark.usefixtures("unchecked")
def test_a_file_that_fits_alone_is_kept_beside_a_job_that_is_long_without_it(directory: Path) -> None:
    actions = [{"index": i, "steering_angle": i - 15, "speed": 1.0 + i / 20} for i in range(30)]
    (directory / "space.json").write_text(json.dumps({"action_space": actions}))
    (directory / "mine.py").write_text(GOOD + "#" * 16_800)
    tracks = f"train.config.track={json.dumps([f'random:{seed}' for seed in range(16)])}"
    changes = ["train.config.action_space=space.json", tracks, f"environment.NOTE={'n' * 900}"]
    spec = specfile.load("job.yaml", changes)
    definition = compile_definition(spec, str(directory))
    assert len(json.dumps(definition)) <= limits.LARGEST["registerjobdefinition"]
    assert len(long_texts(spec)) == 1 and "kept beside the job" in str(spec.notes)
