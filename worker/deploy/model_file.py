"""The model file of an exported policy, ONNX or TorchScript, which other programs run, its description for LEAPP; and such a file as a policy
again."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import platform
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import onnx
import torch
import yaml
from tensordict import TensorDict

from shared_store import __version__
from shared_store.contract.policy import Contract, Group
from shared_store.volume.bundles import CONTRACT

if TYPE_CHECKING:
    from worker.learning.algorithm import ExportedPolicy


OPSET = 18


def to_onnx(policy: ExportedPolicy, metadata: Mapping[str, str]) -> bytes:
    """The policy as one self-contained ONNX file, batch size free, with ``metadata`` inside."""
    import onnx

    inputs, outputs = list(policy.inputs), list(policy.outputs)
    buffer: Any = io.BytesIO()  # torch's annotation leaves out the files that this exporter takes
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        # torch's newer exporter takes ten times as long here and writes two files by default
        warnings.simplefilter("ignore")
        torch.onnx.export(
            policy.network,
            tuple(policy.inputs.values()),
            buffer,
            dynamo=False,
            opset_version=OPSET,
            input_names=inputs,
            output_names=outputs,
            dynamic_axes={name: {0: "batch"} for name in (*inputs, *outputs)},
        )
    model = onnx.load_from_string(buffer.getvalue())
    onnx.helper.set_model_props(model, dict(metadata))
    onnx.checker.check_model(model)
    written: bytes = model.SerializeToString()
    return written


def to_torchscript(policy: ExportedPolicy) -> bytes:
    """The same for ``torch.jit.load``, which needs nothing of Muster; inputs and outputs by position, as in the ONNX file."""
    buffer = io.BytesIO()
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        traced = torch.jit.trace(policy.network, tuple(policy.inputs.values()), check_trace=False)
        torch.jit.save(torch.jit.freeze(traced.eval()), buffer)
    return buffer.getvalue()


def metadata_of(contract: Contract, run_path: str) -> dict[str, str]:
    """The keys of ``metadata_props`` that ROS 2 runners of mjlab's and of legged_control2's policies read, and the whole contract.

    Lists are joined by commas, numbers with all their digits; the contract is JSON under ``muster``.
    """
    joints = [action for action in contract.actions if action.kind != "choice"]
    terms = [term.name for group in contract.groups for term in group.terms]
    lists: dict[str, Sequence[Any]] = {
        "joint_names": [joint.name for joint in joints],
        "joint_stiffness": [joint.stiffness for joint in joints],
        "joint_damping": [joint.damping for joint in joints],
        "default_joint_pos": [joint.default_position for joint in joints],
        "action_scale": [joint.scale for joint in joints],
        "command_names": [command.name for command in contract.commands],
        "observation_names": terms,
    }
    joined = {name: ",".join(map(str, values)) for name, values in lists.items()}
    return {"run_path": run_path, **joined, "muster": json.dumps(contract.document())}


class OnnxPolicy:
    """A policy from an ONNX file, run by onnxruntime on the CPU; acts and forgets as :class:`worker.learning.algorithm.Policy`.

    Args:
        model: The file, or its content.
        contract: Of the policy: which group is which input, and the recurrent state.
    """

    def __init__(self, model: Path | bytes, contract: Contract) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        # faster for small networks, and the same each time
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        source = model if isinstance(model, bytes) else str(model)
        self._session = onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
        self._contract = contract
        self._states: dict[str, np.ndarray] = {}

    def act(self, observations: TensorDict) -> torch.Tensor:
        """Actions for observations by group, batch size (n,); shape (n, actions), float32, on the observations' device."""
        groups = [(group.input, observations[group.name]) for group in self._contract.groups]
        actions = self.run({name: tensor.detach().cpu().numpy() for name, tensor in groups})
        return torch.from_numpy(actions).to(groups[0][1].device)

    def run(self, inputs: Mapping[str, np.ndarray]) -> np.ndarray:
        """Actions for the inputs by name, each of shape (n, …); shape (n, actions)."""
        if not self._states:
            count = len(next(iter(inputs.values())))
            self._states = {state.name: np.zeros((count, *state.shape), np.float32) for state in self._contract.states}
        actions, *states = self._outputs({**inputs, **self._states})
        self._states = dict(zip(self._states, states, strict=True))
        return actions

    def _outputs(self, inputs: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """Actions and next states."""
        names = ["actions", *(state.output for state in self._contract.states)]
        outputs: list[np.ndarray] = self._session.run(names, dict(inputs))
        return outputs

    def reset(self, worlds: torch.Tensor | np.ndarray | None = None) -> None:
        """Forget the recurrent state of all worlds, or where ``worlds``, shape (n,), bool, is true."""
        if worlds is None:
            self._states = {}
        mask = None if worlds is None else np.asarray(worlds.cpu() if isinstance(worlds, torch.Tensor) else worlds)
        for state in self._states.values():
            state[mask] = 0.0


class ScriptPolicy(OnnxPolicy):
    """The same of a TorchScript file."""

    def __init__(self, model: bytes, contract: Contract) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch would rather have its own new format, which few runners read
            self._module = torch.jit.load(io.BytesIO(model))
        self._contract = contract
        self._states = {}

    @torch.no_grad()
    def _outputs(self, inputs: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        names = [*(group.input for group in self._contract.groups), *self._states]
        outputs = self._module(*(torch.from_numpy(inputs[name]) for name in names))
        return [each.numpy().copy() for each in (outputs if isinstance(outputs, tuple) else (outputs,))]


LEAPP = "leapp.yaml"
_VERSION = "1.3"
"""Of LEAPP's format."""
_NODE = "policy"


def leapp_description(model: bytes, contract: Contract) -> str:
    """``leapp.yaml`` for ``policy.onnx`` beside it.

    Tensors are as the file has them, with a batch of 1. Names are given to the numbers of observations and actions; a ``kind`` to none:
    LEAPP's kinds are quantities of a robot, and the policy's numbers become these only by the scales and offsets of the contract.

    Args:
        model: Content of ``policy.onnx``.
        contract: Of the policy.
    """
    graph = onnx.load_from_string(model).graph
    names: dict[str, list[str]] = {group.input: list(_numbers(group)) for group in contract.groups if group.terms}
    if not contract.discrete:
        names["actions"] = list(contract.action_names)
    fed_back = {state.output: state.name for state in contract.states}
    outputs = [_tensor(each, names) for each in graph.output]
    inputs = [_tensor(each, names) for each in graph.input]
    # LEAPP asks for both, and trusts the second
    digests = {"md5sum": hashlib.md5(model, usedforsecurity=False), "sha256sum": hashlib.sha256(model)}
    parameters = {"model_path": "policy.onnx", "backend": "onnx", "opset_version": OPSET, "warp_segments": 0}
    document = {
        "models": {
            _NODE: {
                "inputs": inputs,
                "outputs": outputs,
                "parameters": parameters | {name: digest.hexdigest() for name, digest in digests.items()},
            }
        },
        "pipeline": {
            "configs": {"frequency": contract.control_hz, "contract": CONTRACT},
            "inputs": {_NODE: [each["name"] for each in inputs if each["name"] not in fed_back.values()]},
            "outputs": {_NODE: [each["name"] for each in outputs if each["name"] not in fed_back]},
            "data_flow": {},
            "feedback_flow": {f"{_NODE}/{output}": [f"{_NODE}/{name}"] for output, name in fed_back.items()},
        },
        "system information": {
            "leapp config version": _VERSION,
            "written by": f"muster {__version__}",
            "python version": platform.python_version(),
            "torch version": str(torch.__version__),
        },
    }
    text: str = yaml.safe_dump(document, sort_keys=False, width=120)
    return text


def _tensor(value: onnx.ValueInfoProto, names: dict[str, list[str]]) -> dict[str, Any]:
    kind = value.type.tensor_type
    shape = [each.dim_value or 1 for each in kind.shape.dim]  # the batch is free
    described: dict[str, Any] = {
        "name": value.name,
        "dtype": onnx.helper.tensor_dtype_to_np_dtype(kind.elem_type).name,
        "shape": shape,
        "type": "tensor",
    }
    known = names.get(value.name)
    if known and shape == [1, len(known)]:
        described["element_names"] = [None, known]
    return described


def _numbers(group: Group) -> Iterator[str]:
    """A name for each number of a group; of a history, those of earlier steps with the steps since then."""
    for term in group.terms:
        for ago in range(term.history - 1, -1, -1):
            for name in term.names:
                yield f"{term.name}/{name}" + (f"[-{ago}]" if ago else "")
