"""A run's worlds are the same on any number of ranks: distributed anew at a resume, and at a restart with more room."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from shared_store.volume.checkpoints import Checkpoint, list_checkpoints
from shared_store.volume.layout import Store
from shared_store.volume.metrics import read_metrics
from tests.conftest import Serving, wait_for
from tests.support.processes import gang_members
from worker.learning.shards import Shards

WORLDS = 14
"""Of two ranks with seven each; three ranks can't have equally many."""
HOLDER = (
    'name: holder\nresources: {{cpus: {cpus}, memory: 16MiB}}\ncommand: [python, -c, "import time; time.sleep(600)"]\n'
)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    server = Serving(tmp_path_factory.mktemp("home"), "--cpus", "3")
    yield server
    server.close()


def submit(server: Serving, spec: Path | str, *changes: str) -> dict[str, Any]:
    options = [part for change in changes for part in ("--set", change)]
    done = server.muster("submit", str(spec), "--json", *options)
    assert done.returncode == 0, done.stderr
    return server.detail(json.loads(done.stdout)["jobId"])


def resume(server: Serving, run: str, *arguments: str) -> str:
    done = server.muster("resume", run, "--json", *arguments)
    assert done.returncode == 0, done.stderr
    return str(json.loads(done.stdout)["jobId"])


def hold(server: Serving, folder: Path, cpus: float) -> str:
    """A job that keeps ``cpus`` for itself."""
    spec = folder / f"holder-{cpus}.yaml"
    spec.write_text(HOLDER.format(cpus=cpus))
    job: str = submit(server, spec)["id"]
    server.wait(job, "RUNNING")
    return job


def end(server: Serving, job: str) -> None:
    assert server.muster("stop", job).returncode == 0


def newest(server: Serving, run: str) -> Checkpoint:
    return list_checkpoints(Store(server.home / "store").run(run))[-1]


@pytest.fixture(scope="module")
def resized(server: Serving, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path, list[Checkpoint]]:
    """A run of two iterations on 2 nodes, the third on 3, the fourth on 2; what each rank loaded; the checkpoints."""
    recorded = tmp_path_factory.mktemp("recorded")
    small = ["train.worlds=7", "train.iterations=2", "checkpoint.every=1", "resources.cpus=0.5", "nodes=2"]
    small.append("train.config.episode_seconds=0.5")  # and so the evaluations
    own = ["train.task=tests.support.faults.recorded:Recorded", f"environment.RECORDED={recorded}"]
    job = submit(server, "job_specs/cartpole.yaml", *small, *own)
    found = []
    for iteration, nodes in ((2, 2), (3, 3), (4, 2)):
        if iteration > 2:
            more = ["--set", f"train.iterations={iteration}"]
            job = server.detail(resume(server, job["run"], "--nodes", str(nodes), *more))
        ended = server.wait(job["id"], timeout=240)
        assert ended["status"] == "SUCCEEDED", ended["statusReason"]
        found.append(newest(server, job["run"]))
    return job["run"], recorded, found


def loaded(recorded: Path, epoch: int) -> list[dict[str, torch.Tensor]]:
    """What the ranks of an attempt loaded, in the order of their worlds."""
    files = sorted(recorded.glob(f"{epoch}-*.pt"), key=lambda path: int(path.stem.split("-")[1]))
    return [torch.load(path, weights_only=True) for path in files]


@pytest.mark.parametrize(("epoch", "counts"), [(2, [4, 5, 5]), (3, [7, 7])])
def test_every_world_goes_on_exactly_where_it_was(
    resized: tuple[str, Path, list[Checkpoint]], epoch: int, counts: list[int]
) -> None:
    _, recorded, checkpoints = resized
    saved = Shards(checkpoints[epoch - 2]).worlds(0, WORLDS)
    ranks = loaded(recorded, epoch)
    assert [len(rank["random"]) for rank in ranks] == counts
    assert ranks[0].keys() == saved.keys() and len(saved) >= 7
    for name, tensor in saved.items():
        assert torch.equal(torch.cat([rank[name] for rank in ranks]), tensor), name
    assert saved["random"][:, 1].tolist() == list(range(WORLDS)), "worlds keep their global index"
    assert len(saved["joint_q"].unique(dim=0)) == WORLDS, (
        "no two worlds are alike, so none can have changed places unseen"
    )


def test_the_run_keeps_its_worlds_and_its_history(server: Serving, resized: tuple[str, Path, list[Checkpoint]]) -> None:
    run, _, checkpoints = resized
    assert [checkpoint.manifest["worlds"] for checkpoint in checkpoints] == [WORLDS] * 3
    assert [len(checkpoint.manifest["shards"]) for checkpoint in checkpoints] == [2, 3, 2]
    records = read_metrics(Store(server.home / "store").run(run))
    steps = records[0]["env_steps"]
    assert steps % WORLDS == 0
    assert [record["env_steps"] for record in records] == [steps, 2 * steps, 3 * steps, 4 * steps]


def test_the_worlds_are_known_without_a_readable_checkpoint(
    server: Serving, resized: tuple[str, Path, list[Checkpoint]], tmp_path: Path
) -> None:
    """The worker falls back to an older checkpoint, or begins anew: either way with the run's worlds."""
    run, _, checkpoints = resized
    holder = hold(server, tmp_path, 3)
    for damage in (lambda: os.truncate(checkpoints[-1].path / "manifest.json", 10), remove_all(checkpoints)):
        damage()
        job = resume(server, run, "--nodes", "2", "--set", "train.iterations=9")
        (node,) = server.client.batch("DescribeJobs", jobs=[job])["jobs"][0]["nodeProperties"]["nodeRangeProperties"]
        assert {"name": "MUSTER_WORLDS", "value": str(WORLDS)} in node["container"]["environment"]
        end(server, job)
    end(server, holder)


def remove_all(checkpoints: list[Checkpoint]) -> Any:
    return lambda: shutil.rmtree(checkpoints[0].path.parent)


def test_an_elastic_gang_starts_with_what_is_free_and_grows_at_a_restart(server: Serving, tmp_path: Path) -> None:
    holder = hold(server, tmp_path, 1)
    small = ["train.worlds=8", "train.iterations=4000", "checkpoint.every=5", "resources.cpus=1"]
    job = submit(server, "job_specs/cartpole.yaml", *small, "nodes={min: 1, max: 3}", "retry.attempts=3")
    run = Store(server.home / "store").run(job["run"])
    running = server.wait(job["id"], "RUNNING")
    assert running["statusReason"] == "attempt 1 runs on 2 of 3 nodes: there is no room for more"
    assert len(running["attempts"][0]["nodes"]) == 2
    wait_for(lambda: list_checkpoints(run), 120, "a checkpoint")
    end(server, holder)
    assert len(server.detail(job["id"])["attempts"]) == 1, "room alone does not disturb a gang that runs"
    [rank] = gang_members(server.home, "rank", 1)
    rank.strike(signal.SIGKILL)
    wait_for(lambda: len(server.detail(job["id"])["attempts"]) == 2, 60, "a second attempt")
    reached = wait_for(lambda: re.search(r"resumed from checkpoint (\d+)", text(server, job, 2)), 120, "a restart")
    wait_for(lambda: read_metrics(run)[-1]["iteration"] > int(reached[1]), 60, "an iteration")
    grown = server.detail(job["id"])
    assert grown["statusReason"] == "attempt 2 runs on 3 nodes" and len(grown["attempts"][1]["nodes"]) == 3
    end(server, job["id"])
    assert "starting from new weights: 24 worlds on 2 ranks" in text(server, job, 1)
    assert re.search(r"resumed from checkpoint \S+: 24 worlds on 3 ranks", text(server, job, 2))
    records = read_metrics(run)
    assert [record["env_steps"] for record in records] == [
        records[0]["env_steps"] * i for i in range(1, len(records) + 1)
    ]


def text(server: Serving, job: dict[str, Any], attempt: int) -> str:
    return "\n".join(server.log(job["id"], attempt=attempt))
