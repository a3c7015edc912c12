"""Automatic evaluations beside a real training, with a controller that is killed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from shared_store.volume.checkpoints import best_checkpoint
from shared_store.volume.evaluations import list_evaluations
from shared_store.volume.layout import Store
from tests.conftest import Serving
from tests.support.waiting import wait_for

SPEC = """
name: pole
resources: {cpus: 1, memory: 1GiB}
train: {task: Cartpole, worlds: 4, iterations: 1000000, ppo: {hidden_sizes: [8]}}
checkpoint: {every: 200, keep: 2}
evaluation: {every: 1, episodes: 4, worlds: 4}
"""


def evaluations_of(server: Serving) -> list[dict[str, Any]]:
    filters = [{"name": "JOB_NAME", "values": ["evaluate-*"]}]
    listed = server.client.batch("ListJobs", jobQueue="default", filters=filters)["jobSummaryList"]
    return [server.detail(each["jobId"]) for each in listed]


def test_checkpoints_are_evaluated_beside_a_training_once_each_though_the_controller_is_killed(
    server: Serving, tmp_path: Path
) -> None:
    (tmp_path / "pole.yaml").write_text(SPEC)
    submitted = server.muster("submit", str(tmp_path / "pole.yaml"), "--json")
    assert submitted.returncode == 0, submitted.stderr
    training = json.loads(submitted.stdout)["jobId"]
    wait_for(lambda: [each for each in evaluations_of(server) if each["status"] == "RUNNING"], 60, "an evaluation")
    server.kill()
    server.start()
    run = Store(server.home / "store").run(server.detail(training)["run"])
    wait_for(lambda: len(list_evaluations(run)) >= 2, 60, "two evaluations")
    server.client.batch("TerminateJob", jobId=training, reason="enough")
    server.wait(training, "FAILED")
    for each in evaluations_of(server):
        server.wait(each["id"], "SUCCEEDED")
    jobs = evaluations_of(server)
    found = list_evaluations(run)
    requested = [each["spec"]["evaluate"]["checkpoint"] for each in jobs]
    assert len(requested) == len(set(requested)) and len({each["checkpoint"] for each in found}) == len(found)
    assert {each["job"] for each in found} == {each["id"] for each in jobs}
    assert not any(each["keep"] for each in found)
    best, reported = best_checkpoint(run), server.detail(training)["results"]
    means = {each["checkpoint"]: each["mean_return"] for each in found}
    assert best is not None and means[best.name] == max(means.values()), "the best one is never pruned"
    assert reported["best"]["checkpoint"] == best.name and reported["best"]["of"] == len(means)
    assert reported["automatic"]["status"] == "SUCCEEDED"
