"""A bundle that is not as it was sealed, or does not act as it should, is refused in one line; so is wrong use of the command."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest

from muster_policy.bundle import EXTERNAL, PARTS, open_bundle
from muster_policy.cli import main
from muster_policy.errors import Refused
from muster_policy.policy import Policy
from shared_store.volume.bundles import seal
from tests.support.policy_node import write_bundle
from tests.support.refusals import refusal
from tests.unit.policy_node.walker import JOINTS, contract, term

SPEED = term("joint_velocity", 0, 2, **JOINTS)
WEIGHTS = np.array([[1.0], [-0.5]])


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    return write_bundle(tmp_path / "bundle", contract(SPEED), WEIGHTS)


def resealed(bundle: Path, change: Callable[[Path], None]) -> None:
    """As if the bundle had been made with that change."""
    (bundle / "manifest.json").unlink()
    change(bundle)
    seal(bundle, {"run": "by-hand", "checkpoint": "00000001-e1", "train": {}})


def flipped(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))


def test_a_bundle_passes_its_self_test_and_shows_its_joints_unless_the_domain_is_not_a_number(
    bundle: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main([str(bundle), "--check"]) == 0
    output = capsys.readouterr().out
    assert "Walker of by-hand, checkpoint 00000001-e1: self-test passed, actions differ by" in output
    assert "knee  position [rad] -1.500 to 1.500, default position 0.3000, stiffness 20, damping 1" in output
    monkeypatch.setenv("ROS_DOMAIN_ID", "seven")
    assert main([str(bundle), "--check"]) == 1
    assert capsys.readouterr().err == "error: ROS_DOMAIN_ID=seven: expected an integer\n"


def test_a_recurrent_policy_is_tested_over_the_steps_of_its_recording(tmp_path: Path) -> None:
    path = write_bundle(tmp_path / "bundle", contract(SPEED, recurrent=True), WEIGHTS)
    opened = open_bundle(path)
    assert Policy(opened).self_test(opened.parity) < 1e-6


@pytest.mark.parametrize(
    ("change", "output"),
    [
        (lambda path: flipped(path / "policy.onnx"), "policy.onnx was altered (SHA-256 differs)"),
        (lambda path: flipped(path / "contract.json"), "contract.json was altered (SHA-256 differs)"),
        (lambda path: flipped(path / "parity.npz"), "parity.npz was altered (SHA-256 differs)"),
        (lambda path: (path / "policy.onnx").write_bytes(b"x"), "policy.onnx has 1 bytes"),
        (lambda path: (path / "policy.onnx").unlink(), "policy.onnx is missing; copy the bundle once more"),
        (lambda path: (path / "more.py").write_text("x"), "more.py was added, manifest.json does not list it"),
        (lambda path: (path / "manifest.json").unlink(), "manifest.json is missing; name a bundle"),
        (lambda path: (path / "manifest.json").write_text("[]"), "manifest.json is not a bundle's manifest"),
        (
            lambda path: (path / "manifest.json").write_text(
                (path / "manifest.json").read_text().replace("by-hand", "by-tool")
            ),
            "manifest.json was altered (SHA-256 differs)",
        ),
    ],
)
def test_an_altered_bundle_is_refused(
    bundle: Path, change: Callable[[Path], None], output: str, capsys: pytest.CaptureFixture[str]
) -> None:
    change(bundle)
    assert main([str(bundle)]) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith(f"error: {bundle}: {output}")


def test_every_byte_of_the_manifest_counts(bundle: Path) -> None:
    manifest = bundle / "manifest.json"
    data = manifest.read_bytes()
    for place in range(0, len(data), 7):
        manifest.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        refusal(open_bundle, bundle, error=Refused)


def test_a_policy_that_acts_otherwise_than_it_was_trained_is_refused(tmp_path: Path) -> None:
    path = write_bundle(tmp_path / "bundle", contract(SPEED), WEIGHTS, parity=np.full((2, 3, 1), 0.5, np.float32))
    opened = open_bundle(path)
    with pytest.raises(Refused, match=r"the self-test failed: an action differs from the trained policy's by \d"):
        Policy(opened).self_test(opened.parity)
    nan = write_bundle(tmp_path / "nan", contract(SPEED), np.array([[np.nan], [0.0]]), np.zeros((2, 3, 1), np.float32))
    opened = open_bundle(nan)
    with pytest.raises(Refused, match="differs from the trained policy's by"):
        Policy(opened).self_test(opened.parity)


UNREADABLE = {
    "has format 9, this node reads up to 4; upgrade muster-policy": lambda found: found.update(format=9),
    "actions is missing; export the policy again": lambda found: found.pop("actions"),
    "control_hz is 0; export the policy again": lambda found: found.update(control_hz=0),
    "it is not a policy contract": lambda found: found.update(groups=7),
    "the terms of policy have 2 numbers, its shape is [3]": lambda found: found["groups"][0].update(shape=[3]),
}


@pytest.mark.parametrize("output", UNREADABLE)
def test_a_contract_that_can_t_be_read_is_refused(bundle: Path, output: str) -> None:
    change = UNREADABLE[output]

    def edit(path: Path) -> None:
        document = json.loads((path / "contract.json").read_text())
        change(document)
        (path / "contract.json").write_text(json.dumps(document))

    resealed(bundle, edit)
    with pytest.raises(Refused, match=re.escape(output)):
        open_bundle(bundle)


def test_a_policy_of_other_inputs_than_the_contract_s_is_refused(bundle: Path, tmp_path: Path) -> None:
    """An observation of a wrong size."""
    other = write_bundle(
        tmp_path / "other", contract(term("joint_velocity", 0, 2, **JOINTS, history=2)), np.ones((4, 1))
    )

    def swap(path: Path) -> None:
        (path / "policy.onnx").write_bytes((other / "policy.onnx").read_bytes())

    resealed(bundle, swap)
    with pytest.raises(Refused, match=r"policy\.onnx takes \{'obs': \(4,\)\}, contract\.json says \{'obs': \(2,\)\}"):
        Policy(open_bundle(bundle))
    resealed(bundle, lambda path: (path / "policy.onnx").write_bytes(b"no model") and None)
    with pytest.raises(Refused, match=r"policy\.onnx is not an ONNX file"):
        open_bundle(bundle)
    resealed(
        bundle,
        lambda path: (path / "policy.onnx").write_bytes(onnx.ModelProto(ir_version=8).SerializeToString()) and None,
    )
    with pytest.raises(Refused, match=r"policy\.onnx can't be run by onnxruntime"):
        Policy(open_bundle(bundle))


@pytest.mark.parametrize("location", ["../secret.bin", "/etc/hostname", "weights.bin"])
@pytest.mark.parametrize("place", ["initializer", "constant", "subgraph"])
def test_weights_in_another_file_are_refused_before_the_model_is_run(bundle: Path, place: str, location: str) -> None:
    tensor = onnx.helper.make_tensor("w", onnx.TensorProto.FLOAT, [1], [1.0])
    tensor.ClearField("float_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value=location)
    output = onnx.helper.make_tensor_value_info("actions", onnx.TensorProto.FLOAT, [1])
    constant = onnx.helper.make_node("Constant", [], ["actions"], value=tensor)
    inner = onnx.helper.make_graph([constant], "inner", [], [output])
    condition = onnx.helper.make_tensor("yes", onnx.TensorProto.BOOL, [], [True])
    branches = onnx.helper.make_node("If", ["yes"], ["actions"], then_branch=inner, else_branch=inner)
    identity = onnx.helper.make_node("Identity", ["w"], ["actions"])
    nodes, weights = {
        "initializer": ([identity], [tensor]),
        "constant": ([constant], []),
        "subgraph": ([branches], [condition]),
    }[place]
    model = onnx.helper.make_model(onnx.helper.make_graph(nodes, "policy", [], [output], weights))
    resealed(bundle, lambda path: (path / "policy.onnx").write_bytes(model.SerializeToString()) and None)
    with pytest.raises(Refused, match=r"policy\.onnx has weights in another file"):
        open_bundle(bundle)


def test_the_fields_in_which_tensors_are_looked_for_are_onnx_s() -> None:
    holding = {"TensorProto"}
    while True:  # the messages that may hold a tensor, from onnx's own description
        types = [
            kind.DESCRIPTOR for kind in vars(onnx).values() if isinstance(kind, type) and hasattr(kind, "DESCRIPTOR")
        ]
        more = {
            kind.name
            for kind in types
            for each in kind.fields
            if each.message_type and each.message_type.name in holding
        } | holding
        if more == holding:
            break
        holding = more
    reached = {kind.name: kind for kind in types if kind.name in PARTS}
    assert {
        name: {
            each.number: each.message_type.name
            for each in kind.fields
            if each.message_type and each.message_type.name in holding
        }
        for name, kind in reached.items()
    } == PARTS
    fields = onnx.TensorProto.DESCRIPTOR.fields_by_name
    assert (fields["external_data"].number, fields["data_location"].number) == EXTERNAL


MISUSE = {
    "--remap imu: expected TOPIC:=NAME, such as imu:=/imu/data": ("--remap", "imu"),
    "--remap imu: the node has no such topic; it has joint_commands, joint_states": ("--remap", "imu:=/x"),
    "--remap /a/*: a name of ROS has letters, digits and _ between its slashes": ("--remap", "joint_states:=/a/*"),
    "--namespace /left arm: a name of ROS has letters": ("--namespace", "/left arm"),
    "--name a/b: a node's name has no slash; give --namespace besides": ("--name", "a/b"),
    "--controller 2nd: a name of ROS has letters": ("--controller", "2nd"),
    "domain 233: expected 0 to 232": ("--domain", "233"),
    "--listen nonsense: Zenoh can't open it": ("--listen", "nonsense"),
    "line 2: the policy has no joint kne; did you mean knee?": ("--joints", "JOINTS"),
    "knee and wheel of the policy are both motor of the robot; give each its own": ("--joints", "TWICE"),
    "--joints /no/such: it can't be read (No such file or directory)": ("--joints", "/no/such"),
}


@pytest.mark.parametrize("output", MISUSE)
def test_wrong_use_is_one_line(bundle: Path, tmp_path: Path, output: str, capsys: pytest.CaptureFixture[str]) -> None:
    options = MISUSE[output]
    names = tmp_path / "names.txt"
    names.write_text("wheel = left_wheel  # of the robot\nkne = motor\n")
    twice = tmp_path / "twice.txt"
    twice.write_text("knee = motor\nwheel = motor\n")
    files = {"JOINTS": str(names), "TWICE": str(twice)}
    assert main([str(bundle), *(files.get(each, each) for each in options)]) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert output in line


UNFIT = {
    "": "BUNDLE is missing; see: muster-policy --help",
    "x --strct-limits": (
        "--strct-limits: there is no such option; did you mean --strict-limits? see: muster-policy --help"
    ),
    "x y": "y: more arguments than the command takes; see: muster-policy --help",
    "x --domain ten": "--domain: expected an integer, found ten; see: muster-policy --help",
    "x --rate": "--rate: expected one argument; see: muster-policy --help",
}


@pytest.mark.parametrize("typed", UNFIT)
def test_options_that_do_not_fit_are_one_line_without_the_usage(typed: str, capsys: pytest.CaptureFixture[str]) -> None:
    line = UNFIT[typed]
    with pytest.raises(SystemExit) as ended:
        main(typed.split())
    assert ended.value.code == 2 and capsys.readouterr().err == f"muster-policy: {line}\n"
