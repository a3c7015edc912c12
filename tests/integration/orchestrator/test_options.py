"""Options that several commands have, and filters of lists, on a controller that runs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Serving, call_muster
from tests.support.orchestrator.jobs import FOREVER, refused

SPEC = "name: brief\nresources: {cpus: 0.1, memory: 16MiB}\ncommand: [sh, -c, 'echo through']\nretry: {attempts: 1}\n"


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    with Serving(tmp_path_factory.mktemp("home"), "--cpus", "8") as server:
        (server.home / "job.yaml").write_text(SPEC)
        yield server


def printed(lab: Serving, *arguments: str) -> Any:
    done = lab.muster(*arguments, "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout)


def test_a_run_is_named_placed_sized_planned_detached_and_printed_as_json(lab: Serving) -> None:
    spec = str(lab.home / "job.yaml")
    made = lab.muster("queues", "create", "urgent", "--priority", "7")
    assert made.stdout == "created queue urgent with priority 7; use it with: muster submit SPEC --queue urgent\n"
    for arguments in (
        ("queues", "urgent", "--json"),
        ("queues", "show", "urgent", "--json"),
        ("queues", "--json", "urgent"),
    ):
        assert json.loads(lab.muster(*arguments).stdout)[0]["priority"] == 7
    options = ("--name", "placed", "--queue", "urgent", "--nodes", "2")
    planned = printed(lab, "run", spec, *options, "--dry-run")
    assert len(planned["nodes"]) == 2 and planned["registerJobDefinition"]["jobDefinitionName"] == "placed"
    assert printed(lab, "list", "--name", "placed") == [], "a plan starts nothing"
    ended = printed(lab, "run", spec, *options)
    assert (ended["jobName"], ended["status"], ended["run"]) == ("placed", "SUCCEEDED", f"placed-{ended['jobId'][:8]}")
    detached = lab.muster("run", spec, "--no-follow", "--server", lab.url)
    assert detached.returncode == 0 and "follow it with: muster logs " in detached.stdout
    shown = printed(lab, "show", detached.stdout.split()[3])
    assert shown["queue"] == "default" and shown["nodes"] == 1


def test_a_detached_run_needs_a_controller_and_an_engine_means_its_queue(lab: Serving, tmp_path: Path) -> None:
    spec = str(lab.home / "job.yaml")
    refused(
        ["run", spec, "--no-follow"], tmp_path / "empty", 2, "--no-follow: no controller is running", "muster serve"
    )
    refused(["submit", spec, "--queue", "urgent", "--engine", "local"], lab.home, 2, "leave one of them out")
    refused(["submit", spec, "--nodes", "2", "--set", "nodes=3"], lab.home, 2, "--set nodes=3: --nodes sets nodes")


def test_what_does_not_exist_is_refused_with_what_does_and_in_words_of_the_options(lab: Serving) -> None:
    for arguments, words in (
        (("runs", "delete", "nope"), "run nope does not exist"),
        (("list", "--run", "nope"), "run nope does not exist"),
        (("queues", "create", "fine", "--like", "nope"), "Job queue nope does not exist; available: default"),
        (("queues", "create", "a b"), "NAME 'a b': up to 128 letters"),
        (
            ("queues", "create", "default"),
            "Job queue default exists already; change it with: aws batch update-job-queue",
        ),
        (("queues", "create", "fine", "--priority", "-1"), "--priority: "),
        (
            ("list", "--server", "127.0.0.1:8080"),
            "--server 127.0.0.1:8080: expected the URL of a controller, such as http://127",
        ),
    ):
        refused(arguments, lab.home, 2, words)


def test_jobs_are_listed_by_status_name_run_age_and_owner_and_stopped_together(lab: Serving) -> None:
    jobs = [lab.gang(FOREVER, name=name) for name in ("wolf-1", "wolf-2", "sheep")]
    for job in jobs:
        lab.wait(job, "RUNNING")

    def names(*filters: str) -> set[str]:
        return {each["jobName"] for each in printed(lab, "list", *filters)}

    assert names("--status", "running", "--name", "wolf-*") == {"wolf-1", "wolf-2"} == names("--name", "wolf-[12]")
    assert (
        names("--run", lab.detail(jobs[2])["run"]) == {"sheep"} == names("--name", "sheep", "--mine", "--since", "1h")
    )
    assert names("--since", "0s") == set() and "no job fits" in lab.muster("list", "--name", "nowhere").stdout
    header, row = lab.muster("list", "--name", "sheep").stdout.splitlines()
    assert row[header.index("RUN ") :].split()[0] == lab.detail(jobs[2])["run"]
    stopped = printed(lab, "stop", "wolf-1", "wolf-2", "--reason", "enough")
    assert [(each["jobName"], each["status"]) for each in stopped] == [("wolf-1", "FAILED"), ("wolf-2", "FAILED")]
    done = lab.muster("stop", "wolf-1", "sheep").stdout.splitlines()
    assert (
        done[0].startswith("wolf-1 (")
        and "FAILED already" in done[0]
        and done[1].endswith("ended: stopped by the user")
    )


def test_runs_are_listed_with_their_last_job_and_a_resume_is_planned(lab: Serving) -> None:
    ended = printed(lab, "run", str(lab.home / "job.yaml"), "--name", "again")
    run = ended["run"]
    header, row = lab.muster("runs", "--name", "again-*").stdout.splitlines()
    assert header.split()[:3] == ["RUN", "TASK", "ITERATION"] and row.split()[0] == run
    assert ended["jobId"][:8] in row and "SUCCEEDED" in row
    assert printed(lab, "runs", "list", "--name", "again-*")[0]["jobs"][-1]["id"] == ended["jobId"]
    planned = printed(lab, "resume", run, "--nodes", "2", "--dry-run")
    assert len(planned["nodes"]) == 2 and planned["registerJobDefinition"]["jobDefinitionName"] == "again"
    assert len(printed(lab, "runs", "--name", "again-*")[0]["jobs"]) == 1
    refused(["resume", f"{run}@7"], lab.home, 2, f"run {run} has no checkpoint yet")


def test_a_command_speaks_to_the_server_that_it_names(lab: Serving, tmp_path: Path) -> None:
    for arguments in (
        ("--server", lab.url, "queues"),
        ("queues", "--server", lab.url),
        ("queues", "list", "--server", lab.url),
    ):
        done = call_muster(*arguments, home=tmp_path)
        assert done.returncode == 0 and "default" in done.stdout, done.stderr
