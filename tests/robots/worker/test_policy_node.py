"""What the policy node sees of a robot's messages is what the task sees, and its commands do what the task's actions do."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import pytest

from muster_policy.messages import Messages
from tests.support.policy_node import Wired, assert_sees_what_the_task_sees
from worker.deploy.simulated_robot import SimulatedRobot
from worker.tasks import Observation, find_task, terms
from worker.tasks.declare.declaration import Declaration
from worker.tasks.library.quadruped import Quadruped, QuadrupedConfig
from worker.tasks.run.policy_contract import policy_contract

EXACT = {
    f"observations.{name}.noise": 0.0
    for name in ("base_lin_vel", "base_ang_vel", "projected_gravity", "joint_pos", "joint_vel")
}


class Everything(Quadruped):
    """A quadruped that sees all that the node can measure of a root and its joints, with history, clips and offsets."""

    def declare(self, config: QuadrupedConfig) -> Declaration:
        """Its observations alone are other ones."""
        shown: Mapping[str, Observation] = {
            "height": Observation(terms.root_height, offset=0.3, scale=2.0),
            "place": Observation(terms.root_position),
            "turn": Observation(terms.root_orientation),
            "heading": Observation(terms.heading),
            "up": Observation(terms.root_uprightness),
            "down": Observation(terms.projected_gravity, history=3),
            "speed": Observation(terms.root_linear_velocity, clip=(-0.3, 0.3)),
            "centre": Observation(terms.root_com_linear_velocity),
            "speed_there": Observation(terms.root_linear_velocity_in_world),
            "centre_there": Observation(terms.root_com_linear_velocity_in_world),
            "turning": Observation(terms.root_angular_velocity, scale=(0.25, 0.5, 1.0)),
            "legs": Observation(terms.joint_offset, joints="*_knee"),
            "rates": Observation(terms.joint_velocity, joints="front_*", history=2, clip=(-5.0, 5.0)),
            "asked": Observation(terms.last_action, history=2),
            "command": Observation(terms.command_vector),
        }
        return dataclasses.replace(super().declare(config), observations=shown)


def test_the_contract_names_frames_of_measurement_and_library_functions() -> None:
    """As the files of the robots have it: the Go1's unit sits on the trunk, to the right; the quadruped's centre of mass is its origin."""
    task = find_task("Go1Flat")
    (group, *_) = policy_contract(task(task.config_type(), 1), "Go1Flat").groups
    terms_of = {term.name: term for term in group.terms}
    unit = terms_of["base_lin_vel"].frame
    assert unit is not None and (unit.name, unit.body, unit.root) == ("imu", "trunk", True)
    assert unit.position == pytest.approx((-0.01592, -0.06659, -0.00617), abs=1e-6)
    down = terms_of["projected_gravity"].frame
    assert down is not None and (down.name, down.position) == ("trunk", (0.0, 0.0, 0.0))
    assert terms_of["joint_pos"].frame is None and all(term.library for term in group.terms)
    ant = find_task("Ant")
    (group, *_) = policy_contract(ant(ant.config_type(), 1), "Ant").groups
    reported = {term.quantity: term.library for term in group.terms}
    assert reported["root_height"] and not reported["attitude"], "the task's own function"


def wired(task: Any, name: str) -> Wired:
    contract = policy_contract(task, name)
    seen = tuple(group for group in contract.groups if group.name != "critic")
    return Wired(SimulatedRobot(task, dataclasses.replace(contract, groups=seen), Messages()))


@pytest.mark.parametrize("name", ["Go1Flat", "G1Flat"])
def test_the_node_sees_what_a_robot_s_task_sees(name: str) -> None:
    """Noise is off; episodes of half a second end in between, and the motors' encoders have their bias."""
    task_type = find_task(name)
    task = task_type(task_type.config_type(numbers=EXACT, episode_seconds=0.5), 1, seed=3)
    existing = wired(task, name)
    assert existing.observations.needs == {"joint_states", "imu", "odom"}
    assert assert_sees_what_the_task_sees(existing, 60, 0.3) >= 2


def test_the_node_sees_all_that_odometry_and_an_imu_tell() -> None:
    task = Everything(QuadrupedConfig(episode_seconds=0.5), 1, seed=4)
    assert assert_sees_what_the_task_sees(wired(task, "Everything"), 60, 0.5) >= 2
