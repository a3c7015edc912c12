"""The tasks as Gymnasium's vector environments and as one of rsl_rl: what is copied, what is logged, the clocks."""

from __future__ import annotations

from collections.abc import Iterator

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_space_limit
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

from tests.support.worker.rsl_loop import Seen
from worker.learning.rsl.vector_environment import TaskVecEnv
from worker.settings.cartpole import CartpoleConfig
from worker.tasks.run.find import BUILT_IN
from worker.tasks.run.gym import TaskVectorEnv

WORLDS = 8


@pytest.fixture(scope="module")
def env() -> Iterator[VectorEnv]:
    made = gymnasium.make_vec("worker.tasks.run.gym:Muster/Cartpole-v0", num_envs=WORLDS, episode_seconds=0.5)
    yield made
    made.close()


def test_spaces_are_batched_and_metadata_tells_the_reset_mode(env: VectorEnv) -> None:
    assert env.num_envs == WORLDS
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert env.spec is not None and env.spec.id == "Muster/Cartpole-v0"
    assert env.single_action_space.shape == (1,) and env.action_space.shape == (WORLDS, 1)
    assert env.single_observation_space.shape == (4,) and env.observation_space.shape == (WORLDS, 4)
    assert env.observation_space.dtype == env.action_space.dtype == np.float32
    check_space_limit(env.single_action_space, "action")


def test_reset_honours_the_seed(env: VectorEnv) -> None:
    first, info = env.reset(seed=7)
    assert info == {}
    assert env.observation_space.contains(first)
    again, _ = env.reset(seed=7)
    other, _ = env.reset(seed=8)
    unseeded, _ = env.reset()
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert not np.array_equal(other, unseeded)
    assert len({row.tobytes() for row in first}) == WORLDS, "every world starts differently"
    with pytest.raises(ValueError, match="seed is -1"):
        env.reset(seed=-1)


def test_a_reset_with_a_seed_begins_the_same_episodes_whatever_was_played_before() -> None:
    """Also what outlasts episodes begins anew: the sliders' masses are drawn for each seed, and each world counts its episodes."""
    task = "tests.support.worker.declared:Sliders"
    fresh, used = (TaskVectorEnv(task, num_envs=4, seed=seed) for seed in (1, 2))
    used.reset(seed=3)
    play(used, steps=40)
    first, again = play(fresh, seed=7), play(used, seed=7)
    assert all(np.array_equal(one, other) for one, other in zip(first, again, strict=True))
    assert torch.equal(fresh.task.groups["critic"], used.task.groups["critic"])
    assert not np.array_equal(first[-1], play(used, seed=8)[-1])


def play(env: TaskVectorEnv, *, seed: int | None = None, steps: int = 20) -> list[np.ndarray]:
    """The observations of the first steps under the same actions."""
    draws = np.random.default_rng(0)
    seen = [env.reset(seed=seed)[0]]
    seen += [env.step(draws.uniform(-1, 1, env.action_space.shape).astype(np.float32))[0] for _ in range(steps)]
    return [each for each in seen if isinstance(each, np.ndarray)]


def test_the_action_space_has_the_limits_to_which_actions_are_clipped_and_none_else() -> None:
    limited = TaskVectorEnv("tests.support.worker.declared:Sliders", num_envs=1).single_action_space
    assert isinstance(limited, gymnasium.spaces.Box)
    assert limited.low.tolist() == [-2.0, -2.0] and limited.high.tolist() == [2.0, 2.0]
    free = TaskVectorEnv("tests.support.worker.declared:FreeSliders", num_envs=1).single_action_space
    assert isinstance(free, gymnasium.spaces.Box) and not free.is_bounded("below") and not free.is_bounded("above")


def test_same_step_reset_keeps_the_final_observation(env: VectorEnv) -> None:
    """Push all carts right until the poles fall: the step that ends an episode returns the next episode's start."""
    env.reset(seed=1)
    terminated = truncated = 0
    for _ in range(60):
        observations, rewards, terminations, truncations, info = env.step(np.ones((WORLDS, 1), np.float32))
        assert env.observation_space.contains(observations)
        assert rewards.shape == (WORLDS,) and rewards.dtype == np.float32
        assert terminations.dtype == truncations.dtype == np.bool_
        assert not (terminations & truncations).any()
        ended = terminations | truncations
        assert np.array_equal(info.get("_final_obs", np.zeros(WORLDS, bool)), ended)
        for world in range(WORLDS):
            if not ended[world]:
                assert "final_obs" not in info or info["final_obs"][world] is None
                continue
            final = info["final_obs"][world]
            assert env.single_observation_space.contains(final)
            # 0.4 rad is the limit of an episode and 0.15 rad that of a start.
            assert (abs(final[1]) > 0.4) == terminations[world]
            assert abs(observations[world, 1]) <= 0.15
        terminated += terminations.sum()
        truncated += truncations.sum()
    assert terminated > 0, "a constant push drops poles"

    env.reset(seed=2)
    for _ in range(30):
        *_, truncations, _ = env.step(np.zeros((WORLDS, 1), np.float32))
        truncated += truncations.sum()
    assert truncated > 0, "some poles stand for half a second by themselves"


def test_returned_arrays_are_copies(env: VectorEnv) -> None:
    env.reset(seed=5)
    observations, rewards, *_ = env.step(np.zeros((WORLDS, 1), np.float32))
    kept = observations.copy(), rewards.copy()
    env.step(np.ones((WORLDS, 1), np.float32))
    assert np.array_equal(observations, kept[0]) and np.array_equal(rewards, kept[1])


def test_gymnasiums_own_wrappers_work(env: VectorEnv) -> None:
    """RecordEpisodeStatistics counts 30 steps for an episode that the clock ends after half a second."""
    wrapped = DictInfoToList(RecordEpisodeStatistics(env))
    wrapped.reset(seed=2)
    lengths = []
    for _ in range(30):
        *_, truncations, infos = wrapped.step(np.zeros((WORLDS, 1), np.float32))
        lengths += [infos[world]["episode"]["l"] for world in np.flatnonzero(truncations)]
    assert lengths and set(map(int, lengths)) == {30}


def test_every_built_in_task_has_its_id() -> None:
    assert {f"Muster/{name}-v0" for name in BUILT_IN} <= set(gymnasium.registry)
    made = gymnasium.make_vec("worker.tasks.run.gym:Muster/Quadruped-v0", num_envs=3, randomize={"mass": [0.5, 2.0]})
    observations, _ = made.reset(seed=1)
    assert observations.shape == (3, 48) and made.action_space.shape == (3, 12)
    assert made.metadata["render_fps"] == 50.0
    *_, terminations, truncations, _ = made.step(made.action_space.sample())
    assert not terminations.any() and not truncations.any()
    made.close()
    made = gymnasium.make_vec("Muster/Cartpole-v0", num_envs=2, rewards={"alive": 5.0})
    assert made.unwrapped.task.config.rewards == {**CartpoleConfig().rewards, "alive": 5.0}
    made.close()


def test_mistakes_are_named(env: VectorEnv) -> None:
    with pytest.raises(ValueError, match="actions have shape"):
        env.step(np.zeros((WORLDS + 1, 1), np.float32))
    with pytest.raises(ValueError, match="no setting speed"):
        gymnasium.make_vec("Muster/Cartpole-v0", num_envs=2, speed=3)
    with pytest.raises(ValueError, match="did you mean alive"):
        gymnasium.make_vec("Muster/Cartpole-v0", num_envs=2, rewards={"alife": 5.0})
    with pytest.raises(ValueError, match="reset_mask"):
        env.reset(options={"reset_mask": np.ones(WORLDS, bool)})


def test_an_environment_hands_out_copies_in_floats() -> None:
    task = Seen(seed=3)
    env = TaskVecEnv(task)
    first = env.get_observations()
    image = first["image"].clone()
    assert list(first.keys()) == ["policy", "critic", "place", "image"] and image.dtype == torch.float32
    assert {float(image.min()), float(image.max())} == {-0.5, 0.5}
    observations, rewards, dones, extras = env.step(torch.ones(8, 1))
    assert torch.equal(first["image"], image) and not torch.equal(observations["policy"], first["policy"])
    assert rewards.data_ptr() != task.rewards.data_ptr() and dones.dtype == torch.int64
    assert extras["time_outs"].dtype == torch.float32 and "log" not in extras
    assert env.unwrapped.step_dt == pytest.approx(0.1) and env.cfg["control_hz"] == 10.0


def test_an_environment_logs_what_the_terms_of_the_reward_came_to_and_its_clock_is_that_of_the_task() -> None:
    task = Seen(seed=3)
    env = TaskVecEnv(task)
    returns = torch.zeros(8)
    for _ in range(5):
        *_, dones, extras = env.step(torch.zeros(8, 1))
        returns += task.rewards
    assert dones.bool().all()  # episodes of 0.5 s
    torch.testing.assert_close(extras["log"]["reward_place"], returns.mean().expand(8))
    buffer = task.episode_length
    env.episode_length_buf = torch.tensor([4, 3, 2, 1, 0, 0, 0, 0])
    *_, dones, extras = env.step(torch.zeros(8, 1))
    assert dones.tolist() == [1, 0, 0, 0, 0, 0, 0, 0] and extras["time_outs"].tolist() == dones.tolist()
    assert task.episode_length is buffer and env.episode_length_buf.tolist() == [0, 4, 3, 2, 1, 1, 1, 1]
