"""Jobs of several people that have one name: a command by that name means one's own job, and says whose it is otherwise."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from orchestrator.client import Client
from orchestrator.server import Server
from tests.conftest import call_muster
from tests.support.keys import HomeKeys
from tests.support.processes import end_all

SPEC = {"name": "samejob", "command": ["sleep", "600"], "resources": {"cpus": 0.1, "memory": 64}}


class Lab:
    """A controller on which ``bob`` and then ``alice`` have submitted a job of one name; ``eve`` has none."""

    def __init__(self, home: Path) -> None:
        self.home, keys = home, HomeKeys(home)
        made = [keys.create(name) for name in ("bob", "alice", "eve")]
        self.tokens = {key.name: f"{key.access_key_id}:{key.secret}" for key in made}
        self.server = Server(home, cpus=1)
        self.server.start()
        self.jobs: dict[str, str] = {}
        for name in ("bob", "alice"):
            with Client(self.server.url, self.tokens[name]) as client:
                self.jobs[name] = client.post("/api/jobs", {"spec": SPEC})["jobId"]

    def muster(self, who: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        return call_muster(
            *arguments, home=self.home, MUSTER_URL=self.server.url, MUSTER_TOKEN=self.tokens[who], COLUMNS="200"
        )


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    lab = Lab(tmp_path)
    yield lab
    lab.server.close()
    end_all(tmp_path)


def test_a_name_means_ones_own_job_and_that_of_another_is_named_with_its_owner(lab: Lab) -> None:
    bobs, alices = (lab.jobs[name][:8] for name in ("bob", "alice"))
    shown = lab.muster("bob", "show", "samejob").stdout
    assert lab.jobs["bob"] in shown and "owner:        bob" in shown
    header, *rows = lab.muster("bob", "list").stdout.splitlines()
    assert header.split()[:4] == ["JOB", "NAME", "OWNER", "STATUS"]
    assert [row.split()[:3] for row in rows] == [[alices, "samejob", "alice"], [bobs, "samejob", "bob"]]
    stopped = lab.muster("bob", "stop", "samejob", "--no-wait")
    assert stopped.stdout == f"samejob ({bobs}): stop requested\n", stopped.stderr
    other = lab.muster("eve", "stop", "samejob", "--no-wait")
    assert other.stdout == f"samejob ({alices}) of alice: stop requested\n", "the newest, with its owner"
