"""rsl_rl's algorithms learn on real worlds: a network with memory, symmetry, curiosity, a student from its teacher."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import pytest
import torch
import warp
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from tests.support.worker.loop import groups
from tests.support.worker.rsl_loop import GAUSSIAN, build, evaluate, train
from tests.support.worker.rsl_loop import GRU as SMALL_GRU
from worker.learning.rsl.algorithm import RslRl
from worker.learning.rsl.vector_environment import TaskVecEnv, make
from worker.tasks.library.cartpole import Cartpole, CartpoleConfig

torch.set_num_threads(1)
warp.config.log_level = warp.LOG_WARNING

GRU = {**SMALL_GRU, "rnn_hidden_dim": 32, "hidden_dims": [32]}
HELD = 24.0
"""Return of a cart-pole that is held upright near the middle for all of its 300 steps, of 30 at most."""


def cartpole(seed: int = 1) -> Cartpole:
    """64 worlds, their clocks apart."""
    task = Cartpole(CartpoleConfig(), 64, seed=seed)
    task.set_random_episode_length()
    return task


def without_velocities(task: Cartpole) -> Cartpole:
    """The policy sees where cart and pole are, not how fast; the critic sees all."""
    task.groups = {"policy": task.observations[:, :2], "critic": task.observations}
    task.terminal_groups = {}
    return task


def learner(task: Any, section: dict[str, Any]) -> RslRl:
    torch.manual_seed(1)
    return build(task, section)


@pytest.fixture(scope="module")
def teacher() -> RslRl:
    """PPO as it is without any setting but the length of its rollouts."""
    task = cartpole()
    algorithm = learner(task, {"num_steps_per_env": 16})
    train(algorithm, task, 40)
    return algorithm


def test_an_empty_section_holds_the_pole(teacher: RslRl) -> None:
    mean_return, mean_length = evaluate(teacher.policy(), cartpole(seed=9))
    assert mean_length == 300.0 and mean_return > HELD


def test_a_gru_holds_the_pole_without_seeing_velocities() -> None:
    task = without_velocities(cartpole())
    algorithm = learner(task, {"num_steps_per_env": 16, "actor": {**GRU, "distribution_cfg": GAUSSIAN}})
    train(algorithm, task, 50)
    mean_return, mean_length = evaluate(algorithm.policy(), task)
    assert mean_length > 295.0 and mean_return > HELD


def test_symmetry_makes_a_policy_that_acts_alike_on_both_sides() -> None:
    unlike = {}
    for name, uses in (("with", True), ("without", False)):
        symmetry = {
            "data_augmentation_func": "tests.support.worker.rsl_loop:mirror",
            "use_data_augmentation": uses,
            "use_mirror_loss": uses,
            "mirror_loss_coeff": 1.0,
        }
        task = cartpole()
        algorithm = learner(task, {"num_steps_per_env": 16, "algorithm": {"symmetry_cfg": symmetry}})
        train(algorithm, task, 30)
        existing = groups(task)
        here = algorithm.policy().act(existing)
        mirrored = algorithm.policy().act(TensorDict({key: -value for key, value in existing.items()}, [64]))
        unlike[name] = float((here + mirrored).abs().mean() / here.abs().mean())
        mean_return, mean_length = evaluate(algorithm.policy(), task)
        assert mean_length > 295.0 and mean_return > HELD
    assert unlike["with"] < 0.15 and unlike["with"] < 0.3 * unlike["without"]


def test_what_rnd_knows_is_no_longer_new() -> None:
    curious = {
        "num_outputs": 8,
        "predictor_hidden_dims": [32],
        "target_hidden_dims": [32],
        "weight": 1.0,
        "state_normalization": True,
        "reward_normalization": True,
    }
    task = cartpole()
    algorithm = learner(task, {"num_steps_per_env": 16, "algorithm": {"rnd_cfg": curious}})
    records = train(algorithm, task, 40)
    assert records[-1]["rnd"] < 0.02 * records[0]["rnd"]
    assert 0.0 < records[-1]["intrinsic_reward"] < 0.02 * records[0]["intrinsic_reward"]
    assert records[-1]["rnd_weight"] == pytest.approx(1.0 / 60.0), "rsl_rl scales it with the control step"
    mean_return, mean_length = evaluate(algorithm.policy(), task)
    assert mean_length > 295.0 and mean_return > HELD


def test_a_student_without_velocities_learns_from_a_teacher_that_sees_them(teacher: RslRl) -> None:
    task = without_velocities(cartpole(seed=5))
    student = learner(
        task,
        {
            "num_steps_per_env": 15,
            "obs_groups": {"student": ["policy"], "teacher": ["critic"]},
            "algorithm": {"class_name": "Distillation", "gradient_length": 5, "learning_rate": 3.0e-3},
            "student": {**GRU, "distribution_cfg": {**GAUSSIAN, "init_std": 0.1}},
            "teacher_checkpoint": "taught",
        },
    )
    student.load_teacher(teacher.state_dict())
    records = train(student, task, 100)
    assert records[-1]["behavior"] < 0.3 * records[0]["behavior"]
    mean_return, mean_length = evaluate(student.policy(), task)
    assert mean_length > 290.0 and mean_return > HELD - 2.0


def test_a_runner_of_ones_own_trains_logs_and_saves(tmp_path: Path) -> None:
    env = make("Cartpole", 32, seed=2, episode_seconds=2.0)
    assert isinstance(env, TaskVecEnv) and env.max_episode_length == 120
    network = {"class_name": "MLPModel", "hidden_dims": [32], "obs_normalization": True}
    config = {
        "num_steps_per_env": 16,
        "save_interval": 2,
        "obs_groups": {"actor": ["policy"], "critic": ["policy", "critic"]},
        "algorithm": {"class_name": "PPO"},
        "actor": {**network, "distribution_cfg": GAUSSIAN},
        "critic": network,
    }
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        runner = OnPolicyRunner(env, config, str(tmp_path), "cpu")
        runner.learn(5, init_at_random_ep_len=True)
    assert {path.name for path in tmp_path.glob("model_*.pt")} == {"model_0.pt", "model_2.pt", "model_4.pt"}
    assert "Mean episode reward_alive:" in output.getvalue() and "Mean reward:" in output.getvalue()
    policy = runner.get_inference_policy()
    assert policy(env.get_observations()).shape == (32, 1)
    with pytest.raises(ValueError, match=r"task Cartpole has no setting wind; its settings are .*cart_limit"):
        make("Cartpole", 1, wind=3.0)
