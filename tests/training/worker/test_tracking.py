"""W&B and MLflow for real: a training that is killed and goes on, one without a key, one whose server is away.

W&B offline, whose files are read again; MLflow on a database file. Both packages are extras:
`make services` installs them.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from shared_store.volume.epoch import raise_epoch
from shared_store.volume.layout import Run, Store
from shared_store.volume.metrics import read_metrics
from tests.conftest import PATIENCE
from tests.support.worker.ranks import ROOT, free_port, placement
from tests.support.worker.wandb_files import history, records
from worker.telemetry.services import MLflow, Tracked

TRAIN = {"task": "Cartpole", "worlds": 16, "iterations": 40, "seed": 5, "config": {"episode_seconds": 0.5}}


PATIENT = f"""
import runpy
from worker.telemetry import tracking_processes
tracking_processes.READY_SECONDS *= {PATIENCE}
tracking_processes.FAREWELL["finished"] *= {PATIENCE}
runpy.run_module("worker.train", run_name="__main__")
"""
"""A training that waits for its services for as long as a busy machine needs to import them."""


@pytest.fixture
def run(tmp_path: Path) -> Run:
    made = Store(tmp_path / "store").open().run("taught")
    made.create({"run": "taught", "spec": {"train": TRAIN, "track": {"mlflow": {}}}})
    return made


def train(
    run: Run, epoch: int, track: dict[str, Any], how: Sequence[str] = ("-m", "worker.train"), **env: str
) -> tuple[int, str]:
    """A rank as the supervisor starts it; exit code and output."""
    raise_epoch(run, epoch)
    spec = {"name": "taught", "train": TRAIN, "track": track, "checkpoint": {"every": 10, "keep": 5}}
    supplied = {
        **{"MUSTER_STORE": str(run.path.parent.parent), "MUSTER_RUN": run.name, "MUSTER_EPOCH": str(epoch)},
        **{"MUSTER_JOB_EPOCH": "1", "MUSTER_JOB_ID": "job", "MUSTER_SPEC": json.dumps(spec)},
        **{**placement(), "HOME": str(run.path), "NETRC": "/dev/null"},
    }
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("WANDB_", "MLFLOW_"))}
    done = subprocess.run(
        [sys.executable, *how],
        env={**kept, "PYTHONPATH": str(ROOT), **supplied, **env},
        cwd=run.path,
        capture_output=True,
        text=True,
        timeout=120 * PATIENCE,
    )
    return done.returncode, done.stdout + done.stderr


def killed_and_gone_on(run: Run, track: dict[str, Any]) -> list[dict[str, Any]]:
    """The records of a training that was killed on its way and went on; every iteration is there once."""
    code, output = train(run, 1, track, MUSTER_KILL_AT="33")
    assert code == -9, output
    code, output = train(run, 2, track, ("-c", PATIENT))
    assert code == 0 and "resumed from checkpoint 000000" in output and ": warning" not in output, output
    records = read_metrics(run)
    assert [each["iteration"] for each in records] == list(range(1, 41))
    return records


def test_a_training_that_was_killed_and_goes_on_is_one_run_of_each_service_with_every_iteration_once(run: Run) -> None:
    pytest.importorskip("wandb", reason="pip install 'muster[wandb]', or make services")
    mlflow = pytest.importorskip("mlflow", reason="pip install 'muster[mlflow]', or make services")
    uri = f"sqlite:///{run.path.parent.parent}/mlflow.db"
    track = {
        "wandb": {"mode": "offline", "project": "poles", "tags": ["a"]},
        "mlflow": {"uri": uri, "tags": {"b": "c"}},
    }
    expected = killed_and_gone_on(run, track)
    client = mlflow.MlflowClient(uri)
    [existing] = client.search_runs([client.get_experiment_by_name("Cartpole").experiment_id])
    assert existing.info.status == "FINISHED" and existing.info.run_name == "taught" and existing.data.tags["b"] == "c"
    assert existing.data.params["train.config.episode_seconds"] == "0.5" and "versions.torch" in existing.data.params
    reported = client.get_metric_history(existing.info.run_id, "train/env_steps")
    assert [(each.step, each.value) for each in reported] == [
        (each["iteration"], each["env_steps"]) for each in expected
    ]
    files = {each.path for each in client.list_artifacts(existing.info.run_id)}
    assert files == {"reward.png", "00000040-e2.json"}
    assert existing.data.metrics["evaluation/length"] > 29.0  # of 0.5 s at 60 Hz, within which hardly a pole falls

    [file] = run.tracking.glob("wandb/offline-run-*-taught/run-taught.wandb")
    rows = [row for row in history(file) if "train/env_steps" in row]
    assert [(row["_step"], row["train/env_steps"]) for row in rows] == [
        (each["iteration"], each["env_steps"]) for each in expected
    ]
    assert [row["train/kl"] for row in rows] == [each["kl"] for each in expected]
    known = [record.run for record in records(file) if record.HasField("run")]
    assert (known[0].run_id, known[0].project, list(known[0].tags)) == ("taught", "poles", ["a"])
    config = {each.key: json.loads(each.value_json) for each in known[0].config.update}
    assert config["train"] == TRAIN and config["run"] == "taught" and "newton" in config["versions"]
    saved = {each.path for record in records(file) if record.HasField("files") for each in record.files.files}
    assert {"reward.png", "00000040-e2.json"} <= saved


def test_a_kill_while_mlflow_s_run_is_made_costs_it_no_parameter(tmp_path: Path) -> None:
    pytest.importorskip("mlflow", reason="pip install 'muster[mlflow]', or make services")
    config = {"train": {"task": "Cartpole", **{f"setting{number}": number for number in range(150)}}}  # two requests
    tracked = Tracked("taught", "Cartpole", config, tmp_path)

    class Killed(BaseException):
        pass

    for requests in (0, 1, 2, 2):  # that are answered before the kill
        service = MLflow(tracked, {"uri": f"sqlite:///{tmp_path}/mlflow.db"})
        service.prepare()
        client, answered = service._client, 0
        send = client.log_batch

        def log_batch(*args: Any, requests: int = requests, send: Callable[..., None] = send, **kinds: Any) -> None:
            nonlocal answered
            if answered == requests:
                raise Killed
            answered += 1
            send(*args, **kinds)

        client.log_batch = log_batch
        with contextlib.suppress(Killed):
            service.open(None, "taught")
    assert answered == 0, "a run that has its parameters gets none"
    [existing] = client.search_runs([client.get_experiment_by_name("Cartpole").experiment_id])
    assert existing.data.params == {f"train.{name}": str(value) for name, value in config["train"].items()}


def test_without_a_key_a_training_ends_before_it_begins_with_one_line_and_no_prompt(run: Run) -> None:
    pytest.importorskip("wandb", reason="pip install 'muster[wandb]', or make services")
    code, output = train(run, 1, {"wandb": {}}, WANDB_BASE_URL="https://tracking.example.com")
    assert code == 2 and "Traceback" not in output
    [line] = [line for line in output.splitlines() if line.startswith("error: ")]
    assert line == (
        "error: track.wandb: there is no key for https://tracking.example.com; set WANDB_API_KEY where the job runs, as a secret "
        "or with `wandb login`, or choose mode: offline"
    )
    assert not run.metrics.exists()


def test_a_server_that_is_away_costs_the_training_nothing_and_the_rest_is_sent_afterwards(run: Run) -> None:
    mlflow = pytest.importorskip("mlflow", reason="pip install 'muster[mlflow]', or make services")
    code, output = train(run, 1, {"mlflow": {"uri": f"http://127.0.0.1:{free_port()}"}})
    assert code == 0, output
    message = [line for line in output.splitlines() if line.startswith("mlflow: ")]
    assert [line.partition("(")[0] for line in message[:1]] == ["mlflow: warning: nothing can be sent now "]
    sends = f"mlflow: warning: not everything was sent; `python -m worker.track {run.path} mlflow` sends the rest"
    assert message[1:] == [sends]

    uri = f"sqlite:///{run.path.parent.parent}/mlflow.db"
    for _ in range(2):  # the second time there is nothing left to be sent
        command = [sys.executable, "-m", "worker.track", str(run.path), "mlflow"]
        env = {**os.environ, "MLFLOW_TRACKING_URI": uri, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(command, env=env, capture_output=True, text=True, cwd=run.path, timeout=60 * PATIENCE)
        assert done.returncode == 0, done.stderr
    client = mlflow.MlflowClient(uri)
    [existing] = client.search_runs([client.get_experiment_by_name("Cartpole").experiment_id])
    steps = [each.step for each in client.get_metric_history(existing.info.run_id, "train/kl")]
    assert steps == list(range(1, 41)) and existing.info.status == "FINISHED"


def test_a_package_that_is_missing_is_named_with_what_installs_it(run: Run, tmp_path: Path) -> None:
    for name in ("wandb", "mlflow"):  # found before any that is installed
        (tmp_path / "hidden").mkdir(exist_ok=True)
        (tmp_path / "hidden" / f"{name}.py").write_text(f"raise ModuleNotFoundError('no {name} here')")
    path = os.pathsep.join([str(tmp_path / "hidden"), str(ROOT)])
    code, output = train(run, 1, {"wandb": {"mode": "offline"}}, PYTHONPATH=path)
    assert code == 2 and "Traceback" not in output
    assert (
        "error: track.wandb: wandb can't be imported where this job runs (no wandb here); pip install 'muster[wandb]' there"
        in output
    )
