"""A policy of rsl_rl without the training state: acting, and the function of tensors for the export."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDict
from torch import nn

from worker.learning.algorithm import ExportedPolicy, Spaces
from worker.learning.observations import synthetic, to_numbers
from worker.learning.rsl.vector_environment import as_floats


class RslRlPolicy:
    """rsl_rl's model as a policy. A model in training keeps its state.

    Args:
        model: ``MLPModel`` or a compatible model.
        groups: Its observation groups, in its order.
        spaces: Spaces of the task.
    """

    def __init__(self, model: Any, groups: Sequence[str], spaces: Spaces) -> None:
        self._model, self._groups, self._spaces = model, list(groups), spaces
        self._memory: Any = None

    @torch.no_grad()
    def act(self, observations: TensorDict) -> torch.Tensor:
        """The deterministic output (for a normal distribution, its mean), shape (n, actions), float32."""
        with self._remembering() as model:
            actions: torch.Tensor = model(as_floats(observations, self._groups))
        return actions

    @torch.no_grad()
    def reset(self, worlds: torch.Tensor | None = None) -> None:
        """Clear the recurrent state of all worlds, or where ``worlds``, shape (n,), bool, is true."""
        if worlds is None:
            self._memory = None
            return
        with self._remembering() as model:
            model.reset(worlds.long())

    @contextmanager
    def _remembering(self) -> Iterator[Any]:
        """The model in evaluation mode with this policy's recurrent state; the training's state is restored afterwards."""
        model, training, state = self._model, self._model.training, self._model.get_hidden_state()
        if training:
            model.eval()
        model.reset(hidden_state=self._memory)
        try:
            yield model
            self._memory = model.get_hidden_state()
        finally:
            model.reset(hidden_state=state)
            if training:
                model.train()

    def state_dict(self) -> Mapping[str, Any]:
        """The model's weights and normaliser."""
        weights: Mapping[str, Any] = self._model.state_dict()
        return weights

    def load_state_dict(self, state: Mapping[str, Any]) -> Any:
        """Load the result of :meth:`state_dict`. Raises RuntimeError if it does not fit."""
        return self._model.load_state_dict(state)

    def module(self) -> ExportedPolicy:
        """rsl_rl's own export of the model, with one input for each observation group of the task.

        The recurrent state is ``h`` (and ``c`` of an LSTM), shape (batch, layers, size), and comes out as ``h_out`` (and ``c_out``);
        an episode begins with zeros.
        """
        network = self._model.as_onnx(verbose=False).to("cpu").eval()
        example = self._spaces.example(1, "cpu")
        inputs = {"obs" if group == self._groups[0] else group: example[group] for group in self._groups}
        vectors = [index for index, group in enumerate(self._groups) if len(self._spaces.observations[group]) == 1]
        images = [index for index in range(len(self._groups)) if index not in vectors]
        states = list(zip(network.input_names, network.get_dummy_inputs(), strict=True))[1 + len(images) :]
        remembered = {name.removesuffix("_in"): state.transpose(0, 1).contiguous() for name, state in states}
        return ExportedPolicy(
            network=_OnnxModule(network, vectors, images).eval(),
            inputs={**inputs, **remembered},
            outputs=["actions", *(f"{name}_out" for name in remembered)],
            sample=synthetic(
                {group: self._spaces.observations[group] for group in self._groups}, self._model.obs_normalizer
            ),
        )


class _OnnxModule(nn.Module):
    """rsl_rl's module for ONNX, which takes all vectors as one, then images of floats, then the recurrent state, layers first."""

    def __init__(self, network: nn.Module, vectors: Sequence[int], images: Sequence[int]) -> None:
        super().__init__()
        self._network, self._vectors, self._images = network, list(vectors), list(images)

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor | tuple[torch.Tensor, ...]:
        """Actions; of a recurrent policy, actions and the new state."""
        images = [to_numbers(inputs[index]) for index in self._images]
        states = [state.transpose(0, 1) for state in inputs[len(images) + len(self._vectors) :]]
        vectors = [inputs[index] for index in self._vectors]
        # with images only, rsl_rl still concatenates an empty vector
        numbers = torch.cat(vectors, dim=-1) if vectors else images[0].flatten(1)[:, :0]
        outputs: Any = self._network(numbers, *images, *states)
        if not states:
            actions: torch.Tensor = outputs
            return actions
        actions, *states = [each for each in outputs if each is not None]
        return (actions, *(state.transpose(0, 1) for state in states))
