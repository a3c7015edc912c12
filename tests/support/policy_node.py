"""The policy node without a network: bundles made by hand, and messages that go from a simulated robot to the node's observations."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from muster_policy.actions import Commands
from muster_policy.contract import Contract as NodeContract
from muster_policy.contract import read
from muster_policy.inputs import Inputs
from muster_policy.messages import Messages
from muster_policy.observations import Observations
from shared_store.contract.policy import Contract
from shared_store.volume.bundles import seal


def for_node(contract: Contract) -> NodeContract:
    """A contract as the node reads it."""
    return read(json.dumps(contract.document()).encode(), "contract.json")


def linear_model(weights: np.ndarray, recurrent: bool = False) -> bytes:
    """``actions = obs @ weights``, as ONNX; recurrent: of the sum of all observations since it was reset, the state ``total``."""
    size, count = weights.shape
    shapes = {"obs": ["n", size], "actions": ["n", count], "total": ["n", size], "total_out": ["n", size]}
    known = {name: helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in shapes.items()}
    nodes = [helper.make_node("MatMul", ["obs", "weights"], ["actions"])]
    inputs, outputs = ["obs"], ["actions"]
    if recurrent:
        nodes = [
            helper.make_node("Add", ["obs", "total"], ["total_out"]),
            helper.make_node("MatMul", ["total_out", "weights"], ["actions"]),
        ]
        inputs, outputs = ["obs", "total"], ["actions", "total_out"]
    graph = helper.make_graph(
        nodes,
        "policy",
        [known[name] for name in inputs],
        [known[name] for name in outputs],
        [numpy_helper.from_array(weights.astype(np.float32), "weights")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.checker.check_model(model)
    data: bytes = model.SerializeToString()
    return data


def write_bundle(folder: Path, contract: Contract, weights: np.ndarray, parity: np.ndarray | None = None) -> Path:
    """A sealed bundle of a linear policy.

    Args:
        folder: Which does not exist.
        contract: Of one group; with a state ``total`` the policy is recurrent.
        weights: Shape ``(observations, actions)``.
        parity: Actions of its recording, shape ``(2, 3, actions)``; None: the right ones.
    """
    folder.mkdir(parents=True)
    recurrent = bool(contract.states)
    seen = np.random.default_rng(1).standard_normal((2, 3, len(weights)), dtype=np.float32)
    begins = np.array([[True] * 3, [False, True, False]])
    total = seen.copy()
    if recurrent:
        total[1] += np.where(begins[1][:, None], 0.0, seen[0])
    right = total @ weights.astype(np.float32)
    np.savez(folder / "parity.npz", obs=seen, begins=begins, actions=right if parity is None else parity)
    (folder / "policy.onnx").write_bytes(linear_model(weights, recurrent))
    (folder / "contract.json").write_text(json.dumps(contract.document()))
    seal(folder, {"run": "by-hand", "checkpoint": "00000001-e1", "train": {}})
    return folder


class Wired:
    """A simulated robot and the node's observations with the wire's bytes between them, and no network.

    Args:
        robot: A :class:`worker.deploy.simulated_robot.SimulatedRobot`.
    """

    def __init__(self, robot: Any) -> None:
        self.robot, self.messages = robot, Messages()
        self.contract = for_node(robot.contract)
        self.observations = Observations(self.contract)
        self.commands = Commands(self.contract)
        self.inputs = Inputs(self.observations, self.messages)
        self._ears = {each.topic: self.inputs.hear(each, each.topic) for each in self.inputs.all}
        self.actions = torch.zeros_like(robot.task.actions)

    def observed(self, now: float = 0.0) -> dict[str, np.ndarray]:
        """The policy's inputs by name, from what the robot says now."""
        for topic, kind, message in self.robot.measured(0):
            if topic in self._ears:
                self._ears[topic](self.messages.encode(message, kind), kind, self.messages.type_hash(kind))
        self.inputs.update()
        assert not self.inputs.missing() and not self.inputs.complaints()
        return self.observations.build(self.inputs.snapshot(now))

    def act(self, action: Sequence[float]) -> None:
        """Let the robot do what the policy asks for, by joint commands."""
        requested = np.asarray(action, np.float32)
        self.observations.acted(requested)
        for message in self.commands.joint_states(self.commands.command(requested), self.messages, 0):
            data = self.messages.encode(message, "sensor_msgs/msg/JointState")
            received = self.messages.decode(data, "sensor_msgs/msg/JointState")
            values = next(each for each in (received.position, received.velocity, received.effort) if len(each))
            self.actions = self.robot.actions(list(received.name), values, self.actions)
        self.robot.task.step(self.actions)
        if bool(self.robot.task.dones[0]):
            self.observations.reset()


def assert_sees_what_the_task_sees(wired: Wired, steps: int, size: float) -> int:
    """The node's observations and commands are the task's, step by step; returns the episodes that ended.

    Args:
        wired: Robot and node.
        steps: How many control steps.
        size: Greatest of the random actions, which are evenly distributed; within their clips.
    """
    task, random, ended = wired.robot.task, np.random.default_rng(3), 0
    names = {group.input: group.name for group in wired.contract.groups}
    for step in range(steps):
        for name, found in wired.observed().items():
            requested = task.groups[names[name]][:1].numpy()
            assert found.dtype == requested.dtype and found.shape == requested.shape
            np.testing.assert_allclose(found, requested, rtol=1e-5, atol=1e-5, err_msg=f"{name} in step {step}")
        action = random.uniform(-size, size, task.action_size)
        wired.act(action)
        np.testing.assert_allclose(task.actions[0].numpy(), action, rtol=1e-5, atol=1e-5)
        ended += int(task.dones[0])
    return ended
