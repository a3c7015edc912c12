"""The description of a bundle that NVIDIA's LEAPP reads: ``leapp.yaml``, one model and what is fed back to it."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterator
from typing import Any

import onnx
import torch
import yaml

from shared_store import __version__
from shared_store.contract.policy import Contract, Group
from shared_store.volume.bundles import CONTRACT
from worker.deploy.model_file import OPSET

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
