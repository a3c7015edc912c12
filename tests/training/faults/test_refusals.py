"""A change with which a run can't continue is refused with one line that names the difference, before a process starts where possible."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from shared_store.volume.checkpoints import FORMAT, Checkpoint, DamagedCheckpoint, list_checkpoints
from shared_store.volume.layout import Store
from tests.conftest import Serving
from tests.support.refusals import refusal
from tests.support.worker.ranks import training
from tests.support.worker.runs import runner, train
from tests.support.worker.trained import run_in
from worker.learning.loop import Loop
from worker.learning.shards import read_file
from worker.settings.errors import UserError


class Payload:
    """Pickled, it calls ``os.mkdir`` where it is unpickled without care."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.marker),)


def poison(checkpoint: Checkpoint, name: str, marker: Path) -> None:
    """Hide code in a file of ``checkpoint``, with sizes and digests that fit: only the way of loading protects."""
    path = checkpoint.path / name
    content = torch.load(path, weights_only=True)
    torch.save({**content, "extra": Payload(marker)}, path)
    entry = {"size": path.stat().st_size, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    edit_manifest(checkpoint, files={**checkpoint.manifest["files"], name: entry})
    Checkpoint(checkpoint.path, checkpoint.iteration, checkpoint.epoch).verify()


def edit_manifest(checkpoint: Checkpoint, **changes: Any) -> None:
    path = checkpoint.path / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def test_the_payload_works_where_nothing_protects(tmp_path: Path) -> None:
    torch.save({"extra": Payload(tmp_path / "executed")}, tmp_path / "file.pt")
    torch.load(tmp_path / "file.pt", weights_only=False)
    assert (tmp_path / "executed").is_dir()


# -- through the command ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def served(trained_home: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Serving, str]]:
    """A server and a finished run of two iterations of eight worlds, with a checkpoint of each."""
    with Serving(shutil.copytree(trained_home, tmp_path_factory.mktemp("copy") / "home"), "--cpus", "4") as server:
        yield server, run_in(server.home).name


def refused(served: tuple[Serving, str], code: int, *arguments: str, at: str = "") -> str:
    """The one line with which ``muster resume`` refuses; nothing was submitted, so no process starts."""
    server, run = served
    jobs = len(server.client.get(f"/api/runs/{run}")["jobs"])
    done = server.muster("resume", run + at, "--set", "train.iterations=4", *arguments)
    assert done.returncode == code and len(done.stderr.splitlines()) == 1, done.stderr
    assert len(server.client.get(f"/api/runs/{run}")["jobs"]) == jobs
    return done.stderr


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ("train.seed=9", ["train.seed is 1 and can't become 9"]),
        ("train.ppo.hidden_sizes=[8]", ["train.ppo.hidden_sizes is not set and can't become [8]", "has learnt"]),
        ("train.worlds=9", ["holds 8 worlds, this job would have 9 (1 node × 1 rank × 9)", "leave train.worlds"]),
        ("nodes=9", ["8 worlds can't be distributed over 9 ranks; use fewer nodes"]),
    ],
)
def test_another_seed_network_or_number_of_worlds(served: tuple[Serving, str], change: str, parts: list[str]) -> None:
    message = refused(served, 2, "--set", change)
    assert all(part in message for part in (served[1], *parts)), message


def test_a_learning_rate_that_the_checkpoint_s_job_had_and_that_has_adapted_since(served: tuple[Serving, str]) -> None:
    server, run = served
    newest = list_checkpoints(Store(server.home / "store").run(run))[-1]
    rate = newest.manifest["learning_rate"]
    edit_manifest(newest, learning_rate=4e-4)
    try:
        message = refused(served, 2, "--set", "train.ppo.learning_rate=1.0e-3")
        assert "train.ppo.learning_rate is 0.001 already" in message and "which is 0.0004 now" in message, message
        assert "or train.ppo.schedule=fixed" in message
    finally:
        edit_manifest(newest, learning_rate=rate)


def test_a_checkpoint_of_a_newer_format(served: tuple[Serving, str]) -> None:
    server, run = served
    newest = list_checkpoints(Store(server.home / "store").run(run))[-1]
    edit_manifest(newest, format=FORMAT + 1)
    try:
        for at in ("", "@2"):
            message = refused(served, 1, at=at)
            assert (
                f"{newest.name}: has format {FORMAT + 1}, this Muster reads up to {FORMAT}; upgrade Muster" in message
            )
    finally:
        edit_manifest(newest, format=FORMAT)


def test_code_in_a_checkpoint_fails_the_job_with_one_line_and_is_not_run(
    served: tuple[Serving, str], tmp_path: Path
) -> None:
    server, run = served
    newest = list_checkpoints(Store(server.home / "store").run(run))[-1]
    poison(newest, "learner.pt", tmp_path / "executed")
    changes = ["--set", "train.iterations=4", "--set", "retry.attempts=1"]
    job = json.loads(server.muster("resume", run, "--json", *changes).stdout)["jobId"]
    detail = server.wait(job, timeout=120)
    assert detail["status"] == "FAILED"
    assert f"checkpoint {newest.name}: learner.pt asks for " in detail["statusReason"]
    assert "mkdir: only tensors and plain values are loaded, and nothing of it was run" in detail["statusReason"]
    log = server.log(job)
    assert sum("mkdir" in line for line in log if line.startswith("error: ")) == 1
    assert not any("Traceback" in line for line in log)
    assert not (tmp_path / "executed").exists()


# -- by the worker, for a job that no controller checked -------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a run of two iterations."""
    store = tmp_path_factory.mktemp("store")
    train(training(store, iterations=2))
    return store


@pytest.fixture
def store(trained: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(trained, tmp_path / "store"))


def go_on(store: Path, **changes: Any) -> Loop:
    return runner(training(store, iterations=4, epoch=2, **changes))


@pytest.mark.parametrize(
    ("changes", "difference"),
    [
        ({"task": "Other"}, "task is 'Point' there and 'Other' here"),
        ({"seed": 4}, "train.seed is 3 there and 4 here"),
        ({"config": {"limit": 2.0}}, "train.config is None there and {'limit': 2.0} here"),
        ({"ppo": {"hidden_sizes": [8]}}, r"ppo.hidden_sizes is \[16, 16\] there and \[8\] here"),
        ({"ppo": {"normalize_observations": False}}, "ppo.normalize_observations is True there and False here"),
        ({"worlds": 9}, r"holds 8 worlds \(1 rank of 8\), this job has 9 \(1 rank of 9\).*product is 8"),
    ],
)
def test_the_worker_refuses_what_differs(trained: Path, changes: dict[str, Any], difference: str) -> None:
    with pytest.raises(UserError, match=f"checkpoint 00000002-e1 .*{difference}"):
        go_on(trained, **changes)


def test_the_worker_never_sets_a_newer_format_aside(store: Path) -> None:
    (newest,) = list_checkpoints(Store(store).run("run"))
    edit_manifest(newest, format=FORMAT + 1)
    with pytest.raises(DamagedCheckpoint, match=f"has format {FORMAT + 1}, this Muster reads up to {FORMAT}"):
        go_on(store)
    assert newest.path.is_dir()


@pytest.mark.parametrize("name", ["learner.pt", "rank-0.pt"])
def test_the_worker_runs_no_code_of_a_checkpoint(store: Path, tmp_path: Path, name: str) -> None:
    (newest,) = list_checkpoints(Store(store).run("run"))
    poison(newest, name, tmp_path / "executed")
    message = refusal(go_on, store, error=UserError)
    assert re.search(rf"{name} asks for \w+\.mkdir: only tensors and plain values", message)
    if name == "learner.pt":
        with pytest.raises(UserError, match="asks for"):  # as `muster export` and `evaluate` read it
            read_file(newest, "learner.pt")
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "learner.pt"),
        (b"no archive at all", "learner.pt"),
        ([1, 2], "learner.pt holds a list, not the state of a training"),
        ({"progress": {}}, "does not fit this job's task and algorithm: 'algorithm'"),
    ],
)
def test_a_file_of_something_else_is_named(store: Path, content: Any, message: str) -> None:
    (newest,) = list_checkpoints(Store(store).run("run"))
    path = newest.path / "learner.pt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    entry = {"size": path.stat().st_size, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    edit_manifest(newest, files={**newest.manifest["files"], "learner.pt": entry})
    assert message in refusal(go_on, store, error=UserError)
