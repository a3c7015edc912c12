"""A training with a learner's reward function through the real command, and a clone with a changed one."""

from __future__ import annotations

import json
from pathlib import Path

from shared_store.volume.layout import Store
from shared_store.volume.metrics import read_metrics
from tests.conftest import Serving

SMALL = ["train.worlds=8", "train.iterations=2", "checkpoint.every=1", "resources.cpus=1"]


def test_a_reward_function_trains_and_a_clone_changes_it(server: Serving, tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("def reward_function(params):\n    return 2.0\n")
    changes = [part for each in (*SMALL, f"train.config.reward_function={file}") for part in ("--set", each)]
    submitted = server.muster("submit", "job_specs/racer-reward.yaml", "--json", *changes)
    assert submitted.returncode == 0, submitted.stderr
    file.write_text("seen = []\n\n\ndef reward_function(params):\n    seen.append(params['steps'])\n    return 3\n")
    first = server.wait(json.loads(submitted.stdout)["jobId"], timeout=240)
    assert first["status"] == "SUCCEEDED", first["statusReason"]
    run = first["run"]
    kept = server.client.get(f"/api/runs/{run}")["spec"]["train"]["config"]["reward_function"]
    assert kept == {"file": str(file), "text": "def reward_function(params):\n    return 2.0\n"}
    assert f"{file}: compiled to the device" in "\n".join(server.log(first["id"]))

    change = f"train.config.reward_function={file}"
    refused = server.muster("resume", run, "--set", change, "--set", "train.iterations=3")
    assert refused.returncode == 2 and "reward_function.text is" in refused.stderr
    note, line = refused.stderr.splitlines()
    assert note.startswith("note: ") and f"muster clone {run} --name NEW" in line
    cloned = server.muster("clone", run, "--name", "changed", "--json", "--set", change)
    assert cloned.returncode == 0, cloned.stderr
    file.unlink()
    second = server.wait(json.loads(cloned.stdout)["jobId"], timeout=240)
    assert second["status"] == "SUCCEEDED", second["statusReason"]
    log = "\n".join(server.log(second["id"]))
    assert f"{file}: line 5: a list that grows: such functions run in Python workers" in log
    assert f"starting from the weights of {run}@2" in log
    for name, earned in ((run, 2.0), ("changed", 3.0)):
        for record in read_metrics(Store(server.home / "store").run(name)):
            if record["episodes"]:
                assert record["reward_reward"] == record["reward"] == earned * record["episode_length"]

    summary = server.client.get("/api/runs/changed/evaluations")[-1]
    assert list(summary["rewards"]) == ["reward"] and summary["mean_return"] == 3.0 * summary["mean_length"]
