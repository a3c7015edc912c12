"""``python -m worker.deploy.simulated_robot BUNDLE``: one world of a bundle's task as a robot on ROS 2's wire, in real time.

It publishes what a robot's drivers would (joint states, IMU, odometry, images, the task's commands as the operator's, the clock), takes
joint commands, resets itself where an episode ends, has the policy node begin a fresh episode then, and tells each episode's return.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp

from shared_store.contract.error_text import counted
from shared_store.contract.policy import Contract
from shared_store.volume.bundles import DamagedBundle, read_contract, verify
from worker.learning.job import configure, run_command, user_errors
from worker.settings.accepted_changes import CHANGED_ROBOTS
from worker.settings.errors import UserError

if TYPE_CHECKING:
    from muster_policy.messages import Messages
    from worker.tasks.run.task import Task

Message = tuple[str, str, Any]
"""Topic, ROS type and message."""
JOINT_STATE = "sensor_msgs/msg/JointState"
PATIENCE = 5.0
"""Seconds between two lines while no commands arrive."""
NOT_MEASURED = np.array([-1.0] + [0.0] * 8)
"""Covariance of what a sensor does not measure, as ROS has it."""


class SimulatedRobot:
    """One world of a task as the messages of a robot.

    Args:
        task: One world on the CPU.
        contract: What its policy sees and does.
        messages: Types of a ROS distribution.
    """

    def __init__(self, task: Task, contract: Contract, messages: Messages) -> None:
        self.task, self.contract, self.messages = task, contract, messages
        self._view = task.views["robot"]
        self._arrays = task.robots["robot"]
        units = [term.frame for group in contract.groups for term in group.terms if term.quantity.startswith("imu_")]
        mount = next((frame.rotation for frame in units if frame is not None and frame.root), (0.0, 0.0, 0.0, 1.0))
        self._mount = np.array(mount)
        self._scale = np.array([action.scale for action in contract.actions])
        self._offset = np.array([action.offset for action in contract.actions])
        self._columns = {action.name: index for index, action in enumerate(contract.actions)}

    def measured(self, nanoseconds: int) -> list[Message]:
        """Its sensors' present values, the joint states last: a policy that acts on their arrival has all the others."""
        from muster_policy.observations import image_topic

        found: list[Message] = []
        if self._view.root_coordinate >= 0:
            found += self._root(nanoseconds)
        found += self._commands()
        for group in self.contract.groups:
            if group.image is not None:
                image = self._image(group.name, len(group.image.channels))
                found.append((image_topic(group.name), "sensor_msgs/msg/Image", image))
        view, arrays = self._view, self.task.worlds.arrays
        positions = arrays.joint_q.numpy()[0, view.coordinates] + self._arrays.encoder_bias.numpy()[0]
        joints = self.messages.make(
            JOINT_STATE,
            header=self.messages.header(nanoseconds),
            name=list(view.joint_names),
            position=positions.astype(np.float64),
            velocity=arrays.joint_qd.numpy()[0, view.dofs].astype(np.float64),
            effort=np.zeros(0),
        )
        return [*found, ("joint_states", JOINT_STATE, joints)]

    def actions(self, names: list[str], values: np.ndarray, before: torch.Tensor) -> torch.Tensor:
        """The task's actions that joint commands stand for, shape ``(1, actions)``.

        Args:
            names: Of the joints.
            values: Commands [unit of each action].
            before: Actions of the joints that are not named.
        """
        found = before.clone()
        for name, value in zip(names, values, strict=True):
            column = self._columns[name]
            found[0, column] = float((value - self._offset[column]) / self._scale[column])
        return found

    def _root(self, nanoseconds: int) -> list[Message]:
        """IMU and odometry from the pose and velocities of the free root."""
        from muster_policy.observations import matrix

        make, header, vector = self.messages.make, self.messages.header, self.messages.vector
        view, arrays, coms = self._view, self.task.worlds.arrays, self.task.worlds.model.body_com
        pose = arrays.joint_q.numpy()[0, view.root_coordinate : view.root_coordinate + 7].astype(np.float64)
        velocity = arrays.joint_qd.numpy()[0, view.root_dof : view.root_dof + 6].astype(np.float64)
        assert coms is not None
        com = coms.numpy().reshape(-1, 3)[view.root_body].astype(np.float64)
        turn, zeros = matrix(pose[3:]), np.zeros(9)
        angular = turn.T @ velocity[3:]
        linear = turn.T @ velocity[:3] - np.cross(angular, com)
        imu = make(
            "sensor_msgs/msg/Imu",
            header=header(nanoseconds, "imu"),
            orientation=self.messages.quaternion(_times(pose[3:], self._mount)),
            orientation_covariance=zeros,
            angular_velocity=vector(matrix(self._mount).T @ angular),
            angular_velocity_covariance=zeros,
            linear_acceleration=vector(np.zeros(3)),
            linear_acceleration_covariance=NOT_MEASURED,
        )
        x, y, z = pose[:3].tolist()
        position = make("geometry_msgs/msg/Point", x=x, y=y, z=z)
        placed = make("geometry_msgs/msg/Pose", position=position, orientation=self.messages.quaternion(pose[3:]))
        twist = self.messages.twist(linear, angular)
        odometry = make(
            "nav_msgs/msg/Odometry",
            header=header(nanoseconds, "odom"),
            child_frame_id=view.body_names[0],
            pose=make("geometry_msgs/msg/PoseWithCovariance", pose=placed, covariance=np.zeros(36)),
            twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )
        return [("imu", "sensor_msgs/msg/Imu", imu), ("odom", "nav_msgs/msg/Odometry", odometry)]

    def _commands(self) -> list[Message]:
        from muster_policy.observations import command_topic, is_twist

        found: list[Message] = []
        described: dict[str, Any] = {command.name: command for command in self.contract.commands}
        for name, first in self.task.plan.binder.commands.items():
            command = described[name]
            memory = self.task.state_tensors()["memory"][0, first : first + len(command.names)]
            numbers = memory.double().tolist()
            if is_twist(command):
                twist = self.messages.twist((*numbers[:2], 0.0), (0.0, 0.0, numbers[2]))
                found.append((command_topic(command), "geometry_msgs/msg/Twist", twist))
            else:
                found.append((command_topic(command), "std_msgs/msg/Float64MultiArray", self.messages.array(numbers)))
        return found

    def _image(self, group: str, channels: int) -> Any:
        pixels = self.task.groups[group][0, :channels].numpy().transpose(1, 2, 0)
        height, width, _ = pixels.shape
        return self.messages.make(
            "sensor_msgs/msg/Image",
            header=self.messages.header(0, "camera"),
            height=height,
            width=width,
            encoding="rgb8" if channels == 3 else "mono8",
            is_bigendian=0,
            step=width * channels,
            data=np.ascontiguousarray(pixels).ravel(),
        )


def _times(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Product of two quaternions xyzw."""
    a, b = first[:3], second[:3]
    w = first[3] * second[3] - a @ b
    return np.append(first[3] * b + second[3] * a + np.cross(a, b), w)


def play(
    robot: SimulatedRobot, node: Any, episodes: int, speed: float = 1.0, report: Callable[[str], None] = print
) -> list[float]:
    """Be a robot on the network until so many episodes have ended.

    Args:
        robot: The robot.
        node: A :class:`muster_policy.graph.Node`.
        episodes: How many.
        speed: Simulated seconds in a second.
        report: Called with each line.

    Returns:
        Return of each episode.
    """
    task, messages = robot.task, node.messages
    publishers: dict[str, Any] = {}
    newest: list[tuple[list[str], np.ndarray]] = []

    def commanded(data: bytes, kind: str, type_hash: str) -> None:
        message = messages.decode(data, JOINT_STATE)
        values = next(each for each in (message.position, message.velocity, message.effort) if len(each))
        newest.append((list(message.name), values))

    def publish(topic: str, kind: str, message: Any) -> None:
        if topic not in publishers:
            publishers[topic] = node.publisher(topic, kind)
        publishers[topic].publish(message)

    node.subscribe("joint_commands", JOINT_STATE, commanded)
    empty = messages.make("std_msgs/msg/Empty", structure_needs_at_least_one_member=0)
    reset = node.publisher("/muster_policy/reset", "std_msgs/msg/Empty")
    period = 1.0 / task.config.control_hz
    actions, total, late, steps = torch.zeros_like(task.actions), 0.0, 0, 0
    returns: list[float] = []
    simulated, is_commanded = 0, False
    deadline = time.monotonic()
    patience = deadline + PATIENCE
    while len(returns) < episodes:
        simulated += round(period * 1e9)
        clock = messages.make("rosgraph_msgs/msg/Clock", clock=messages.stamp(simulated))
        for message in (("/clock", "rosgraph_msgs/msg/Clock", clock), *robot.measured(time.time_ns())):
            publish(*message)
        deadline = max(deadline + period / speed, time.monotonic())
        time.sleep(max(0.0, deadline - time.monotonic()))
        if not is_commanded:
            if newest:
                is_commanded = True
                report("the first command has come")
            else:
                if time.monotonic() > patience:
                    patience = time.monotonic() + PATIENCE
                    report(
                        "no joint_commands yet; is a policy node there, and on the same router? muster-policy BUNDLE"
                    )
                continue
        late += not newest
        while newest:
            actions = robot.actions(*newest.pop(0), actions)
        task.step(actions)
        steps += 1
        total += float(task.rewards[0])
        if bool(task.dones[0]):
            returns.append(total)
            lateness = f"{counted(steps, 'step')}, {late} without a new command"
            report(f"episode {len(returns)} of {episodes}: return {total:.2f}, {lateness}")
            total, late, steps = 0.0, 0, 0
            actions = torch.zeros_like(actions)
            newest.clear()
            reset.publish(empty)
    report(f"mean return {np.mean(returns):.2f} of {counted(len(returns), 'episode')}")
    return returns


def open_robot(bundle: Path, messages: Messages, seed: int = 0, *, accept: bool = False) -> SimulatedRobot:
    """The robot of a bundle's task, with the configuration of the training.

    Raises:
        UserError: The bundle is damaged, its task is not here, means something else by now, or has no declared robot; or the robot
            changed, and ``accept`` is false.
    """
    from worker.learning.setup import check_fit, check_robots
    from worker.tasks import find_task
    from worker.tasks.run.policy_contract import policy_contract, same_policy

    try:
        manifest, contract = verify(bundle), read_contract(bundle)
    except DamagedBundle as error:
        raise UserError(str(error)) from error
    with user_errors("task"):
        task_type = find_task(contract.task)
    CHANGED_ROBOTS.set(accept)
    with user_errors():
        task = task_type(configure(task_type, manifest["train"]), 1, seed=seed, device="cpu")
    if task.discrete or any(action.rule or not action.scale for action in contract.actions):
        raise UserError(f"task {contract.task}: joint commands can't be turned back into its actions")
    now, of = same_policy(policy_contract(task, contract.task), contract), f"bundle {bundle}"
    if changes := check_fit(contract, now, of, check_robots(contract, task, of, accept=accept)):
        print(f"warning: {changes}", flush=True)
    return SimulatedRobot(task, replace(contract, actions=now.actions), messages)


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python -m worker.deploy.simulated_robot",
        description="Be a simulated robot on ROS 2's wire, for the policy node of a bundle.",
        epilog="example: muster-policy cart-policy --listen tcp/localhost:7447 & python -m worker.deploy.simulated_robot cart-policy",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("bundle", type=Path, help="directory of a bundle")
    accept = "go on where the robot's file loads otherwise than in the training"
    add("--accept-changed-robot", action="store_true", help=accept)
    add("--episodes", type=int, default=10, help="end after so many (default: 10)")
    add("--speed", type=float, default=1.0, help="simulated seconds in a second (default: 1)")
    add("--seed", type=int, default=0, help="of the world (default: 0)")
    add("--connect", default="tcp/localhost:7447", help="the router (default: tcp/localhost:7447)")
    add("--listen", default=None, help="be a router on this endpoint")
    add("--domain", type=int, default=0, help="ROS domain (default: 0)")
    options = parser.parse_args()
    if options.episodes < 1 or not 0.0 < options.speed <= 100.0:
        raise UserError("--episodes must be 1 or more, --speed above 0 and at most 100")
    try:
        from muster_policy.errors import Refused
        from muster_policy.graph import Node, open_session
        from muster_policy.messages import Messages
    except ModuleNotFoundError as error:
        raise UserError(f"{error.name} is not installed; pip install ./policy_node") from error
    warp.config.log_level = warp.LOG_WARNING  # not a line for each kernel module
    messages = Messages()
    robot = open_robot(options.bundle, messages, options.seed, accept=options.accept_changed_robot)
    try:
        connect = None if options.listen else options.connect
        with open_session(connect, options.listen) as session:
            node = Node(session, messages, options.domain, "/", "simulated_robot")
            print(f"simulated robot of {robot.contract.task}: it waits for joint_commands", flush=True)
            try:
                play(robot, node, options.episodes, options.speed, lambda line: print(line, flush=True))
            finally:
                node.close()
    except Refused as error:
        raise UserError(str(error)) from error
    return 0


if __name__ == "__main__":
    run_command(main)
