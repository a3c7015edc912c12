"""``track`` and ``secrets`` of the job YAML, and checkpoints by name: what is accepted, and in which words the rest is refused."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import jsonschema
import pytest
import yaml

from orchestrator.domain.errors import SpecError
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.json_schema import schema
from orchestrator.spec.model import validate

TRAIN = {"task": "Cartpole", "worlds": 4, "iterations": 2}


@cache
def validator() -> jsonschema.Draft202012Validator:
    return jsonschema.Draft202012Validator(schema())


def spec(**changes: Any) -> dict[str, Any]:
    return {"name": "a", "train": TRAIN, **changes}


@pytest.mark.parametrize(
    ("given", "kept"),
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
def test_services_are_named_alone_in_a_list_or_with_their_settings(given: Any, kept: Any) -> None:
    found = validate(spec(track=given), "job.yaml")
    assert found.track is not None and found.track.model_dump(mode="json", exclude_none=True) == kept
    assert validator().is_valid(spec(track=given))
    again = validate(found.model_dump(mode="json", exclude_none=True), "run.json")
    assert again == found  # as a run that is resumed reads it


URI = "track.mlflow.uri: a password would be stored in the run; give MLFLOW_TRACKING_USERNAME and "
URI += "MLFLOW_TRACKING_PASSWORD as secrets"
STORED = "the key would be stored in the run; remove it, and give it as a secret: secrets"
WRONG = {
    "track: wandv": "track: no service is called 'wandv'; did you mean wandb?",
    "track: [wandb, 3]": "track: no service is called '3'; there are wandb, mlflow",
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
    "secrets: {KEY: 3}": "secrets.KEY: expected a text, found a whole number (3)",
}


@pytest.mark.parametrize("changes", WRONG)
def test_invalid_tracking_and_secrets_are_refused_in_one_line(changes: str) -> None:
    with pytest.raises(SpecError) as refused:
        validate(spec(**yaml.safe_load(changes)), "job.yaml")
    assert str(refused.value) == f"job.yaml: {WRONG[changes]}"


def test_secrets_become_those_of_the_job_definition() -> None:
    made = compile_definition(validate(spec(secrets={"WANDB_API_KEY": "wandb"}), "s"), "/home/me")
    [entry] = made["nodeProperties"]["nodeRangeProperties"]
    assert entry["container"]["secrets"] == [{"name": "WANDB_API_KEY", "valueFrom": "wandb"}]
    [carried] = [each for each in entry["container"]["environment"] if each["name"] == "MUSTER_SPEC"]
    assert json.loads(carried["value"])["secrets"] == {"WANDB_API_KEY": "wandb"}  # the name alone


@pytest.mark.parametrize("kind", ["evaluate", "race", "export", "record", "render"])
def test_a_checkpoint_is_named_in_the_same_ways_by_every_kind_of_job(kind: str) -> None:
    for wanted in (3, "best", "latest"):
        job = {"name": "a", kind: {"run": "x", "checkpoint": wanted}}
        assert getattr(validate(job, "job.yaml"), kind).checkpoint == wanted
        assert validator().is_valid(job)
    for wrong in (-1, "newest", True, 1.5):
        with pytest.raises(SpecError) as refused:
            validate({"name": "a", kind: {"run": "x", "checkpoint": wrong}}, "job.yaml")
        assert str(refused.value).startswith(f"job.yaml: {kind}.checkpoint: expected an iteration, best or latest")
