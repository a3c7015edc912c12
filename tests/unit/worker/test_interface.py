"""What tasks declare of their observations and actions is what their kernels compute; noise follows it; checkpoints hold it."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import warp as wp

from tests.support.worker.tasks import observe, put
from worker.errors import UserError
from worker.learning.job import configure
from worker.learning.setup import describe
from worker.learning.training import Training
from worker.tasks import BUILT_IN, find_task
from worker.tasks.cartpole import Cartpole, CartpoleConfig
from worker.tasks.declared import DeclaredTask
from worker.tasks.interface import Interface
from worker.tasks.quadruped import QuadrupedConfig
from worker.tasks.task import Task

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


def quantities(task: Task) -> dict[str, torch.Tensor]:
    """The measured quantities of a robot that stands upright at the origin and faces +x, by the names of observations."""
    q, qd, first_q, first_qd = joints(task)
    if first_q == 0:
        return dict(zip(task.observation_names, (*q.T, *qd.T), strict=True))
    found = {"torso_height": q[:, 2]}
    for body in ("torso", "trunk"):
        found |= {f"{body}_velocity_{axis}": qd[:, index] for index, axis in enumerate("xyz")}
        found |= {f"{body}_angular_velocity_{axis}": qd[:, 3 + index] for index, axis in enumerate("xyz")}
    zero, one = torch.zeros(WORLDS), torch.ones(WORLDS)
    found |= {"torso_yaw": zero, "torso_roll": zero, "torso_up": one, "torso_heading": one}
    found |= {"gravity_x": zero, "gravity_y": zero, "gravity_z": -one}
    for index, joint in enumerate(task.action_names):
        found |= {f"{joint}_position": q[:, first_q + index], f"{joint}_velocity": qd[:, first_qd + index]}
    return found


def declared(task: Task) -> Interface:
    interface = task.interface()
    assert interface is not None
    return interface


def test_an_observation_is_its_quantity_with_the_declared_scale_and_offset(task: Task) -> None:
    interface = declared(task)
    assert tuple(seen.name for seen in interface.observations) == task.observation_names
    put(task)
    q, qd, first_q, _ = joints(task)
    generator = torch.Generator().manual_seed(3)
    q[:, first_q:] += 0.1 * torch.rand(q[:, first_q:].shape, generator=generator)
    qd += torch.rand(qd.shape, generator=generator)
    task.actions.copy_(3.0 * torch.randn(task.actions.shape, generator=generator))
    observe(task)
    assert not task.dones.any()
    known, actions = quantities(task), dict(zip(task.action_names, task.actions.T, strict=True))
    compared = 0
    for column, seen in enumerate(interface.observations):
        if seen.kind == "command":
            least, greatest = getattr(task.config, seen.name)
            assert seen.range == (least, greatest)
            continue
        if seen.kind == "previous_action":
            expected = actions[seen.name.removesuffix("_previous_action")].clamp(*interface.actions[0].clip)
        else:
            expected = seen.scale * (known[seen.name] - seen.offset)
        assert torch.allclose(task.observations[:, column], expected, atol=1e-5), seen.name
        compared += 1
    assert compared >= len(interface.observations) - 3


def test_an_action_drives_its_joint_as_declared(task: Task) -> None:
    actions = declared(task).actions
    assert tuple(action.name for action in actions) == task.action_names
    put(task)
    q, qd, first_q, first_qd = (part.clone() if isinstance(part, torch.Tensor) else part for part in joints(task))
    asked = torch.tensor([-2.0, -0.5, 0.5, 2.0])[:, None].expand(WORLDS, len(actions)).contiguous()
    task.step(asked)
    drives = wp.to_torch(task.worlds.arrays.drives)
    for index, action in enumerate(actions):
        given = action.offset + action.scale * asked[:, index].clamp(*action.clip)
        effort = given
        if action.kind == "position":
            assert torch.allclose(wp.to_torch(task.worlds.arrays.controls)[:, index], given)
            position, velocity = q[:, first_q + index], qd[:, first_qd + index]
            effort = action.stiffness * (given - position) - action.damping * velocity
        if action.effort_limit is not None:
            effort = effort.clamp(-action.effort_limit, action.effort_limit)
        assert torch.allclose(drives[:, first_qd + index], effort, rtol=1e-4), action.name
        assert effort.abs().min() > 1.0, "and it is worth comparing"


def test_an_episode_begins_at_the_declared_positions(task: Task) -> None:
    task.reset()
    q, _, first_q, _ = joints(task)
    for index, action in enumerate(declared(task).actions):
        assert torch.allclose(q[:, first_q + index], torch.tensor(action.default_position)), action.name


def described(task: Task) -> dict[str, Any]:
    job: Any = SimpleNamespace(
        spec={}, section={"task": type(task).__name__}, setting=lambda name, default, **_: default
    )
    return describe(Training.of(job, type(task)), task)


def test_a_checkpoint_holds_the_policy_contract(task: Task) -> None:
    contract = json.loads(json.dumps(described(task)))["contract"]
    assert contract["control_hz"] == task.config.control_hz
    terms = contract["groups"][0]["terms"]
    assert [name for term in terms for name in term["names"]] == list(task.observation_names)
    assert contract["action_names"] == list(task.action_names)
    if isinstance(task.config, QuadrupedConfig):
        knee = contract["actions"][contract["action_names"].index("front_left_knee")]
        assert (knee["kind"], knee["unit"], knee["scale"], knee["offset"]) == ("position", "rad", 0.4, -1.5)
        assert (knee["stiffness"], knee["damping"], knee["effort_limit"]) == (60.0, 1.5, 33.0)
        (term,) = [term for term in terms if "command_turn" in term["names"]]
        turn = term["names"].index("command_turn")
        assert (term["kind"], term["units"][turn], term["ranges"][turn]) == ("command", "rad/s", [-1.0, 1.0])


def test_every_built_in_task_declares_its_interface_and_images_stand_for_themselves() -> None:
    assert SETTINGS.keys() <= BUILT_IN.keys()
    # of all others, as of these, it follows from the declaration; those of real robots are judged in tests/robots
    assert all(issubclass(find_task(name), DeclaredTask) for name in BUILT_IN)
    kind = find_task("CartpolePixels")
    task = kind(kind.config_type(), 1)
    contract = described(task)["contract"]
    assert contract["groups"][0]["image"]["camera"]["width"] == 64 and not contract["groups"][0]["terms"]
    assert contract["groups"][0]["image"]["channels"] == ["red", "green", "blue"]
    assert [action["name"] for action in contract["actions"]] == ["slider"]


def test_an_interface_of_other_numbers_than_the_task_s_is_refused() -> None:
    class Careless(Cartpole):
        def interface(self) -> Interface:
            own = super().interface()
            return Interface(own.observations[::-1], own.actions)

    with pytest.raises(
        ValueError, match=r"task Careless: interface\(\) has other observations than the task, or in an"
    ):
        Careless(CartpoleConfig(), 1)


# -- noise -----------------------------------------------------------------------------------------------------------


def noisy(noise: Any) -> tuple[Task, torch.Tensor]:
    """A Quadruped with this noise in 512 worlds, and the deviation of each of its observations from those without noise."""
    kind = find_task("Quadruped")
    clean, blurred = (
        kind(configure(kind, {"config": {"randomize": randomize}}), 512, seed=1)
        for randomize in ({}, {"observation_noise": noise})
    )
    for task in (clean, blurred):
        put(task)
        task.actions.fill_(0.3)
        observe(task)
    return blurred, (blurred.observations - clean.observations).std(dim=0)


def test_noise_leaves_the_command_and_the_last_action_alone() -> None:
    task, found = noisy(0.2)
    kinds = [seen.kind for seen in declared(task).observations]
    assert kinds.count("command") == 3 and kinds.count("previous_action") == 12
    for kind, deviation in zip(kinds, found.tolist(), strict=True):
        assert deviation == (pytest.approx(0.2, rel=0.15) if kind == "measured" else 0.0)


def test_noise_is_given_by_name_in_the_unit_of_the_quantity() -> None:
    task, found = noisy({"*_velocity": 1.5, "*_position": 0.01, "rear_*_position": 0.02, "gravity_z": 0.05})
    deviations = dict(zip(task.observation_names, found.tolist(), strict=True))
    expected = {"front_left_knee_velocity": 1.5 * 0.05, "front_left_hip_position": 0.01}
    expected |= {"rear_left_hip_position": 0.02, "gravity_z": 0.05}
    for name, deviation in expected.items():
        assert deviations[name] == pytest.approx(deviation, rel=0.15), name
    for name in (
        "gravity_x",
        "trunk_velocity_x",
        "trunk_angular_velocity_z",
        "command_turn",
        "rear_left_hip_previous_action",
    ):
        assert deviations[name] == 0.0, name


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        (
            {"gravity": 0.1},
            "config.randomize.observation_noise: no observation that is measured is called 'gravity'; did",
        ),
        ({"command_turn": 0.1}, "config.randomize.observation_noise: no observation that is measured is called 'comm"),
        (
            {"*_velocity": -1.0},
            "train.config.randomize.observation_noise.*_velocity: expected a number of 0 or more, found -1.0",
        ),
        (
            {"*_velocity": "much"},
            "train.config.randomize.observation_noise.*_velocity: expected a number of 0 or more, found 'much'",
        ),
    ],
)
def test_noise_that_can_not_be_is_refused_in_one_line(noise: Any, message: str) -> None:
    from worker.learning.job import user_errors

    kind = find_task("Quadruped")
    with pytest.raises(UserError) as error, user_errors():
        kind(configure(kind, {"config": {"randomize": {"observation_noise": noise}}}), 1)
    assert str(error.value).startswith(message) and "\n" not in str(error.value), str(error.value)
