"""`muster resume --set`: every key of the spec is applied to the job that goes on, or refused by name. A key without a decision fails."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
import yaml
from pydantic import BaseModel

from orchestrator.domain.errors import ClientError
from orchestrator.services.resume import _check_changes, _check_rate
from orchestrator.services.spec_submission import Changes
from orchestrator.spec.changes import override
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.model import ALGORITHMS, Spec, validate
from shared_store.contract.plugins import sections
from shared_store.volume.checkpoints import Checkpoint
from shared_store.volume.layout import Run, Store
from shared_store.volume.run_settings import setting_at
from tests.support.definitions import submission_of
from tests.support.orchestrator.trained import add_checkpoint, add_run
from tests.support.refusals import refusal

pytestmark = pytest.mark.usefixtures("installed_once")
RUN = Run(Path("/store/runs/ant"))
TRAIN = {"task": "Ant", "worlds": 4, "iterations": 2}
OTHERS = ("evaluate", "export", "record", "render")
KINDS: dict[str, dict[str, Any]] = {
    "train": {"train": TRAIN},
    **{kind: {kind: {"run": "other"}} for kind in OTHERS},
    "command": {"command": ["true"]},
}

Place = Callable[[dict[str, Any], dict[str, Any]], Any]
"""Where a job has a setting, in the requests RegisterJobDefinition and SubmitJob that are sent for it."""


def container(definition: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = definition["nodeProperties"]["nodeRangeProperties"][0]["container"]
    return found


def variable(name: str) -> Place:
    return lambda definition, _: {e["name"]: e["value"] for e in container(definition)["environment"]}.get(name)


def resource(kind: str) -> Place:
    return lambda definition, _: {e["type"]: e["value"] for e in container(definition)["resourceRequirements"]}[kind]


def carried(key: str) -> Place:
    """In the spec that the rank reads."""
    return lambda definition, _: setting_at(json.loads(variable("MUSTER_SPEC")(definition, {})), key)


APPLIED: dict[str, tuple[str, Any, Place]] = {
    "name": ("again", "again", lambda _, job: job["jobName"]),
    "queue": ("gpu", "gpu", lambda _, job: job["jobQueue"]),
    "share": ("mine", "mine", lambda _, job: job.get("shareIdentifier")),
    "priority": ("7", 7, lambda definition, _: definition.get("schedulingPriority")),
    "preemptible": ("true", "1", variable("MUSTER_PREEMPTIBLE")),
    "nodes.min": ("{min: 2, max: 3}", "2", variable("MUSTER_MIN_NODES")),
    "nodes.max": ("{min: 2, max: 3}", 3, lambda definition, _: definition["nodeProperties"]["numNodes"]),
    "resources.cpus": ("2.5", "2.5", resource("VCPU")),
    "resources.gpus": ("2", "2", variable("MUSTER_RANKS_PER_NODE")),
    "resources.memory": ("2GiB", "2048", resource("MEMORY")),
    "command": ("[echo, hello]", ["echo", "hello"], lambda definition, _: container(definition)["command"]),
    "environment": ("{COLOUR: red}", "red", variable("COLOUR")),
    "image": ("mine:2", "mine:2", lambda definition, _: container(definition)["image"]),
    "logs.limit": ("2MiB", str(2 << 20), variable("MUSTER_LOG_LIMIT")),
    "retry.attempts": ("7", 7, lambda definition, _: definition["retryStrategy"]["attempts"]),
    "on_child_failure": ("fail", "fail", variable("MUSTER_ON_CHILD_FAILURE")),
    "timeout": ("2h", 7200, lambda definition, _: (definition.get("timeout") or {}).get("attemptDurationSeconds")),
    "stall_timeout": ("10m", "600", variable("MUSTER_STALL_TIMEOUT")),
}
"""Of each key that may change: another value as ``--set`` has it, what becomes of it, and where the job has that."""
CARRIED: dict[str, Any] = yaml.safe_load("""
secrets: {KEY: name}
track:
  wandb: {project: a, entity: a, group: a, tags: [a], mode: offline}
  mlflow: {uri: 'sqlite:///a', experiment: a, tags: {a: b}}
train: {iterations: 9, accept_changed_robot: true}
evaluate: {run: ant, checkpoint: 3, accept_changed_robot: true, episodes: 3, worlds: 3, seed: 3, config: {x: 1}, keep: false}
export: {run: ant, checkpoint: 3, accept_changed_robot: true, episodes: 3, worlds: 3}
record: {run: ant, checkpoint: 3, accept_changed_robot: true, worlds: 3, episodes: 3, seed: 3}
render: {run: ant, checkpoint: 3, accept_changed_robot: true, format: png, worlds: 3, seconds: 2.5, width: 128, height: 128}
checkpoint: {every: auto, keep: 3}
evaluation:
  {every: 3, episodes: 7, worlds: 7, queue: idle, share: mine, resources: {cpus: 2.5, gpus: 1, memory: 2048},
   retry: {attempts: 2}}
""")
"""Other values of keys that the rank reads in the spec; tests of the worker show what it does with them."""
REFUSED = {
    "train.task": "Cartpole",
    "train.seed": "7",
    "train.algorithm": "sac",
    "train.config": "{rewards: {up: 2.0}}",
}
"""Of each key that can't change: another value."""
ELSEWHERE = {"train.worlds", "train.settings", "train.hyperparameters"}
"""Depends on the checkpoint, or on the class of the user's own: tests/training/faults/test_refusals.py and tests/long/faults/test_resume_others.py.
Hyperparameters are settings by other names, which a task may have."""


def sections_of(annotation: Any) -> list[type[BaseModel]]:
    kinds = [kind for kind in (annotation, *get_args(annotation)) if isinstance(kind, type)]
    return [kind for kind in kinds if issubclass(kind, BaseModel)]


def keys_of(model: type[BaseModel], path: str = "") -> Iterator[str]:
    """Every key of the spec but the sections."""
    for name, field in model.model_fields.items():
        inner = sections_of(field.annotation)
        yield from (key for section in inner for key in keys_of(section, f"{path}{name}."))
        if not inner:
            yield f"{path}{name}"


def carried_keys() -> list[str]:
    return [key for key in keys_of(Spec) if setting_at(CARRIED, key) is not None]


def kind_of(key: str) -> str:
    first = key.partition(".")[0]
    return first if first in KINDS else "train"


def changed(kind: str, *assignments: str, **train: Any) -> tuple[Spec, Spec]:
    document: dict[str, Any] = {"name": "ant", **KINDS[kind]}
    if train:
        document["train"] = {**TRAIN, **train}
    return validate(document, "run ant"), validate(override(document, assignments), "run ant", merged=False)


def requests_of(spec: Spec) -> tuple[dict[str, Any], dict[str, Any]]:
    return compile_definition(spec, "/"), submission_of(spec, "arn")


def test_every_key_of_the_spec_is_in_one_of_the_tables() -> None:
    algorithms = {f"train.{name}.{field}" for name, kind in ALGORITHMS.items() for field in kind.__pydantic_fields__}
    assert len(algorithms) > 50
    own = {key for key in keys_of(Spec) if key.partition(".")[0] not in sections()}
    assert own == {*APPLIED, *carried_keys(), *REFUSED, *ELSEWHERE, *algorithms}


@pytest.mark.parametrize("key", [*APPLIED, *carried_keys()])
def test_a_key_that_is_accepted_is_in_the_job_that_goes_on(key: str) -> None:
    named = next((section for section in ("nodes", "evaluation") if key.startswith(f"{section}.")), key)
    values = json.dumps(setting_at(CARRIED, named))
    text, expected, place = APPLIED.get(key) or (values, setting_at(CARRIED, key), carried(key))
    before, after = changed(kind_of(key), f"{named}={text}")
    _check_changes(RUN, before, after)
    assert place(*requests_of(before)) != expected and place(*requests_of(after)) == expected


@pytest.mark.parametrize("key", REFUSED)
def test_a_key_of_the_run_s_history_is_refused_by_name_and_leads_to_a_clone(key: str) -> None:
    before, after = changed("train", f"{key}={REFUSED[key]}")
    with pytest.raises(
        ClientError, match=rf"^run ant: {key} is .* can't become .*: muster clone ant --name NEW begins"
    ):
        _check_changes(RUN, before, after)


def test_a_job_does_not_become_one_of_another_kind() -> None:
    before, after = changed("train")[0], changed("command")[0]
    with pytest.raises(ClientError, match="run ant is a train job; it can't continue as command"):
        _check_changes(RUN, before, after)


PROBES = ["1", "2", "0.5", "0.25", "true", "false", "[8]", "[8, 4, 2]", "[0.1, 0.2]", "adamw", "fixed", "tanh"]
PROBES += ["critic", "min", "min_or_mean", "{a: [b]}", "{actor: [policy]}", "{a: 1}", "{learning_rate: 0.5}"]
PROBES += ["run@3", "default"]


def accepted_value(name: str, key: str) -> str:
    """Some value that the setting takes."""
    for probe in PROBES:
        try:
            document = {"name": "a", "train": {**TRAIN, "algorithm": name}}
            spec = validate(override(document, [f"train.{name}.{key}={probe}"]), "x", merged=False)
        except Exception:
            continue
        assert spec.train is not None
        if spec.train.overrides().get(key) is not None:
            return probe
    raise AssertionError(f"no probe is a value of train.{name}.{key}: add one")


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_each_setting_of_an_algorithm_is_carried_to_the_rank_or_refused_by_name(name: str) -> None:
    kind = ALGORITHMS[name]
    fixed = set(kind.fixed)
    assert {key.partition(".")[0] for key in fixed} <= {item.name for item in dataclasses.fields(kind)}
    assert set(kind.clone_may_change) <= fixed
    for item in dataclasses.fields(kind):
        probe = accepted_value(name, item.name)
        before, after = changed("train", f"train.{name}.{item.name}={probe}", algorithm=name)
        if item.name in fixed:
            may = "muster clone ant" if item.name in kind.clone_may_change else "start a new run for that$"
            with pytest.raises(ClientError, match=rf"run ant: train\.{name}\.{item.name} is not set .*{may}"):
                _check_changes(RUN, before, after)
        else:
            _check_changes(RUN, before, after)
            assert carried(f"train.{name}.{item.name}")(*requests_of(after)) is not None


VALUES: dict[str, Any] = {
    "num_outputs": 5,
    "predictor_hidden_dims": [9],
    "target_hidden_dims": [9],
    "activation": "tanh",
}
VALUES |= {"state_normalization": "true", "reward_normalization": "true", "learning_rate": 0.5, "optimizer": "sgd"}
"""Another one, where a text is none."""


@pytest.mark.parametrize("key", [key for key in ALGORITHMS["rsl_rl"].fixed if "." in key])
def test_a_fixed_setting_inside_a_section_is_refused_by_its_full_name(key: str) -> None:
    required = {"num_outputs": 4, "weight": 1.0, "predictor_hidden_dims": [8], "target_hidden_dims": [8]}
    curious = {"algorithm": {"rnd_cfg": required}} if "rnd_cfg" in key else {}
    value = VALUES.get(key.rpartition(".")[2], "other")
    before, after = changed("train", f"train.rsl_rl.{key}={value}", algorithm="rsl_rl", rsl_rl=curious)
    with pytest.raises(ClientError, match=rf"train\.rsl_rl\.{key} is .* and can't become .*clone ant"):
        _check_changes(RUN, before, after)


RATES = {"ppo": "learning_rate", "rsl_rl": "algorithm.learning_rate"}
FORMS = {
    "train.ppo.learning_rate=0.001": "ppo",
    "train.ppo={learning_rate: 0.001}": "ppo",
    "train.rsl_rl.algorithm.learning_rate=0.001": "rsl_rl",
    "train.rsl_rl.algorithm={learning_rate: 0.001}": "rsl_rl",
    "train.rsl_rl={algorithm: {learning_rate: 0.001}}": "rsl_rl",
}
"""How ``--set`` may give the rate of each algorithm that adapts it."""


def saved_with(path: Path, rate: float, name: str, *assignments: str) -> Checkpoint:
    """A checkpoint whose rate is this one now, of a job with these settings."""
    store = Store(path / "store").open()
    add_run(store, "ant")
    train = override({"train": {"algorithm": name}}, assignments)["train"]
    return add_checkpoint(store, "ant", 1, algorithm=name, train=train, learning_rate=rate)


@pytest.mark.parametrize("form", FORMS)
def test_a_learning_rate_that_would_have_no_effect_is_refused_in_whatever_form_it_is_given(
    tmp_path: Path, form: str
) -> None:
    name = FORMS[form]
    key = RATES[name]
    chosen = saved_with(tmp_path, 0.0004, name, f"train.{name}.{key}=0.001")
    after = changed("train", form, algorithm=name)[1]
    assert refusal(_check_rate, RUN, chosen, after, [form], error=ClientError).startswith(
        f"run ant: train.{name}.{key} is 0.001 already, so that the run would continue with the rate of its checkpoint, "
        "which is 0.0004 now; set another value"
    )
    _check_rate(RUN, chosen, after, ["train.iterations=9"])


@pytest.mark.parametrize(("name", "key"), RATES.items())
def test_a_learning_rate_that_takes_effect_or_is_in_effect_is_accepted(tmp_path: Path, name: str, key: str) -> None:
    form = f"train.{name}.{key}=0.001"
    after = changed("train", form, algorithm=name)[1]
    _check_rate(RUN, saved_with(tmp_path / "new", 0.0004, name), after, [form])
    _check_rate(RUN, saved_with(tmp_path / "other", 0.0004, name, f"train.{name}.{key}=0.002"), after, [form])
    # a fixed rate: the checkpoint has the one that is asked for, as ppo keeps it
    _check_rate(RUN, saved_with(tmp_path / "fixed", 0.0010000000474974513, name, form), after, [form])


def test_two_options_for_the_same_setting_are_refused() -> None:
    assert Changes(assignments=("train.iterations=3",), nodes=4).all() == ["train.iterations=3", "nodes=4"]
    assert Changes(assignments=("nodes=2",)).all() == ["nodes=2"]
    for assignment in ("nodes=2", "nodes.max=2"):
        message = rf"--set {assignment}: --nodes 4 sets the number of nodes; give one of them"
        with pytest.raises(ClientError, match=message):
            Changes(assignments=(assignment,), nodes=4).all()
