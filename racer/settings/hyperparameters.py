"""DeepRacer's hyperparameters under their own names: what settings of PPO and SAC they are. Imported without numpy and torch.

Whoever submits a job reads of each of them that means something else here, or nothing; what goes on is plain settings.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from shared_store.contract.error_text import Refused, nearest, shown

EPISODE = 200
"""Control steps for which an episode counts where episodes are counted: 13 s, about a lap of a preset track."""
FEWEST_STEPS, MOST_STEPS = 16, 256
"""Of each world in an iteration, however many episodes that is."""

Setting = tuple[str, ...]
"""Keys to a setting in the section ``train``, such as ``("ppo", "gamma")``."""


@dataclass(frozen=True)
class TrainingFacts:
    """The facts on which a hyperparameter's meaning depends.

    Attributes:
        algorithm: ``ppo`` or ``sac``.
        worlds: Of each rank.
        steps: Of every world in one iteration of PPO.
        has_camera: Whether the task sees images.
    """

    algorithm: str
    worlds: int
    steps: int
    has_camera: bool


Meaning = tuple[dict[Setting, Any], str]
"""Settings, and a note; empty where there is nothing to report."""


@dataclass(frozen=True)
class Hyperparameter:
    """One of them.

    Attributes:
        check: Gives the value as it is used. Raises ValueError, whose words follow "expected".
        meaning: What it is here; a text: it is not done, and why.
    """

    check: Callable[[Any], Any]
    meaning: Callable[[Any, TrainingFacts], Meaning] | str


def plain_settings(train: Mapping[str, Any], config: Any) -> tuple[dict[str, Any], list[str]]:
    """A job's ``train`` section with settings of ``ppo`` or ``sac`` in the place of its ``hyperparameters``.

    Args:
        train: The section, whose other keys are not checked yet.
        config: The task's default configuration.

    Returns:
        The section, and a note for each hyperparameter that is not meant, or not done, exactly so.

    Raises:
        Refused: One of them is misspelt, out of range, or given as a setting, too.
    """
    where, values = "hyperparameters", train["hyperparameters"]
    if not isinstance(values, Mapping):
        raise Refused((where,), f"expected an object such as {{lr: 3.0e-4}}, or a JSON file, found {shown(values)}")
    algorithm = train.get("algorithm", "ppo")
    if algorithm not in ("ppo", "sac"):
        raise Refused((where,), f"they are settings of ppo and sac, and the algorithm is {shown(algorithm)}")
    checked = {name: _checked(where, str(name), value) for name, value in values.items()}
    worlds = train.get("worlds")
    own = _at(train, ("ppo", "steps"))
    job = TrainingFacts(
        algorithm,
        worlds if isinstance(worlds, int) and worlds > 0 else 1,  # the section's own check follows
        own if isinstance(own, int) and own > 0 else config.ppo.steps,
        getattr(config, "front", None) is not None,
    )
    plain = {key: dict(value) if isinstance(value, Mapping) else value for key, value in train.items() if key != where}
    notes = []
    # the length of an iteration is set before its division into minibatches
    for name in sorted(checked, key=lambda name: name != "num_episodes_between_training"):
        try:
            settings, note = _meaning(name, checked[name], job)
        except ValueError as error:
            raise Refused((where, name), str(error)) from None
        for setting, value in settings.items():
            if _at(train, setting) is not None:
                other = f"train.{'.'.join(setting)}"
                raise Refused((where, name), f"it is {other} here, which is given, too; leave one of them out")
            _put(plain, setting, value)
            if setting == ("ppo", "steps"):
                job = TrainingFacts(job.algorithm, job.worlds, value, job.has_camera)
        if note:
            notes.append(f"{where}.{name} {values[name]}: {note}")
    return plain, notes


def deepracer_names(algorithm: str, settings: Mapping[str, Any], worlds: int, frames: int) -> dict[str, Any]:
    """The settings of a training that DeepRacer has, under its names; of another algorithm than ``ppo`` and ``sac`` none.

    Args:
        algorithm: Its name.
        settings: All of its settings.
        worlds: Of each rank.
        frames: Images of one observation.
    """
    if algorithm not in ("ppo", "sac"):
        return {}
    alike = {
        "discount_factor": settings["gamma"],
        "loss_type": "mean squared error",
        "num_episodes_between_training": max(1, round(settings["steps"] * worlds / EPISODE)),
        "stack_size": frames,
    }
    if algorithm == "sac":
        return alike | {
            "batch_size": settings["batch_size"],
            "exploration_type": "additive_noise",
            "lr": settings["actor_learning_rate"],
            "sac_alpha": settings["init_temperature"],
        }
    return alike | {
        "batch_size": settings["steps"] * worlds // settings["minibatches"],
        "beta_entropy": settings["entropy_coef"],
        "exploration_type": "categorical",
        "lr": settings["learning_rate"],
        "num_epochs": settings["epochs"],
    }


def _checked(where: str, name: str, value: Any) -> Any:
    if name not in KNOWN:
        near = difflib.get_close_matches(name, _ALSO, n=1, cutoff=0.8)
        meant = f"did you mean {_ALSO[near[0]]}?" if near else nearest(name, list(KNOWN), _UNKNOWN)
        if meant == _UNKNOWN:
            return value
        raise Refused((where, name), f"DeepRacer has no such hyperparameter; {meant}")
    try:
        return KNOWN[name].check(value)
    except ValueError as error:
        raise Refused((where, name), f"expected {error}, found {shown(value)}") from None


def _meaning(name: str, value: Any, job: TrainingFacts) -> Meaning:
    meaning = KNOWN[name].meaning if name in KNOWN else _UNKNOWN
    return ({}, meaning) if isinstance(meaning, str) else meaning(value, job)


def _at(section: Mapping[str, Any], setting: Setting) -> Any:
    value: Any = section
    for key in setting:
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def _put(section: dict[str, Any], setting: Setting, value: Any) -> None:
    *parents, last = setting
    for key in parents:
        inner = section.get(key)
        section[key] = section = dict(inner) if isinstance(inner, Mapping) else {}
    section[last] = value


def _number(low: float, high: float) -> Callable[[Any], float]:
    def check(value: Any) -> float:
        try:  # files have numbers as texts, too, and YAML takes 3e-4 for one
            number = math.nan if isinstance(value, bool) else float(value)
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if not low <= number <= high:
            raise ValueError(f"a number from {low:g} to {high:g}")
        return number

    return check


def _whole(low: int, high: float) -> Callable[[Any], int]:
    def check(value: Any) -> int:
        try:
            number = _number(low, min(high, 2**31))(value)
        except ValueError:
            number = 0.5
        if number != int(number):
            raise ValueError(f"an integer from {low} to {high:g}" if high < math.inf else f"an integer from {low} on")
        return int(number)

    return check


def _one_of(*values: Any) -> Callable[[Any], Any]:
    def check(value: Any) -> Any:
        found = value.lower().replace("_", " ").strip() if isinstance(value, str) else value
        for known in values:
            if found == known or str(found) == str(known):
                return known
        raise ValueError(f"one of {', '.join(map(str, values))}")

    return check


def _batch_size(value: int, job: TrainingFacts) -> Meaning:
    if job.algorithm == "sac":
        return {("sac", "batch_size"): value}, ""
    parts = [part for part in range(1, job.steps + 1) if job.steps % part == 0]
    best = min(parts, key=lambda part: abs(math.log(job.steps * job.worlds / part / value)))
    size = job.steps * job.worlds // best
    note = (
        "" if size == value else f"a minibatch of each rank has {size} steps, since it has equally many of each world"
    )
    return {("ppo", "minibatches"): best}, note


def _num_epochs(value: int, job: TrainingFacts) -> Meaning:
    if job.algorithm == "sac":
        return {}, "sac makes no passes over a batch; sac.updates says how often it learns in an iteration"
    return {("ppo", "epochs"): value}, ""


def _lr(value: float, job: TrainingFacts) -> Meaning:
    if job.algorithm == "sac":
        rates = ("actor_learning_rate", "critic_learning_rate", "temperature_learning_rate")
        return {("sac", rate): value for rate in rates}, ""
    return {("ppo", "learning_rate"): value, ("ppo", "schedule"): "fixed"}, ""


def _beta_entropy(value: float, job: TrainingFacts) -> Meaning:
    if job.algorithm == "sac":
        return {}, "it is not used, since the entropy's weight in sac is sac_alpha"
    return {("ppo", "entropy_coef"): value}, ""


def _loss_type(value: str, job: TrainingFacts) -> Meaning:
    if job.algorithm == "sac":
        return {}, "it is not used: sac learns a distribution of the return, by its cross-entropy"
    if value == "huber":
        return {}, "the loss of the value is its squared error, whose gradients ppo.max_grad_norm bounds"
    return {}, ""


def _num_episodes(value: int, job: TrainingFacts) -> Meaning:
    if job.algorithm == "sac":
        return {}, "sac learns after every sac.steps control steps of each world, whatever episodes have ended"
    steps = min(max(8 * math.ceil(value * EPISODE / job.worlds / 8), FEWEST_STEPS), MOST_STEPS)
    cars = f"{steps} control steps of each of {job.worlds} cars"
    return {
        ("ppo", "steps"): steps
    }, f"an iteration is {cars} ({value} episodes of {EPISODE} steps are {value * EPISODE})"


def _exploration_type(value: str, job: TrainingFacts) -> Meaning:
    if value == "e-greedy":
        raise ValueError("ppo and sac draw actions from the policy itself; use categorical")
    if value == "additive noise" and job.algorithm == "ppo":
        return (
            {},
            "it is that of SAC, and ppo draws actions from the policy itself; a file of SAC wants train.algorithm: sac",
        )
    return {}, ""


def _stack_size(value: int, job: TrainingFacts) -> Meaning:
    if job.has_camera:
        return {("config", "front", "frames"): value}, ""
    if value > 1:
        raise ValueError("it stacks images, and the task sees none; use task RacerPixels, or 1")
    return {}, ""


def _sac_alpha(value: float, job: TrainingFacts) -> Meaning:
    if job.algorithm == "ppo":
        return {}, "it is not used by ppo"
    if not value:
        raise ValueError("sac adapts its temperature, from more than 0 on; use a small one, such as 0.001")
    return {("sac", "init_temperature"): value}, "it is the temperature at first, which sac then adapts"


_ENDS = "it ends no training; train.iterations says how long it is"
_UNKNOWN = "it changes nothing, as on AWS, which does not know it"
_GREEDY = "it is not used without e-greedy exploration"

_ALSO = {
    "learning_rate": "lr",
    "gamma": "discount_factor",
    "epochs": "num_epochs",
    "entropy": "beta_entropy",
    "loss": "loss_type",
}
"""Hyperparameters by the names that other trainers give them."""

KNOWN: Mapping[str, Hyperparameter] = {
    "batch_size": Hyperparameter(_one_of(32, 64, 128, 256, 512), _batch_size),
    "num_epochs": Hyperparameter(_whole(3, 10), _num_epochs),
    "lr": Hyperparameter(_number(1e-8, 1e-3), _lr),
    "discount_factor": Hyperparameter(_number(0, 1), lambda value, job: ({(job.algorithm, "gamma"): value}, "")),
    "beta_entropy": Hyperparameter(_number(0, 1), _beta_entropy),
    "loss_type": Hyperparameter(_one_of("huber", "mean squared error"), _loss_type),
    "num_episodes_between_training": Hyperparameter(_whole(1, 100), _num_episodes),
    "exploration_type": Hyperparameter(_one_of("categorical", "e-greedy", "additive noise"), _exploration_type),
    "e_greedy_value": Hyperparameter(_number(0, 1), _GREEDY),
    "epsilon_steps": Hyperparameter(_whole(0, math.inf), _GREEDY),
    "stack_size": Hyperparameter(_whole(1, 16), _stack_size),
    "sac_alpha": Hyperparameter(_number(0, 1), _sac_alpha),
    "term_cond_max_episodes": Hyperparameter(_whole(1, math.inf), _ENDS),
    "term_cond_avg_score": Hyperparameter(_number(-1e9, 1e9), _ENDS),
}
"""All of them."""
