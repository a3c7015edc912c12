"""Other systems' policies on Muster's tasks: an rsl_rl checkpoint, as written by mjlab, as a plain network, with checks that it fits the
task."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import nn

from shared_store.contract.error_text import nearest
from worker.learning.algorithm import POLICY
from worker.tasks.declare.interface import Interface

ACTIVATIONS: Mapping[str, type[nn.Module]] = {
    "elu": nn.ELU,
    "relu": nn.ReLU,
    "tanh": nn.Tanh,
    "selu": nn.SELU,
    "sigmoid": nn.Sigmoid,
}
"""Activations of a network by rsl_rl's names."""
EPSILON = 1e-2
"""Constant that rsl_rl's normaliser adds to each standard deviation."""
TOLERANCE = 1e-3
"""Tolerance for scales and default positions of the same policy, in their own unit: mjlab's own export has three decimals."""


CLOSE = 2e-3
"""Tolerance for actions of the same policy in two environments, relative to the greatest: products on a GPU may use TF32."""


class PlainPolicy:
    """The mean action of a Gaussian policy: normalise, then a network of linear layers.

    Args:
        layers: Weights, shape (outputs, inputs), and biases, shape (outputs,), in order; float32.
        mean: Mean of each observation, shape (observations,); None without normalisation.
        deviation: Standard deviation of each, shape (observations,).
        activation: Between the layers, one of :data:`ACTIVATIONS`.
        device: Its device.

    Raises:
        ValueError: The activation is unknown, or the sizes of consecutive layers don't match.
    """

    def __init__(
        self,
        layers: Sequence[tuple[torch.Tensor, torch.Tensor]],
        mean: torch.Tensor | None,
        deviation: torch.Tensor | None,
        activation: str = "elu",
        device: str = "cpu",
    ) -> None:
        if activation not in ACTIVATIONS:
            raise ValueError(f"there is no activation {activation!r}; {nearest(activation, ACTIVATIONS)}")
        for (before, _), (after, _) in itertools.pairwise(layers):
            if after.shape[1] != before.shape[0]:
                raise ValueError(f"a layer of {before.shape[0]} outputs is followed by one of {after.shape[1]} inputs")
        self._layers = [(weight.to(device).float(), bias.to(device).float()) for weight, bias in layers]
        self._mean = None if mean is None or deviation is None else mean.to(device).float()
        self._deviation = None if self._mean is None or deviation is None else deviation.to(device).float() + EPSILON
        self._activation = ACTIVATIONS[activation]().to(device)

        self.device = device

    @property
    def observations(self) -> int:
        """Number of its inputs."""
        return int(self._layers[0][0].shape[1])

    @property
    def actions(self) -> int:
        """Number of its outputs."""
        return int(self._layers[-1][0].shape[0])

    @torch.no_grad()
    def act(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Mean actions, shape (n, actions), for the group ``policy`` of ``observations``, shape (n, observations), float32."""
        values = observations[POLICY]
        if self._mean is not None and self._deviation is not None:
            values = (values - self._mean) / self._deviation
        for index, (weight, bias) in enumerate(self._layers):
            values = torch.nn.functional.linear(self._activation(values) if index else values, weight, bias)
        return values

    def reset(self, worlds: torch.Tensor | None = None) -> None:
        """It remembers nothing."""


def read_rsl_rl(path: Path | str, activation: str = "elu", device: str = "cpu") -> PlainPolicy:
    """The policy of a checkpoint that rsl_rl 5 or mjlab wrote (``model_<iteration>.pt``).

    Args:
        path: The file. It is read without running code from it.
        activation: Activation of its network, which the file lacks.
        device: Where the policy runs.

    Raises:
        ValueError: The file does not exist or is not such a checkpoint, or its network has other than linear layers.
    """
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise ValueError(f"there is no checkpoint {path}") from None
    except Exception as error:
        raise ValueError(f"{path} is not a checkpoint of rsl_rl: {str(error).splitlines()[0]}") from error
    if not isinstance(found, dict) or "actor_state_dict" not in found:
        keys = ", ".join(map(str, found)) if isinstance(found, dict) else type(found).__name__
        raise ValueError(f"{path} is not a checkpoint of rsl_rl 5: it has no actor_state_dict, but {keys}")
    actor = found["actor_state_dict"]
    numbers = sorted(int(key.split(".")[1]) for key in actor if key.startswith("mlp.") and key.endswith(".weight"))
    known = {f"mlp.{number}.{part}" for number in numbers for part in ("weight", "bias")}
    strange = sorted(
        key for key in actor if key not in known and not key.startswith(("obs_normalizer.", "distribution."))
    )
    if strange or not numbers:
        raise ValueError(f"{path}: its actor is not a plain network, it has {', '.join(strange) or 'no layers'}")
    layers = [(actor[f"mlp.{number}.weight"], actor[f"mlp.{number}.bias"]) for number in numbers]
    moments = (actor.get(f"obs_normalizer.{name}") for name in ("_mean", "_std"))
    mean, deviation = (None if each is None else each.flatten() for each in moments)
    return PlainPolicy(layers, mean, deviation, activation, device)


def check_fit(policy: PlainPolicy, observations: int, actions: int, task: str) -> None:
    """Raises ValueError if the policy's number of inputs or outputs differs from the task's."""
    for what, has, wants in (("sees", policy.observations, observations), ("gives", policy.actions, actions)):
        if has != wants:
            raise ValueError(f"the policy {what} {has} values, task {task} has {wants}")


def check_probe(policy: PlainPolicy, probe: Mapping[str, Any]) -> None:
    """Check that the policy acts as in the system that trained it.

    Args:
        policy: The policy of the training's last checkpoint.
        probe: What the record says under ``probe``: ``observations``, shape (n, observations), and ``actions``, shape (n, actions).

    Raises:
        ValueError: Its actions differ.
    """
    seen, supplied = torch.tensor(probe["observations"]), torch.tensor(probe["actions"])
    device = policy.device
    apart = float((policy.act({POLICY: seen.to(device)}).cpu() - supplied).abs().max())
    if not apart <= CLOSE * max(1.0, float(supplied.abs().max())):
        raise ValueError(
            f"the converted policy acts otherwise than the one that was trained: actions are {apart:g} apart"
        )


def check_contract(contract: Mapping[str, Any], interface: Interface, task: str) -> None:
    """Check that the numbers of mjlab's policy have the same meaning in ``task``.

    Args:
        contract: What the record of a training by mjlab says under ``contract``.
        interface: Of the task.
        task: Its name, for messages.

    Raises:
        ValueError: Another order or number of observations, other joints, scales or default positions; the message names the first.
    """
    widths = contract["observations"]
    if sum(widths.values()) != len(interface.observations):
        raise ValueError(
            f"mjlab's policy sees {sum(widths.values())} values, task {task} has {len(interface.observations)}"
        )
    joints = [action.name for action in interface.actions]
    for place, (theirs, ours) in enumerate(zip(contract["actions"], joints, strict=False)):
        if theirs != ours:
            raise ValueError(f"action {place} moves joint {theirs} in mjlab and {ours} in task {task}")
    if len(contract["actions"]) != len(joints):
        raise ValueError(f"mjlab's policy has {len(contract['actions'])} actions, task {task} has {len(joints)}")
    scales = contract["action_scale"]
    scales = scales if isinstance(scales, Sequence) else [scales] * len(joints)
    positions = dict(zip(contract["joints"], contract["positions"], strict=True))
    for action, scale in zip(interface.actions, scales, strict=True):
        for what, existing, here in (
            ("scale", scale, action.scale),
            ("offset", positions[action.name], action.offset),
        ):
            if not math.isclose(existing, here, abs_tol=TOLERANCE):
                raise ValueError(
                    f"joint {action.name}: its {what} is {existing:g} in mjlab and {here:g} in task {task}"
                )
    _check_order(widths, [seen.name for seen in interface.observations], joints, task)


def _check_order(widths: Mapping[str, int], names: Sequence[str], joints: Sequence[str], task: str) -> None:
    """Check that mjlab's observations of joints and commands are in the task's columns, with the joints in the same order."""
    first = 0
    for term, width in widths.items():
        ours = names[first : first + width]
        if term.startswith("joint_") or term == "actions":
            wrong = [name for name, joint in zip(ours, joints, strict=False) if joint not in name]
            wrong += ours[len(joints) :]
        else:
            wrong = [name for name in ours if any(joint in name for joint in joints)]
        if term == "command":
            wrong += [name for name in ours if "command" not in name]
        if wrong:
            raise ValueError(f"mjlab sees {term} at {first} to {first + width - 1}, where task {task} has {wrong[0]}")
        first += width
