"""A user's own algorithm, as it is shipped: it learns, a run of it that is killed ends with the same bits, and what it learnt is used."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import torch
import yaml

from shared_store.volume.evaluations import list_evaluations
from shared_store.volume.layout import Store
from shared_store.volume.metrics import read_metrics
from tests.conftest import REPOSITORY, run_muster
from tests.support.worker.loop import iterate, mean_return, setting_of
from tests.support.worker.point_task import Point, PointConfig
from tests.support.worker.ranks import run_ranks, training
from worker.learning.algorithms import find_algorithm, settings

SPEC = "job_specs/my-algorithm.yaml"
OWN = "job_specs.my_algorithm:Mine"


@pytest.fixture
def mine(monkeypatch: pytest.MonkeyPatch) -> type:
    monkeypatch.chdir(REPOSITORY)
    return find_algorithm(OWN)


def test_the_example_is_as_short_as_a_page_or_two() -> None:
    lines = [line for line in (REPOSITORY / "job_specs/my_algorithm.py").read_text().splitlines() if line.strip()]
    assert len(lines) < 150


def test_it_learns_cartpole_as_it_is_shipped(mine: type) -> None:
    """By the settings of the YAML and as many iterations; the greatest return that there could be is 30."""
    from worker.tasks.library.cartpole import Cartpole, CartpoleConfig

    section = yaml.safe_load((REPOSITORY / SPEC).read_text())["train"]
    assert section["task"] == "Cartpole" and section["algorithm"] == OWN
    torch.manual_seed(0)
    task = Cartpole(CartpoleConfig(), section["worlds"], seed=0)
    held_out = Cartpole(CartpoleConfig(), 64, seed=99)
    task.set_random_episode_length()
    algorithm = mine(settings(mine, OWN, CartpoleConfig(), section), setting_of(task))
    assert mean_return(algorithm.policy(), held_out) < 5.0
    iterate(algorithm, task, 0, section["iterations"])
    assert mean_return(algorithm.policy(), held_out) > 20.0


def test_killed_it_ends_with_the_same_bits_and_is_evaluated_and_exported(tmp_path: Path) -> None:
    """Through the real command, whose ranks see neither the tests nor their directory."""
    home = tmp_path / "home"
    small = ["--set", "train.worlds=16", "--set", "checkpoint.every=4"]
    done = run_muster("verify-resume", SPEC, "--at", "6", "--iterations", "3", *small, home=home, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"^equal: \d+ tensors, 9 iterations$", done.stdout, re.M), done.stdout
    killed = re.search(r"^killed: +(\S+), by SIGKILL .* resumed from iteration (\d+)$", done.stdout, re.M)
    assert killed and int(killed[2]) in (0, 4), done.stdout
    run = Store(home / "store").run(killed[1])
    assert [record["iteration"] for record in read_metrics(run)] == list(range(1, 10))
    assert {"policy_loss", "value_loss", "action_std"} <= read_metrics(run)[-1].keys()
    for kind in ("evaluate", "export"):
        spec = tmp_path / f"{kind}.yaml"
        section = {"run": run.name, **({"worlds": 4} if kind == "evaluate" else {})}
        resources = {"cpus": 1, "memory": "1GiB"}
        spec.write_text(yaml.safe_dump({"name": kind, "nodes": 1, "resources": resources, kind: section}))
        done = run_muster("run", str(spec), home=home, timeout=300)
        assert done.returncode == 0, done.stdout + done.stderr
    (exported,) = run.exports.iterdir()
    assert json.loads((exported / "contract.json").read_text())["groups"][0]["terms"]
    report = json.loads((exported / "report.json").read_text())
    assert report["parity"]["greatest_difference"]["onnx"] <= 1e-5 and report["judged"]["episodes"] == 16
    both = list_evaluations(run)  # at the end of the training, and of the job
    assert [each["checkpoint"] for each in both] == [exported.name] * 2 and both[1]["episodes"] == 100


def test_two_ranks_of_it_hold_the_same_weights(tmp_path: Path) -> None:
    """Checkpoints hold the main rank's alone; metrics are those of both."""
    ranks = run_ranks("long.faults.test_my_algorithm:one_of_two", 2, training(tmp_path), timeout=300)
    assert [code for code, _, _ in ranks] == [0, 0], ranks[0][2] + ranks[1][2]
    one, other = (json.loads(output.splitlines()[-1]) for _, output, _ in ranks)
    assert one == other


def one_of_two() -> int:
    """A rank: three iterations on the point task with worlds of its own; what came of it is the last line of its output."""
    import os

    from worker.learning.algorithm import WorldShare
    from worker.learning.distributed import RankPlacement, connect
    from worker.learning.randomness import seed_generators

    gang = connect(RankPlacement.from_env(os.environ))
    algorithm_type = find_algorithm(OWN)
    share = WorldShare.of(gang.rank, gang.size, 5)
    task = Point(PointConfig(), share.count, seed=2, first_world=share.first)
    seed_generators(1, gang.rank)  # other weights on each rank, were they not shared
    algorithm = algorithm_type(algorithm_type.config_type(), setting_of(task, gang=gang, share=share))
    metrics = {name: float(value) for name, value in iterate(algorithm, task, 0, 3).items()}
    learnt = {name: value.tolist() for name, value in algorithm.policy().state_dict().items()}
    print(json.dumps([metrics, learnt]))
    gang.close()
    return 0
