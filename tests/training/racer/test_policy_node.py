"""The policy node drives a car."""

from __future__ import annotations

import dataclasses
import subprocess
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from muster_policy.actions import Commands
from muster_policy.bundle import open_bundle
from muster_policy.policy import Policy as NodePolicy
from racer.car.task import RacerPixels
from racer.settings.task import FrontCameraConfig, RacerPixelsConfig
from tests.support.worker.bundles import ENVIRONMENT, NODE, bundle_of
from tests.support.worker.loop import setting_of
from worker.learning.algorithms import find_algorithm
from worker.learning.setup import spaces_of


def test_the_node_drives_a_car_whose_policy_chooses_among_actions(tmp_path: Path) -> None:
    """Its choices of the camera's images are the trained policy's, and what it commands is what reaches the car."""
    space = {"action_space": [{"steering_angle": angle, "speed": 1.0} for angle in (-30, -10, 10, 30)]}
    config = RacerPixelsConfig(action_space=space, front=FrontCameraConfig(width=64, height=48))
    task = RacerPixels(config, 4, seed=1)
    setting = dataclasses.replace(setting_of(task, seed=5), spaces=spaces_of(task))
    policy = find_algorithm("ppo")(config.ppo, setting).policy()
    path = bundle_of(task, policy, tmp_path)
    checked = subprocess.run([*NODE, str(path), "--check"], capture_output=True, text=True, env=ENVIRONMENT)
    assert checked.returncode == 0, checked.stdout + checked.stderr

    opened = open_bundle(path)
    node, commands = NodePolicy(opened), Commands(opened.contract)
    assert node.self_test(opened.parity) == 0.0 and commands.joints == ["steering", "speed"]
    task.reset()
    for _ in range(5):
        images = task.groups["policy"]
        chosen = node.act({"obs": images.numpy()})
        np.testing.assert_array_equal(chosen, policy.act(TensorDict(dict(task.groups), batch_size=[4])).numpy())
        task.step(torch.from_numpy(chosen))
        request = [commands.command(each).values for each in chosen]
        np.testing.assert_allclose(request, task.sensors["car"].arrays.commands.numpy(), rtol=1e-6)
