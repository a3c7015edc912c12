"""What may become of a policy outside training: it is read back, and exported with all that a robot needs, or refused in one line."""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
import yaml
from tensordict import TensorDict
from torch import nn

import worker.tasks.library
from shared_store.contract.policy import Action, Command, Contract, Group, State, Term
from shared_store.volume.bundles import verify
from shared_store.volume.layout import Run
from tests.support.worker.rsl_loop import GRU, GroupedPoint, build, train
from tests.support.worker.sac import make, point
from worker.deploy import bundle
from worker.deploy.bundle import _publish, bundle_files
from worker.deploy.model_file import OnnxPolicy, leapp_description, metadata_of, to_onnx
from worker.deploy.parity import RecordedObservations, judge
from worker.evaluation.episodes import Episodes
from worker.learning.algorithm import ExportedPolicy
from worker.learning.trained import load_policy
from worker.settings.errors import TrainingError, UserError
from worker.tasks.library.ant import Ant
from worker.tasks.library.cartpole import Cartpole
from worker.tasks.library.go1 import Go1Flat
from worker.tasks.run.policy_contract import policy_contract

torch.set_num_threads(1)
FACTS = {"task": "Point", "algorithm": "mine:Mine", "policy": {"groups": {"policy": [2]}, "action_size": 2}}
RECURRENT = {**GRU, "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0}}


class Sum(nn.Module):
    """Gives its input, or its input and a sum of all so far."""

    def __init__(self, state: bool, offset: float = 0.0) -> None:
        super().__init__()
        self.state, self.offset = state, offset

    def forward(self, obs: torch.Tensor, total: torch.Tensor | None = None) -> Any:
        if total is None:
            return obs + self.offset
        return total + obs + self.offset, total + obs


class Summing:
    """Remembers the sum of what it saw, and may keep that from its export."""

    def __init__(self, tells: bool, offset: float = 0.0) -> None:
        self.tells, self.offset, self.total = tells, offset, torch.zeros(1)

    def act(self, observations: TensorDict) -> torch.Tensor:
        self.total = self.total + observations["policy"]
        return self.total

    def reset(self, worlds: torch.Tensor | None = None) -> None:
        self.total = torch.zeros(1) if worlds is None else torch.where(worlds[:, None], 0.0, self.total)

    def module(self) -> ExportedPolicy:
        sample = TensorDict({"policy": torch.randn(16, 2)}, batch_size=[16])
        state = {"total": torch.zeros(1, 2)} if self.tells else {}
        outputs = ["actions", "total_out"] if self.tells else ["actions"]
        return ExportedPolicy(Sum(self.tells, self.offset), {"obs": sample["policy"][:1], **state}, outputs, sample)


def files_of(policy: Any) -> tuple[dict[str, bytes], dict[str, Any]]:
    """The files of a policy of two observations, compared with it on a made-up roll-out in which episodes begin anew."""
    exported = policy.module()
    states = tuple(State(name, f"{name}_out", tuple(exported.inputs[name].shape[1:])) for name in exported.states)
    group = Group("policy", "obs", (2,), "float32")
    contract = Contract("Point", "0.1.0", 10.0, (group,), (), ("x", "y"), states=states)
    numbers = np.random.default_rng(0).standard_normal((6, 3, 2), dtype=np.float32)
    begins = np.zeros((6, 3), dtype=bool)
    begins[0], begins[4, 1] = True, True
    return bundle_files(
        policy, exported, contract, "mine:Mine", {"rollout": RecordedObservations({"obs": numbers}, begins)}
    )


def test_a_memory_that_the_export_does_not_have_is_refused() -> None:
    """In the first step the two are alike."""
    existing = (
        r"^the policy of algorithm mine:Mine remembers what it saw before, but its module\(\) has no recurrent state"
    )
    with pytest.raises(UserError, match=existing):
        files_of(Summing(tells=False))


def test_a_memory_that_the_export_has_is_compared_over_steps_and_resets() -> None:
    files, report = files_of(Summing(tells=True))
    reported = np.load(io.BytesIO(files["parity.npz"]))
    # by hand: the second world's sum begins anew in step 4
    requested = reported["obs"].cumsum(0)
    requested[4:, 1] = reported["obs"][4:, 1].cumsum(0)
    np.testing.assert_allclose(reported["actions"], requested, atol=1e-5)
    assert report["resets"] == 1 and report["observations"] == {"rollout": 18, "made_up": 48}
    with pytest.raises(TrainingError, match=r"^the exported policy \(onnx\) differs from the trained one by 0\.1"):
        files_of(Summing(tells=True, offset=0.1))


def exported(run: Run, policy: Any, task: Any, rounds: int = 1) -> Path:
    run.path.mkdir(parents=True, exist_ok=True)
    manifest = {**FACTS, "iteration": 4, "train": {"task": "Point"}, "settings": {}, "files": {}, "reward": 1.5}
    checkpoint: Any = SimpleNamespace(name="00000004-e1", iteration=4, manifest=manifest)
    contract = policy_contract(task, "Point", policy.module())
    return bundle.export(run, checkpoint, task, (policy, policy), contract, rounds)


@pytest.fixture(scope="module")
def recurrent() -> Any:
    """A GRU that has learnt a little, so that its normaliser has seen something."""
    torch.manual_seed(0)  # whatever ran before in this process
    algorithm = build(GroupedPoint(), {"actor": RECURRENT, "critic": RECURRENT, "num_steps_per_env": 8})
    train(algorithm, GroupedPoint(), 3)
    return algorithm.policy()


def test_a_recurrent_policy_can_be_run_from_the_bundle_alone(tmp_path: Path, recurrent: Any) -> None:
    """With numpy, onnxruntime and the contract, as on a robot; it is judged on the same worlds as the policy."""
    task = GroupedPoint()
    target = exported(Run(tmp_path / "run"), recurrent, task, rounds=2)
    judged = json.loads((target / "report.json").read_text())["judged"]
    assert judged["episodes"] == 2 * task.world_count and judged["trained"]["std_return"] > 0.0
    assert judged["bundle"]["mean_return"] == pytest.approx(judged["trained"]["mean_return"], abs=1e-3)
    assert judged["bundle"]["mean_length"] == judged["trained"]["mean_length"]
    assert judged["trained"]["success"] is None and "success" not in judged, "this task does not say what that is"
    contract = json.loads((target / "contract.json").read_text())
    assert contract["states"] == [{"name": "h", "output": "h_out", "shape": [1, 8]}]
    reported = np.load(target / "parity.npz")
    steps, worlds = reported["begins"].shape
    assert steps * worlds >= 1000 and reported["begins"][0].all() and reported["begins"][1:].sum() > worlds
    session = onnxruntime.InferenceSession(target / "policy.onnx", providers=["CPUExecutionProvider"])
    state = np.zeros((worlds, 1, 8), dtype=np.float32)
    for step in range(steps):
        state[reported["begins"][step]] = 0.0
        actions, state = session.run(["actions", "h_out"], {"obs": reported["obs"][step], "h": state})
        np.testing.assert_allclose(actions, reported["actions"][step], atol=1e-5)
    one, zeros = reported["extreme_obs"], np.zeros((len(reported["extreme_obs"]), 1, 8), dtype=np.float32)
    (found,) = session.run(["actions"], {"obs": one, "h": zeros})
    np.testing.assert_allclose(found, reported["extreme_actions"], atol=1e-5)
    assert one.shape[1] == 2 and 2 <= len(one) <= 4
    script = torch.jit.load(target / "policy.pt")
    np.testing.assert_allclose(script(torch.from_numpy(one), torch.from_numpy(zeros))[0].numpy(), found, atol=1e-5)


def test_a_bundle_that_does_worse_than_its_policy_is_not_published(
    tmp_path: Path, recurrent: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where the episodes' ends are not passed to the exported policy: all its actions alone were right."""
    run = Run(tmp_path / "run")
    before = exported(run, recurrent, GroupedPoint())
    stands = {path.name: path.read_bytes() for path in before.iterdir() if path.is_file()}

    class Absent(OnnxPolicy):
        def act(self, observations: TensorDict) -> torch.Tensor:
            super().act(observations)
            return torch.sign(observations["policy"][:, :1])

    monkeypatch.setattr(bundle, "OnnxPolicy", Absent)
    existing = "^the bundle does not do what the trained policy does: its mean return over 128"
    with pytest.raises(TrainingError, match=existing):
        exported(run, recurrent, GroupedPoint(world_count=128))
    assert {path.name: path.read_bytes() for path in before.iterdir() if path.is_file()} == stands
    assert [path.name for path in run.exports.iterdir()] == ["00000004-e1"]


def played(returns: list[float], successes: list[int]) -> Episodes:
    """Episodes of ten steps, as an evaluation records them."""
    rows = torch.zeros(len(returns), 5, dtype=torch.float64)
    rows[:, 0], rows[:, 1], rows[:, 4] = torch.tensor(returns), 10.0, torch.tensor(successes)
    return Episodes(rows, (), ("time_out",), "arrived ended the episode")


def test_a_bundle_has_to_succeed_as_often_as_its_policy() -> None:
    """Of 16 episodes one that fails may be a rounding error, eight are not, though the mean return is the same."""
    trained, seldom = played([1.0, 2.0] * 8, [1] * 16), played([1.0, 2.0] * 8, [1, 0] * 8)
    found = judge(trained, played([1.0, 2.0] * 8, [0] + [1] * 15))
    assert found["success"]["difference"] == 1 / 16 <= found["success"]["tolerance"]
    assert (found["trained"]["success"], found["bundle"]["success"]) == (1.0, 15 / 16)
    with pytest.raises(TrainingError, match=r"its share of successes over 16 episodes is 0\.5, the trained policy's"):
        judge(trained, seldom)


def test_a_second_export_replaces_the_first_as_a_whole(tmp_path: Path) -> None:
    run, policy = Run(tmp_path / "run"), make(point()).policy()
    first = verify(exported(run, policy, point()))
    assert first["run"] == "run" and first["reward"] == 1.5 and first["versions"]["muster"]
    assert set(first["files"]) == {
        *("README.md", "contract.json", "leapp.yaml", "parity.npz", "policy.onnx", "policy.pt", "report.json")
    }
    second = verify(exported(run, policy, point(), rounds=0))
    assert second["created"] > first["created"]
    assert json.loads((run.exports / "00000004-e1" / "report.json").read_text())["judged"] is None


def test_the_metadata_has_what_ros_2_runners_read_with_all_digits() -> None:
    knee = Action("knee", "position", "rad", 0.1 + 0.2, 1 / 3, stiffness=20.123456, damping=0.5)
    hip = Action("hip", "position", "rad", 0.25, -0.5, stiffness=30.0, damping=1.0)
    term = Term("joint_pos", "measured", 0, ("knee", "hip"), ("rad", "rad"), (1.0, 1.0), (0.0, 0.0))
    command = Command("velocity", ("x",), ("m/s",), (None,), (5.0, 5.0))
    group = Group("policy", "obs", (2,), "float32", (term,))
    contract = Contract("Walk", "0.1.0", 50.0, (group,), (knee, hip), ("knee", "hip"), (command,))
    reported = metadata_of(contract, "walk/00000004-e1")
    assert reported.pop("muster") == json.dumps(contract.document())
    assert reported == {
        "run_path": "walk/00000004-e1",
        "joint_names": "knee,hip",
        "joint_stiffness": "20.123456,30.0",
        "joint_damping": "0.5,1.0",
        "default_joint_pos": "0.3333333333333333,-0.5",
        "action_scale": "0.30000000000000004,0.25",
        "command_names": "velocity",
        "observation_names": "joint_pos",
    }


@pytest.mark.parametrize(
    ("settings", "output"),
    [
        ({"steps": 8, "momentum": 0.9}, r"settings\.momentum: .*, found 0\.9"),
        ({"steps": 0}, r"settings\.steps: .*, found 0"),
        ({"critic_observations": "policy", "kernel_sizes": [9]}, r"settings: channels, kernel_sizes and strides: give"),
    ],
)
def test_settings_that_the_algorithm_does_not_take_any_more_are_refused_in_one_line(
    settings: dict[str, Any], output: str
) -> None:
    """As after an upgrade: a checkpoint has the settings of the program that wrote it."""
    checkpoint: Any = SimpleNamespace(name="00000004-e1", manifest={**FACTS, "algorithm": "ppo", "settings": settings})
    existing = rf"^checkpoint 00000004-e1: algorithm ppo refuses what it was trained with: {output}"
    with pytest.raises(UserError, match=existing) as caught:
        load_policy(checkpoint)
    assert "\n" not in str(caught.value)


SUMMED_TERMS = (
    Term("slope", "measured", 0, ("x",), ("1",), (1.0,), (0.0,), history=1),
    Term("speed", "measured", 1, ("x",), ("m/s",), (2.0,), (0.0,), history=1),
)
SUMMED = Contract(
    "Point",
    "0.1.0",
    50.0,
    (Group("policy", "obs", (2,), "float32", SUMMED_TERMS),),
    (Action("x", "effort", "N", 10.0, 0.0), Action("y", "effort", "N", 10.0, 0.0)),
    ("x", "y"),
    states=(State("total", "total_out", (2,)),),
)


def test_the_description_for_leapp_has_each_tensor_its_names_and_what_is_fed_back() -> None:
    model = to_onnx(Summing(tells=True).module(), {})
    described = yaml.safe_load(leapp_description(model, SUMMED))
    pair = {"dtype": "float32", "shape": [1, 2], "type": "tensor"}
    assert described["models"]["policy"]["inputs"] == [
        {"name": "obs", **pair, "element_names": [None, ["slope/x", "speed/x"]]},
        {"name": "total", **pair},
    ]
    assert described["models"]["policy"]["outputs"] == [
        {"name": "actions", **pair, "element_names": [None, ["x", "y"]]},
        {"name": "total_out", **pair},
    ]
    assert described["models"]["policy"]["parameters"]["sha256sum"] == hashlib.sha256(model).hexdigest()
    assert described["pipeline"] == {
        "configs": {"frequency": 50.0, "contract": "contract.json"},
        "inputs": {"policy": ["obs"]},
        "outputs": {"policy": ["actions"]},
        "data_flow": {},
        "feedback_flow": {"policy/total_out": ["policy/total"]},
    }


def test_numbers_of_earlier_steps_are_named_with_the_steps_since_then() -> None:
    past = Term("speed", "measured", 0, ("x",), ("m/s",), (1.0,), (0.0,), history=2)
    group = Group("policy", "obs", (2,), "float32", (past,))
    contract = Contract("Point", "0.1.0", 50.0, (group,), (), ("left", "right"), discrete=True)
    described = yaml.safe_load(leapp_description(to_onnx(Summing(tells=False).module(), {}), contract))
    assert described["models"]["policy"]["inputs"][0]["element_names"] == [None, ["speed/x[-1]", "speed/x"]]
    assert "element_names" not in described["models"]["policy"]["outputs"][0]  # one number, which of the choices


def test_leapp_itself_runs_the_bundle_as_it_is_described_over_steps_and_a_reset(tmp_path: Path) -> None:
    pytest.importorskip("leapp", reason="pip install 'muster[leapp]', or make services")
    from leapp import InferenceManager

    files, _ = files_of(Summing(tells=True))
    (tmp_path / "policy.onnx").write_bytes(files["policy.onnx"])
    (tmp_path / "leapp.yaml").write_text(leapp_description(files["policy.onnx"], SUMMED))
    manager = InferenceManager(str(tmp_path / "leapp.yaml"))
    assert manager.inputs == ["policy/obs"] and manager.outputs == ["policy/actions"]
    assert manager.feedback_inputs == ["policy/total"]
    reported = np.load(io.BytesIO(files["parity.npz"]))
    for world in range(3):
        manager.reset()
        for step in range(len(reported["begins"])):
            if reported["begins"][step, world]:
                manager.reset()
            found = manager({"policy/obs": torch.from_numpy(reported["obs"][step, world : world + 1])})
            np.testing.assert_allclose(found["policy/actions"], reported["actions"][step, world : world + 1], atol=1e-5)


def bundle_of(tmp_path: Path, kind: Any) -> tuple[Path, dict[str, Any]]:
    """A bundle of made-up policy files and of task ``kind``, whose worlds are not built: a robot is what its declaration says."""
    task: Any = kind.__new__(kind)
    task.config = kind.config_type()
    files = {"policy.onnx": to_onnx(Summing(tells=False).module(), {})}
    manifest = {"files": {}, "train": {}, "settings": {}}
    checkpoint: Any = SimpleNamespace(name="00000004-e1", iteration=4, manifest=manifest)
    run = Run(tmp_path / "run")
    run.path.mkdir()
    target = _publish(run, checkpoint, task, SUMMED, files, {}, {})
    return target, verify(target)


def test_a_robot_of_musters_own_is_in_the_bundle_with_its_licence(tmp_path: Path) -> None:
    target, manifest = bundle_of(tmp_path, Cartpole)
    file = "cartpole.xml"
    assert (target / "robot" / file).read_bytes() == Path(worker.tasks.library.__file__).with_name(file).read_bytes()
    assert manifest["robot"] == {"source": file, "format": "mjcf", "licence": "Apache-2.0", "file": f"robot/{file}"}
    assert f"robot/{file}" in manifest["files"]  # with its digest
    output = (target / "README.md").read_text()
    assert f"`robot/{file}` is the robot's model ({file}); its licence: Apache-2.0." in output
    assert "The policy, the contract and the recordings belong to whoever trained the policy" in output


@pytest.mark.parametrize(("kind", "package"), [(Ant, "newton"), (Go1Flat, "mjlab")])
def test_a_robot_of_another_package_is_named_with_its_licence_and_not_copied(
    tmp_path: Path, kind: Any, package: str
) -> None:
    target, manifest = bundle_of(tmp_path, kind)
    assert not (target / "robot").exists() and manifest["robot"]["file"] is None
    assert manifest["robot"]["package"].startswith(f"{package} ") and "Apache" in manifest["robot"]["licence"]
    output = (target / "README.md").read_text()
    assert "The robot's model is not in the bundle." in output and manifest["robot"]["licence"] in output
    assert json.loads((target / "manifest.json").read_text())["robot"] == manifest["robot"]
