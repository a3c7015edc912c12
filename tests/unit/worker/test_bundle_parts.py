"""What a bundle has besides its policy: a description for LEAPP, the robot's model, licences."""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from shared_store.bundles import verify
from shared_store.layout import Run
from shared_store.policy_contract import Action, Contract, Group, State, Term
from tests.unit.worker.test_export import Summing, files_of
from worker.deploy.bundle import Files, _publish
from worker.deploy.leapp_description import leapp_description
from worker.deploy.model import to_onnx
from worker.tasks.ant import Ant
from worker.tasks.cartpole import Cartpole
from worker.tasks.go1 import Go1Flat

TERMS = (
    Term("slope", "measured", 0, ("x",), ("1",), (1.0,), (0.0,), history=1),
    Term("speed", "measured", 1, ("x",), ("m/s",), (2.0,), (0.0,), history=1),
)
CONTRACT = Contract(
    "Point",
    "0.1.0",
    50.0,
    (Group("policy", "obs", (2,), "float32", TERMS),),
    (Action("x", "effort", "N", 10.0, 0.0), Action("y", "effort", "N", 10.0, 0.0)),
    ("x", "y"),
    states=(State("total", "total_out", (2,)),),
)


def test_the_description_for_leapp_has_each_tensor_its_names_and_what_is_fed_back() -> None:
    model = to_onnx(Summing(tells=True).module(), {})
    described = yaml.safe_load(leapp_description(model, CONTRACT))
    assert described["models"]["policy"]["inputs"] == [
        {
            **{"name": "obs", "dtype": "float32", "shape": [1, 2], "type": "tensor"},
            "element_names": [None, ["slope/x", "speed/x"]],
        },
        {"name": "total", "dtype": "float32", "shape": [1, 2], "type": "tensor"},
    ]
    assert described["models"]["policy"]["outputs"] == [
        {
            **{"name": "actions", "dtype": "float32", "shape": [1, 2], "type": "tensor"},
            "element_names": [None, ["x", "y"]],
        },
        {"name": "total_out", "dtype": "float32", "shape": [1, 2], "type": "tensor"},
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
    contract = Contract(
        "Point",
        "0.1.0",
        50.0,
        (Group("policy", "obs", (2,), "float32", (past,)),),
        (),
        ("left", "right"),
        discrete=True,
    )
    described = yaml.safe_load(leapp_description(to_onnx(Summing(tells=False).module(), {}), contract))
    assert described["models"]["policy"]["inputs"][0]["element_names"] == [None, ["speed/x[-1]", "speed/x"]]
    assert "element_names" not in described["models"]["policy"]["outputs"][0]  # one number, which of the choices


def test_leapp_itself_runs_the_bundle_as_it_is_described_over_steps_and_a_reset(tmp_path: Path) -> None:
    pytest.importorskip("leapp", reason="pip install 'muster[leapp]', or make services")
    from leapp import InferenceManager

    files = files_of(Summing(tells=True))
    (tmp_path / "policy.onnx").write_bytes(files.onnx)
    (tmp_path / "leapp.yaml").write_text(leapp_description(files.onnx, CONTRACT))
    manager = InferenceManager(str(tmp_path / "leapp.yaml"))
    assert manager.inputs == ["policy/obs"] and manager.outputs == ["policy/actions"]
    assert manager.feedback_inputs == ["policy/total"]
    told = np.load(io.BytesIO(files.parity))
    for world in range(3):
        manager.reset()
        for step in range(len(told["begins"])):
            if told["begins"][step, world]:
                manager.reset()
            found = manager({"policy/obs": torch.from_numpy(told["obs"][step, world : world + 1])})
            np.testing.assert_allclose(found["policy/actions"], told["actions"][step, world : world + 1], atol=1e-5)


def published(tmp_path: Path, kind: Any) -> tuple[Path, dict[str, Any]]:
    """A bundle of made-up policy files and of task ``kind``, whose worlds are not built: a robot is what its declaration says."""
    task: Any = kind.__new__(kind)
    task.config = kind.config_type()
    files = Files(to_onnx(Summing(tells=False).module(), {}), b"", b"", {})
    manifest = {"files": {}, "train": {}, "settings": {}}
    checkpoint: Any = SimpleNamespace(name="00000004-e1", iteration=4, manifest=manifest)
    run = Run(tmp_path / "run")
    run.path.mkdir()
    target = _publish(run, checkpoint, task, CONTRACT, files, {})
    return target, verify(target)


@pytest.mark.parametrize(("kind", "file"), [(Cartpole, "cartpole.xml")])
def test_a_robot_of_musters_own_is_in_the_bundle_with_its_licence(tmp_path: Path, kind: Any, file: str) -> None:
    target, manifest = published(tmp_path, kind)
    import worker.tasks

    original = Path(worker.tasks.__file__).parent / file
    assert (target / "robot" / file).read_bytes() == original.read_bytes()
    assert manifest["robot"] == {"source": file, "format": "mjcf", "licence": "Apache-2.0", "file": f"robot/{file}"}
    assert f"robot/{file}" in manifest["files"]  # with its digest
    said = (target / "README.md").read_text()
    assert f"`robot/{file}` is the robot's model ({file}); its licence: Apache-2.0." in said
    assert "The policy, the contract and the recordings belong to whoever trained the policy" in said


@pytest.mark.parametrize(("kind", "package"), [(Ant, "newton"), (Go1Flat, "mjlab")])
def test_a_robot_of_another_package_is_named_with_its_licence_and_not_copied(
    tmp_path: Path, kind: Any, package: str
) -> None:
    target, manifest = published(tmp_path, kind)
    assert not (target / "robot").exists() and manifest["robot"]["file"] is None
    assert manifest["robot"]["package"].startswith(f"{package} ") and "Apache" in manifest["robot"]["licence"]
    said = (target / "README.md").read_text()
    assert "The robot's model is not in the bundle." in said and manifest["robot"]["licence"] in said
    assert json.loads((target / "manifest.json").read_text())["robot"] == manifest["robot"]
