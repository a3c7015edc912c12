"""What terms need follows from their functions: numbers of their own, columns of sensors, limits of joints."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from tests.support.refusals import refusal
from tests.support.worker.declared import MODEL, Sliders, SlidersConfig
from worker.simulation.actuators import PositionActuator
from worker.simulation.sensors.contact import ContactSensor
from worker.simulation.sensors.frames import Frames
from worker.simulation.sensors.height_scan import HeightScan, RingPattern
from worker.simulation.sensors.imu import Imu
from worker.tasks import (
    Action,
    Choice,
    Command,
    Event,
    Metric,
    Observation,
    Robot,
    Term,
    Termination,
    WorldArrays,
    terms,
)
from worker.tasks.compile.binding import has_columns

TURN = (-1.0, 1.0)
VELOCITIES: Mapping[str, Any] = {"names": ("a", "b", "c"), "forward": TURN, "left": TURN, "turn": TURN}
FEET = {
    "touch": ContactSensor(bodies=("near", "far")),
    "soles": Frames(bodies=("near", "far")),
    "scan": HeightScan(bodies=("near", "far"), pattern=RingPattern(radius=0.04, count=4, center=True)),
    "imu": Imu(body="near"),
}


def sliders(robot: Robot | None = None, **changed: Any) -> type[Sliders]:
    """The sliders with other sections in place of their own."""

    class Changed(Sliders):
        def robot(self, config: SlidersConfig) -> Robot:
            return robot or Robot(MODEL)

        def sections(self) -> dict[str, Any]:
            return {**super().sections(), **changed}

    return Changed


def observing(**changed: Any) -> Sliders:
    """A sketch of the sliders that observe these terms, with feet and a velocity command."""
    sensors, commands = {"sensors": FEET}, {"commands": {"v": Command(terms.velocity_command, **VELOCITIES)}}
    return sliders(**{**sensors, **commands, "observations": changed}).sketch(SlidersConfig())


@wp.func
def _choose(world: int, worlds: WorldArrays, choice: int):
    worlds.controls[world, 0] = float(choice)


SERVOS = (PositionActuator("*", stiffness=20.0, damping=0.5),)


def test_a_smoothed_target_has_two_numbers_for_each_joint() -> None:
    action = Action(terms.smoothed_position_target, share=0.3, unit="m")
    task = sliders(Robot(MODEL, actuators=SERVOS), actions={"target": action}, randomize={})(SlidersConfig(), 2, seed=1)
    command = task._buffers["memory"][:, next(iter(task.plan.binder.commands.values()))].clone()
    # the command and its countdown, two numbers for each of two joints, the countdown of the event
    assert task.plan.binder.memory == 2 + 4 + 1
    task.step(torch.full_like(task.actions, 0.7))
    assert torch.equal(task._buffers["memory"][:, next(iter(task.plan.binder.commands.values()))], command)


def test_a_command_has_hidden_numbers_of_its_function() -> None:
    command = Command(terms.heading_velocity_command, **VELOCITIES, heading=(-3.0, 3.0))
    seen = {"v": Observation(terms.command_number)}
    plan = sliders(commands={"v": command}, curricula={}, events={}, observations=seen).sketch(SlidersConfig())
    # three numbers, six hidden ones, the countdown; no term has further ones
    assert plan.plan.binder.memory == 3 + 6 + 1 and plan.plan.commands[0].countdown == 9
    assert plan.observation_names == ("v_0", "v_1", "v_2"), "all numbers of the command"


def test_a_term_is_called_for_each_column_of_its_sensors(tmp_path: Path) -> None:
    motion = {name: np.zeros((5, 2)) for name in ("joint_pos", "joint_vel")}
    motion |= {f"body_{name}_w": np.zeros((5, 2, 3)) for name in ("pos", "lin_vel", "ang_vel")}
    np.savez(tmp_path / "motion.npz", fps=[10.0], body_quat_w=np.tile([1.0, 0.0, 0.0, 0.0], (5, 2, 1)), **motion)
    recorded = terms.Motion(tmp_path / "motion.npz", bodies="*", anchor="near")
    task = sliders(
        sensors={**FEET, "motion": recorded, "stiff": terms.Tolerances(standing={"first": 0.1})},
        observations={
            "height": Observation(terms.frame_clearance, points=5),
            "touch": Observation(terms.in_contact),
            "body": Observation(terms.followed_body_position),
            "turn": Observation(terms.followed_body_turn),
            "tilt": Observation(terms.frame_orientation_element),
            "first": Observation(terms.frame_orientation_element, size=3, names=("x", "y", "z")),
        },
        metrics={"posture": Metric(terms.tolerant_posture)},
    ).sketch(SlidersConfig())
    names = task.observation_names
    assert names[:4] == ("height_0", "height_1", "near_touch", "far_touch")
    assert names[4:10] == tuple(f"{body}_body_{axis}" for body in ("near", "far") for axis in "xyz")
    assert len(names) == 2 + 2 + 2 * 3 + 2 * 6 + 6 + 3
    assert task.declaration.sensors["stiff"].rows(task.views) == ["first"]


KEPT = "swing_height_error keeps 2 numbers, and memory is 1; leave memory= out"
SENSED = "points is 4, and the scan scan has 10 columns; give the number of its points for each frame"


@pytest.mark.parametrize(
    ("term", "message"),
    [
        (Observation(terms.swing_height_error, height=0.1, memory=1), KEPT),
        (Observation(terms.frame_clearance, points=4), SENSED),
        (
            Observation(terms.frame_clearance, points=5, size=3),
            "size is 3, more than the 2 frames of scan; leave size= out",
        ),
        (
            Observation(terms.command_number, size=4),
            "size is 4, more than the 3 numbers of the command v; leave size= out",
        ),
        (Observation(terms.command_rotation), "command_rotation needs a command of 7 numbers; v has 3"),
    ],
)
def test_counts_that_do_not_fit_are_refused(term: Observation, message: str) -> None:
    assert refusal(observing, x=term) == f"task Changed: observations.x: {message}"


PLACE = {"observations": {"place": Observation(terms.joint_position)}}
UPDATE = Term(terms.steer_planar_pose_command)
LIMITS = "needs limits of its position, which joint second of robot lacks"
REFUSED: Mapping[str, dict[str, Any]] = {
    "metrics.slide: foot_slide needs as many columns of each of its sensors; feet has 2 and soles has 1": {
        "sensors": {"feet": ContactSensor(bodies=("near", "far")), "soles": Frames(bodies="near")},
        "metrics": {"slide": Metric(terms.foot_slide)},
    },
    "commands.v: velocity_command draws 3 numbers; names= has 2": PLACE
    | {"commands": {"v": Command(terms.velocity_command, **{**VELOCITIES, "names": ("a", "b")})}},
    "commands.v: heading_velocity_command hides 6 numbers, and hidden is 2; leave hidden= out": PLACE
    | {"commands": {"v": Command(terms.heading_velocity_command, **VELOCITIES, heading=TURN, hidden=2)}},
    "commands.v.update: steer_planar_pose_command needs a command of 3 numbers and 3 hidden ones; v has 1 and 3": PLACE
    | {"commands": {"v": Command(terms.number_command, names=("a",), bounds=TURN, update=UPDATE)}},
    f"actions.f: share_of_range_target {LIMITS}": {
        "robot": Robot(MODEL, actuators=SERVOS),
        "actions": {"f": Action(terms.share_of_range_target)},
    },
    f"metrics.m: joint_limit_excess {LIMITS}": {"metrics": {"m": Metric(terms.joint_limit_excess, joints="second")}},
    "metrics.m: joint_effort_excess needs a limit of its force, which joint first of robot lacks": {
        "metrics": {"m": Metric(terms.joint_effort_excess)}
    },
    "events.e: reset_root moves a free root, and that of robot is fixed; leave the term out": {
        "events": {"e": Event(terms.reset_root)}
    },
    "rewards.change: action_rate_squared is called for each action, and a choice has none": {
        "actions": Choice(_choose, names=("left", "right"))
    },
}


@pytest.mark.parametrize("message", REFUSED)
def test_a_term_whose_needs_the_task_does_not_meet_is_refused(message: str) -> None:
    output = refusal(sliders(**REFUSED[message]).sketch, SlidersConfig())
    assert output.startswith(f"task Changed: {message}") and (output.endswith(message) or "slide" not in message)


@wp.struct
class Called:
    values: wp.array2d(dtype=wp.float32)


@wp.struct
class Subscripted:
    values: wp.array2d[wp.float32]


@wp.struct
class RowsAlone:
    values: wp.array[wp.vec3]


def test_both_notations_of_an_array_tell_the_columns_of_a_sensor() -> None:
    assert [has_columns(kind) for kind in (Called, Subscripted, RowsAlone)] == [True, True, False]


def test_a_share_of_the_effort_is_one_of_the_force_on_the_joint() -> None:
    geared = MODEL.replace('gear="2"', 'gear="10" ctrllimited="true" ctrlrange="-1 1"').replace(
        'gear="3"', 'gear="-4" forcelimited="true" forcerange="-0.5 0.5"'
    )
    task = sliders(Robot(geared), actions={"f": Action(terms.limited_effort)})(SlidersConfig(), 1, seed=1)
    task.step(torch.tensor([[0.05, 0.5]]))
    # the greatest forces are 10 N and 4 * 0.5 N, so 0.5 N and 1 N, each over its gear
    assert task.worlds.arrays.controls.numpy()[0].tolist() == pytest.approx([0.05, -0.25])
    assert task.worlds.arrays.drives.numpy()[0].tolist() == pytest.approx([0.5, 1.0])


def _mixed_up(task: Sliders) -> torch.Tensor:
    return torch.arange(2.0 * task.world_count).reshape(2, task.world_count)


def test_a_torch_term_of_another_shape_is_refused_and_a_column_is_accepted() -> None:
    requested = r"observations.a: _mixed_up gives shape \(2, 3\); expected .* shape \(3, 2\) for 3 worlds: set size= "
    with pytest.raises(ValueError, match=requested):
        sliders(observations={"a": Observation(_mixed_up, size=2)})(SlidersConfig(), 3)
    requested = r"terminations.a: _mixed_up gives shape \(2, 3\); expected .* \(3,\) or \(3, 1\) for 3 worlds: reduce "
    with pytest.raises(ValueError, match=requested):
        sliders(terminations={"a": Termination(_mixed_up)})(SlidersConfig(), 3).step(torch.zeros(3, 2))
    task = sliders(terminations={"a": Termination(lambda task: _mixed_up(task)[0, :, None] > 1.0)})(SlidersConfig(), 3)
    task.step(torch.zeros(3, 2))
    assert task.dones.tolist() == [False, False, True]
