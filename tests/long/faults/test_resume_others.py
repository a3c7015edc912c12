"""Every setting of ``sac``, ``rsl_rl`` and a custom algorithm is applied to what a resumed run's learner uses, or refused by name."""

from __future__ import annotations

import dataclasses
import inspect
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from rsl_rl.algorithms import PPO, Distillation
from rsl_rl.extensions import RandomNetworkDistillation

from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.initial_weights import TeacherCopy
from shared_store.volume.layout import Store
from tests.support.worker.clones import make_clone
from tests.support.worker.ranks import training
from tests.support.worker.runs import runner, train
from worker.learning.loop import Loop
from worker.learning.rsl.algorithm import RslRl
from worker.learning.sac.sac import SAC
from worker.settings.errors import UserError
from worker.settings.rsl_rl import RslRlConfig
from worker.settings.sac import SACConfig

SAC_RUN: dict[str, Any] = {
    **{"steps": 4, "updates": 2, "batch_size": 16, "replay_steps": 32, "warm_up": 4, "n_step": 1},
    **{"actor_sizes": [8], "critic_sizes": [8], "atoms": 11},
}
NETWORK = {"hidden_dims": [8]}
CURIOUS = {"num_outputs": 4, "predictor_hidden_dims": [8], "target_hidden_dims": [8], "weight": 1.0}
PPO_RUN: dict[str, Any] = {"num_steps_per_env": 8, "actor": NETWORK, "critic": NETWORK}
RND_RUN: dict[str, Any] = {**PPO_RUN, "algorithm": {"rnd_cfg": CURIOUS}}
PUPIL_RUN: dict[str, Any] = {
    **{"num_steps_per_env": 8, "algorithm": {"class_name": "Distillation", "gradient_length": 4}},
    **{"student": NETWORK, "teacher": NETWORK, "teacher_checkpoint": "rsl"},
}
OWN = "tests.support.worker.plain_ppo:PlainPPO"


def mirror(env: Any, obs: Any, actions: Any) -> tuple[Any, Any]:
    """Symmetry of nothing."""
    return obs, actions


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a run of each kind, of one iteration."""
    store = tmp_path_factory.mktemp("store")
    for run, settings in {"sac": SAC_RUN, "rsl": PPO_RUN, "rnd": RND_RUN, "pupil": PUPIL_RUN}.items():
        name = "sac" if run == "sac" else "rsl_rl"
        train(training(store, run=run, iterations=1, algorithm=name, **{name: settings}))
    train(training(store, run="own", iterations=1, algorithm=OWN, settings={"hidden_sizes": [8], "steps": 8}))
    return store


def go_on(store: Path, run: str, settings: dict[str, Any], **changes: Any) -> Loop:
    name = "sac" if run == "sac" else "rsl_rl"
    loop = runner(training(store, run=run, iterations=2, epoch=2, algorithm=name, **{name: settings}, **changes))
    assert loop.resumed is not None
    return loop


@pytest.fixture(scope="module")
def unchanged(store: Path) -> dict[str, Any]:
    """The learner of each run that goes on with its own settings."""
    own = {"sac": SAC_RUN, "rsl": PPO_RUN, "pupil": PUPIL_RUN}
    return {run: go_on(store, run, settings).algorithm for run, settings in own.items()}


# -- sac --------------------------------------------------------------------------------------------------------------


def rate(optimizer: str, group: int = 0, key: str = "lr") -> Callable[[SAC], float]:
    return lambda sac: getattr(sac.learner, f"_{optimizer}_optimizer").param_groups[group][key]


SAC_APPLIED: dict[str, tuple[Any, Callable[[SAC], Any]]] = {
    "steps": (8, lambda sac: len(sac._slots)),
    "updates": (4, lambda sac: len(sac._all_rows)),
    "policy_delay": (1, lambda sac: sac.config.policy_delay),
    "batch_size": (8, lambda sac: sac.learner.samples),
    "warm_up": (9, lambda sac: sac.config.warm_up),
    "combine": ("min", lambda sac: sac.learner.config.combine),
    "gamma": (0.5, lambda sac: float(sac.replay._powers[1])),
    "n_step": (2, lambda sac: sac.replay.n_step),
    "tau": (0.5, lambda sac: sac.learner.config.tau),
    "actor_learning_rate": (0.5, rate("policy")),
    "temperature_learning_rate": (0.5, rate("policy", 1)),
    "critic_learning_rate": (0.5, rate("critic")),
    "weight_decay": (0.5, rate("critic", 0, "weight_decay")),
    "max_grad_norm": (0.5, lambda sac: sac.learner.config.max_grad_norm),
    "save_replay": (False, lambda sac: bool(sac.world_state())),
    "target_entropy": (-1.0, lambda sac: sac.learner.config.target_entropy),
}
SAC_REFUSED: dict[str, Any] = {
    **{"actor_sizes": [4], "critic_sizes": [4], "critics": 3, "layer_norm": False, "critic_group": "critic"},
    **{"normalize_observations": False, "atoms": 12, "v_min": -5.0, "v_max": 5.0, "replay_steps": 64},
    **{"action_limit": 0.5, "init_std": 0.25, "init_temperature": 0.5},
}


def test_every_setting_of_sac_is_in_one_of_the_two_tables() -> None:
    assert {item.name for item in dataclasses.fields(SACConfig)} == {*SAC_APPLIED, *SAC_REFUSED}
    assert set(SACConfig.fixed) == SAC_REFUSED.keys()


@pytest.mark.parametrize("name", SAC_APPLIED)
def test_a_setting_of_sac_that_is_accepted_is_what_the_learner_uses(
    store: Path, unchanged: dict[str, Any], name: str
) -> None:
    value, used = SAC_APPLIED[name]
    before, after = unchanged["sac"], go_on(store, "sac", {**SAC_RUN, name: value}).algorithm
    assert isinstance(before, SAC) and isinstance(after, SAC)
    assert used(before) != pytest.approx(value) and used(after) == pytest.approx(value)


@pytest.mark.parametrize("name", SAC_REFUSED)
def test_a_setting_of_sac_that_its_state_holds_is_refused(store: Path, name: str) -> None:
    with pytest.raises(UserError, match=rf"sac\.{name} is .* there and .* here; start a new run for that"):
        go_on(store, "sac", {**SAC_RUN, name: SAC_REFUSED[name]})


# -- rsl_rl -----------------------------------------------------------------------------------------------------------


def of(name: str) -> Callable[[RslRl], Any]:
    return lambda algorithm: getattr(algorithm.algorithm, name)


RSL_APPLIED: dict[str, tuple[Any, Callable[[RslRl], Any]]] = {
    "num_steps_per_env": (4, lambda algorithm: algorithm.algorithm.storage.num_transitions_per_env),
    "torch_compile_mode": (
        "default",
        lambda rsl: "default" if rsl.algorithm.actor is not rsl.algorithm._raw_actor else None,
    ),
    "algorithm.num_learning_epochs": (3, of("num_learning_epochs")),
    "algorithm.num_mini_batches": (2, of("num_mini_batches")),
    "algorithm.clip_param": (0.1, of("clip_param")),
    "algorithm.gamma": (0.5, of("gamma")),
    "algorithm.lam": (0.5, of("lam")),
    "algorithm.value_loss_coef": (0.5, of("value_loss_coef")),
    "algorithm.entropy_coef": (0.5, of("entropy_coef")),
    "algorithm.learning_rate": (0.5, lambda rsl: rsl.learning_rate),
    "algorithm.max_grad_norm": (0.5, of("max_grad_norm")),
    "algorithm.use_clipped_value_loss": (False, of("use_clipped_value_loss")),
    "algorithm.schedule": ("fixed", of("schedule")),
    "algorithm.desired_kl": (0.5, of("desired_kl")),
    "algorithm.normalize_advantage_per_mini_batch": (True, of("normalize_advantage_per_mini_batch")),
    "algorithm.use_mixed_precision": (True, of("use_mixed_precision")),
    "algorithm.grad_reduce_bucket_mb": (5, of("grad_reduce_bucket_mb")),
    "algorithm.symmetry_cfg": (
        {"use_data_augmentation": True, "data_augmentation_func": f"{__name__}:mirror"},
        lambda rsl: None if rsl.algorithm.symmetry is None else RSL_APPLIED["algorithm.symmetry_cfg"][0],
    ),
}
RSL_REFUSED: dict[str, Any] = {
    "obs_groups": {"critic": ["policy"]},
    "actor": {"hidden_dims": [4]},
    "critic": {"hidden_dims": [4]},
    "algorithm.class_name": "rsl_rl.algorithms:PPO",
    "algorithm.optimizer": "adamw",
    "algorithm.rnd_cfg": CURIOUS,
}
RND_APPLIED: dict[str, Any] = {"weight": 0.5, "weight_schedule": {"mode": "step", "final_step": 9, "final_value": 0.0}}
RND_REFUSED: dict[str, Any] = {
    **{"num_outputs": 3, "predictor_hidden_dims": [4], "target_hidden_dims": [4], "activation": "tanh"},
    **{"state_normalization": True, "reward_normalization": True, "learning_rate": 0.5},
}
PUPIL_APPLIED: dict[str, tuple[Any, Callable[[RslRl], Any]]] = {
    "algorithm.num_learning_epochs": (3, of("num_learning_epochs")),
    "algorithm.gradient_length": (2, of("gradient_length")),
    "algorithm.learning_rate": (0.5, lambda rsl: rsl.learning_rate),
    "algorithm.max_grad_norm": (0.5, of("max_grad_norm")),
    "algorithm.loss_type": (
        "huber",
        lambda rsl: "huber" if rsl.algorithm.loss_fn is torch.nn.functional.huber_loss else "mse",
    ),
    "algorithm.use_mixed_precision": (True, of("use_mixed_precision")),
    "algorithm.grad_reduce_bucket_mb": (5, of("grad_reduce_bucket_mb")),
}
PUPIL_REFUSED: dict[str, Any] = {
    **{"student": {"hidden_dims": [4]}, "teacher": {"hidden_dims": [4]}, "teacher_checkpoint": "rnd"},
    **{"algorithm.class_name": "PPO", "algorithm.optimizer": "adamw"},
}
SET_BY_MUSTER = {"self", "storage", "device", "multi_gpu_cfg", "kwargs", "actor", "critic", "student", "teacher"}
"""What an algorithm of rsl_rl is built of, beside its settings."""


def parameters(kind: Any) -> set[str]:
    return {f"algorithm.{name}" for name in inspect.signature(kind.__init__).parameters if name not in SET_BY_MUSTER}


def with_value(settings: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    first, _, rest = key.partition(".")
    return {**settings, first: with_value(settings.get(first) or {}, rest, value) if rest else value}


def test_every_setting_of_rsl_rl_is_in_one_of_the_tables() -> None:
    tables = {*RSL_APPLIED, *RSL_REFUSED, *PUPIL_APPLIED, *PUPIL_REFUSED}
    assert {item.name for item in dataclasses.fields(RslRlConfig)} == {key.partition(".")[0] for key in tables}
    own = {"algorithm.class_name"}
    assert {key for key in (*RSL_APPLIED, *RSL_REFUSED) if "." in key} == parameters(PPO) | own
    assert {key for key in (*PUPIL_APPLIED, *PUPIL_REFUSED) if "." in key} == parameters(Distillation) | own
    curious = set(inspect.signature(RandomNetworkDistillation.__init__).parameters)
    assert {*RND_APPLIED, *RND_REFUSED} == curious - {"self", "num_states", "obs_groups", "device"}
    refused = {*RSL_REFUSED, *PUPIL_REFUSED} - {"algorithm.rnd_cfg"}
    assert set(RslRlConfig.fixed) == refused | {f"algorithm.rnd_cfg.{name}" for name in RND_REFUSED}


@pytest.mark.parametrize(
    ("run", "key"), [*(("rsl", key) for key in RSL_APPLIED), *(("pupil", key) for key in PUPIL_APPLIED)]
)
def test_a_setting_of_rsl_rl_that_is_accepted_is_what_the_learner_uses(
    store: Path, unchanged: dict[str, Any], run: str, key: str
) -> None:
    value, used = (RSL_APPLIED if run == "rsl" else PUPIL_APPLIED)[key]
    settings = with_value(PPO_RUN if run == "rsl" else PUPIL_RUN, key, value)
    before, after = unchanged[run], go_on(store, run, settings).algorithm
    assert isinstance(before, RslRl) and isinstance(after, RslRl)
    assert used(before) != value and used(after) == value


@pytest.mark.parametrize(
    ("run", "key", "value"),
    [
        *(("rsl", key, value) for key, value in RSL_REFUSED.items()),
        *(("pupil", key, value) for key, value in PUPIL_REFUSED.items()),
        *(("rnd", f"algorithm.rnd_cfg.{key}", value) for key, value in RND_REFUSED.items()),
        ("rnd", "algorithm", {}),
    ],
)
def test_a_setting_of_rsl_rl_that_its_state_holds_is_refused(store: Path, run: str, key: str, value: Any) -> None:
    settings = {"rsl": PPO_RUN, "pupil": PUPIL_RUN, "rnd": RND_RUN}[run]
    name = key + "." if value == CURIOUS else "algorithm.rnd_cfg." if value == {} else key
    with pytest.raises(UserError) as error:
        go_on(store, run, with_value(settings, key, value))
    message = str(error.value)
    if key == "algorithm.class_name" and run == "pupil":
        assert "train.rsl_rl.algorithm.gradient_length: there is no such key" in message
    else:
        assert f"rsl_rl.{name}" in message and " there and " in message and "start a new run for that" in message, (
            message
        )


@pytest.mark.parametrize("key", RND_APPLIED)
def test_a_setting_of_curiosity_that_is_accepted_is_what_it_uses(store: Path, key: str) -> None:
    settings = with_value(RND_RUN, f"algorithm.rnd_cfg.{key}", RND_APPLIED[key])
    curiosity = go_on(store, "rnd", settings).algorithm.algorithm.rnd
    if key == "weight":
        assert curiosity.initial_weight == pytest.approx(0.5 * 0.1), "rsl_rl scales it by the length of a step"
    else:
        assert curiosity.weight_scheduler is not None or curiosity.weight_scheduler_params is not None


# -- one's own --------------------------------------------------------------------------------------------------------


def go_on_with_own(store: Path, **settings: Any) -> Loop:
    values = {"hidden_sizes": [8], "steps": 8, **settings}
    return runner(training(store, run="own", iterations=2, epoch=2, algorithm=OWN, settings=values))


def test_settings_of_an_algorithm_of_ones_own_are_applied_or_refused_as_its_class_says(store: Path) -> None:
    assert go_on_with_own(store, gamma=0.5).algorithm.config.gamma == 0.5
    with pytest.raises(UserError, match=r": settings\.hidden_sizes is \[8\] there and \[9\] here; start a new run"):
        go_on_with_own(store, hidden_sizes=[9])


def test_a_pupil_that_goes_on_needs_its_teacher_s_run_no_more(store: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(store, tmp_path / "store"))
    shutil.rmtree(copy / "runs" / "rsl")
    assert go_on(copy, "pupil", PUPIL_RUN).algorithm.algorithm.teacher_loaded


def test_a_pupil_begins_with_the_copy_of_its_teacher_that_its_run_holds(store: Path, tmp_path: Path) -> None:
    opened = Store(Path(shutil.copytree(store, tmp_path / "store")))
    copy = TeacherCopy(opened, "test", "rsl", list_checkpoints(opened.run("rsl"))[-1])
    copy.copy("teacher")
    copy.publish(opened.run("waited").path)
    copy.close()
    shutil.rmtree(opened.run("rsl").path)  # while the job waited
    for reference in ("rsl", "rsl@1"):
        settings = {**PUPIL_RUN, "teacher_checkpoint": reference}
        started = runner(training(opened.path, run="waited", algorithm="rsl_rl", rsl_rl=settings)).algorithm
        original = go_on(store, "pupil", PUPIL_RUN).algorithm.state_dict()["teacher_state_dict"]["mlp.0.weight"]
        assert torch.equal(started.state_dict()["teacher_state_dict"]["mlp.0.weight"], original)
    with pytest.raises(UserError, match="run rsl has no checkpoint of iteration 2; available: 1"):
        runner(
            training(opened.path, run="waited", algorithm="rsl_rl", rsl_rl={**settings, "teacher_checkpoint": "rsl@2"})
        )


def test_how_often_is_saved_and_how_much_is_kept_apply_at_once(store: Path) -> None:
    loop = go_on(store, "sac", SAC_RUN, every=7, keep=3)
    assert loop.state.saver.keep == 3 and loop.cadence.due(7, {}) and not loop.cadence.due(6, {})


def test_a_teacher_of_an_older_muster_is_refused_in_one_line(store: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(store, tmp_path / "store"))
    (checkpoint,) = list_checkpoints(Store(copy).run("rsl"))
    manifest = checkpoint.path / "manifest.json"
    content = json.loads(manifest.read_text())
    del content["algorithm"]
    manifest.write_text(json.dumps(content))
    with pytest.raises(
        UserError, match=rf"^teacher_checkpoint: checkpoint {checkpoint.name} of run rsl is of an older"
    ):
        runner(training(copy, run="late", algorithm="rsl_rl", rsl_rl=PUPIL_RUN))


def test_a_clone_of_a_pupil_keeps_its_teacher_unless_it_names_another(store: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(store, tmp_path / "store"))
    train(training(copy, run="other", iterations=1, seed=8, algorithm="rsl_rl", rsl_rl=PPO_RUN))
    shutil.rmtree(copy / "runs" / "rsl")  # the pupil's teacher
    found = {}
    for name, teacher in {"same": "rsl", "another": "other"}.items():
        make_clone(copy, name, "pupil")
        settings = {**PUPIL_RUN, "teacher_checkpoint": teacher}
        found[name] = runner(training(copy, run=name, algorithm="rsl_rl", rsl_rl=settings)).algorithm.state_dict()
    original = go_on(copy, "pupil", PUPIL_RUN).algorithm.state_dict()
    for part, same, another in (("policy", True, True), ("teacher_state_dict", True, False)):
        for name, expected in (("same", same), ("another", another)):
            weights = found[name][part]["mlp.0.weight"]
            assert torch.equal(weights, original[part]["mlp.0.weight"]) is expected, (part, name)
