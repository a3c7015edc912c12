"""Automatic evaluations in a real controller: of what looks like a training to it, a process whose checkpoints the test writes."""

from __future__ import annotations

import json
import logging
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from orchestrator.client import Client
from orchestrator.domain.errors import ApiError
from orchestrator.persistence.batch_models import Job
from orchestrator.server import Server
from orchestrator.services import automatic_evaluations as automatic
from orchestrator.services import submission
from shared_store.volume.checkpoints import list_checkpoints, retain
from shared_store.volume.evaluations import keep_for_evaluation, pending_checkpoints
from tests.conftest import call_muster
from tests.support.definitions import container, multinode
from tests.support.orchestrator.jobs import FOREVER
from tests.support.orchestrator.trained import SPEC, add_checkpoint, add_run
from tests.support.processes import end_all
from tests.support.waiting import wait_for

TRAIN = {**SPEC["train"], "iterations": 100}


class Controller:
    """A server in this process, whose thread for evaluations looks when the test says so."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self.start()

    def start(self) -> None:
        self.server = Server(self.home, cpus=1)
        self.server.evaluations._interval = 3600
        self.server.start()
        self.client = Client(self.server.url)
        self.poll: Callable[[], None] = self.server.evaluations.poll

    def stop(self) -> None:
        self.client.close()
        self.server.evaluations._ending.set()
        self.server.close()

    def train(self, evaluation: dict[str, Any], name: str = "taught") -> str:
        """Submit a training; what runs is a process that sleeps on the one CPU. Returns the job's id once it runs."""
        spec = {**SPEC, "name": name, "train": TRAIN, "evaluation": evaluation}
        variables = {"MUSTER_SPEC": json.dumps(spec), "MUSTER_RUN": name, "MUSTER_ON_CHILD_FAILURE": "restart"}
        definition = multinode(name, container(["python", "-c", FOREVER], "1", variables))
        registered = self.client.batch("RegisterJobDefinition", **definition)
        requested = {"jobName": name, "jobQueue": "default", "jobDefinition": registered["jobDefinitionArn"]}
        job = str(self.client.batch("SubmitJob", **requested)["jobId"])
        self.wait(job, "RUNNING")
        return job

    def muster(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        return call_muster(*arguments, home=self.home)

    def wait(self, job: str, *statuses: str) -> None:
        wait_for(lambda: self.client.get(f"/api/jobs/{job}")["status"] in statuses, 20, f"{job} {statuses}")

    def end(self, job: str) -> None:
        self.client.batch("TerminateJob", jobId=job, reason="the test says so")
        self.wait(job, "FAILED")

    def save(self, *iterations: int, keep: int = 2) -> None:
        for iteration in iterations:
            add_checkpoint(self.server.store, "taught", iteration)
            retain(self.server.store.run("taught"), keep)

    def evaluations(self) -> list[tuple[int, str]]:
        """Iteration and state of each evaluation that was submitted, in their order."""
        with self.server.controller.database.session() as session:
            jobs = session.scalars(select(Job).where(Job.name == "evaluate-taught").order_by(Job.created_at, Job.id))
            specs = [(each.node_properties["nodeRangeProperties"][0]["container"], each.status) for each in jobs]
        read = [({e["name"]: e["value"] for e in each["environment"]}, status) for each, status in specs]
        return [(json.loads(each["MUSTER_SPEC"])["evaluate"]["checkpoint"], status) for each, status in read]

    def newest(self) -> dict[str, Any]:
        found: dict[str, Any] = self.client.get("/api/runs/taught")["automatic"]
        return found


@pytest.fixture
def controller(tmp_path: Path) -> Iterator[Controller]:
    running = Controller(tmp_path / "home")
    yield running
    running.stop()
    end_all(tmp_path)


def test_checkpoints_are_evaluated_in_jobs_one_at_a_time_and_the_newest_when_they_fall_behind(
    controller: Controller, caplog: pytest.LogCaptureFixture
) -> None:
    training = controller.train({"every": 2, "episodes": 8})
    controller.save(10)
    controller.poll()
    assert controller.evaluations() == []
    add_checkpoint(controller.server.store, "taught", 12, scheduled=False)  # of a long iteration: it is not counted
    controller.poll()
    assert controller.evaluations() == []
    controller.save(20)
    controller.poll()
    controller.poll()
    assert controller.evaluations() == [(20, "RUNNABLE")]
    controller.save(30, 40)
    controller.poll()
    controller.save(50, 60, 70)
    controller.poll()
    assert controller.evaluations() == [(20, "RUNNABLE")], "one at a time"
    run = controller.server.store.run("taught")
    assert [each.iteration for each in list_checkpoints(run)] == [20, 60, 70], "what waits is not pruned"
    with caplog.at_level(logging.WARNING):
        controller.end(controller.newest()["job"])
        controller.poll()
    assert controller.evaluations() == [(20, "FAILED"), (70, "RUNNABLE")]
    assert "run taught: the evaluation of checkpoint 00000020-e1 failed: the test says so" in caplog.text
    assert controller.newest()["passed"] == 1, "40, or 60"
    shown = " ".join(controller.muster("show", training).stdout.split())
    assert "evaluating: taught@70 by job " in shown and "1 checkpoint skipped" in shown
    controller.save(80)
    assert [each.iteration for each in list_checkpoints(run)] == [70, 80]
    assert controller.client.get(f"/api/jobs/{training}")["status"] == "RUNNING", "which no evaluation concerns"
    with controller.server.controller.database.session() as session:
        owners = set(session.scalars(select(Job.owner)))
    assert len(owners) == 1, "the evaluations are the training's owner's"


def test_a_list_counts_automatic_evaluations_and_names_what_they_evaluate(
    controller: Controller,
) -> None:
    training = controller.train({"every": 1})
    controller.save(10)
    controller.poll()
    listed = controller.muster("list").stdout.splitlines()
    assert [line.split()[0] for line in listed[1:-1]] == [training[:8]]
    assert listed[-1] == "1 automatic evaluation is not shown; --all shows it"
    first = controller.newest()["job"]
    controller.end(first)
    controller.save(20)
    controller.poll()
    output = controller.muster("list").stdout
    assert output.endswith("2 automatic evaluations are not shown; --all shows them\n")
    every = controller.muster("list", "--all").stdout
    assert "evaluates taught@20" in every and "evaluates taught@10; the test says so" in every
    assert "not shown" not in every
    reported = json.loads(controller.muster("list", "--json").stdout)
    assert [each.get("automaticEvaluation") for each in reported] == ["taught@20", "taught@10", None]
    shown = " ".join(controller.muster("show", first).stdout.split())
    assert "evaluates: taught@10" in shown and controller.newest()["iteration"] == 20


def test_facts_of_a_deleted_run_are_not_shown_for_a_new_run_of_the_same_name(controller: Controller) -> None:
    former = controller.train({"every": 1})
    controller.save(10)
    controller.poll()
    evaluation = controller.newest()["job"]
    controller.end(evaluation)
    controller.end(former)
    controller.poll()
    shutil.rmtree(controller.server.store.run("taught").path)
    training = controller.train({"every": 1})
    found = controller.client.get("/api/runs/taught")
    assert found["automatic"] is None and [job["id"] for job in found["jobs"]] == [training]
    controller.poll()
    assert controller.newest()["job"] is None and controller.newest()["checkpoint"] is None
    old = controller.client.get(f"/api/jobs/{former}")
    assert old["runIsReplaced"] and old["results"] is None and old["progress"] is None
    assert "taught (gone; another run has its name now)" in controller.muster("show", former).stdout
    assert not controller.client.get(f"/api/jobs/{training}")["runIsReplaced"]


def test_a_stopped_controller_neither_loses_nor_repeats_evaluations(
    controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        """Nothing after it is done."""

    def killed(*_: object, **__: object) -> None:
        raise Killed

    controller.train({"every": 1})
    controller.save(10)
    for module, name in ((automatic, "submit"), (automatic, "_row"), (submission, "_release")):
        with monkeypatch.context() as patch:  # before the transaction, at its end, and in the middle of the submission
            patch.setattr(module, name, killed)
            with pytest.raises(Killed):
                controller.poll()
        controller.stop()
        controller.start()
        assert controller.evaluations() == []
    controller.poll()
    assert controller.evaluations() == [(10, "RUNNABLE")]
    controller.end(controller.newest()["job"])
    controller.poll()
    run = controller.server.store.run("taught")
    keep_for_evaluation(run, "00000010-e1")  # as one that was killed before it submitted a job
    controller.stop()
    controller.start()
    controller.poll()
    assert controller.evaluations() == [(10, "FAILED")]
    wait_for(lambda: pending_checkpoints(run) == set(), what="the claim is given up")


def test_a_training_that_is_asked_to_stop_or_has_saved_its_last_checkpoint_gets_no_more(controller: Controller) -> None:
    training = controller.train({"every": 1})
    controller.save(90, 100)
    controller.poll()
    assert controller.evaluations() == [], "the training itself evaluates its last one"
    with controller.server.controller.database.session() as session:
        session.get_one(Job, training).stop_reason = "enough"
        session.commit()
        controller.save(95)
        controller.poll()
    assert controller.evaluations() == []


def test_an_evaluation_that_its_queue_refuses_is_reported(
    controller: Controller, caplog: pytest.LogCaptureFixture
) -> None:
    order = [{"order": 1, "computeEnvironment": "local"}]
    controller.client.batch("CreateJobQueue", jobQueueName="idle", priority=1, computeEnvironmentOrder=order)
    controller.train({"every": 1, "queue": "idle"})
    controller.client.batch("UpdateJobQueue", jobQueue="idle", state="DISABLED")
    controller.save(10)
    controller.poll()
    controller.poll()
    problem = "checkpoint 00000010-e1 was not evaluated: Job queue idle is DISABLED and takes no jobs"
    assert controller.newest()["problem"] == problem and controller.evaluations() == []
    controller.save(20)
    controller.poll()
    assert "checkpoint 00000020-e1" in controller.newest()["problem"]
    refused = "run taught: checkpoints are not evaluated: Job queue idle is DISABLED and takes no jobs"
    assert caplog.messages.count(refused) == 1, "once, however many checkpoints it concerns"
    controller.client.batch("UpdateJobQueue", jobQueue="idle", state="ENABLED")
    controller.save(30)
    controller.poll()
    assert controller.evaluations() == [(30, "RUNNABLE")] and controller.newest()["problem"] is None


def test_a_queue_that_does_not_take_the_evaluations_is_refused_with_the_training(controller: Controller) -> None:
    with pytest.raises(ApiError, match="evaluation: Job queue nowhere does not exist"):
        controller.train({"every": 1, "queue": "nowhere"})
    with pytest.raises(ApiError, match=r"^evaluation\.every: is required$"):
        controller.train({})


def test_evaluations_that_never_start_are_refused(controller: Controller) -> None:
    add_run(controller.server.store, "taught")
    controller.save(3)
    submit = "submit job_specs/cartpole.yaml --set nodes=1"
    for line in (submit, f"{submit} --dry-run", "resume taught", "clone taught --name twin"):
        for section, output in (
            ("resources: {gpus: 1}", "evaluation: each node needs 1 CPU, 1 GPU"),
            ("queue: nowhere", "evaluation: Job queue nowhere does not exist; available: default"),
        ):
            done = controller.muster(*line.split(), "--set", f"evaluation={{every: 2, {section}}}")
            assert (done.returncode, done.stderr.count("\n")) == (2, 1) and output in done.stderr, done.stderr
    with controller.server.controller.database.session() as session:
        assert not session.scalars(select(Job)).all()
