"""What tasks declare of their observations and actions is what their kernels compute, and noise follows it."""

from __future__ import annotations

import fnmatch
from typing import Any

import pytest
import torch
import warp as wp

from tests.support.worker.tasks import observe, put
from worker.learning.job import configure
from worker.settings.errors import UserError
from worker.tasks import find_task
from worker.tasks.library.cartpole import Cartpole
from worker.tasks.run.task import Task

WORLDS = 4
QUIET = {"start_angle_noise": 0.0, "start_velocity_noise": 0.0}
SETTINGS: dict[str, dict[str, Any]] = {
    "Cartpole": {"start_position": 0.0, "start_angle": 0.0, "start_velocity": 0.0},
    "Ant": {**QUIET, "substeps": 1},
    "Humanoid": {**QUIET, "substeps": 1},
    "Quadruped": {**QUIET, "substeps": 1, "action_scale": 0.4, "stand_knee": -1.5, "velocity_scale": 0.07},
}
"""Starts without noise; one physics step, so that the drives of a control step are those of its beginning."""


@pytest.fixture(scope="module", params=SETTINGS)
def task(request: pytest.FixtureRequest) -> Task:
    kind = find_task(request.param)
    return kind(kind.config_type(**SETTINGS[request.param]), WORLDS, seed=1)


def joints(task: Task) -> tuple[torch.Tensor, torch.Tensor, int, int]:
    """Coordinates and velocities of all worlds, and where the first joint's are."""
    arrays = task.worlds.arrays
    free = isinstance(task, Cartpole) is False
    return wp.to_torch(arrays.joint_q), wp.to_torch(arrays.joint_qd), 7 * free, 6 * free


def test_an_action_drives_its_joint_as_declared(task: Task) -> None:
    actions = task.interface().actions
    assert tuple(action.name for action in actions) == task.action_names
    put(task)
    q, qd, first_q, first_qd = (part.clone() if isinstance(part, torch.Tensor) else part for part in joints(task))
    labels = "_".join(label.rsplit("/", 1)[-1] for label in task.worlds.model.joint_label)
    assert labels.removeprefix("root_").startswith("_".join(task.action_names))
    requested = torch.tensor([-2.0, -0.5, 0.5, 2.0])[:, None] * torch.linspace(0.7, 1.0, len(actions))
    task.step(requested)
    drives = wp.to_torch(task.worlds.arrays.drives)
    for index, action in enumerate(actions):
        supplied = action.offset + action.scale * requested[:, index].clamp(*action.clip)
        effort = supplied
        if action.kind == "position":
            assert torch.allclose(wp.to_torch(task.worlds.arrays.controls)[:, index], supplied)
            position, velocity = q[:, first_q + index], qd[:, first_qd + index]
            effort = action.stiffness * (supplied - position) - action.damping * velocity
        if action.effort_limit is not None:
            effort = effort.clamp(-action.effort_limit, action.effort_limit)
        assert torch.allclose(drives[:, first_qd + index], effort, rtol=1e-4), action.name
        assert effort.abs().min() > 1.0, "and it is worth comparing"


def observed(randomize: dict[str, Any]) -> Task:
    """512 Quadrupeds that have observed the same state."""
    kind = find_task("Quadruped")
    task = kind(configure(kind, {"config": {"randomize": randomize}}), 512, seed=1)
    put(task)
    task.actions.fill_(0.3)
    observe(task)
    return task


@pytest.fixture(scope="module")
def clean() -> torch.Tensor:
    return observed({}).observations


@pytest.mark.parametrize(
    ("noise", "deviations"),
    [
        (0.2, {"*": 0.2}),
        (
            {"*_velocity": 1.5, "*_position": 0.01, "rear_*_position": 0.02, "gravity_z": 0.05},
            {"*_velocity": 1.5 * 0.05, "rear_*_position": 0.02, "front_*_position": 0.01, "gravity_z": 0.05},
        ),
    ],
    ids=["of all", "by name"],
)
def test_noise_is_in_the_unit_of_the_quantity_and_leaves_command_and_last_action_alone(
    clean: torch.Tensor, noise: Any, deviations: dict[str, float]
) -> None:
    blurred = observed({"observation_noise": noise})
    found = (blurred.observations - clean).std(dim=0).tolist()
    kinds = [seen.kind for seen in blurred.interface().observations]
    assert kinds.count("command") == 3 and kinds.count("previous_action") == 12
    for seen, deviation in zip(blurred.interface().observations, found, strict=True):
        requested = [value for pattern, value in deviations.items() if fnmatch.fnmatch(seen.name, pattern)]
        expected = requested[0] if requested and seen.kind == "measured" else 0.0
        assert deviation == (pytest.approx(expected, rel=0.15) if expected else 0.0), seen.name


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        ({"gravity": 0.1}, ": no observation that is measured is called 'gravity'; did"),
        ({"command_turn": 0.1}, ": no observation that is measured is called 'comm"),
        ({"*_velocity": -1.0}, ".*_velocity: expected a number of 0 or more, found -1.0"),
        ({"*_velocity": "much"}, ".*_velocity: expected a number of 0 or more, found 'much'"),
    ],
)
def test_invalid_noise_is_refused_in_one_line(noise: Any, message: str) -> None:
    from worker.learning.job import user_errors

    kind = find_task("Quadruped")
    with pytest.raises(UserError) as error, user_errors():
        kind(configure(kind, {"config": {"randomize": {"observation_noise": noise}}}), 1)
    output = str(error.value).removeprefix("train.")
    assert output.startswith(f"config.randomize.observation_noise{message}") and "\n" not in output, output
