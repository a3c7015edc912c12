"""Tasks: what their kernels compute follows from the declaration, by hand."""

from __future__ import annotations

import pytest
import torch
import warp as wp

from tests.support.worker.declared import Sliders, SlidersConfig, TorchSliders
from tests.support.worker.tasks import observe, play, put, same, statistics
from worker.tasks.run.adapting import adaptive_steps, begin_evaluation

WORLDS = 6


@pytest.fixture(scope="module")
def sliders() -> Sliders:
    return Sliders(SlidersConfig(), WORLDS, seed=1)


def column(task: Sliders, name: str, group: str = "policy") -> torch.Tensor:
    names = task.observation_names if group == "policy" else ("first_place", "second_place", "count")
    return task.groups[group][:, names.index(name)]


def test_columns_are_called_after_terms_and_joints_and_an_action_is_clipped_scaled_and_offset(sliders: Sliders) -> None:
    assert sliders.observation_names == (
        *("first_place", "second_place", "first_late_2", "first_late_1", "first_late", "noisy", "target"),
        *("first_last", "second_last"),
    )
    assert sliders.action_names == ("first", "second")
    assert sliders.groups["critic"].shape == (WORLDS, 3)
    put(sliders)
    sliders.step(torch.tensor([[1.0, -5.0]]).expand(WORLDS, 2))
    controls = wp.to_torch(sliders.worlds.arrays.controls)
    assert controls[0].tolist() == [0.25 + 0.5, 0.25 - 2.0]


def test_observations_are_offset_clipped_scaled_and_noisy(sliders: Sliders) -> None:
    put(sliders, joint_q=[[0.25, 0.3], [-1.0, 1.0]], joint_qd=[[0.0, 0.0]] * WORLDS)
    observe(sliders)
    assert column(sliders, "first_place")[:2].tolist() == pytest.approx([2 * (0.25 - 0.5), 2 * -0.8])
    assert column(sliders, "second_place")[:2].tolist() == pytest.approx([0.3, 0.8])
    noise = column(sliders, "noisy") - column(sliders, "second_place", "critic")
    assert (noise.abs() <= 0.1).all() and noise.abs().max() > 0.0 and len(noise.unique()) == WORLDS


def test_late_observations_come_late_and_history_keeps_the_last_three(sliders: Sliders) -> None:
    put(sliders)
    lags = sliders.state_dict()["past"][:, 0]
    assert set(lags.tolist()) <= {0.0, 1.0, 2.0} and len(lags.unique()) > 1, "each episode draws its own"
    speeds = [torch.zeros(WORLDS)]
    seen = [sliders.observations.clone()]
    for step in range(5):
        sliders.step(torch.full((WORLDS, 2), 0.1 * step))
        assert not sliders.dones.any()
        speeds.append(wp.to_torch(sliders.worlds.arrays.joint_qd)[:, 0].clone())
        seen.append(sliders.observations.clone())
    for step in range(6):
        for back, name in enumerate(("first_late", "first_late_1", "first_late_2")):
            index = sliders.observation_names.index(name)
            for world in range(WORLDS):
                at = max(step - back, 0)
                expected = speeds[max(at - int(lags[world]), 0)][world]
                assert seen[step][world, index] == expected, (step, back, world)


def test_rewards_metrics_and_ends_by_hand(sliders: Sliders) -> None:
    put(
        sliders,
        joint_q=[[0.5, 0.0], [1.6, 0.0], [0.0, 1.6], [1.6, 1.6]],
        joint_qd=[[0.25, -0.5]] * 4,
        last_actions=[[1.0, 0.0]] * 4,
        lasting=[[0.0]] * WORLDS,
        episode_length=[3, 3, 3, 3],
    )
    sliders.actions.zero_()
    sliders.actions[:, 1] = 3.0
    observe(sliders)
    change = -0.5 * (1.0 + 9.0) * 0.1
    expected = [0.5 + change + 2.0, 1.6 + change - 3.0, change + 2.0, 1.6 + change - 3.0]
    assert sliders.rewards[:4].tolist() == pytest.approx(expected, abs=1e-6)
    assert sliders.dones[:4].tolist() == [False, True, True, True]
    assert sliders.time_outs[:4].tolist() == [False, False, True, False]
    totals = statistics(sliders)
    assert totals["episodes"] == 3 and totals["metric_speed"] == pytest.approx(3 * 0.75)
    assert totals["termination_first_left"] == 2 and totals["termination_second_left"] == 2
    assert totals["termination_time_out"] == 0
    assert column(sliders, "count", "critic")[:4].tolist() == [0.0, 1.0, 1.0, 1.0], "it outlasts the episode"
    assert sliders.terminal_groups["critic"][1].tolist() == pytest.approx([1.6, 0.0, 0.0])
    assert column(sliders, "first_last")[:2].tolist() == [0.0, 0.0] and column(sliders, "second_last")[0] == 3.0
    assert column(sliders, "second_last")[1] == 0.0, "a new episode has no last action"
    put(sliders, episode_length=[11], joint_q=[[0.0, 0.0]] * WORLDS)
    observe(sliders)
    totals = statistics(sliders)
    assert totals["termination_time_out"] == totals["episodes"] == 1 and sliders.time_outs[0]


def test_commands_hold_for_their_time_and_events_come_at_intervals() -> None:
    task = Sliders(SlidersConfig(episode_seconds=1000.0, numbers={"terminations.second_left.limit": 1e9}), 32, seed=5)
    targets, speeds = [], []
    for _ in range(40):
        task.step(torch.tensor([[-0.5, -0.25]]).expand(32, 2))  # no force: scale and offset cancel
        targets.append(column(task, "target").clone())
        speeds.append(wp.to_torch(task.worlds.arrays.joint_qd)[:, 1].clone())
    changes = torch.stack(targets).diff(dim=0) != 0
    for world in range(32):
        at = changes[:, world].nonzero().flatten()
        lengths = set(at.diff().tolist())
        assert lengths <= {3, 4, 5}, "0.3 to 0.5 s at 10 Hz"
    assert (torch.stack(targets).abs() <= 1.0).all() and torch.stack(targets).std() > 0.4
    kicked = (torch.stack(speeds) - 0.75).abs() < 1e-6
    assert kicked[3::4].all(), "every 0.4 s"


def test_numbers_are_data_and_a_curriculum_sets_them() -> None:
    curriculum = {"terminations.first_left.limit": [[0, 1.0], [10, 3.0]], "place": [[0, 2.0]]}
    plain = Sliders.sketch(SlidersConfig())
    task = Sliders(SlidersConfig(numbers={"actions.force.scale": [5.0, 6.0]}, curriculum=curriculum), 2, seed=1)
    assert task.numbers("actions.force.scale").tolist() == [5.0, 6.0]
    assert plain.plan.numbers.places == task.plan.numbers.places
    other = Sliders(SlidersConfig(), 2, seed=1)
    assert other._control.kernels.judge is task._control.kernels.judge, "changing a number compiles nothing"
    for iteration, expected in ((0, 1.0), (5, 2.0), (20, 3.0)):
        task.begin_iteration(iteration, None, None)
        assert task.numbers("terminations.first_left.limit").tolist() == pytest.approx([expected])
    assert task._buffers["weights"][0] == 2.0
    put(task, joint_q=[[1.6, 0.0]])
    observe(task)
    assert not task.dones[0]


def test_an_adaptive_number_follows_the_returns_and_continues_after_a_restart() -> None:
    task = Sliders(SlidersConfig(), 2, seed=1)
    speed = task.numbers("events.kick.speed")
    found = []
    for iteration, mean in enumerate((None, 6.0, 4.0, 6.0, 7.0, -6.0)):
        task.begin_iteration(iteration, mean, 3.0)
        task.begin_iteration(iteration, mean, 3.0)
        found.append(speed.item())
    assert found == [0.75, 1.25, 1.25, 1.75, 1.75, 1.25]
    other = Sliders(SlidersConfig(), 2, seed=1)
    other.load_state_dict(task.state_dict())
    assert other.numbers("events.kick.speed").item() == 1.25
    other.begin_iteration(5, 6.0, 3.0)
    assert other.numbers("events.kick.speed").item() == 1.25, "that iteration was begun already"
    other.begin_iteration(6, 6.0, 3.0)
    assert other.numbers("events.kick.speed").item() == 1.75


def test_an_evaluation_has_adaptive_numbers_as_the_checkpoint_has_them_and_moves_none() -> None:
    task, judged = (Sliders(SlidersConfig(), 2, seed=seed) for seed in (1, 2))
    for iteration, mean in enumerate((None, 6.0, 6.0, -6.0)):
        task.begin_iteration(iteration, mean, 3.0)
    assert adaptive_steps(task) == {"kicks": 1.0}
    for other in (judged, task):
        for _ in range(2):
            begin_evaluation(other, 3, 9.0, 3.0, adaptive_steps(task))
            assert other.numbers("events.kick.speed").item() == 1.25
    begin_evaluation(judged, 8, 9.0, 3.0, {"kicks": 7.0, "unknown": 1.0})
    assert judged.numbers("events.kick.speed").item() == 1.75, "the rule has 2 steps now"
    begin_evaluation(judged, 9, 9.0, 3.0, {})
    assert judged.numbers("events.kick.speed").item() == 0.75, "an older checkpoint does not say"
    task.begin_iteration(4, 9.0, 3.0)
    assert task.numbers("events.kick.speed").item() == 1.75, "the training itself goes on from where it was"


def test_worlds_differ_as_declared_and_alike_on_any_number_of_ranks() -> None:
    whole = Sliders(SlidersConfig(), 6, seed=3)
    part = Sliders(SlidersConfig(), 3, seed=3, first_world=3)
    masses = whole.worlds.solver.mjw_model.body_mass.numpy()
    assert len(set(masses[:, 1])) == 6 and masses[:, 1].min() >= 0.5 and masses[:, 1].max() <= 2.0
    assert (part.worlds.solver.mjw_model.body_mass.numpy() == masses[3:]).all()
    assert same([tuple(each[3:] for each in step) for step in play(whole, 40, seed=9)], play(part, 40, seed=9))


@pytest.mark.parametrize("kind", [Sliders, TorchSliders])
def test_it_goes_on_bit_for_bit(kind: type[Sliders]) -> None:
    first, second = kind(SlidersConfig(), 4, seed=4), kind(SlidersConfig(), 4, seed=4)
    play(first, 17, seed=1)
    second.load_state_dict(first.state_dict())
    assert same(play(first, 30, seed=2), play(second, 30, seed=2))
    assert all(torch.equal(tensor, second.state_dict()[name]) for name, tensor in first.state_dict().items())


def test_terms_in_torch() -> None:
    task = TorchSliders(SlidersConfig(), 4, seed=1)
    assert task.observation_names == ("both_0", "both_1", "first_place", "second_place")
    put(task, joint_q=[[0.5, 0.25], [1.7, 0.0]])
    task.actions.zero_()
    task.actions[0] = 1.0
    observe(task)
    places = wp.to_torch(task.worlds.arrays.joint_q)
    assert torch.equal(task.observations[:, :2], 3.0 * places), "after the reset of a world, too"
    assert task.terminal_observations[1].tolist() == pytest.approx([5.1, 0.0, 1.7, 0.0])
    sums = task.state_dict()["episode_sums"]
    assert sums[0, 4] == 0.0 and sums[2, 4] == 2.0
    steps = play(task, 20, seed=1)
    assert all(torch.equal(step[0][:, :2], 3.0 * step[0][:, 2:]) for step in steps)
