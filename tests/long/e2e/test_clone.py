"""A training is cloned with other rewards, through the command, and killed once: the whole way at its smallest."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.layout import Store
from shared_store.volume.metrics import history_of
from tests.conftest import Serving, wait_for
from tests.support.processes import kill_rank
from tests.support.worker.trained import run_in

LAST = 100


def test_a_clone_trains_on_with_other_rewards_and_goes_on_when_it_is_killed(trained_home: Path, tmp_path: Path) -> None:
    home = shutil.copytree(trained_home, tmp_path / "home")
    source, store = run_in(home), Store(home / "store")
    (held,) = [each for each in list_checkpoints(source) if each.iteration == 1]
    weights = (held.path / "learner.pt").read_bytes()
    with Serving(home, "--cpus", "4") as server:
        changes = ["train.config.rewards.alive=40.0", f"train.iterations={LAST}", "train.seed=4"]
        options = [part for each in changes for part in ("--set", each)]
        done = server.muster("clone", f"{source.name}@1", "--name", "prouder", "--json", *options)
        assert done.returncode == 0, done.stderr
        shutil.rmtree(source.path)
        job, clone = json.loads(done.stdout)["jobId"], store.run("prouder")
        wait_for(lambda: list_checkpoints(clone), timeout=300, what="the clone's first checkpoint")
        kill_rank(job, 0)
        detail = server.wait(job, timeout=300)
        assert detail["status"] == "SUCCEEDED", detail["statusReason"]
        assert len(detail["attempts"]) == 2 and detail["results"]["parent"]["iteration"] == 1
        log = server.log(job)

    started = f"starting from the weights of {source.name}@1 (checkpoint {held.name}): 8 worlds"
    assert sum(started in each for each in log) == 1
    assert sum("resumed from checkpoint" in each for each in log) == 1
    assert (clone.parent / held.name / "learner.pt").read_bytes() == weights
    newest = list_checkpoints(clone)[-1]
    assert newest.iteration == LAST and newest.manifest["train"]["config"] == {"rewards": {"alive": 40.0}}
    records = history_of(clone).after(0, 1000)
    assert [each["iteration"] for each in records] == list(range(1, LAST + 1))
    alive = [each["reward_alive"] / each["episode_length"] for each in records if each["episodes"]]
    assert alive and all(each > 20.0 for each in alive), "the rewards are the new ones"
