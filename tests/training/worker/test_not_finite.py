"""What is not finite: named by world and observation, kept from the policy, counted, and, past a limit, the end of the run."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
import torch

from shared_store.volume.layout import Store
from tests.support.worker.broken_task import Rooted, RootedCritic, Rotten, RottenInTorch
from tests.support.worker.in_process import call_worker
from tests.support.worker.ranks import training
from tests.support.worker.runs import runner
from tests.support.worker.tasks import put, statistics
from worker import repeat_incident
from worker.learning.loop import Loop
from worker.settings.errors import TrainingError
from worker.tasks.library.cartpole import Cartpole, CartpoleConfig

STILL = torch.zeros(4, 1)


def test_an_observation_that_is_not_finite_is_hidden_and_its_world_reset_in_the_next_step() -> None:
    task = Rooted(CartpoleConfig(), 4, seed=1, first_world=100)
    put(task, joint_q=[[0.0, 0.0], [0.0, 0.0], [0.0, -0.3], [0.0, 0.0]], joint_qd=[[0.0, 0.0]] * 4)
    task.step(STILL)
    assert task.observations[2, 2] == 0 and task.observations.isfinite().all() and not task.dones.any()
    assert statistics(task)["nan_worlds"] == 0 and task.read_failed_world(int(task.failed_world)) is None
    saved = task.state_dict()
    task.step(STILL)
    assert task.dones.tolist() == [False, False, True, False] and not task.time_outs.any()
    assert task.rewards[2] == 0 and task.terminal_observations[2].isfinite().all()
    assert task.observations[2, 1].abs() <= 0.15, "placed afresh"
    totals = statistics(task)
    assert totals["nan_worlds"] == 1 and totals["episodes"] == 0
    assert task.read_failed_world(int(task.failed_world)) == (2, "its observation slider_velocity was not finite")
    # it is part of the state: who resumes between the two steps sees the same
    after = task.state_dict()
    task.load_state_dict(saved)
    task.step(STILL)
    assert all(torch.equal(tensor, after[name]) for name, tensor in task.state_dict().items())


def test_physics_and_rewards_are_named_too_and_the_first_world_is_reported() -> None:
    task = Cartpole(CartpoleConfig(rewards={"velocity": -1e38}), 4, seed=1)
    put(task, joint_q=[[0.0, 0.0]] * 4, joint_qd=[[0.0, 0.0], [900.0, 0.0], [0.0, 0.0], [math.nan, 0.0]])
    task.step(STILL)
    assert task.dones.tolist() == [False, True, False, True] and statistics(task)["nan_worlds"] == 2
    assert task.read_failed_world(int(task.failed_world)) == (1, "its reward term velocity was not finite")
    put(task, joint_q=[[0.0, 0.0]] * 4, joint_qd=[[0.0, 0.0]] * 3 + [[math.nan, 0.0]])
    task.step(STILL)
    assert task.read_failed_world(int(task.failed_world)) == (
        3,
        "its physics failed (a joint faster than `fastest`, or not finite)",
    )
    put(task, joint_q=[[0.0, 0.0]] * 4, joint_qd=[[0.0, 0.0]] * 2 + [[0.0, 2000.0], [0.0, 0.0]])
    task.step(STILL)
    assert task.dones.tolist() == [False, False, True, False] and task.rewards[2] == 0, "finite, but past belief"


def test_a_reward_of_finite_terms_that_overflows_names_none_of_them() -> None:
    task = Cartpole(CartpoleConfig(rewards={"alive": 3e38, "position": 3e38}), 4, seed=1)
    put(task, joint_q=[[0.0, 0.0], [1.0, 0.0], [0.0, 0.0], [0.0, 0.0]], joint_qd=[[0.0, 0.0]] * 4)
    task.step(STILL)
    assert task.read_failed_world(int(task.failed_world)) == (
        1,
        "its reward was not finite, though each of its terms was",
    )


def test_a_privileged_observation_that_is_not_finite_is_hidden_and_counted_as_the_policys_is() -> None:
    task = RootedCritic(CartpoleConfig(), 4, seed=1)
    put(task, joint_q=[[0.0, 0.0], [0.0, -0.3], [0.0, 0.0], [0.0, 0.0]], joint_qd=[[0.0, 0.0]] * 4)
    task.step(STILL)
    critic = task.groups["critic"]
    assert critic[1, 2] == 0 and critic.isfinite().all() and not task.dones.any()
    assert statistics(task)["nan_worlds"] == 0 and task.read_failed_world(int(task.failed_world)) is None
    saved = task.state_dict()
    task.step(STILL)
    assert task.dones.tolist() == [False, True, False, False] and not task.time_outs.any()
    assert statistics(task)["nan_worlds"] == 1
    assert task.read_failed_world(int(task.failed_world)) == (1, "its observation critic.root was not finite")
    after = task.state_dict()
    task.load_state_dict(saved)
    task.step(STILL)
    assert all(torch.equal(tensor, after[name]) for name, tensor in task.state_dict().items())


def broken(path: Path, limit: float, task: type[Cartpole] = Rooted) -> Loop:
    name = f"{task.__module__}:{task.__qualname__}"
    return runner(training(path, iterations=3, worlds=16, config={"nan_limit": limit}, task=name), task=task)


def test_training_goes_on_below_the_limit_and_tells(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert broken(tmp_path, 10.0).train() == 0
    output = capsys.readouterr().out
    assert re.search(
        r"warning: iteration \d: \d+ resets? of worlds, among them world \d+: its observation slider_velocity was not finite",
        output,
    )
    assert "nan_worlds" in output and "error" not in output


def test_past_the_limit_it_stops_with_the_state_and_it_happens_again(tmp_path: Path) -> None:
    with pytest.raises(TrainingError) as stop:
        broken(tmp_path, 0.0).train()
    found = re.fullmatch(
        r"iteration (\d): (\d+) resets? of worlds, among them (world \d+: its observation slider_velocity was not finite); that is more "
        r"than nan_limit, 0 times 16 worlds; there is no checkpoint yet. See it happen again: python -m worker.repeat_incident (\S+)",
        str(stop.value),
    )
    assert found, stop.value
    assert [str(path) for path in Store(tmp_path).run("run").incidents.iterdir()] == [found[4]]
    again = call_worker(repeat_incident.main, {}, found[4])
    assert again.returncode == 0, again.stderr
    assert again.stdout.startswith(
        f"iteration {found[1]} of tests.support.worker.broken_task:Rooted: 16 steps of 16 worlds\nstep "
    )
    assert found[3] in again.stdout and again.stdout.count("joint_q:") >= 1
    angle = re.search(r"joint_q: \[\S+ (\S+)\]", again.stdout)
    assert angle and float(angle[1]) < -0.2, "the pole leant to the left"


@pytest.mark.parametrize("task", [Rotten, RottenInTorch])
def test_the_reward_term_that_is_not_finite_is_named_at_the_end_and_in_the_replay(
    task: type[Cartpole], tmp_path: Path
) -> None:
    with pytest.raises(TrainingError) as stop:
        broken(tmp_path, 0.0, task).train()
    found = re.search(
        r"among them (world \d+): (its reward term rotten was not finite); .*repeat_incident (\S+)", str(stop.value)
    )
    assert found, stop.value
    assert stop.value.cause == found[2], "another attempt names another world"
    again = call_worker(repeat_incident.main, {}, found[3])
    assert again.returncode == 0, again.stderr
    assert f"{found[1]}: {found[2]}; before it:" in again.stdout
    terms = set(re.findall(r"  reward terms of the step: (.+)", again.stdout))
    assert terms <= {"alive 1, rotten nan, fall 0", "alive 0, rotten nan, fall -2"} and terms


def test_a_file_other_than_an_incident_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "nonsense").write_text("x")
    (tmp_path / "empty").touch()
    for name, says in {"nonsense": "holds no", "missing": "can't be read (", "empty": "holds no"}.items():
        refused = call_worker(repeat_incident.main, {}, str(tmp_path / name))
        assert refused.returncode == 2 and refused.stderr.count("\n") == 1, refused.stderr
        assert refused.stderr.startswith(f"error: {tmp_path / name} {says}")
