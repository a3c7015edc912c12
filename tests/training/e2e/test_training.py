"""Training through the real command: from YAML to a policy that balances, stopped and resumed, killed and restarted."""

from __future__ import annotations

import json
import os
import re
import signal
from pathlib import Path

import pytest

from shared_store.layout import Store
from shared_store.metrics import read_metrics
from tests.conftest import Serving, run_muster, wait_for
from tests.support.processes import gang_members, processes_of
from tests.support.worker.cartpole import raw_iterations, submit, wait_for_iteration

long = pytest.mark.skipif(not os.environ.get("MUSTER_LONG"), reason="a minute: MUSTER_LONG=1, in make bits")


def test_one_command_trains_a_gang_of_three_that_balances_the_pole(tmp_path: Path) -> None:
    home = tmp_path / "home"
    done = run_muster("run", "job_specs/cartpole.yaml", home=home, timeout=400)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "SUCCEEDED" in done.stdout and re.search(r"iteration \d+/\d+ .*steps/s .*ETA .*nodes 3", done.stdout)
    evaluation = re.search(r"mean episode length ([\d.]+) of (\d+)", done.stdout)
    assert evaluation and float(evaluation[1]) >= 0.9 * float(evaluation[2]), done.stdout
    for name in ("checkpoint", "log", "plot"):
        path = re.search(rf"^  {name}: +(\S+)$", done.stdout, re.MULTILINE)
        assert path and Path(path[1]).exists(), done.stdout
    assert Path(path[1]).read_bytes().startswith(b"\x89PNG")
    run = Store(home / "store").runs()[0]
    records = read_metrics(run)
    assert [record["iteration"] for record in records] == list(range(1, len(records) + 1))
    assert list(run.metrics.glob("events.out.tfevents.*"))
    assert not processes_of(home)


def test_a_stopped_run_goes_on_at_the_next_iteration(server: Serving) -> None:
    job = submit(server, "train.iterations=4000")
    wait_for_iteration(server, job["run"], 8)
    stopped = server.muster("stop", job["id"])
    assert stopped.returncode == 0 and f"muster resume {job['run']}" in stopped.stdout
    assert not processes_of(server.home)
    reached = raw_iterations(server, job["run"])[-1]
    checkpoints = json.loads(server.muster("checkpoints", job["run"], "--json", "--verify").stdout)
    assert checkpoints[-1]["iteration"] == reached and checkpoints[-1]["verified"], "the stop itself is a checkpoint"

    target = reached + 7
    resumed = server.muster("resume", job["run"], "--json", "--set", f"train.iterations={target}")
    assert json.loads(resumed.stdout)["iteration"] == reached
    detail = server.wait(json.loads(resumed.stdout)["jobId"], timeout=240)
    assert detail["status"] == "SUCCEEDED", detail["statusReason"]
    assert raw_iterations(server, job["run"]) == list(range(1, target + 1)), "no iteration twice, none skipped"
    records = server.client.get(f"/api/runs/{job['run']}/metrics")
    steps = records[0]["env_steps"]
    assert [record["env_steps"] for record in records] == [steps * i for i in range(1, target + 1)]

    missing = server.muster("resume", job["run"], "--checkpoint", "3")
    assert missing.returncode == 2 and "has no checkpoint of iteration 3" in missing.stderr
    _check_damage(server, job["run"], target)


def _check_damage(server: Serving, run: str, target: int) -> None:
    """A damaged checkpoint is named; a person's choice of it is refused; otherwise the one before it is used."""
    newest = json.loads(server.muster("checkpoints", run, "--json").stdout)[-1]
    victim = Path(newest["path"]) / "learner.pt"
    victim.write_bytes(victim.read_bytes()[:-10])
    verified = server.muster("checkpoints", run, "--verify")
    assert verified.returncode == 1 and "learner.pt has" in verified.stdout
    jobs = len(server.client.get(f"/api/runs/{run}")["jobs"])
    chosen = server.muster(
        "resume", run, "--checkpoint", str(newest["iteration"]), "--set", f"train.iterations={target + 3}"
    )
    assert chosen.returncode == 1 and "learner.pt has" in chosen.stderr and "Traceback" not in chosen.stderr
    assert len(server.client.get(f"/api/runs/{run}")["jobs"]) == jobs, "nothing was submitted"
    resumed = server.muster("resume", run, "--json", "--set", f"train.iterations={target + 3}")
    detail = server.wait(json.loads(resumed.stdout)["jobId"], timeout=240)
    assert detail["status"] == "SUCCEEDED", detail["statusReason"]
    log = "\n".join(server.log(detail["id"]))
    assert newest["name"] in log and "learner.pt has" in log and f"set aside as {newest['name']}.damaged" in log
    assert Path(f"{newest['path']}.damaged").is_dir()


@long
def test_a_killed_rank_restarts_the_gang_from_the_last_checkpoint(server: Serving) -> None:
    job = submit(server, "train.iterations=4000", "retry.attempts=2")
    wait_for_iteration(server, job["run"], 6)
    [victim] = gang_members(server.home, "rank", 1)
    victim.strike(signal.SIGKILL)
    wait_for(lambda: len(server.detail(job["id"])["attempts"]) == 2, 60, "a second attempt")
    reached = raw_iterations(server, job["run"])[-1]
    wait_for(lambda: raw_iterations(server, job["run"])[-1] > reached + 6, 120, "progress after the restart")
    assert server.muster("stop", job["id"]).returncode == 0
    detail = server.detail(job["id"])
    first, second = detail["attempts"]
    # under load the main node's broken collective may be seen before the end that broke it
    reasons = [str(node.get("reason")) for node in first["nodes"]]
    assert any("rank 1 was killed by SIGKILL" in reason for reason in reasons) and first["spent"]
    assert second["number"] == 2 and second["epoch"] == first["epoch"] + 1
    log = "\n".join(server.log(job["id"], attempt=2))
    start = int(re.search(r"resumed from checkpoint (\d{8})-e\d+", log)[1])
    assert start >= 5 and start % 5 == 0
    records = server.client.get(f"/api/runs/{job['run']}/metrics")
    assert [record["iteration"] for record in records] == list(range(1, len(records) + 1))
    assert not processes_of(server.home)


@long
def test_ant_trains_on_two_nodes(server: Serving) -> None:
    done = server.muster_process(
        "submit", "job_specs/ant.yaml", "-f", "--set", "train.iterations=2", "--set", "train.worlds=8", timeout=500
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "SUCCEEDED" in done.stdout
