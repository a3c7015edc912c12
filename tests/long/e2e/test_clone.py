"""A training is cloned with other rewards, through the command, and killed once: the whole way at its smallest."""

from __future__ import annotations

import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any

from shared_store.checkpoints import list_checkpoints
from shared_store.layout import Store
from shared_store.metrics import history_of
from tests.conftest import Serving, wait_for

SMALL = {"nodes": 1, "train.worlds": 8, "checkpoint.every": 1, "train.ppo.hidden_sizes": [8], "train.ppo.steps": 8}


def options(changes: dict[str, Any]) -> list[str]:
    return [part for key, value in changes.items() for part in ("--set", f"{key}={json.dumps(value)}")]


def ranks_of(home: Path, job: str) -> list[int]:
    """Process ids of the job's ranks."""
    found = []
    for each in Path("/proc").iterdir():
        try:
            ours = each.name.isdecimal() and "worker.train" in (each / "cmdline").read_text()
            if ours and f"MUSTER_JOB_ID={job}\0" in (each / "environ").read_text():
                found.append(int(each.name))
        except OSError:
            continue
    return found


def test_a_clone_trains_on_with_other_rewards_and_goes_on_when_it_is_killed(server: Serving) -> None:
    taught = json.loads(
        server.muster("submit", "job_specs/cartpole.yaml", "--json", *options({**SMALL, "train.iterations": 2})).stdout
    )
    detail = server.wait(taught["jobId"], timeout=300)
    assert detail["status"] == "SUCCEEDED", detail["statusReason"]
    source, store = detail["run"], Store(server.home / "store")
    (held,) = [each for each in list_checkpoints(store.run(source)) if each.iteration == 1]
    weights = (held.path / "learner.pt").read_bytes()

    changes = {"train.config": {"rewards": {"alive": 40.0}}, "train.iterations": 150, "train.seed": 4}
    done = server.muster("clone", f"{source}@1", "--name", "prouder", "--json", *options(changes))
    assert done.returncode == 0, done.stderr
    shutil.rmtree(store.run(source).path)
    job, clone = json.loads(done.stdout)["jobId"], store.run("prouder")
    wait_for(lambda: list_checkpoints(clone), timeout=300, what="the clone's first checkpoint")
    for rank in ranks_of(server.home, job):
        os.kill(rank, signal.SIGKILL)
    detail = server.wait(job, timeout=300)
    assert detail["status"] == "SUCCEEDED", detail["statusReason"]
    assert len(detail["attempts"]) == 2 and detail["results"]["parent"]["iteration"] == 1

    log = server.log(job)
    assert (
        sum(f"starting from the weights of {source}@1 (checkpoint {held.name}): 8 worlds" in each for each in log) == 1
    )
    assert sum("resumed from checkpoint" in each for each in log) == 1
    assert (clone.parent / held.name / "learner.pt").read_bytes() == weights
    newest = list_checkpoints(clone)[-1]
    assert newest.iteration == 150 and newest.manifest["train"]["config"] == {"rewards": {"alive": 40.0}}
    records = history_of(clone).after(0, 1000)
    assert [each["iteration"] for each in records] == list(range(1, 151))
    alive = [each["reward_alive"] / each["episode_length"] for each in records if each["episodes"]]
    assert alive and all(each > 20.0 for each in alive), "the rewards are the new ones"
