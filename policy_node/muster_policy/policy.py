"""The policy itself: ``policy.onnx`` in onnxruntime on one thread, its recurrent state, and the self-test of the bundle."""

from __future__ import annotations

import io
from collections.abc import Mapping

import numpy as np
import onnxruntime

from muster_policy.bundle import Bundle
from muster_policy.errors import Refused

TOLERANCE = 1e-4
"""Greatest difference of an action in the self-test, absolute up to 1 and relative beyond: the bundle was compared to within 1e-5 on
another processor."""


class Policy:
    """Acts on one observation at a time, and keeps the state of a recurrent policy.

    Args:
        bundle: Verified.

    Raises:
        Refused: The file can't be run, or its inputs are not those of the contract.
    """

    def __init__(self, bundle: Bundle) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # faster for small networks
        options.log_severity_level = 3
        contract = self._contract = bundle.contract
        self._where = bundle.path
        try:
            self._session = onnxruntime.InferenceSession(bundle.model, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own classes have no common base
            reason = " ".join(str(error).split())
            raise Refused(f"{bundle.path}: policy.onnx can't be run by onnxruntime: {reason[:200]}") from None
        inputs = {each.name: tuple(each.shape[1:]) for each in self._session.get_inputs()}
        described = {each.input: each.shape for each in contract.groups} | {
            each.name: each.shape for each in contract.states
        }
        if inputs != described:
            raise Refused(
                f"{bundle.path}: policy.onnx takes {inputs}, contract.json says {described}; export the policy again"
            )
        self._outputs = ["actions", *(state.output for state in contract.states)]
        self._states: dict[str, np.ndarray] = {}
        self.reset()

    def reset(self, count: int = 1) -> None:
        """Clear the recurrent state; afterwards the policy acts on ``count`` observations at a time."""
        self._states = {state.name: np.zeros((count, *state.shape), np.float32) for state in self._contract.states}

    def act(self, inputs: Mapping[str, np.ndarray]) -> np.ndarray:
        """Actions for inputs by name, each of shape ``(count, …)``; shape ``(count, actions)``, float32."""
        actions, *states = self._session.run(self._outputs, {**inputs, **self._states})
        self._states = dict(zip(self._states, states, strict=True))
        found: np.ndarray = actions
        return found

    def self_test(self, parity: bytes) -> float:
        """Repeat the trained policy's actions in the bundle's recording; returns the greatest difference, and clears the state.

        Args:
            parity: ``parity.npz``.

        Raises:
            Refused: An action differs by more than :data:`TOLERANCE`.
        """
        try:
            with np.load(io.BytesIO(parity), allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
            begins, trained = arrays["begins"], arrays["actions"]
            inputs = {group.input: arrays[group.input] for group in self._contract.groups}
        except (ValueError, OSError, KeyError) as error:
            raise Refused(f"{self._where}: parity.npz can't be read ({error}); export the policy again") from None
        greatest = 0.0
        self.reset(begins.shape[1])
        for step, fresh in enumerate(begins):
            for state in self._states.values():
                state[fresh] = 0.0
            actions = self.act({name: np.ascontiguousarray(each[step]) for name, each in inputs.items()})
            with np.errstate(invalid="ignore"):
                apart = np.abs(actions - trained[step]) / np.maximum(1.0, np.abs(trained[step]))
            greatest = max(greatest, float(np.nan_to_num(apart, nan=np.inf).max()))
        self.reset()
        if not greatest <= TOLERANCE:
            raise Refused(
                f"{self._where}: the self-test failed: an action differs from the trained policy's by {greatest:g} "
                f"(at most {TOLERANCE:g} is allowed); try another version of onnxruntime (here {onnxruntime.__version__})"
            )
        return greatest
