"""Runs and jobs that an older commit left behind, under today's code: they go on, to the same bits, with nothing lost.

``tests/data/former/README.md`` says how the home was made. Which bits a training computes depends on the processor and the libraries, too:
on another kind than the archive's a resumed run is compared with one that today's code computed straight, and a warning says so.
"""

from __future__ import annotations

import json
import shutil
import warnings
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
import yaml

from shared_store.volume.checkpoints import Checkpoint, list_checkpoints
from shared_store.volume.layout import Run
from shared_store.volume.metrics import read_metrics
from tests.support.faults.checks import files_differing, without_timing
from tests.support.former.archive import Archived, unpack
from tests.support.former.serving import KeyServing
from tests.support.former.specs import OTHERS, TRAINING
from tests.support.orchestrator.receiver import Receiver, receiving, write_webhooks
from tests.support.waiting import wait_for

LAST = TRAINING["train"]["iterations"]
SINCE = {"learning_rate_horizon": None, "normalizer_horizon": None, "min_std": 1e-6, "max_std": 1e6}
"""PPO's settings that have another default since, with the values of then; a run that goes on keeps these by itself."""


@pytest.fixture(scope="module")
def archived(tmp_path_factory: pytest.TempPathFactory) -> Archived:
    """As the older commit left it."""
    return unpack(tmp_path_factory.mktemp("archived"))


@pytest.fixture(scope="module")
def receiver() -> Iterator[Receiver]:
    with receiving() as listening:
        yield listening


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory, receiver: Receiver) -> Iterator[KeyServing]:
    """Today's controller on another copy; its webhook leads to the receiver."""
    copy = unpack(tmp_path_factory.mktemp("served"))
    webhooks = write_webhooks(copy.home / "webhooks.json", chat={"url": receiver.url, "queues": ["robots"]})
    with KeyServing(copy.home, "--cpus", "4", "--webhooks", webhooks, key=copy.facts["keys"]["me"]) as server:
        yield server


def copy_of(archived: Archived, served: KeyServing, name: str) -> Run:
    """The run that the controller has of the archived one."""
    return Archived(served.home, archived.facts).run(name)


def checkpoint(run: Run, iteration: int, epoch: int) -> Checkpoint:
    (found,) = [each for each in list_checkpoints(run) if each.name == f"{iteration:08}-e{epoch}"]
    found.verify()
    return found


def succeeded(server: KeyServing, job: str) -> dict[str, Any]:
    detail = server.wait(job, timeout=300)
    assert detail["status"] == "SUCCEEDED", detail["statusReason"] + "\n" + "\n".join(server.log(job)[-20:])
    return detail


def test_jobs_that_ran_or_waited_when_the_power_was_cut_go_on(
    archived: Archived, served: KeyServing, receiver: Receiver
) -> None:
    jobs, run = archived.facts["jobs"], copy_of(archived, served, "cut")
    durable = list_checkpoints(archived.run("cut"))[-1]
    assert durable.iteration < LAST
    first, second = succeeded(served, jobs["cut"])["attempts"]
    assert (first["ending"], second["ending"], second["epoch"]) == ("failed", "succeeded", 2)
    assert any(line.startswith(f"resumed from checkpoint {durable.name}:") for line in served.log(jobs["cut"]))
    assert [record["iteration"] for record in read_metrics(run)] == list(range(1, LAST + 1))
    written = json.loads((run.metrics / "metrics-e2.jsonl").read_text().splitlines()[0])
    assert written == {"resumed_from": durable.iteration}, "what was durable was not computed again"
    if archived.other_bits() is None:
        assert not files_differing(checkpoint(archived.run("whole"), LAST, 1), checkpoint(run, LAST, 2))
    succeeded(served, jobs["after"])
    succeeded(served, jobs["waiting"])
    assert served.log(jobs["waiting"])[0] == "had room"
    wait_for(lambda: receiver.of(jobs["waiting"]), 30, "the webhook's message")
    assert all(json.loads(body)["data"]["queue"] == "robots" for _, body in receiver.messages)


@pytest.mark.parametrize(
    ("name", "middle", "later", "last"),
    [("whole", 30, 40, LAST), *((spec["name"], 4, 8, spec["train"]["iterations"]) for spec in OTHERS)],
)
def test_a_run_resumed_from_its_middle_ends_with_the_same_bits(
    archived: Archived, served: KeyServing, tmp_path: Path, name: str, middle: int, later: int, last: int
) -> None:
    if name == "racer" and "Racer" not in entry_points(group="muster.tasks").names:
        pytest.skip("the racer is not installed: its old runs are untested")
    run, existing, differing = copy_of(archived, served, name), archived.run(name), archived.other_bits()
    epoch = resumed_epoch(served, run, middle)
    if differing is None:
        pairs = [(checkpoint(existing, each, 1), checkpoint(run, each, epoch)) for each in (later, last)]
        before = {record["iteration"]: without_timing(record) for record in read_metrics(existing)}
        for record in read_metrics(run):
            old = before[record["iteration"]]
            assert {key: record.get(key) for key in old} == old
    else:
        warnings.warn(f"computed by today's code instead of the archive's: {differing}", stacklevel=1)
        kept = tmp_path / f"{last:08}-e{epoch}"
        shutil.copytree(checkpoint(run, last, epoch).path, kept)
        pairs = [(Checkpoint(kept, last, epoch), checkpoint(run, last, resumed_epoch(served, run, later)))]
    for straight, resumed in pairs:
        assert not files_differing(straight, resumed)


def resumed_epoch(served: KeyServing, run: Run, iteration: int) -> int:
    """Resume the run from a checkpoint, to its end; returns the epoch of that."""
    job = served.answer("resume", f"{run.name}@{iteration}")["jobId"]
    epoch: int = succeeded(served, job)["attempts"][-1]["epoch"]
    return epoch


def test_the_same_training_begun_anew_computes_the_same_bits(
    archived: Archived, served: KeyServing, tmp_path: Path
) -> None:
    if differing := archived.other_bits():
        pytest.skip(f"the archive's bits are those of another kind of machine: {differing}")
    ppo = {**TRAINING["train"]["ppo"], **SINCE}
    spec = {**TRAINING, "name": "anew", "train": {**TRAINING["train"], "iterations": 10, "ppo": ppo}}
    (tmp_path / "anew.yaml").write_text(yaml.safe_dump(spec))
    job = succeeded(served, served.answer("submit", str(tmp_path / "anew.yaml"))["jobId"])
    anew = copy_of(archived, served, "anew")
    assert job["run"] == anew.name
    assert not files_differing(checkpoint(archived.run("whole"), 10, 1), checkpoint(anew, 10, 1))


def test_old_checkpoints_are_evaluated_exported_and_cloned(archived: Archived, served: KeyServing) -> None:
    run = copy_of(archived, served, "whole")
    job = archived.facts["jobs"]["evaluate"]
    (path,) = archived.run("whole").evaluations.glob(f"*-{job[:8]}.json")
    old = json.loads(path.read_text())
    done = served.muster("evaluate", f"{run.name}@60", "--episodes", "4", "--seed", str(old["seed"]), "--name", "again")
    assert done.returncode == 0, done.stdout + done.stderr
    new = [each for each in served.client.get(f"/api/runs/{run.name}/evaluations") if each["seed"] == old["seed"]][-1]
    assert new["job"] != old["job"] and new["episodes"] == old["episodes"] == 4
    if archived.other_bits() is None:
        same = ("mean_return", "std_return", "mean_length", "return", "min_return", "max_return")
        assert {key: new.get(key) for key in same} == {key: old.get(key) for key in same}
    exported = served.muster("export", f"{run.name}@50")
    assert exported.returncode == 0, exported.stdout + exported.stderr
    registered = served.answer("models", "register", f"{run.name}@50", "--name", "pole")
    assert registered["version"] == 2, "the next version of the model that was there"
    cloned = served.answer(
        "clone", f"{run.name}@30", "--name", "twin", "--set", "train.iterations=2", "--set", "nodes=1"
    )
    succeeded(served, cloned["jobId"])
