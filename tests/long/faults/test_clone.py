"""A clone begins with the weights of another run's checkpoint and with nothing else of it, whatever becomes of that run."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.initial_weights import parent_checkpoint
from shared_store.volume.layout import Store
from tests.support.worker.clones import make_clone
from tests.support.worker.plain_ppo import PlainPPO
from tests.support.worker.point_task import Point
from tests.support.worker.ranks import training
from tests.support.worker.runs import assert_same_bits, last, runner, tensors, train
from worker.learning.algorithms import installed
from worker.learning.loop import Loop
from worker.learning.ppo.fused import PPO
from worker.settings.errors import UserError

SMALL_SAC = {
    **{"steps": 4, "updates": 2, "batch_size": 16, "replay_steps": 32, "warm_up": 4, "n_step": 1},
    **{"actor_sizes": [8], "critic_sizes": [8], "atoms": 11},
}
SMALL_RSL = {"num_steps_per_env": 8, "actor": {"hidden_dims": [8]}, "critic": {"hidden_dims": [8]}}
KINDS: dict[str, dict[str, Any]] = {
    "ppo": {},
    "sac": {"algorithm": "sac", "sac": SMALL_SAC},
    "rsl_rl": {"algorithm": "rsl_rl", "rsl_rl": SMALL_RSL},
    "own": {"algorithm": "tests.support.worker.plain_ppo:PlainPPO", "settings": {"hidden_sizes": [8], "steps": 8}},
}
"""The training of each kind of algorithm."""


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a run of each kind, of four iterations."""
    store = tmp_path_factory.mktemp("store")
    for name, settings in KINDS.items():
        train(training(store, run=name, iterations=4, every=2, **settings))
    return store


@pytest.fixture
def store(trained: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(trained, tmp_path / "store"))


def learnt(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = torch.load(path / "learner.pt", weights_only=True)["algorithm"]
    return found


def is_network(name: str) -> bool:
    """Whether a tensor of an algorithm's state is a weight or belongs to a normaliser."""
    kept = ("policy", "critic", "critics", "targets", "critic_normalizers", "critic_state_dict")
    return name.split("/")[1] in kept


@pytest.mark.parametrize("kind", KINDS)
def test_the_first_policy_has_the_source_s_bits_and_all_else_is_new(
    store: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    source = learnt(last(store, kind))
    assert int(list_checkpoints(Store(store).run(kind))[-1].manifest["env_steps"]) > 0
    make_clone(store, "clone", kind)
    shutil.rmtree(store / "runs" / kind)  # nothing that befalls the source matters
    started = runner(training(store, run="clone", iterations=4, **KINDS[kind]))
    assert started.resumed is None and started.adopted is not None and started.adopted.iteration == 4
    assert f"starting from the weights of {kind}@4 (checkpoint 00000004-e1): 8 worlds on 1 rank" in started._beginning()
    own, existing = (tensors(dict(state)) for state in (started.algorithm.state_dict(), source))
    networks = [name for name in existing if is_network(name) and isinstance(existing[name], torch.Tensor)]
    assert len(networks) > 6 and any("obs_normalizer" in name or "mean" in name for name in networks)
    for name in networks:
        assert torch.equal(own[name], existing[name]), name
    saved = [name for name in existing if "optimizer" in name and "/state/" in name]
    assert saved and not any(name in own for name in saved if "optimizer" in name), "the optimizer is new"
    assert started.state.progress.iteration == 0 == started.state.progress.env_steps
    fresh = runner(training(store, run="fresh", iterations=4, **KINDS[kind]))
    for name, tensor in fresh.task.state_dict().items():
        assert torch.equal(started.task.state_dict()[name], tensor), f"{name} of the worlds is new"


def test_the_learning_rate_is_the_setting_s_and_not_the_adapted_one(store: Path) -> None:
    adapted = list_checkpoints(Store(store).run("ppo"))[-1].manifest["learning_rate"]
    make_clone(store, "clone", "ppo")
    started = runner(training(store, run="clone", ppo={"learning_rate": 2e-4}))
    assert isinstance(started.algorithm, PPO) and float(started.algorithm._rate) == pytest.approx(2e-4) != adapted


def test_another_configuration_seed_and_length_apply_and_are_in_the_manifest(store: Path) -> None:
    make_clone(store, "clone", "ppo")
    train(
        training(store, run="clone", iterations=1, seed=9, config={"limit": 2.0, "control_hz": 20.0}, ppo={"steps": 4})
    )
    manifest = list_checkpoints(Store(store).run("clone"))[-1].manifest
    assert manifest["train"]["config"] == {"limit": 2.0, "control_hz": 20.0} and manifest["train"]["seed"] == 9
    assert manifest["contract"]["control_hz"] == 20.0 and manifest["iteration"] == 1
    assert manifest["env_steps"] == 8 * 4


def test_a_clone_that_was_killed_before_its_first_checkpoint_begins_with_the_same_weights_again(store: Path) -> None:
    for name in ("straight", "killed"):
        make_clone(store, name, "ppo")
    train(training(store, run="straight", iterations=4, every=2))
    started = runner(training(store, run="killed", iterations=4, every=2))
    started._iterate()  # it dies here: nothing was saved
    assert not list_checkpoints(Store(store).run("killed"))
    again = train(training(store, run="killed", iterations=2, every=2, epoch=2))
    assert again.adopted is not None
    after = train(training(store, run="killed", iterations=4, every=2, epoch=3))
    assert after.adopted is None and after.resumed is not None and after.resumed.iteration == 2
    assert_same_bits(last(store, "straight"), last(store, "killed"))
    assert not torch.equal(
        learnt(last(store, "straight"))["policy"]["mlp.0.weight"], learnt(last(store, "ppo"))["policy"]["mlp.0.weight"]
    )


# -- what does not fit -----------------------------------------------------------------------------------------------


class Wide(Point):
    """With one observation more."""

    observation_shape = (3,)
    observation_names = ("place", "velocity", "nothing")

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.groups = {name: torch.zeros(self.world_count, 3) for name in self.groups}
        self.terminal_groups = {name: torch.zeros(self.world_count, 3) for name in self.groups}


class Renamed(Point):
    observation_names = ("place", "speed")


def begin(store: Path, task: Any = Point, **settings: Any) -> Loop:
    return runner(training(store, run="clone", **settings), task=task)


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        ("ppo", {"ppo": {"hidden_sizes": [8]}}, r"ppo.hidden_sizes is \[16, 16\] there and \[8\] here; leave"),
        ("ppo", {"ppo": {"normalize_observations": False}}, "ppo.normalize_observations is True there and False here"),
        ("ppo", {"ppo": {"init_std": 0.5}}, "ppo.init_std is 1.0 there and 0.5 here"),
        ("sac", {**KINDS["sac"], "sac": {**SMALL_SAC, "v_max": 5.0}}, "sac.v_max is 20.0 there and 5.0 here"),
        (
            "rsl_rl",
            {**KINDS["rsl_rl"], "rsl_rl": {**SMALL_RSL, "actor": {"hidden_dims": [9]}}},
            "actor.hidden_dims is ",
        ),
        (
            "ppo",
            KINDS["own"],
            r"fit this job: policy\.std is not there; they are of algorithm ppo, and tests\..*:Plain",
        ),
        ("ppo", KINDS["rsl_rl"], "are of algorithm ppo, which rsl_rl can't read; set train.algorithm: ppo"),
        ("own", {}, r"fit this job: policy\.\S+ is not there; they are of algorithm tests\.\S+, and ppo "),
    ],
)
def test_weights_that_do_not_fit_are_refused_in_one_line(
    store: Path, kind: str, settings: dict[str, Any], message: str
) -> None:
    make_clone(store, "clone", kind)
    with pytest.raises(UserError, match=message) as error:
        begin(store, **settings)
    assert "00000004-e1" in str(error.value) and "\n" not in str(error.value)


def test_other_observations_are_named_with_the_tensor(store: Path) -> None:
    make_clone(store, "clone", "ppo")
    with pytest.raises(UserError) as error:
        begin(store, Wide)
    assert str(error.value) == (
        "the weights of checkpoint 00000004-e1 do not fit this job: policy.obs_normalizer._mean has shape (1, 2) there and "
        "(1, 3) here; there observations critic [2], policy [2] and 1 actions (task Point), here observations critic [3], "
        "policy [3] and 1 actions (task Point)"
    )


def test_observations_of_other_names_are_warned_of(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_clone(store, "clone", "ppo")
    begin(store, Renamed)
    assert "warning: the weights were learnt with another policy contract: " in (message := capsys.readouterr().out)
    assert "observation 1: velocity is gone; observation 1: speed is new" in message


@dataclasses.dataclass
class Reader(PlainPPO):
    """Reads the weights of the fused PPO, too."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)

    def load_state_dict(self, state: Any, *, weights_only: bool = False, changed: Any = ()) -> list[str]:
        if "obs_normalizer._mean" in state["policy"]:
            assert weights_only
            self.actor.layers[0].weight.data.copy_(state["policy"]["mlp.0.weight"])
            return []
        return super().load_state_dict(state, weights_only=weights_only, changed=changed)


def test_an_algorithm_of_ones_own_may_read_another_s_weights(store: Path) -> None:
    make_clone(store, "clone", "ppo")
    settings = {"hidden_sizes": [16, 16], "steps": 8}
    started = begin(store, algorithm=f"{__name__}:Reader", settings=settings)
    weights = learnt(last(store, "ppo"))["policy"]["mlp.0.weight"]
    assert torch.equal(started.algorithm.actor.layers[0].weight, weights)
    assert "reader" not in installed()


@pytest.mark.parametrize("harm", ["missing", "altered", "all of it"])
def test_weights_that_are_damaged_or_gone_are_refused(store: Path, harm: str) -> None:
    run = make_clone(store, "clone", "ppo")
    parent = parent_checkpoint(run)
    assert parent is not None
    weights = parent.path / "learner.pt"
    if harm == "missing":
        weights.unlink()
    elif harm == "altered":
        data = bytearray(weights.read_bytes())
        data[-1] ^= 1
        weights.write_bytes(data)
    else:  # someone deleted the run while its job waited; the controller then made a new one
        shutil.rmtree(run.path)
        run.path.mkdir()
    message = {
        "missing": "learner.pt is missing",
        "altered": "was altered",
        "all of it": "run.json does not name them",
    }[harm]
    with pytest.raises(
        UserError, match=f"run clone can't begin with the weights of ppo@4: .*{message}.*clone it again"
    ):
        begin(store, MUSTER_PARENT="ppo@4")
