"""An upgrade with jobs running: an older commit's controller is stopped, today's is started on its home, and the old nodes run on."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest
import yaml

from orchestrator.api.http.auth import cookie_name
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.layout import Store
from shared_store.volume.metrics import read_metrics
from tests.conftest import PATIENCE
from tests.support.former.archive import lift_database
from tests.support.former.environment import COMMIT, is_in_history, make_environment
from tests.support.former.serving import FormerServing, KeyServing, create_key
from tests.support.former.specs import TRAINING
from tests.support.processes import Process, gang_members
from tests.support.waiting import wait_for

pytestmark = pytest.mark.skipif(
    not is_in_history(),
    reason=f"this checkout's history lacks commit {COMMIT}: an upgrade with its jobs running is untested",
)
SHORT, LONG = 200, 100_000
"""Iterations of the job that ends by itself and of the one that is stopped."""


@dataclass(frozen=True)
class Upgraded:
    """Today's controller on the home."""

    server: KeyServing
    jobs: dict[str, str]
    """By name. Their ranks stand still until a test has them go on."""
    session: str
    """Of a person who logged in to the older commit's console."""


def submit(server: KeyServing, directory: Path, name: str, nodes: int, iterations: int) -> str:
    spec = {**TRAINING, "name": name, "nodes": nodes, "train": {**TRAINING["train"], "iterations": iterations}}
    path = directory / f"{name}.yaml"
    path.write_text(yaml.safe_dump(spec))
    return str(server.answer("submit", str(path))["jobId"])


def hold(server: KeyServing, job: str) -> None:
    """Let the job come to a checkpoint and stand still there: what is to be seen is not to be over before."""
    run = Store(server.home / "store").run(server.detail(job)["run"])
    wait_for(lambda: list_checkpoints(run), 200, "a checkpoint")
    for rank in ranks_of(server.home, job):
        rank.strike(signal.SIGSTOP)


def ranks_of(home: Path, job: str) -> list[Process]:
    return [rank for rank in gang_members(home, "rank") if rank.gang.startswith(job)]


@pytest.fixture(scope="module")
def upgraded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Upgraded]:
    base = tmp_path_factory.mktemp("upgrade")
    home = base / "home"
    home.mkdir(mode=0o700)
    command = make_environment(base / "former")
    key = create_key(command, home, "me")
    former = FormerServing(home, command, "--cpus", "4", key=key)
    try:
        jobs = {
            "stopped": submit(former, base, "stopped", 1, LONG),
            "goes-on": submit(former, base, "goes-on", 2, SHORT),
        }
        for name in ("goes-on", "stopped"):
            hold(former, jobs[name])
        before = {str(each) for each in gang_members(home)}
        (session,) = httpx.post(f"{former.url}/login", data={"key": key}, trust_env=False).cookies.values()
        former.process.send_signal(signal.SIGTERM)
        former.process.wait(60 * PATIENCE)
    except BaseException:
        former.close()
        raise
    lift_database(home)
    with KeyServing(home, "--cpus", "4", key=key) as server:
        assert {str(each) for each in gang_members(home)} >= before, "the nodes ran on"
        yield Upgraded(server, jobs, session)


def test_a_session_of_the_console_goes_on(upgraded: Upgraded) -> None:
    url = httpx.URL(upgraded.server.url)
    assert url.port is not None
    cookies, browser = {cookie_name(url.port): upgraded.session}, {"Accept": "text/html"}
    assert httpx.get(url, cookies=cookies, headers=browser, trust_env=False).status_code == 200
    assert httpx.get(url, headers=browser, trust_env=False).headers["location"].startswith("/login")


def test_a_training_of_the_older_commit_goes_on_to_its_end(upgraded: Upgraded) -> None:
    server, job = upgraded.server, upgraded.jobs["goes-on"]
    assert server.detail(job)["status"] == "RUNNING"
    for rank in ranks_of(server.home, job):
        rank.strike(signal.SIGCONT)
    ended = server.wait(job, timeout=300)
    assert ended["status"] == "SUCCEEDED", ended["statusReason"]
    assert [each["ending"] for each in ended["attempts"]] == ["succeeded"], "its first attempt"
    run = Store(server.home / "store").run(ended["run"])
    assert [record["iteration"] for record in read_metrics(run)] == list(range(1, SHORT + 1))
    assert [each.iteration for each in list_checkpoints(run)][-1] == SHORT


def test_commands_reach_nodes_of_the_older_commit_and_their_run_is_resumed(
    upgraded: Upgraded,
) -> None:
    server, job = upgraded.server, upgraded.jobs["stopped"]
    run = Store(server.home / "store").run(server.detail(job)["run"])
    (rank,) = ranks_of(server.home, job)
    rank.strike(signal.SIGCONT)
    wait_for(lambda: _reporting(server, job), 60, "the node's progress over the bus")
    saved = server.muster("checkpoint", job)
    assert saved.returncode == 0, saved.stderr
    assert list_checkpoints(run)[-1].name >= saved.stdout.split()[-1] > f"{TRAINING['checkpoint']['every']:08}"
    stopped = server.muster("stop", job)
    assert stopped.returncode == 0 and f"muster resume {run.name}" in stopped.stdout, stopped.stdout + stopped.stderr
    assert not ranks_of(server.home, job)
    reached = read_metrics(run)[-1]["iteration"]
    resumed = json.loads(
        server.muster("resume", run.name, "--set", f"train.iterations={reached + 10}", "--json").stdout
    )
    assert resumed["iteration"] == reached, "what the old nodes saved when they were asked to leave"
    ended = server.wait(resumed["jobId"], timeout=300)
    assert ended["status"] == "SUCCEEDED", ended["statusReason"]
    assert [record["iteration"] for record in read_metrics(run)] == list(range(1, reached + 11))


def _reporting(server: KeyServing, job: str) -> bool:
    """Whether each node has found the new controller's bus."""
    return all(node["progress"] for node in server.detail(job)["attempts"][-1]["nodes"])
