"""A training with a reward function that is too long for a job's definition: its run goes on, and explains itself, without the upload."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from orchestrator.cli.submitting import submit_spec
from orchestrator.spec import file as specfile
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.evaluations import list_evaluations
from shared_store.volume.layout import Run, Store
from shared_store.volume.texts import digest_of
from tests.conftest import PATIENCE, Serving

LINE = [[round(0.01 * number, 2), 0.5, 2.0] for number in range(1500)]
FIRST = f"LINE = {LINE!r}\n\n\ndef reward_function(params):\n    return 1.0 + params['speed'] + LINE[7][0]\n"
SECOND = FIRST.replace("1.0 +", "2.0 +")
JOB = """
name: line
nodes: 1
resources: {cpus: 1, memory: 2GiB}
train:
  task: Racer
  worlds: 8
  iterations: 4
  ppo: {steps: 8, minibatches: 1, epochs: 1}
  config: {reward_function: first.py, episode_seconds: 1.0}
checkpoint: {every: 2}
"""


@pytest.fixture
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "job.yaml").write_text(JOB)
    (tmp_path / "first.py").write_text(FIRST)
    (tmp_path / "second.py").write_text(SECOND)
    return tmp_path


def rewarded(run: Run) -> str:
    """The text of the reward function in the newest checkpoint."""
    text: str = list_checkpoints(run)[-1].manifest["train"]["config"]["reward_function"]["text"]
    return text


def held(run: Run) -> set[str]:
    return {path.name for path in run.texts.iterdir()}


def test_a_killed_training_goes_on_and_its_run_is_resumed_cloned_and_evaluated_without_the_upload(
    server: Serving, directory: Path
) -> None:
    def succeeded(job: str) -> dict[str, Any]:
        found = server.wait(job, timeout=300 * PATIENCE)
        assert found["status"] == "SUCCEEDED", found["statusReason"]
        return found

    def started(*arguments: str) -> dict[str, Any]:
        done = server.muster(*arguments, "--json", cwd=directory)
        assert done.returncode == 0, done.stderr
        return succeeded(json.loads(done.stdout)["jobId"])

    def lose_uploads() -> None:
        shutil.rmtree(server.home / "store" / "texts")

    store = Store(server.home / "store")
    killed = submit_spec(server.client, specfile.load("job.yaml"), "job.yaml", {"MUSTER_KILL_AT": "3"})
    first = succeeded(killed["jobId"])
    run = store.run(first["run"])
    assert len(first["attempts"]) == 2, "the main rank was killed in iteration 3"
    assert (held(run), rewarded(run)) == ({digest_of(FIRST)}, FIRST)
    lose_uploads()
    (directory / "first.py").unlink()

    started("resume", run.name, "--set", "train.iterations=6")
    assert list_checkpoints(run)[-1].iteration == 6 and rewarded(run) == FIRST
    lose_uploads()
    copied = store.run(started("clone", run.name, "--name", "same", "--set", "train.iterations=2")["run"])
    assert (held(copied), rewarded(copied)) == ({digest_of(FIRST)}, FIRST)
    change = "train.config.reward_function=second.py"
    other = store.run(
        started("clone", run.name, "--name", "other", "--set", change, "--set", "train.iterations=2")["run"]
    )
    assert (held(other), rewarded(other)) == ({digest_of(SECOND)}, SECOND)

    change = "config.reward_function=second.py"
    done = server.muster("evaluate", run.name, "--episodes", "8", "--set", change, cwd=directory)
    assert done.returncode == 0, done.stdout + done.stderr
    evaluated = list_evaluations(run)[-1]
    assert evaluated["config"] == {"reward_function": {"file": "second.py", "sha256": digest_of(SECOND)}}
    assert held(run) == {digest_of(FIRST), digest_of(SECOND)}


def test_a_run_whose_text_was_altered_gets_it_again_at_the_next_attempt(server: Serving, directory: Path) -> None:
    job = submit_spec(server.client, specfile.load("job.yaml"), "job.yaml")["jobId"]
    run = Store(server.home / "store").run(server.wait(job, timeout=300 * PATIENCE)["run"])
    (run.texts / digest_of(FIRST)).write_text(SECOND)
    done = server.muster("resume", run.name, "--set", "train.iterations=6", "--json", cwd=directory)
    ended = server.wait(json.loads(done.stdout)["jobId"], timeout=300 * PATIENCE)
    assert (ended["status"], rewarded(run)) == ("SUCCEEDED", FIRST)
    assert (run.texts / digest_of(FIRST)).read_text() == FIRST
