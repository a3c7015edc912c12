"""Benchmarks: loaded machines, contradictions, and beside peers their records, policies and judgements."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest
import torch
from rsl_rl.models.mlp_model import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict

from benchmarks import load
from benchmarks.peers import conversion, table
from benchmarks.processor import contradictions
from worker.tasks.declare.interface import Action, Interface, Observation


def record(peer: str, rate: float, seed: int = 0, **more: Any) -> dict[str, Any]:
    """A record of a training with 10 worlds, 24 steps and a warm iteration, at a constant rate."""
    curve = [
        {"seconds": number * 240 / rate, "env_steps": number * 240, "collect_s": 0.2, "learn_s": 0.1, "reward": 1.0}
        for number in (1, 2, 3)
    ]
    facts = {"peer": peer, "case": "go1", "limits": "theirs", "worlds": 10, "steps": 24, "seed": seed, "warm": 1}
    figures = {"rate": rate, "startup_s": 12.0, "first_s": 3.0, "device": "a GPU", "others": 0.01, "load_average": 0.5}
    return facts | figures | {"curve": curve, "checkpoints": [], "versions": {"mjlab": "1.6.0"}} | more


def test_the_table_has_medians_and_ratios_to_muster() -> None:
    rows = [record("muster", rate, seed) for seed, rate in enumerate((900.0, 1000.0, 1300.0))]
    rows += [record("mjlab", 250.0), record("rsl_rl", 400.0), record("muster", 700.0, algorithm="sac")]
    rows.append(record("mjlab", 500.0, limits="ours"))
    lines = [line for line in table.table(rows).splitlines() if line.startswith("| go1")]
    shown = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    assert [row[3] for row in shown] == ["Muster", "Muster (sac)", "rsl_rl's runner on Muster", *["mjlab 1.6.0"] * 2]
    assert shown[0][4:] == ["3", "1,000 (900 to 1,300)", "–", "200 ms", "100 ms", "12.0 s", "3.0 s"]
    assert [row[6] for row in shown[1:]] == ["1.4 ×", "2.5 ×", "4.0 ×", "–"]  # none of ours under the last's limits
    assert [row[1] for row in shown[3:]] == ["theirs (10/20, 1e-08)", "ours (4/8, 1e-08)"]


def test_the_table_says_when_muster_was_as_good_as_a_peer() -> None:
    def row(seconds: float, linear: float, angular: float, length: float) -> dict[str, float]:
        errors = {"linear_error": linear, "angular_error": angular, "length_share": length}
        return {"seconds": seconds, "env_steps": 1e6, **errors}

    facts = {"case": "go1", "limits": "theirs", "judged_limits": "theirs", "seed": 0, "device": "a GPU"}
    theirs = {**facts, "peer": "mjlab", "rows": [row(300.0, 0.5, 0.5, 0.9), row(600.0, 0.2, 0.3, 0.98)]}
    # the second is better at everything but the length
    own = [row(50.0, 0.3, 0.2, 1.0), row(100.0, 0.1, 0.1, 0.97), row(150.0, 0.2, 0.3, 0.98), row(200.0, 0.1, 0.1, 1.0)]
    ours = {**facts, "peer": "muster", "rows": own}
    text = table.table([record("muster", 1000.0)], [theirs, ours, {**ours, "seed": 1, "rows": own[:2]}])
    assert "| 98.0 % | 150.0 s (4.0 ×), 1 of 2 |" in text
    assert table.reached(own[:2], theirs["rows"][-1]) is None


def saved_actor(path: Path, observations: int = 7, actions: int = 3, normalized: bool = True) -> MLPModel:
    """An actor of rsl_rl that has met observations, and its checkpoint as rsl_rl writes it."""
    torch.manual_seed(3)
    example = TensorDict({"actor": torch.zeros(1, observations)}, batch_size=[1])
    reported: dict[str, Any] = {"class_name": GaussianDistribution, "init_std": 0.5}
    shape = {"hidden_dims": (16, 8), "activation": "elu", "obs_normalization": normalized, "distribution_cfg": reported}
    actor = MLPModel(example, {"actor": ["actor"]}, "actor", actions, **shape)
    if normalized:
        actor.train()
        actor.obs_normalizer.update(torch.randn(500, observations) * 4.0 + 2.0)
    torch.save({"actor_state_dict": actor.state_dict(), "iter": 4, "infos": {"env_state": {"steps": 96}}}, path)
    return actor.eval()


@pytest.mark.parametrize("normalized", [True, False])
def test_a_converted_policy_acts_as_rsl_rl_says(tmp_path: Path, normalized: bool) -> None:
    path = tmp_path / "model_4.pt"
    actor = saved_actor(path, normalized=normalized)
    policy = conversion.read_rsl_rl(path)
    seen = torch.randn(32, 7) * 3.0
    with torch.no_grad():
        expected = actor(TensorDict({"actor": seen}, batch_size=[32]))
    assert (policy.observations, policy.actions) == (7, 3)
    assert expected.std() > 0.01
    torch.testing.assert_close(policy.act({"policy": seen}), expected)
    probe = {"observations": seen.tolist(), "actions": expected.tolist()}
    conversion.check_probe(policy, probe)
    with pytest.raises(ValueError, match=r"acts otherwise than the one that was trained: actions are 0\.1"):
        conversion.check_probe(policy, probe | {"actions": (expected + 0.1).tolist()})


JOINTS = ("hip", "knee")
CONTRACT: dict[str, Any] = {
    "observations": {"base_lin_vel": 3, "joint_pos": 2, "joint_vel": 2, "actions": 2, "command": 3},
    "joints": ["hip", "knee"],
    "positions": [0.1, -0.2],
    "actions": ["hip", "knee"],
    "action_scale": [0.25, 0.5],
}


def interface(order: tuple[str, ...] = JOINTS, scale: float = 0.5, offset: float = -0.2) -> Interface:
    """What a task of two joints says of its policy."""
    names = [f"velocity_{axis}" for axis in "xyz"]
    names += [f"{joint}_{what}" for what in ("position", "velocity", "action") for joint in order]
    names += ["command_forward", "command_left", "command_turn"]
    actions = {
        "hip": Action("hip", "position", "rad", scale=0.25, default_position=0.1, offset=0.1),
        "knee": Action("knee", "position", "rad", scale=scale, default_position=offset, offset=offset),
    }
    return Interface(tuple(map(Observation, names)), tuple(actions[joint] for joint in order))


def test_a_policy_of_mjlab_fits_a_task_of_the_same_order_alone() -> None:
    conversion.check_contract(CONTRACT, interface(), "Own")
    widths = CONTRACT["observations"]
    wider = CONTRACT | {"observations": widths | {"command": 4}}
    turned = {name: widths[name] for name in ("joint_pos", "base_lin_vel", "joint_vel", "actions", "command")}
    for contract, own, words in (
        (CONTRACT, interface(("knee", "hip")), "action 0 moves joint hip in mjlab and knee in task Own"),
        (CONTRACT, interface(scale=0.4), r"joint knee: its scale is 0\.5 in mjlab and 0\.4 in task Own"),
        (CONTRACT, interface(offset=0.0), r"joint knee: its offset is -0\.2 in mjlab and 0 in task Own"),
        (wider, interface(), "mjlab's policy sees 13 values, task Own has 12"),
        (CONTRACT | {"observations": turned}, interface(), "sees joint_pos at 0 to 1, where task Own has velocity_x"),
    ):
        with pytest.raises(ValueError, match=words):
            conversion.check_contract(contract, own, "Own")


BUSY = "while :; do :; done"


def test_a_machine_on_which_others_work_is_refused_or_marked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(load, "WATCHED", 0.5)
    started = f"timeout 60 sh -c '{BUSY}' >/dev/null & echo $!"  # its parent ends: it is not a child of this process
    other = int(subprocess.run(["sh", "-c", started], stdout=subprocess.PIPE, text=True, check=True).stdout)
    try:
        with pytest.raises(SystemExit, match=r"the machine is loaded: other processes used \d+ % .*--loaded-anyway"):
            load.Watch(loaded_anyway=False)
        row = load.Watch(loaded_anyway=True).start
    finally:
        os.kill(other, signal.SIGTERM)
    assert row["others"] > load.LIMIT
    assert load.reported([row]).startswith("**The machine was loaded.** Other processes used at most ")
    assert "loaded" not in load.reported([{"others": 0.01, "load_average": 0.2}])


def test_a_training_that_took_longer_than_its_rate_says_is_a_contradiction() -> None:
    rates = [{"task": "Cartpole", "worlds": 64, "train": 64_740.0, "stock": 30_140.0}]
    curve = [[9.2, 153_600, 27.3, 300.0]]
    ours = {"task": "Cartpole", "worlds": 64, "seconds": 9.2, "curve": curve}
    theirs = {**ours, "stock": True, "seconds": 5.3}
    (line,) = contradictions(rates, [ours, theirs, {**ours, "worlds": 128}])
    assert line == "Cartpole with 64 worlds by Muster: 153,600 steps took 9.2 s, its rate says 2.4 s"
