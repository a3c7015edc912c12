"""The loop is closed: a bundle's policy in the node, as a process, balances the simulated robot over Zenoh, in real time."""

from __future__ import annotations

import dataclasses
import re
import signal
import socket
import subprocess
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from muster_policy.graph import Node, open_session
from muster_policy.messages import Messages
from tests.conftest import PATIENCE, wait_for
from tests.support.policy_node import Wired, assert_sees_what_the_task_sees
from tests.support.worker.bundles import ENVIRONMENT, NODE, bundle_of
from worker.deploy.simulated_robot import SimulatedRobot, open_robot, play
from worker.learning.algorithm import ExportedPolicy
from worker.settings.cartpole import CartpolePixelsConfig
from worker.settings.errors import UserError
from worker.tasks.library.cartpole import Cartpole, CartpoleConfig
from worker.tasks.library.cartpole_pixels import CartpolePixels
from worker.tasks.run.policy_contract import policy_contract

SECONDS, EPISODES, SEED = 2.0, 3, 11
GAINS = (1.0, 10.0, 1.5, 2.0)
"""Of a linear policy that balances: on the cart's and the pole's position, on their velocities."""


class Linear(nn.Module):
    """``action = gains . observation``."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("gains", torch.tensor(GAINS)[:, None])

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return obs @ self.gains


class Balancing:
    """That policy, as an algorithm gives it."""

    def __init__(self) -> None:
        self.network = Linear()

    def act(self, observations: TensorDict) -> torch.Tensor:
        return self.network(observations["policy"])

    def reset(self, worlds: Any = None) -> None:
        """It remembers nothing."""

    def module(self) -> ExportedPolicy:
        sample = torch.randn(16, 4)
        seen = TensorDict({"policy": sample}, batch_size=[16])
        return ExportedPolicy(self.network, {"obs": sample[:1]}, ["actions"], seen)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.set_num_threads(1)
    task = Cartpole(CartpoleConfig(episode_seconds=SECONDS), 4, seed=1)
    return bundle_of(task, Balancing(), tmp_path_factory.mktemp("cart"), episode_seconds=SECONDS)


def direct(path: Path) -> list[float]:
    """Returns of the episodes that the simulated robot will live through, with the policy in the simulation's own process."""
    task, policy = open_robot(path, Messages(), SEED).task, Balancing()
    returns, total = [], 0.0
    while len(returns) < EPISODES:
        task.step(policy.act(TensorDict(dict(task.groups), batch_size=[1])))
        total += float(task.rewards[0])
        if bool(task.dones[0]):
            returns.append(total)
            total = 0.0
    return returns


@pytest.mark.parametrize("trigger", ["joint_states", "timer"])
def test_the_node_reaches_the_return_of_the_direct_evaluation_in_real_time(
    exported: Path, tmp_path: Path, trigger: str
) -> None:
    requested = direct(exported)
    assert min(requested) > 0.85 * SECONDS * 6.0, "a policy that balances earns up to 6 a second"
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{listening.getsockname()[1]}"
    options = ["--listen", endpoint, "--trigger", trigger, "--timeout", "2"]
    log = tmp_path / "log"
    with log.open("w") as out:
        command = [*NODE, str(exported), *options]
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, env=ENVIRONMENT)
    try:
        wait_for(lambda: "node /muster_policy" in log.read_text(), 30, "the node")
        messages = Messages()
        with open_session(endpoint, None) as session:
            times = 0
            while times < 5:  # until the machine, which others use, too, has kept up with the robot
                times += 1
                robot = open_robot(exported, messages, SEED)
                node = Node(session, messages, name="simulated_robot")
                lines: list[str] = []
                found = play(robot, node, EPISODES, report=lines.append)
                node.close()
                if all(int(steps) < 5 for steps in re.findall(r"(\d+) without a new command", "\n".join(lines))):
                    break
    finally:
        process.send_signal(signal.SIGTERM)
        assert process.wait(30 * PATIENCE) == 0
    output = log.read_text()
    last = output.splitlines()[-1]
    assert " 0 messages ignored" in last and f" {times * EPISODES} resets" in last, output
    assert len(lines) == EPISODES + 2
    # a command now and then comes a control step later on a machine that others use, too
    assert found == pytest.approx(requested, rel=0.05), output


def test_the_node_sees_a_camera_s_images_as_the_task_does() -> None:
    """Two frames, the present one first; episodes of a fifth of a second end in between."""
    task = CartpolePixels(CartpolePixelsConfig(episode_seconds=0.2), 1, seed=2)
    contract = policy_contract(task, "CartpolePixels")
    seen = tuple(group for group in contract.groups if group.name == "policy")
    wired = Wired(SimulatedRobot(task, dataclasses.replace(contract, groups=seen), Messages()))
    assert assert_sees_what_the_task_sees(wired, 30, 1.0) >= 2


def test_a_bundle_whose_task_has_changed_is_refused_as_a_simulated_robot(
    exported: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import worker.tasks.run.policy_contract as contracts
    from shared_store.volume.bundles import read_contract

    assert isinstance(open_robot(exported, Messages()), SimulatedRobot)
    changed = dataclasses.replace(read_contract(exported), control_hz=30.0)
    monkeypatch.setattr(contracts, "policy_contract", lambda *_: changed)
    with pytest.raises(UserError, match="does not fit task Cartpole as it is now: the control rate 60 Hz became 30 Hz"):
        open_robot(exported, Messages())
    with pytest.raises(UserError, match=r"manifest\.json is missing"):
        open_robot(exported.parent, Messages())
