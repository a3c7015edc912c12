"""An exported policy as ONNX's own evaluator reads it."""

from __future__ import annotations

import io
import warnings
from typing import TYPE_CHECKING

import torch

from worker.learning.algorithm import ExportedPolicy

if TYPE_CHECKING:
    from onnx.reference import ReferenceEvaluator


def onnx_of(exported: ExportedPolicy) -> ReferenceEvaluator:
    """The policy's network with any batch size."""
    import onnx
    from onnx.reference import ReferenceEvaluator

    buffer, names = io.BytesIO(), [*exported.inputs, *exported.outputs]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            exported.network,
            tuple(exported.inputs.values()),
            buffer,  # type: ignore[arg-type]  # torch writes to a buffer, too
            dynamo=False,
            opset_version=18,
            input_names=list(exported.inputs),
            output_names=list(exported.outputs),
            dynamic_axes={name: {0: "batch"} for name in names},
        )
    return ReferenceEvaluator(onnx.load_from_string(buffer.getvalue()))
