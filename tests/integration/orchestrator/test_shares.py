"""Shares of keys: in a fair-share queue a job has the share of the key that submits it, whatever it names."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from orchestrator.client import Client
from orchestrator.domain.errors import ApiError
from orchestrator.persistence.batch_models import Job
from orchestrator.server import Server
from orchestrator.services import derived_jobs
from tests.support.definitions import container, multinode
from tests.support.keys import HomeKeys
from tests.support.orchestrator.jobs import FOREVER
from tests.support.orchestrator.trained import SPEC, add_checkpoint, add_run
from tests.support.processes import end_all
from tests.support.waiting import wait_for

TOKEN = "a-token-for-tests-alone"


class Lab:
    """A controller with the queue ``fair`` and the keys ``ann-1``, ``bob`` and ``eve``; the last two have the share ``lab``."""

    def __init__(self, home: Path) -> None:
        keys = HomeKeys(home)
        made = [keys.create("ann-1"), keys.create("bob", share="lab"), keys.create("eve", share="lab")]
        self.server = Server(home, cpus=1, token=TOKEN)
        self.server.evaluations._interval = 3600
        self.server.start()
        tokens = {"token": TOKEN, **{key.name: f"{key.access_key_id}:{key.secret}" for key in made}}
        self.clients = {name: Client(self.server.url, token) for name, token in tokens.items()}
        root = self.clients["token"]
        policy = root.batch("CreateSchedulingPolicy", name="labs", fairsharePolicy={})["arn"]
        order = [{"order": 1, "computeEnvironment": "local"}]
        root.batch(
            "CreateJobQueue",
            jobQueueName="fair",
            priority=1,
            computeEnvironmentOrder=order,
            schedulingPolicyArn=policy,
        )
        self.definition = root.batch("RegisterJobDefinition", **multinode("true", container(["true"])))[
            "jobDefinitionArn"
        ]

    def submit(self, who: str, queue: str = "fair", **request: Any) -> str | None:
        """Submit a job; the share that it has got."""
        requested = {"jobName": "j", "jobQueue": queue, "jobDefinition": self.definition, **request}
        return self.share_of(self.clients[who].batch("SubmitJob", **requested)["jobId"])

    def spec(self, who: str, **changes: Any) -> str | None:
        """The same from a spec."""
        document = {"name": "j", "queue": "fair", "command": ["true"], "resources": {"cpus": 0.1}, **changes}
        return self.share_of(self.clients[who].post("/api/jobs", {"spec": document})["jobId"])

    def share_of(self, job: str) -> str | None:
        (detail,) = self.clients["token"].batch("DescribeJobs", jobs=[job])["jobs"]
        share: str | None = detail.get("shareIdentifier")
        with self.server.controller.database.session() as session:
            assert session.get_one(Job, job).share == share
        return share

    def close(self) -> None:
        for client in self.clients.values():
            client.close()
        self.server.close()


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    lab = Lab(tmp_path)
    yield lab
    lab.close()
    end_all(tmp_path)


def test_a_job_has_the_share_of_its_key_and_may_name_no_other(lab: Lab) -> None:
    assert [lab.submit(who) for who in ("ann-1", "bob", "eve")] == ["ann1", "lab", "lab"]
    assert [lab.spec(who) for who in ("ann-1", "bob")] == ["ann1", "lab"]
    assert lab.submit("ann-1", shareIdentifier="ann1") == lab.spec("ann-1", share="ann1") == "ann1"
    assert lab.submit("bob", schedulingPriorityOverride=7) == "lab"
    why = "'other': jobs of key ann-1 have its share, which is ann1: leave"
    for submit, words in (
        (lambda: lab.submit("ann-1", shareIdentifier="other"), f"shareIdentifier {why} shareIdentifier"),
        (lambda: lab.spec("ann-1", share="other"), f"share {why} the share out"),
    ):
        with pytest.raises(ApiError, match=words) as caught:
            submit()
        assert caught.value.status == 400 and "\n" not in str(caught.value)
    assert lab.submit("ann-1", queue="default") is None, "a queue without a policy knows no shares"
    with pytest.raises(ApiError, match="can onlybe submitted to job queue with fair share"):
        lab.submit("ann-1", queue="default", shareIdentifier="ann1")
    with pytest.raises(
        ApiError, match=r"^job queue default has no fair-share policy, so its jobs have no share; leave"
    ):
        lab.spec("ann-1", queue="default", share="ann1")
    with pytest.raises(ApiError, match="evaluation: share 'other'"):
        lab.spec(
            "ann-1",
            train=SPEC["train"],
            command=None,
            resources=SPEC["resources"],
            evaluation={"every": 1, "share": "other"},
        )


def test_a_caller_without_a_key_names_the_share_itself(lab: Lab) -> None:
    assert lab.submit("token", shareIdentifier="anybody") == lab.spec("token", share="anybody") == "anybody"
    with pytest.raises(ApiError, match="has a fair share scheduling policy: give a shareIdentifier"):
        lab.submit("token")
    with pytest.raises(ApiError, match=r"^job queue fair has a fair-share policy: give the job a share$"):
        lab.spec("token")


def test_a_job_that_comes_from_anothers_run_has_the_share_of_the_one_who_submits_it(lab: Lab) -> None:
    store, server = lab.server.store, lab.server
    add_run(store, "taught", {**SPEC, "queue": "fair", "share": "ann1"}, queue="fair")
    add_checkpoint(store, "taught", 9)
    for name, share in (("key bob", "lab"), ("key ann-1", "ann1"), ("MUSTER_TOKEN", "ann1")):
        actor = server.access.actor_named(name)
        assert actor is not None
        job = derived_jobs.derive(server.controller, actor, store.run("taught"), "evaluate", {"episodes": 1}, "")
        assert lab.share_of(job.id) == share, name
    exported = {"resources": {"cpus": 1}, "command": None, "export": {"run": "taught"}}
    found = {who: lab.spec(who, **exported) for who in ("bob", "ann-1", "token")}
    assert found == {"bob": "lab", "ann-1": "ann1", "token": "ann1"}, "a spec that reads the run and names no share"


def test_automatic_evaluations_have_the_share_that_the_trainings_owner_has_now(lab: Lab, tmp_path: Path) -> None:
    spec = {**SPEC, "queue": "fair", "train": {**SPEC["train"], "iterations": 100}, "evaluation": {"every": 1}}
    variables = {"MUSTER_SPEC": json.dumps(spec), "MUSTER_RUN": "taught", "MUSTER_ON_CHILD_FAILURE": "restart"}
    ann = lab.clients["ann-1"]
    definition = multinode("taught", container(["python", "-c", FOREVER], "1", variables))
    arn = ann.batch("RegisterJobDefinition", **definition)["jobDefinitionArn"]
    job = ann.batch("SubmitJob", jobName="taught", jobQueue="fair", jobDefinition=arn)["jobId"]
    wait_for(lambda: ann.get(f"/api/jobs/{job}")["status"] == "RUNNING", 20, "the training")

    def evaluated(iteration: int) -> str:
        add_checkpoint(lab.server.store, "taught", iteration)
        lab.server.evaluations.poll()
        found = lab.clients["token"].get("/api/runs/taught")["automatic"]
        assert found["iteration"] == iteration and found["problem"] is None, found
        detail = lab.clients["token"].get(f"/api/jobs/{found['job']}")
        assert detail["owner"] == "key ann-1"
        return str(found["job"])

    first = evaluated(10)
    assert lab.share_of(first) == "ann1"
    lab.clients["token"].batch("TerminateJob", jobId=first, reason="seen")
    wait_for(lambda: lab.clients["token"].get(f"/api/jobs/{first}")["status"] == "FAILED", 20, "its end")
    lab.server.keys.delete("ann-1")
    lab.server.keys.create("ann-1", share="lab")
    assert lab.share_of(evaluated(20)) == "lab"
