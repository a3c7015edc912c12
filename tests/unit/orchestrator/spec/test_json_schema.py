"""The JSON Schema of the job YAML agrees with what is accepted; ``track``, ``secrets`` and checkpoints by name."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from orchestrator.domain.errors import SpecError
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.json_schema import schema
from orchestrator.spec.model import KINDS, Spec, validate
from orchestrator.spec.values import known_tasks

SHIPPED = sorted((Path(__file__).parents[4] / "job_specs").glob("*.yaml"))


@cache
def validator() -> jsonschema.Draft202012Validator:
    return jsonschema.Draft202012Validator(schema())


def accepts(document: Any) -> bool:
    return bool(validator().is_valid(document))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_the_json_schema_accepts_every_shipped_spec(path: Path) -> None:
    assert accepts(yaml.safe_load(path.read_text()))


RIGHT = ["{}", "nodes: 2", "nodes: {min: 1, max: 2}", "timeout: 2h", "timeout: 7200", "resources: {memory: 4GiB}"]
RIGHT += ["environment: {A: b}"]
WRONG = ["nodez: 2", "nodes: 0", "nodes: two", "retry: {attempts: 11}", "on_child_failure: resart"]
WRONG += ["environment: {A: 1}", "command: []", "name: null"]


@pytest.mark.parametrize(("changes", "fine"), [*((each, True) for each in RIGHT), *((each, False) for each in WRONG)])
def test_the_json_schema_tells_right_from_wrong(changes: str, fine: bool) -> None:
    assert accepts({"name": "a", "command": ["x"], **yaml.safe_load(changes)}) == fine


def test_the_json_schema_lists_every_key_and_the_known_tasks() -> None:
    document: Any = validator().schema
    assert document["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert list(document["properties"]) == list(Spec.model_fields)
    assert set(KINDS) < document["properties"].keys()
    assert document["required"] == ["name"]
    assert document["$defs"]["Train"]["properties"]["task"]["examples"] == known_tasks()
    assert json.loads(json.dumps(document)) == document


RIGHT_CONFIGS = [
    "Ant {}",
    "Ant {fall_height: 0.3, rewards: {up: 1}, curriculum: {level: [[0, 0.5], [9, 1]]}}",
    "Ant {randomize: {mass: [0.9, 1.1], observation_noise: {'*_velocity': 0.1}}}",
    "CartpolePixels {camera: {width: 96}}",
    "Quadruped {command_turn: [-1, 1]}",
    "my_module:Task {anything: 1}",
]
WRONG_CONFIGS = [
    *("Ant {fall_hight: 0.3}", "Ant {fall_height: low}", "Ant {substeps: 0}", "Ant {rewards: {foward: 1}}"),
    *("Ant {curriculum: {foward: [[0, 1]]}}", "Ant {curriculum: {up: [[0]]}}", "Ant {randomize: {mass: [0, 1]}}"),
    *("Ant {camera: {width: 96}}", "Ant {ppo: {steps: 8}}", "CartpolePixels {camera: {width: 0}}"),
]


@pytest.mark.parametrize(
    ("case", "fine"), [*((each, True) for each in RIGHT_CONFIGS), *((each, False) for each in WRONG_CONFIGS)]
)
def test_the_json_schema_knows_the_configuration_of_each_task(case: str, fine: bool) -> None:
    task, config = case.split(" ", 1)[0], yaml.safe_load(case.split(" ", 1)[1])
    document = {"name": "a", "train": {"task": task, "worlds": 1, "iterations": 1, "config": config}}
    assert accepts(document) == fine
    try:
        validate(document, "job.yaml")
        taken = True
    except SpecError:
        taken = False
    assert taken == fine, "as the submission does"


def test_the_json_schema_is_valid() -> None:
    jsonschema.Draft202012Validator.check_schema(validator().schema)
    assert not any("PPO" in name for name in validator().schema["$defs"]), (
        "how a task is trained has a section of its own"
    )


TRAIN = {"task": "Cartpole", "worlds": 4, "iterations": 2}


def spec(**changes: Any) -> dict[str, Any]:
    return {"name": "a", "train": TRAIN, **changes}


@pytest.mark.parametrize(
    ("supplied", "kept"),
    [
        ("wandb", {"wandb": {"tags": []}}),
        (["wandb", "mlflow"], {"wandb": {"tags": []}, "mlflow": {"tags": {}}}),
        ({"mlflow": None}, {"mlflow": {"tags": {}}}),
        (
            {"wandb": {"project": "ant", "mode": "offline", "tags": ["x"]}},
            {"wandb": {"project": "ant", "mode": "offline", "tags": ["x"]}},
        ),
        ({"mlflow": {"uri": "http://host:5000/a"}}, {"mlflow": {"uri": "http://host:5000/a", "tags": {}}}),
    ],
)
def test_services_are_named_alone_in_a_list_or_with_their_settings(supplied: Any, kept: Any) -> None:
    found = validate(spec(track=supplied), "job.yaml")
    assert found.track is not None and found.track.model_dump(mode="json", exclude_none=True) == kept
    assert accepts(spec(track=supplied))
    again = validate(found.model_dump(mode="json", exclude_none=True), "run.json")
    assert again == found  # as a run that is resumed reads it


URI = "track.mlflow.uri: a password would be stored in the run; give MLFLOW_TRACKING_USERNAME and "
URI += "MLFLOW_TRACKING_PASSWORD as secrets"
STORED = "the key would be stored in the run; remove it, and give it as a secret: secrets"
WRONG_TRACKING = {
    "track: wandv": "track: no service is called 'wandv'; did you mean wandb?",
    "track: [wandb, 3]": "track: no service is called '3'; available: wandb, mlflow",
    "track: 3": "track: expected wandb, mlflow, a list of them, or each with its settings, found 3",
    "track: {wandb: {projct: x}}": "track.wandb.projct: unknown key; did you mean project?",
    "track: {wandb: {mode: 'off'}}": "track.wandb.mode: expected 'online' or 'offline', found 'off'",
    "track: {mlflow: {uri: 'http://me:word@host'}}": URI,
    "track: {mlflow: {uri: 'https://word@host/?password=word'}}": URI,
    "{track: mlflow, environment: {MLFLOW_TRACKING_URI: 'postgresql://host/db?password=word'}}": (
        f"environment.MLFLOW_TRACKING_URI: {STORED}: {{MLFLOW_TRACKING_URI: NAME}}"
    ),
    "{track: wandb, environment: {WANDB_API_KEY: x}}": f"environment.WANDB_API_KEY: {STORED}: {{WANDB_API_KEY: NAME}}",
    "{track: wandb, train: null, evaluate: {run: x}}": (
        "track: only a training has metrics to track; this job has evaluate"
    ),
    "secrets: {MUSTER_TOKEN: x}": (
        "secrets: MUSTER_TOKEN is reserved; names that start with AWS_BATCH or MUSTER_ are set by Muster"
    ),
    "secrets: {KEY: ''}": "secrets: 'KEY': expected the name under which the controller has the value",
    "{secrets: {KEY: x}, environment: {KEY: y}}": "secrets: KEY is in environment, too; give it once",
    "secrets: {KEY: 3}": "secrets.KEY: expected a string, found an integer (3)",
}


@pytest.mark.parametrize("changes", WRONG_TRACKING)
def test_invalid_tracking_and_secrets_are_refused_in_one_line(changes: str) -> None:
    with pytest.raises(SpecError) as refused:
        validate(spec(**yaml.safe_load(changes)), "job.yaml")
    assert str(refused.value) == f"job.yaml: {WRONG_TRACKING[changes]}"


def test_secrets_become_those_of_the_job_definition() -> None:
    made = compile_definition(validate(spec(secrets={"WANDB_API_KEY": "wandb"}), "s"), "/home/me")
    [entry] = made["nodeProperties"]["nodeRangeProperties"]
    assert entry["container"]["secrets"] == [{"name": "WANDB_API_KEY", "valueFrom": "wandb"}]
    [carried] = [each for each in entry["container"]["environment"] if each["name"] == "MUSTER_SPEC"]
    assert json.loads(carried["value"])["secrets"] == {"WANDB_API_KEY": "wandb"}  # the name alone


@pytest.mark.parametrize("kind", ["evaluate", "export", "record", "render"])
def test_a_checkpoint_is_named_in_the_same_ways_by_every_kind_of_job(kind: str) -> None:
    for expected in (3, "best", "latest"):
        job = {"name": "a", kind: {"run": "x", "checkpoint": expected}}
        assert getattr(validate(job, "job.yaml"), kind).checkpoint == expected
        assert accepts(job)
    for wrong in (-1, "newest", True, 1.5):
        with pytest.raises(SpecError) as refused:
            validate({"name": "a", kind: {"run": "x", "checkpoint": wrong}}, "job.yaml")
        assert str(refused.value).startswith(f"job.yaml: {kind}.checkpoint: expected an iteration, best or latest")
