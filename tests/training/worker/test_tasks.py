"""Tasks on the CPU: resets by hand, exact resume, the same worlds on any number of ranks. Rewards: tests/unit/worker/test_task_formulas.py."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import warp as wp

import worker.tasks.library.cartpole as cartpole_module
from tests.support.worker.tasks import observe, play, put, same, statistics
from worker.tasks import find_task
from worker.tasks.library.ant import Ant, AntConfig
from worker.tasks.library.cartpole import Cartpole, CartpoleConfig
from worker.tasks.library.humanoid import Humanoid, HumanoidConfig
from worker.tasks.library.quadruped import Quadruped
from worker.tasks.run.task import Task

torch.set_num_threads(1)


@pytest.fixture(scope="module")
def cartpole() -> Cartpole:
    return Cartpole(CartpoleConfig(), 8, seed=1)


@pytest.fixture(scope="module")
def ant() -> Ant:
    return Ant(AntConfig(episode_seconds=0.5), 8, seed=1)


def test_time_out_is_not_termination(cartpole: Cartpole) -> None:
    """World 0 falls, 1 times out, 2 falls in its last step, 3 goes on; the rest are young."""
    put(
        cartpole,
        joint_q=[[0.0, 0.5], [0.1, 0.2], [0.0, -0.6], [0.3, 0.1]],
        episode_length=[10, 299, 299, 298],
        solver_warm_start=[[5.0, 6.0]] * 8,
    )
    before = cartpole.state_dict()
    observe(cartpole)
    assert cartpole.dones[:4].tolist() == [True, True, True, False] and not cartpole.dones[4:].any()
    assert cartpole.time_outs[:4].tolist() == [False, True, False, False]
    assert cartpole.episode_length[:4].tolist() == [0, 0, 0, 299]
    # The terminal observation is the state before the reset; the observation is the next episode's start.
    expected = torch.cat([before["joint_q"], before["joint_qd"]], dim=1)
    assert torch.equal(cartpole.terminal_observations[:3], expected[:3])
    assert torch.equal(cartpole.observations[3:], expected[3:])
    assert (cartpole.observations[:3, 1].abs() <= 0.15).all()
    assert not torch.equal(cartpole.observations[:3], expected[:3])
    assert cartpole.state_dict()["solver_warm_start"].tolist() == [[0.0, 0.0]] * 3 + [[5.0, 6.0]] * 5
    totals = statistics(cartpole)
    assert totals["episodes"] == 3 and totals["episode_length"] == 3 and totals["reward_fall"] == -4


def test_one_step_agrees_with_mujoco_itself(cartpole: Cartpole) -> None:
    model = mujoco.MjModel.from_xml_path(str(Path(cartpole_module.__file__).with_name("cartpole.xml")))
    model.opt.timestep = 1.0 / 60.0
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    put(cartpole, joint_q=[[0.1, 0.1], [0.0, -0.2]], joint_qd=[[0.5, -0.3], [0.0, 0.4]])
    state = cartpole.state_dict()
    actions = torch.zeros(8, 1)
    actions[:2, 0] = torch.tensor([0.7, -3.0])
    cartpole.step(actions)
    for world, control in ((0, 0.7), (1, -1.0)):
        data = mujoco.MjData(model)
        data.qpos, data.qvel, data.ctrl[0] = state["joint_q"][world], state["joint_qd"][world], control
        mujoco.mj_step(model, data)
        assert np.allclose(cartpole.observations[world], [*data.qpos, *data.qvel], atol=1e-5)


def test_any_number_of_substeps_steps_equally(cartpole: Cartpole) -> None:
    """One control step of 3 (odd) or 2 (even) substeps is as many control steps of one substep at the same timestep."""
    for substeps in (2, 3):
        coarse = Cartpole(CartpoleConfig(substeps=substeps, control_hz=60), 8, seed=1)
        fine = Cartpole(CartpoleConfig(substeps=1, control_hz=60 * substeps), 8, seed=1)
        for _ in range(4):
            coarse.step(torch.ones(8, 1) * 0.3)
            for _ in range(substeps):
                fine.step(torch.ones(8, 1) * 0.3)
        assert torch.equal(coarse.observations, fine.observations)


def test_a_replay_equals_the_launches(cartpole: Cartpole) -> None:
    put(cartpole)
    start = cartpole.state_dict()
    addresses = cartpole.observations.data_ptr(), cartpole.rewards.data_ptr(), cartpole.statistics.data_ptr()
    replayed = play(cartpole, 60, seed=3)
    cartpole.load_state_dict(start)
    replaying, cartpole._steps = cartpole._steps, [part for _, part in cartpole._control.parts()]
    try:
        eager = play(cartpole, 60, seed=3)
    finally:
        cartpole._steps = replaying
    assert same(replayed, eager) and any(dones.any() for _, _, dones, _ in eager)
    assert addresses == (
        cartpole.observations.data_ptr(),
        cartpole.rewards.data_ptr(),
        cartpole.statistics.data_ptr(),
    )


def test_statistics_are_sums_over_finished_episodes(cartpole: Cartpole) -> None:
    put(cartpole)
    returns, lengths = torch.zeros(8, dtype=torch.float64), torch.zeros(8)
    episodes, total_return, total_length, squares = 0, 0.0, 0.0, 0.0
    for _, rewards, dones, _ in play(cartpole, 200, seed=4):
        returns += rewards
        lengths += 1
        episodes += int(dones.sum())
        total_return += returns[dones].sum().item()
        squares += returns[dones].square().sum().item()
        total_length += lengths[dones].sum().item()
        returns[dones] = 0
        lengths[dones] = 0
    totals = statistics(cartpole)
    assert episodes > 20
    assert totals["episodes"] == episodes and totals["episode_length"] == total_length
    assert totals["episode_return"] == pytest.approx(total_return, rel=1e-5)
    assert totals["squared_return"] == pytest.approx(squares, rel=1e-5)
    assert sum(totals[f"reward_{term}"] for term in CartpoleConfig().rewards) == pytest.approx(total_return, rel=1e-5)
    cartpole.clear_statistics()
    assert not cartpole.statistics.any()


def test_a_world_that_is_nan_is_reset_and_counted_and_touches_no_other(cartpole: Cartpole) -> None:
    put(cartpole)
    clean = play(cartpole, 5, seed=5)
    put(cartpole, joint_qd=[[math.nan, 0.0]], solver_warm_start=[[math.nan, math.inf]])
    broken = play(cartpole, 5, seed=5)
    observations, rewards, dones, time_outs = broken[0]
    assert dones.tolist() == [True] + [False] * 7 and not time_outs.any()
    assert rewards[0] == 0 and torch.equal(cartpole.terminal_observations[0], torch.zeros(4))
    assert observations.isfinite().all() and all(step[0].isfinite().all() for step in broken)
    assert same([tuple(t[1:] for t in step) for step in clean], [tuple(t[1:] for t in step) for step in broken])
    totals = statistics(cartpole)
    assert totals["nan_worlds"] == 1 and totals["episodes"] == sum(int(step[2][1:].sum()) for step in broken)


def test_the_warm_start_belongs_to_the_state(ant: Ant) -> None:
    put(ant)
    play(ant, 20, seed=7)
    state = ant.state_dict()
    exact = play(ant, 20, seed=8)
    ant.load_state_dict(state | {"solver_warm_start": torch.zeros_like(state["solver_warm_start"])})
    assert not same(exact, play(ant, 20, seed=8))
    ant.load_state_dict(state)
    assert same(exact, play(ant, 20, seed=8))


def test_a_state_that_does_not_fit_is_refused_whole(cartpole: Cartpole) -> None:
    put(cartpole)
    state = cartpole.state_dict()
    with pytest.raises(ValueError, match=r"joint_q is \(4, 2\) torch.float32, expected \(8, 2\)"):
        cartpole.load_state_dict(state | {"joint_q": state["joint_q"][:4], "joint_qd": state["joint_qd"] + 1})
    with pytest.raises(ValueError, match="lacks random"):
        cartpole.load_state_dict({name: tensor for name, tensor in state.items() if name != "random"})
    with pytest.raises(ValueError, match="holds joint_w, which"):
        cartpole.load_state_dict(state | {"joint_w": state["joint_q"]})
    assert all(torch.equal(tensor, state[name]) for name, tensor in cartpole.state_dict().items())


def test_a_task_without_reward_terms_is_refused() -> None:
    unrewarded = Cartpole.with_(rewards=dict.fromkeys(CartpoleConfig().rewards))
    with pytest.raises(
        ValueError, match=r"^task Cartpole: rewards: there is none; declare one, such as Reward\(terms.alive, "
    ):
        unrewarded(unrewarded.config_type(), 2)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("task_type", [Cartpole, Ant, Humanoid, Quadruped])
def test_on_a_gpu_a_step_is_one_graph_and_fits_into_a_larger_one(task_type: type[Task]) -> None:
    task = task_type(task_type.config_type(), 64, seed=1, device="cuda:0")
    host = task_type(task_type.config_type(), 64, seed=1)
    assert torch.allclose(task.observations.cpu(), host.observations, atol=1e-6), "starts do not depend on the device"
    actions = torch.zeros(64, task.action_size, device="cuda:0")
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(3):
            task.step(actions)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    for _ in range(3):
        host.step(actions.cpu())
    assert torch.allclose(task.observations.cpu(), host.observations, atol=1e-3)

    larger = torch.cuda.CUDAGraph()
    torch.cuda.synchronize()
    with torch.cuda.graph(larger, capture_error_mode="thread_local"):
        task.step(torch.tanh(actions))
    ages = task.episode_length.clone()
    larger.replay()
    larger.replay()
    assert torch.equal(task.episode_length, ages + 2)


def test_an_overflow_counts_in_the_control_step_in_which_it_was(cartpole: Cartpole) -> None:
    put(cartpole)
    wp.to_torch(cartpole.worlds.arrays.overflow)[2:4] = 1
    observe(cartpole)
    observe(cartpole)
    assert statistics(cartpole)["solver_overflows"] == 2


def test_random_humanoids_fall_and_stay_finite_within_the_solvers_capacity() -> None:
    task = Humanoid(HumanoidConfig(), 32, seed=1)
    steps = play(task, 120, seed=2)
    assert all(step[0].isfinite().all() and step[1].isfinite().all() for step in steps)
    totals = statistics(task)
    assert totals["episodes"] > 32 and totals["solver_overflows"] == 0 and totals["nan_worlds"] == 0


def test_tasks_are_found_by_name_or_refused_with_the_nearest() -> None:
    assert find_task("Cartpole") is Cartpole and find_task("worker.tasks.library.ant:Ant") is Ant
    with pytest.raises(ValueError, match="no task is called 'cartpol'; did you mean Cartpole"):
        find_task("cartpol")
    with pytest.raises(ValueError, match="no module 'nowhere'"):
        find_task("nowhere:Thing")
    with pytest.raises(ValueError, match="no class 'Cat'"):
        find_task("worker.tasks.library.ant:Cat")


def test_a_module_that_exits_ends_nothing_but_the_search_for_its_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "exiting.py").write_text("raise SystemExit(3)\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ValueError, match=r"^task 'exiting:Task': exiting exits when it is imported \(code 3\)$"):
        find_task("exiting:Task")
