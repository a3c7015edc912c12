"""rsl_rl as an algorithm of Muster: what is refused, the same weights as its own runner, exact resumption, policies and their export."""

from __future__ import annotations

import contextlib
import copy
import io
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from rsl_rl import algorithms
from rsl_rl.models import MLPModel
from rsl_rl.runners import DistillationRunner, OnPolicyRunner
from torch import nn

from tests.support.worker.loop import spaces_of
from tests.support.worker.onnx import onnx_of
from tests.support.worker.rsl_loop import GRU, Seen, build, restore, save, settings, train
from tests.support.worker.sac import same
from worker.learning.rsl.algorithm import RslRl
from worker.learning.rsl.vector_environment import TaskVecEnv

torch.set_num_threads(1)

GAUSSIAN = {"class_name": "GaussianDistribution", "init_std": 0.5}
LSTM = {**GRU, "rnn_type": "lstm", "rnn_num_layers": 2}
CONVOLUTIONS = {"output_channels": [4], "kernel_size": 3, "stride": 2, "norm": "batch"}
CNN = {"class_name": "CNNModel", "hidden_dims": [8], "cnn_cfg": CONVOLUTIONS}
RND = {
    "num_outputs": 4,
    "predictor_hidden_dims": [8],
    "target_hidden_dims": [8],
    "weight": 5.0,
    "weight_schedule": {"mode": "linear", "initial_step": 10, "final_step": 60, "final_value": 0.0},
    "state_normalization": True,
    "reward_normalization": True,
}
SYMMETRY = {
    "data_augmentation_func": "tests.support.worker.rsl_loop:mirror",
    "use_data_augmentation": True,
    "use_mirror_loss": True,
    "mirror_loss_coeff": 0.5,
}
DISTILLATION = {"class_name": "Distillation", "gradient_length": 4}
IMAGES = {"actor": ["image", "policy"], "critic": ["image"]}

CASES: dict[str, dict[str, Any]] = {
    "nothing": {},
    "fixed rate": {"algorithm": {"schedule": "fixed", "optimizer": "adamw"}},
    "GRU": {"actor": {**GRU, "distribution_cfg": GAUSSIAN}, "critic": GRU},
    "LSTM of the critic alone": {"critic": LSTM},
    "RND": {"algorithm": {"rnd_cfg": RND}},
    "symmetry": {"algorithm": {"symmetry_cfg": SYMMETRY}},
    "Beta": {"actor": {"distribution_cfg": {"class_name": "BetaDistribution"}}},
    "heteroscedastic": {"actor": {"distribution_cfg": {"class_name": "HeteroscedasticGaussianDistribution"}}},
    "shared convolutions": {
        "obs_groups": {"actor": ["image"], "critic": ["image"]},
        "algorithm": {"share_cnn_encoders": True},
        "actor": {**CNN, "distribution_cfg": GAUSSIAN},
        "critic": {"class_name": "CNNModel", "hidden_dims": [8]},
    },
    "images and numbers": {
        "obs_groups": IMAGES,
        "actor": {**CNN, "obs_normalization": True, "distribution_cfg": GAUSSIAN},
        "critic": CNN,
    },
    "a custom class": {"actor": {"class_name": "tests.unit.worker.test_rsl_rl:Tanh", "distribution_cfg": GAUSSIAN}},
    "distillation": {
        "algorithm": DISTILLATION,
        "student": {**GRU, "distribution_cfg": GAUSSIAN},
        "obs_groups": {"student": ["place"]},
        "teacher_checkpoint": "taught",
    },
    "distillation of a GRU by an LSTM": {
        "algorithm": DISTILLATION,
        "student": {**GRU, "distribution_cfg": GAUSSIAN},
        "teacher": {**LSTM, "distribution_cfg": GAUSSIAN},
        "teacher_checkpoint": "taught",
    },
}


class Tanh(MLPModel):
    """A network that is not rsl_rl's."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.mlp = nn.Sequential(self.mlp, nn.Tanh())


def made(name: str, seed: int = 4) -> tuple[RslRl, Seen]:
    """An algorithm on a new task, with weights drawn from ``seed``; a teacher has those that it began with."""
    task = Seen(seed=3)
    torch.manual_seed(seed)
    algorithm = build(task, {"num_steps_per_env": 8, **CASES[name]})
    if CASES[name].get("teacher_checkpoint"):
        algorithm.load_teacher({"policy": copy.deepcopy(algorithm.algorithm.teacher.state_dict())})
    return algorithm, task


class OwnPPO(algorithms.PPO):
    """A class of the user's own, whose settings only the rank can check."""


class OwnDistillation(algorithms.Distillation):
    """As :class:`OwnPPO`."""


def own(kind: str = "PPO", **keys: Any) -> dict[str, Any]:
    return {"algorithm": {"class_name": f"tests.unit.worker.test_rsl_rl:Own{kind}", **keys}}


def turn(obs: Any, actions: Any) -> tuple[Any, Any]:
    """A symmetry function with other arguments than rsl_rl's."""
    return obs, actions


def mirrored(by: str = "tests.support.worker.rsl_loop:mirror") -> dict[str, Any]:
    return {"algorithm": {"symmetry_cfg": {**SYMMETRY, "data_augmentation_func": by}}}


TAUGHT = {"teacher_checkpoint": "taught"}
BATCHES = {"algorithm": {"num_mini_batches": 9}}
SHORT = r"algorithm\.gradient_length: .* 8 steps .*, 9 are needed"
NORMALISED = {**CNN, "obs_normalization": True, "distribution_cfg": GAUSSIAN}


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"algorithm": {"class_name": "PPOO"}}, r"algorithm\.class_name: Could not resolve 'PPOO'"),
        (own(gamma="99e-2"), r"algorithm\.gamma: expected a number, found a string \('99e-2'\)$"),
        (own(num_mini_batches=2.5), r"algorithm\.num_mini_batches: expected an integer, found a number \(2\.5\)$"),
        ({"algorithm": {"num_mini_batches": 65}}, r"algorithm\.num_mini_batches: 65 .* samples; a rank has 64"),
        ({"critic": GRU, **BATCHES}, r"algorithm\.num_mini_batches: 9 .* worlds, .* recurrent; a rank has 8"),
        ({"actor": {"class_name": "nowhere:Net"}}, r"actor\.class_name: No module named 'nowhere'"),
        ({"critic": {"hiden_dims": [8]}}, r"critic: .* unexpected keyword argument 'hiden_dims'"),
        ({"actor": {"class_name": "MLPModel"}}, r"actor\.distribution_cfg: PPO needs a distribution"),
        ({"actor": CNN}, r"actor: No 2D observations are provided"),
        ({"obs_groups": {"actor": ["polcy"]}}, r"obs_groups: Observation 'polcy' in observation set 'actor' not found"),
        ({**CASES["shared convolutions"], "actor": NORMALISED}, r"actor\.obs_normalization: it sees images alone"),
        ({"critic": GRU, **mirrored()}, r"algorithm: Symmetry augmentation is not supported for recurrent"),
        (mirrored("tests.unit.worker.test_rsl_rl:turn"), r".*data_augmentation_func: turn is called with env, obs"),
        ({**own(), **TAUGHT}, r"teacher_checkpoint: .*:OwnPPO has no teacher"),
        ({**own("Distillation", gradient_length=9), **TAUGHT}, SHORT),
        ({"torch_compile_mode": "reduce-overhead"}, r"algorithm: torch_compile_mode='reduce-overhead'"),
    ],
)
def test_rsl_rl_s_refusal_is_reported_in_one_line_with_its_place(section: dict[str, Any], message: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(ValueError, match=rf"^rsl_rl\.{message}") as refusal:
            build(Seen(seed=3), {"num_steps_per_env": 8, **section})
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("name", CASES)
def test_the_weights_are_those_of_rsl_rls_own_runner_and_a_resumed_run_ends_with_the_same_bits(name: str) -> None:
    algorithm, task = made(name)
    train(algorithm, task, 2)
    saved = save(algorithm, task)
    records = train(algorithm, task, 2, done=2)
    weights = copy.deepcopy(dict(algorithm.algorithm.save()))
    again, fresh = made(name, seed=77)
    train(again, fresh, 1)
    restore(again, fresh, saved)
    assert same(train(again, fresh, 2, done=2), records)
    assert same(dict(again.state_dict()), dict(algorithm.state_dict()))
    assert same(dict(again.world_state()), dict(algorithm.world_state()))
    assert same(fresh.state_dict(), task.state_dict())

    own = Seen(seed=3)
    config = settings({"num_steps_per_env": 8, **CASES[name]})
    distils = "teacher_checkpoint" in CASES[name]
    names = ("student", "teacher") if distils else ("actor", "critic")
    stock: dict[str, Any] = {each: config.section(each) for each in ("algorithm", *names)}
    torch.manual_seed(4)
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        stock |= {"num_steps_per_env": 8, "save_interval": 100, "obs_groups": copy.deepcopy(config.obs_groups)}
        runner = (DistillationRunner if distils else OnPolicyRunner)(TaskVecEnv(own), stock, None, "cpu")
        if distils:
            runner.alg.teacher_loaded = True
        runner.learn(4)
    assert same(weights, dict(runner.alg.save()))
    assert records[-1]["learning_rate"] == runner.alg.optimizer.param_groups[0]["lr"]
    assert torch.equal(task.place, own.place)


def test_loading_only_weights_leaves_the_optimizer_unchanged() -> None:
    trained, task = made("RND")
    train(trained, task, 3)
    state = copy.deepcopy(dict(trained.state_dict()))
    fresh, _ = made("RND", seed=5)
    fresh.load_state_dict(state, weights_only=True)
    assert same(dict(fresh.policy().state_dict()), state["policy"])
    now = fresh.state_dict()
    assert same(now["rnd_state_dict"], state["rnd_state_dict"])
    assert not now["optimizer_state_dict"]["state"] and now["rnd_steps"] == 0 and fresh.learning_rate == 1e-3
    fresh.learning_rate = 2e-4
    assert fresh.algorithm.learning_rate == 2e-4 and fresh.learning_rate == 2e-4


def test_a_teacher_has_the_weights_of_a_run_of_ppo_and_must_fit_it() -> None:
    teaching, task = made("GRU")
    train(teaching, task, 1)
    section = {"algorithm": DISTILLATION, "student": GRU, "num_steps_per_env": 8, **TAUGHT}
    pupil = build(task, {**section, "teacher": CASES["GRU"]["actor"]})
    with pytest.raises(ValueError, match=r"^rsl_rl\.teacher_checkpoint: the teacher's weights were not loaded$"):
        pupil.begin(0)
    pupil.load_teacher(teaching.state_dict())
    pupil.begin(0)
    assert same(pupil.algorithm.teacher.state_dict(), dict(teaching.policy().state_dict()))
    with pytest.raises(ValueError, match=r"^rsl_rl\.teacher: the weights do not fit; set .*") as refusal:
        build(task, section).load_teacher(teaching.state_dict())
    assert "\n" not in str(refusal.value)
    with pytest.raises(ValueError, match=r"^rsl_rl\.teacher_checkpoint: only Distillation has a teacher"):
        teaching.load_teacher(teaching.state_dict())


@pytest.mark.parametrize("name", CASES)
def test_a_policy_acts_like_the_one_that_is_trained_and_like_its_export(name: str) -> None:
    algorithm, task = made(name)
    train(algorithm, task, 1)
    before = copy.deepcopy(dict(algorithm.world_state()))
    config = settings({"num_steps_per_env": 8, **CASES[name]})
    policy = RslRl.build_policy(config, spaces_of(task), "cpu")
    policy.load_state_dict(algorithm.policy().state_dict())
    exported = policy.module()
    run = onnx_of(exported)
    sample = {key: value.numpy() for key, value in exported.sample.items()}
    count = len(exported.sample)
    inputs = dict(zip(exported.inputs, sample.values(), strict=False))
    state = {
        name: np.repeat(value.numpy(), count, axis=0) for name, value in list(exported.inputs.items())[len(sample) :]
    }
    forgotten = torch.arange(count) % 2 == 0
    for _ in range(3):
        expected = policy.act(exported.sample)
        assert torch.equal(expected, algorithm.policy().act(exported.sample))
        actions, *after = run.run(None, {**inputs, **state})
        assert np.abs(actions - expected.numpy()).max() < 1e-5
        state = dict(zip(state, after, strict=True))
        for part in state.values():
            part[forgotten.numpy()] = 0.0
        policy.reset(forgotten)
        algorithm.policy().reset(forgotten)
    policy.reset()
    algorithm.policy().reset()
    assert torch.equal(policy.act(exported.sample), algorithm.policy().act(exported.sample))
    assert same(dict(algorithm.world_state()), before)  # training goes on with its own memory
    assert algorithm.algorithm.get_policy().training
