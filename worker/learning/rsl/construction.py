"""The construction of a configuration's objects by rsl_rl's own functions, with errors in one line."""

from __future__ import annotations

import contextlib
import copy
import inspect
import io
import os
import sys
import warnings
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

from rsl_rl.algorithms import PPO, Distillation
from rsl_rl.utils import resolve_callable, resolve_class, resolve_obs_groups
from tensordict import TensorDict
from torch import nn

from shared_store.contract.error_text import Refused, kind_of
from worker.learning.algorithm import LearningSetting, Spaces, WorldShare
from worker.learning.rsl.vector_environment import as_floats
from worker.settings.errors import is_out_of_memory
from worker.settings.rsl_rl import NETWORKS, RslRlConfig
from worker.settings.rsl_rl_checks import check_gradient_length, check_networks


def _environment(setting: LearningSetting, example: TensorDict) -> SimpleNamespace:
    """The part of an environment that rsl_rl needs to build an algorithm; a symmetry function receives it as ``env``. It has no ``step``,
    since Muster steps the worlds."""
    env = SimpleNamespace(num_envs=setting.share.count, num_actions=setting.spaces.actions, cfg={})
    env.device, env.step_dt, env.get_observations = setting.gang.device, setting.control_seconds, lambda: example
    env.unwrapped = env  # rsl_rl looks for step_dt behind wrappers
    return env


def example_of(spaces: Spaces, worlds: int, device: str) -> TensorDict:
    """Zeros in the form of the task's observations for rsl_rl, batch size (worlds,)."""
    return as_floats(spaces.example(worlds, device), spaces.observations)


def algorithm_type(config: RslRlConfig) -> tuple[Any, tuple[str, str]]:
    """The algorithm's class and the names of its two networks, the policy first. Raises ValueError if the class can't be found."""
    name = config.section("algorithm")["class_name"]
    with _refused("algorithm.class_name"):
        found = _find(name)
        if not hasattr(found, "construct_algorithm"):
            raise ValueError(f"{name} is not an algorithm: it has no construct_algorithm")
    distils = isinstance(found, type) and issubclass(found, Distillation)
    sections = {each: getattr(config, each) for each in NETWORKS}
    try:
        return found, check_networks(name, distils, sections, config.teacher_checkpoint)
    except Refused as refused:
        raise ValueError(f"rsl_rl.{refused}") from refused


def observation_sets(config: RslRlConfig, names: tuple[str, str], example: TensorDict) -> dict[str, list[str]]:
    """The observation groups of each set. Raises ValueError for a group that the task does not have."""
    curious = ["rnd_state"] if config.algorithm.get("rnd_cfg") else []
    with _refused("obs_groups"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about missing sets: the settings' description has the defaults
        sets: dict[str, list[str]] = resolve_obs_groups(example, copy.deepcopy(config.obs_groups), [*names, *curious])
    return sets


def build_network(
    config: RslRlConfig, name: str, sets: dict[str, list[str]], example: TensorDict, outputs: int
) -> nn.Module:
    """One network. Raises ValueError for settings that it refuses."""
    section = config.section(name)
    with _refused(f"{name}.class_name"):
        _find(section["class_name"])
    with _refused(name):
        built, arguments = resolve_class(section)
        network: nn.Module = built(example, sets, name, outputs, **arguments)
    return network


def build_algorithm(config: RslRlConfig, setting: LearningSetting) -> tuple[Any, list[str], list[str]]:
    """rsl_rl's algorithm, the observation groups of its policy, and all groups that it needs. Raises ValueError for impossible settings."""
    spaces, gang = setting.spaces, setting.gang
    if spaces.discrete:
        raise ValueError("rsl_rl: its distributions are of numbers, and the actions of this task are choices")
    found, names = algorithm_type(config)
    _check_numbers(found, config.section("algorithm"))
    example = example_of(spaces, setting.share.count, gang.device)
    sets = observation_sets(config, names, example)
    groups = list(spaces.observations)
    if found.construct_algorithm in (PPO.construct_algorithm, Distillation.construct_algorithm):
        # store only groups of the sets; a class with its own construction may need more
        groups = [group for group in groups if any(group in each for each in sets.values())]
    example = example.select(*groups)
    place = {"global_rank": gang.rank, "local_rank": gang.placement.local_rank, "world_size": gang.size}
    complete = {
        "num_steps_per_env": config.num_steps_per_env,
        "obs_groups": sets,
        "algorithm": config.section("algorithm"),
        **{name: config.section(name) for name in names},
        "torch_compile_mode": config.torch_compile_mode,
        "multi_gpu": place if gang.size > 1 else None,
    }
    try:
        with _quiet():
            built = found.construct_algorithm(example, _environment(setting, example), complete, gang.device)
    except Exception as error:
        for name in names if not is_out_of_memory(error) else ():  # was it one of them?
            try:
                build_network(config, name, sets, example, 1 if name == "critic" else spaces.actions)
            except ValueError as refusal:
                if str(refusal.__cause__) == str(error):
                    raise refusal from error
        with _refused("algorithm"):
            raise
    _check(built, names, setting, config.num_steps_per_env)
    return built, sets[names[0]], groups


def _check_numbers(found: Any, section: dict[str, Any]) -> None:
    """Refuse values other than numbers, and fractions for counts, which a user's class would only notice while it computes."""
    for name, parameter in inspect.signature(found).parameters.items():
        default, value = parameter.default, section.get(name, parameter.default)
        if not isinstance(default, int | float) or isinstance(default, bool):
            continue
        kind = int if isinstance(default, int) and name != "grad_reduce_bucket_mb" else int | float
        if not isinstance(value, kind) or isinstance(value, bool):
            expected = "an integer" if kind is int else "a number"
            raise ValueError(f"rsl_rl.algorithm.{name}: expected {expected}, found {kind_of(value)}")


def _check(built: Any, names: tuple[str, str], setting: LearningSetting, steps: int) -> None:
    """Refuse settings on which rsl_rl would only fail while it learns."""
    networks = [getattr(built, name) for name in names if hasattr(built, name)]
    for name, network in zip(names, networks, strict=False):
        if getattr(network, "obs_normalization", False) and not network.obs_groups:
            raise ValueError(
                f"rsl_rl.{name}.obs_normalization: it sees images alone, which are not normalised; set false"
            )
    worlds = min(WorldShare.of(rank, setting.gang.size, setting.share.total).count for rank in range(setting.gang.size))
    if isinstance(built, PPO):
        if networks[0].distribution is None:
            raise ValueError("rsl_rl.actor.distribution_cfg: PPO needs a distribution to draw actions from")
        recurrent = any(network.is_recurrent for network in networks)
        parts, available = built.num_mini_batches, worlds if recurrent else worlds * steps
        if parts > available:
            what = "worlds, since a network is recurrent" if recurrent else "samples"
            raise ValueError(
                f"rsl_rl.algorithm.num_mini_batches: {parts} minibatches need as many {what}; a rank has {available}"
            )
        if built.symmetry:  # refuse a function that rsl_rl can't call
            function = built.symmetry.data_augmentation_func
            try:
                inspect.signature(function).bind(env=None, obs=None, actions=None)
            except (TypeError, ValueError) as error:
                what = (
                    f"{getattr(function, '__qualname__', type(function).__name__)} is called with env, obs and actions"
                )
                raise ValueError(f"rsl_rl.algorithm.symmetry_cfg.data_augmentation_func: {what}: {error}") from error
    if isinstance(built, Distillation):
        try:
            check_gradient_length(built.gradient_length, built.num_learning_epochs, steps)
        except Refused as refused:
            raise ValueError(f"rsl_rl.{refused}") from refused


def _find(name: Any) -> Any:
    """The object called ``name``, by rsl_rl's rules. A module may be in the job's directory, and never hides one of ours."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    return resolve_callable(name)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence rsl_rl's prints, and torch's warning about convolutions that two networks share."""
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "optimizer contains a parameter group with duplicate parameters")
        yield


@contextlib.contextmanager
def _refused(where: str) -> Iterator[None]:
    """Turn any exception in this context, except out of memory, into a ValueError of one line that begins with ``where``."""
    try:
        with _quiet():
            yield
    except Exception as error:
        if is_out_of_memory(error):
            raise
        kind = f"{type(error).__name__}: " if isinstance(error, LookupError | AssertionError) else ""
        raise ValueError(f"rsl_rl.{where}: {kind}{' '.join(str(error).split())}") from error
