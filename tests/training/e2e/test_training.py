"""Training through the real command: from YAML to a policy that balances, stopped and resumed, with a damaged checkpoint."""

from __future__ import annotations

import json
import re
from pathlib import Path

from shared_store.contract.phases import Phase
from shared_store.volume.layout import Store
from shared_store.volume.metrics import read_metrics
from tests.conftest import Serving, run_muster
from tests.support.processes import processes_of
from tests.support.worker.cartpole import raw_iterations, submit, wait_for_iteration


def test_one_command_trains_a_gang_of_three_that_balances_the_pole(tmp_path: Path) -> None:
    home = tmp_path / "home"
    done = run_muster("run", "job_specs/cartpole.yaml", home=home, timeout=400)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "SUCCEEDED" in done.stdout and re.search(r"iteration \d+/\d+ .*steps/s .*ETA .*nodes 3", done.stdout)
    ended = done.stdout.partition("iteration 60/60")[2].partition("SUCCEEDED")[0]
    assert "reward" in ended and "ETA" not in ended, ended
    shown = [line for line in ended.splitlines() if line in list(Phase)]
    assert shown == [phase for phase in Phase if phase in shown], ended  # a short one may fall between two looks
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

    missing = server.muster("resume", f"{job['run']}@3")
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
    chosen = server.muster("resume", f"{run}@{newest['iteration']}", "--set", f"train.iterations={target + 3}")
    assert chosen.returncode == 1 and "learner.pt has" in chosen.stderr and "Traceback" not in chosen.stderr
    assert len(server.client.get(f"/api/runs/{run}")["jobs"]) == jobs, "nothing was submitted"
    resumed = server.muster("resume", run, "--json", "--set", f"train.iterations={target + 3}")
    detail = server.wait(json.loads(resumed.stdout)["jobId"], timeout=240)
    assert detail["status"] == "SUCCEEDED", detail["statusReason"]
    log = "\n".join(server.log(detail["id"]))
    assert newest["name"] in log and "learner.pt has" in log and f"set aside as {newest['name']}.damaged" in log
    assert Path(f"{newest['path']}.damaged").is_dir()
