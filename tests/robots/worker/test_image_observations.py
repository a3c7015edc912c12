"""Images beside numbers: declared, observed, kept in the state, learnt from, exported, and refused where they can't be."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
import torch

from orchestrator.spec.model import validate
from orchestrator.spec.settings import effective_problem
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.layout import Store
from tests.support.refusals import refusal
from tests.support.worker.ranks import training
from tests.support.worker.runs import assert_same_bits, last, runner, train
from tests.support.worker.seeing import Seeing, SeeingAlone, SeeingConfig, SeeingDepth
from tests.support.worker.tasks import put
from worker.export import export
from worker.learning import algorithms
from worker.learning.loop import Loop
from worker.learning.ppo.fused import PPO
from worker.settings.errors import UserError
from worker.settings.ppo import PPOConfig
from worker.settings.rsl_rl import RslRlConfig
from worker.settings.sac import SACConfig
from worker.settings.task import Randomization
from worker.simulation.sensors.camera import CameraSensor
from worker.simulation.sensors.imu import Imu
from worker.tasks.__main__ import describe
from worker.tasks.compile.tables import tables
from worker.tasks.declare.declaration import Declaration, Image
from worker.tasks.run.gym import TaskVectorEnv
from worker.tasks.run.policy_contract import images_of

torch.set_num_threads(1)
NAME = "tests.support.worker.seeing:Seeing"


@pytest.fixture(scope="module")
def seeing() -> Seeing:
    return Seeing(SeeingConfig(), 4, seed=1)


@pytest.fixture(scope="module")
def depth() -> SeeingDepth:
    return SeeingDepth(SeeingConfig(), 3, seed=2)


def test_numbers_and_images_stand_side_by_side(seeing: Seeing) -> None:
    shapes = {name: (tuple(group.shape), group.dtype) for name, group in seeing.groups.items()}
    assert shapes == {
        "policy": ((4, 1), torch.float32),
        "critic": ((4, 1), torch.float32),
        "camera": ((4, 6, 12, 16), torch.uint8),
    }
    assert set(seeing.terminal_groups) == {"policy", "critic"}
    put(seeing, joint_q=[[0.0], [0.5], [-0.5], [0.0]], joint_qd=[[0.0]] * 4)
    seeing.step(torch.zeros(4, 1))
    blue = [
        (image[2].float() > 2 * image[0].float()).nonzero()[:, 1].float().mean() for image in seeing.groups["camera"]
    ]
    # the box is to the right of a cart on the left, of which +y is
    assert blue[2] < blue[0] < blue[1] and blue[0] == blue[3]
    before = seeing.groups["camera"].clone()
    seeing.step(torch.ones(4, 1))
    assert torch.equal(seeing.groups["camera"][:, 3:], before[:, :3])
    seeing.reset()
    assert torch.equal(seeing.groups["camera"][:, 3:], seeing.groups["camera"][:, :3])


def test_a_term_reads_depth_in_metres_of_the_image_just_taken(depth: SeeingDepth) -> None:
    for _ in range(3):
        depth.step(torch.ones(3, 1))
        camera = depth.sensors["front"].arrays
        # the box's face is at 2.15 m; the cart's x stays 0
        assert depth.groups["policy"][:, 1].numpy() == pytest.approx(2.15 - camera.poses.numpy()[:, 0], abs=1e-5)
        assert np.array_equal(depth.groups["policy"][:, 1].numpy(), camera.depths.numpy()[:, 6, 8])
    places = camera.poses.numpy()[:, 0].copy()
    assert len(set(places)) == 3 and (np.abs(places - 0.25) <= 0.1).all()
    for _ in range(30):
        depth.step(torch.zeros(3, 1))
    assert not np.isin(depth.sensors["front"].arrays.poses.numpy()[:, 0], places).any(), "drawn anew at a reset"


def test_images_go_on_bit_for_bit(depth: SeeingDepth) -> None:
    actions = torch.linspace(-1.0, 1.0, 3).unsqueeze(1)
    for _ in range(4):
        depth.step(actions)
    saved = depth.state_dict()
    assert {"sensor_front_images", "sensor_front_mounts", "sensor_front_depths"} <= set(saved)

    def go_on() -> list[torch.Tensor]:
        seen = []
        for _ in range(35):  # over the end of an episode
            depth.step(actions)
            seen += [group.clone() for group in depth.groups.values()] + [depth.rewards.clone()]
        return seen

    straight = go_on()
    depth.reset()
    depth.load_state_dict(saved)
    assert all(torch.equal(one, two) for one, two in zip(straight, go_on(), strict=True))


def run(path: Path, name: str, iterations: int, epoch: int = 1) -> Loop:
    env = training(path, run=name, iterations=iterations, epoch=epoch, worlds=4, task=NAME, algorithm="rsl_rl")
    return train(env, task=Seeing)


def test_rsl_rl_learns_from_both_resumes_with_the_same_bits_and_exports(tmp_path: Path) -> None:
    straight = run(tmp_path, "straight", 3)
    actor: Any = straight.algorithm.algorithm.actor
    gradients = {name: weight.grad for name, weight in actor.named_parameters() if weight.grad is not None}
    assert any(name.startswith("cnns.camera") and each.abs().max() > 0 for name, each in gradients.items())
    first: Any = next(each for name, each in gradients.items() if name.startswith("mlp"))
    # behind the one number of the state come those that the convolutions make
    assert first[:, 0].abs().max() > 0 and first[:, 1:].abs().max() > 0
    run(tmp_path, "stopped", 2)
    run(tmp_path, "stopped", 3, epoch=2)
    assert_same_bits(last(tmp_path, "straight"), last(tmp_path, "stopped"))
    store = Store(tmp_path).run("straight")
    target = export(store, list_checkpoints(store)[-1], straight.task)  # compares the files with the policy itself
    reported = json.loads((target / "contract.json").read_text())
    numbers, camera = reported["groups"]
    assert [(each["name"], each["input"], each["shape"]) for each in reported["groups"]] == [
        ("policy", "obs", [1]),
        ("camera", "camera", [6, 12, 16]),
    ]
    assert (camera["image"]["channels"], camera["image"]["frames"]) == (["red", "green", "blue"], 2)
    assert camera["image"]["camera"]["body"] == "cart" and numbers["terms"][0]["names"] == ["rail_velocity"]
    import onnx

    graph = onnx.load(str(target / "policy.onnx")).graph
    kinds = {each.name: each.type.tensor_type.elem_type for each in graph.input}
    assert kinds == {"obs": onnx.TensorProto.FLOAT, "camera": onnx.TensorProto.UINT8}


def test_a_job_with_images_and_numbers_is_accepted_and_its_groups_are_checked_at_the_submission() -> None:
    train = {"task": NAME, "worlds": 4, "iterations": 2, "algorithm": "rsl_rl"}
    groups = {"obs_groups": {"actor": ["policy", "camera"]}}
    spec = validate(
        {"name": "seeing", "resources": {"cpus": 1, "memory": "1GiB"}, "train": {**train, "rsl_rl": groups}}, "job.yaml"
    )
    assert spec.train is not None
    config = SeeingConfig()
    assert config.observation_groups == {"policy": False, "critic": False, "camera": True}
    assert effective_problem(RslRlConfig, "rsl_rl", config, groups) is None
    wrong = effective_problem(RslRlConfig, "rsl_rl", config, {"obs_groups": {"actor": ["policy", "camrea"]}})
    assert wrong is not None
    assert "there is no observation group 'camrea'; available: policy, critic, camera" in wrong[1]
    wrong = effective_problem(SACConfig, "sac", config, {"critic_group": "camera"})
    assert wrong is not None and "it can't learn from images, and observation group 'camera' is one" in wrong[1]


def test_ppo_takes_the_numbers_and_refuses_images_that_the_policy_does_not_see(tmp_path: Path) -> None:
    def loop(**ppo: Any) -> Loop:
        return runner(training(tmp_path, worlds=4, task=NAME, ppo=ppo), task=Seeing)

    assert loop().algorithm.rollout.actor.observations.shape[2:] == (1,)
    with pytest.raises(UserError, match="critic_observations: expected 'policy' or 'critic', found 'camera'"):
        loop(critic_observations="camera")
    assert algorithms.settings(PPO, "ppo", SeeingConfig(), {}) == PPOConfig(
        steps=4, hidden_sizes=(8,), minibatches=1, epochs=1
    )


def test_a_policy_may_see_an_image_alone() -> None:
    alone = SeeingAlone(SeeingAlone.config_type(), 2, seed=1)
    assert alone.observation_shape == (6, 12, 16) and alone.observations is alone.groups["policy"]
    assert alone.groups["critic"].shape == (2, 1) and set(alone.terminal_groups) == {"critic"}
    assert alone.config.observation_groups == {"policy": True, "critic": False}
    assert set(tables(alone.plan)) >= {"observations", "observations of critic"}
    assert images_of(alone)["policy"]["sensor"] == "front"
    space = TaskVectorEnv("tests.support.worker.seeing:SeeingAlone", 2).single_observation_space
    assert space == gymnasium.spaces.Box(0, 255, (6, 12, 16), np.uint8)


def test_the_list_of_tasks_describes_images() -> None:
    reported = describe(NAME, whole=True)
    words = "2 x color of 16 x 12 bytes, the present one first"
    assert reported["observations"] == ["rail_velocity", f"camera: {words}"]
    assert reported["tables"]["observations of camera"] == [{"camera": "front", "image": words}]
    assert reported["tables"]["sensors"][0]["kind"] == "CameraSensor"
    assert describe("tests.support.worker.seeing:SeeingAlone")["observations"] == [f"image: {words}"]
    assert describe("tests.support.worker.seeing:SeeingDepth")["observations"][2:] == [
        "camera: 1 x depth from 0.05 to 4 m of 16 x 12 bytes, the present one first"
    ]


def test_gymnasium_sees_a_dictionary() -> None:
    worlds = TaskVectorEnv(NAME, 2, episode_seconds=0.05)
    first, _ = worlds.reset(seed=1)
    assert isinstance(worlds.single_observation_space, gymnasium.spaces.Dict)
    assert worlds.observation_space.contains(first) and set(first) == {"policy", "camera"}
    seen: Any = first
    for _ in range(3):
        before = seen
        seen, _, _, truncated, info = worlds.step(np.ones((2, 1), np.float32))
    assert truncated.all() and np.array_equal(info["final_obs"][0]["camera"], before["camera"][0])
    assert info["final_obs"][0]["policy"] == worlds.task.terminal_observations[0].numpy()
    worlds.close()


def test_scenes_differ_as_the_configuration_asks() -> None:
    plain = Seeing(SeeingConfig(spread=0.0), 2, seed=3).groups["camera"]
    assert torch.equal(plain[0], plain[1]), "the same start, the same image"
    for scene in ({"camera_position": 0.3}, {"camera_angle": 0.1}, {"colors": 0.5}, {"light": (0.4, 0.9)}):
        config = SeeingConfig(spread=0.0, randomize=Randomization(**scene))
        images = Seeing(config, 3, seed=3).groups["camera"].clone()
        assert not torch.equal(images[0], images[1]), scene
        assert torch.equal(images[2:], Seeing(config, 1, seed=3, first_world=2).groups["camera"]), "not the rank's"
    noisy = SeeingConfig(randomize=Randomization(observation_noise=0.1))
    assert Seeing.sketch(noisy).plan.groups["critic"], "numbers beside images may be noisy"


def declared(config: SeeingConfig, observations: Mapping[str, Any], sensors: Mapping[str, Any]) -> None:
    """Bind a declaration like that of :class:`Seeing` with other observations and sensors."""

    class Other(Seeing):
        def declare(self, config: Any) -> Declaration:
            usual = super().declare(config)
            return Declaration(usual.actions, observations, usual.rewards, events=usual.events, sensors=sensors)

    Other.sketch(config)


SEEING, FRONT = SeeingConfig(), {"front": CameraSensor()}
NUMBERS = Seeing.sketch(SEEING).declaration.groups["policy"]


class Plain(SeeingConfig):
    further_groups: ClassVar[Mapping[str, bool]] = MappingProxyType({})


REFUSED: Mapping[str, tuple[SeeingConfig, Any, dict[str, Any]]] = {
    "observations.camera: it is an image, and Plain does not declare it": (Plain(), Image("front"), FRONT),
    "there is no camera 'frnt'; did you mean front": (SEEING, Image("frnt"), FRONT),
    "there is no camera 'front'; the task declares none; give it a CameraSensor": (SEEING, Image("front"), {}),
    "the sensor imu is not a camera; ": (SEEING, Image("imu"), {"imu": Imu(body="cart"), **FRONT}),
    "SeeingConfig.further_groups says that it is an image, and the task gives terms": (SEEING, NUMBERS, {}),
    "SeeingConfig.further_groups has camera, and the task declares no such group": (SEEING, None, {}),
}


@pytest.mark.parametrize("words", REFUSED)
def test_a_group_of_images_that_does_not_fit_is_refused_in_one_line(words: str) -> None:
    config, camera, sensors = REFUSED[words]
    groups = {"policy": NUMBERS} | ({"camera": camera} if camera is not None else {})
    assert words in refusal(declared, config, groups, sensors)


def test_images_need_numbers_beside_them() -> None:
    for observations, words in (
        ({"policy": Image("front")}, "the policy sees an image alone; give a group critic of terms besides"),
        ({**NUMBERS, "front": Image("front")}, "observations.front: an Image is a group of its own"),
    ):
        assert words in refusal(declared, SeeingConfig(), observations, FRONT)
