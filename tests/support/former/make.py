"""Making the archive anew: ``python -m tests.support.former.make``, in a checkout whose history holds the commit.

Its controller and its nodes run for real: a training that ends, its evaluation, export, model and clone; a training that is killed with
its controller in the middle, and jobs that wait for it. What is left of the home then becomes ``tests/data/home-8f62cff.tar.xz``, but
for what is made again (compiled kernels, locks, sockets) and pictures.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import tarfile
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml

from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.files import write_json
from shared_store.volume.layout import Store
from tests.support.definitions import container, multinode
from tests.support.former.archive import ARCHIVE, FACTS, LIBRARIES, processor
from tests.support.former.environment import COMMIT, make_environment
from tests.support.former.serving import FormerServing, create_key
from tests.support.former.specs import COMMAND, OTHERS, TRAINING
from tests.support.orchestrator.receiver import SECRET
from tests.support.processes import end_all, gang_members
from tests.support.suite.caches import kernel_cache
from tests.support.waiting import wait_for

_WEBHOOK = {"url": "http://127.0.0.1:1/hooks", "secret": SECRET, "queues": ["robots"]}
_LEFT_OUT = {"kernels", "ray", "controllers", "controller.json", "muster.db-shm"}
_MADE_AGAIN = (".lock", ".png", ".sock")


def main() -> int:
    os.environ.setdefault("WARP_CACHE_PATH", str(kernel_cache()))
    os.environ["MUSTER_PICTURE"] = "0"
    base = Path("/tmp/muster-archive")  # logs and heartbeats name it
    base.mkdir(mode=0o700)
    home = base / "home"
    try:
        facts = _make_home(base, home)
        write_json(base / FACTS, facts)
        _check(base, home)
        _pack(base, home)
    finally:
        end_all(home)
        shutil.rmtree(base)
    print(f"{ARCHIVE}: {ARCHIVE.stat().st_size:,} bytes")
    return 0


def _make_home(base: Path, home: Path) -> dict[str, Any]:
    """Let the commit make the home; returns what is known of it."""
    command = make_environment(base / "former")
    home.mkdir(mode=0o700)
    webhooks = home / "webhooks.json"
    webhooks.touch(mode=0o600)
    webhooks.write_text(json.dumps({"chat": _WEBHOOK}))
    rights = {"me": [], "alice": ["--queue", "robots"], "wall": ["--read-only"]}
    keys = {name: create_key(command, home, name, *options) for name, options in rights.items()}
    with FormerServing(home, command, "--cpus", "2", "--webhooks", str(webhooks), key=keys["me"]) as server:
        jobs = _run_to_the_end(server, base)
        jobs |= _leave_running(server, base)
        listed = _lists(server, jobs)
        _cut(server, jobs["cut"])
    return {
        "commit": COMMIT,
        "keys": keys,
        "jobs": jobs,
        "listed": listed,
        "processor": processor(),
        "libraries": {name: metadata.version(name) for name in LIBRARIES},
    }


def _run_to_the_end(server: FormerServing, base: Path) -> dict[str, str]:
    """Jobs that are over: a training and what follows from it, programs that succeed and fail. Ids by name."""
    policy = server.client.batch(
        "CreateSchedulingPolicy",
        name="shares",
        fairsharePolicy={
            "shareDecaySeconds": 60,
            "shareDistribution": [{"shareIdentifier": "lab*", "weightFactor": 0.5}],
        },
    )
    for queue, more in (("robots", {}), ("shares", {"schedulingPolicyArn": policy["arn"]})):
        server.client.batch(
            "CreateJobQueue",
            jobQueueName=queue,
            state="ENABLED",
            priority=5,
            computeEnvironmentOrder=[{"order": 1, "computeEnvironment": "local"}],
            tags={"team": queue},
            **more,
        )
    jobs = {spec["name"]: _submit(server, base, spec) for spec in (TRAINING, *OTHERS)}
    for spec in OTHERS:
        _ended(server, jobs[spec["name"]])
    run = _ended(server, jobs["whole"])["run"]
    for words in (["evaluate", run, "--episodes", "4"], ["export", run], ["models", "register", run, "--name", "pole"]):
        done = server.muster(*words)
        assert done.returncode == 0, done.stdout + done.stderr
    ids = {job["jobName"]: job["jobId"] for job in server.answer("list")}
    jobs |= {kind: ids[f"{kind}-{run}"] for kind in ("evaluate", "export")}
    changed = ["--set", "train.iterations=2", "--set", "nodes=1"]
    jobs["clone"] = server.answer("clone", f"{run}@30", "--name", "clone", *changed)["jobId"]
    _ended(server, jobs["clone"])
    jobs["gang"] = _submit(
        server, base, {**COMMAND, "name": "gang", "nodes": 2, "command": ["echo", "a line of the gang"]}
    )
    _ended(server, jobs["gang"])
    jobs["failed"] = _submit(server, base, {**COMMAND, "name": "failed", "command": ["sh", "-c", "echo no; exit 3"]})
    _ended(server, jobs["failed"], "FAILED")
    needs = container(["echo", "child"], "0.5")
    server.client.batch("RegisterJobDefinition", **multinode("plain", needs, 1, tags={"muster:queues": "robots"}))
    return jobs


def _leave_running(server: FormerServing, base: Path) -> dict[str, str]:
    """Jobs that are not over: one that runs, one that waits for its end, one that waits for its processors."""
    jobs = {"cut": _submit(server, base, {**TRAINING, "name": "cut"})}
    run = Store(server.home / "store").run(server.detail(jobs["cut"])["run"])
    after = server.client.batch(
        "SubmitJob", jobName="after", jobQueue="default", jobDefinition="plain", dependsOn=[{"jobId": jobs["cut"]}]
    )
    jobs["after"] = after["jobId"]
    full = {**COMMAND, "name": "waiting", "queue": "robots", "resources": {"cpus": 2, "memory": "64MiB"}}
    jobs["waiting"] = _submit(server, base, {**full, "command": ["echo", "had room"]})
    wait_for(lambda: len(list_checkpoints(run)) >= 2, 120, "the second checkpoint")
    for rank in gang_members(server.home, "rank"):  # it must not end while the jobs are listed
        rank.strike(signal.SIGSTOP)
    return jobs


def _cut(server: FormerServing, job: str) -> None:
    """End the controller and the running training as a power cut does."""
    server.kill()
    end_all(server.home)
    run = next(run for run in Store(server.home / "store").runs() if run.name.startswith("cut"))
    reached = [checkpoint.iteration for checkpoint in list_checkpoints(run)]
    if not reached or reached[-1] >= TRAINING["train"]["iterations"]:
        raise SystemExit(f"the training {job} had the checkpoints {reached} when it was killed: begin again")


def _submit(server: FormerServing, base: Path, spec: dict[str, Any]) -> str:
    path = base / f"{spec['name']}.yaml"
    path.write_text(yaml.safe_dump(spec))
    return str(server.answer("submit", str(path))["jobId"])


def _ended(server: FormerServing, job: str, status: str = "SUCCEEDED") -> dict[str, Any]:
    detail = server.wait(job, timeout=300)
    assert detail["status"] == status, detail
    return detail


def _lists(server: FormerServing, jobs: dict[str, str]) -> dict[str, Any]:
    """What the commit's commands list, for comparison."""
    run = server.detail(jobs["whole"])["run"]
    ids = [job["jobId"] for job in server.answer("list")]
    return {
        "jobs": server.client.batch("DescribeJobs", jobs=ids)["jobs"],
        "queues": server.client.batch("DescribeJobQueues")["jobQueues"],
        "definitions": server.client.batch("DescribeJobDefinitions")["jobDefinitions"],
        "models": [f"{model['name']}@{model['version']}" for model in server.answer("models", "list")],
        "keys": server.answer("keys", "list"),
        "logs": {name: [line["text"] for line in server.client.logs(jobs[name])] for name in ("gang", "failed")},
        "checkpoints": [each["name"] for each in server.answer("checkpoints", run)],
        "metrics": server.client.get(f"/api/runs/{run}/metrics"),
    }


def _files(home: Path) -> Iterator[Path]:
    for path in sorted(home.rglob("*")):
        within = path.relative_to(home)
        is_left_out = not _LEFT_OUT.isdisjoint(within.parts) or path.suffix in _MADE_AGAIN or "tfevents" in path.name
        if path.is_file() and not path.is_symlink() and not is_left_out:
            yield path


def _check(base: Path, home: Path) -> None:
    """Refuse a home that names this checkout."""
    for path in [base / FACTS, *_files(home)]:
        if os.fsencode(Path.cwd()) in path.read_bytes():
            raise SystemExit(f"{path.relative_to(base)} names {Path.cwd()}")


def _pack(base: Path, home: Path) -> None:
    def anonymous(entry: tarfile.TarInfo) -> tarfile.TarInfo:
        entry.uid = entry.gid = 0
        entry.uname = entry.gname = ""
        return entry

    ARCHIVE.parent.mkdir(exist_ok=True)
    with tarfile.open(ARCHIVE, "w:xz", preset=9) as archive:
        for path in [base / FACTS, *_files(home)]:
            archive.add(path, str(path.relative_to(base)), filter=anonymous)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    raise SystemExit(main())
