"""Ranks on GPUs of their own: two nodes that share this machine's GPUs as two hosts would, and NCCL between them."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.epoch import raise_epoch
from shared_store.volume.layout import Store
from tests.conftest import MAIN_LAST, PATIENCE, Serving
from tests.support.engines.ray_cluster import RayCluster
from tests.support.hosts import start_ranks, two_hosts
from tests.support.worker.ranks import training


def count_gpus() -> int:
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True)
    except OSError:
        return 0
    return sum(line.startswith("GPU ") for line in listed.stdout.splitlines())


EACH = count_gpus() // 2
"""GPUs of each of the two nodes."""
needs_two = pytest.mark.skipif(not EACH, reason="needs two NVIDIA GPUs")

NOTICED = 120
"""Seconds in which the other ranks have started, trained and noticed that one is gone; a collective's own limit is 600."""

SCRIPT = f"""
import os, torch, torch.distributed as dist
rank, local, size = (int(os.environ[name]) for name in ("RANK", "LOCAL_RANK", "WORLD_SIZE"))
here = [torch.cuda.get_device_properties(i).uuid for i in range(torch.cuda.device_count())]
torch.cuda.set_device(local)
dist.init_process_group("nccl")
shared = torch.full((1 << 22,), rank + 1.0, device="cuda")
dist.all_reduce(shared)
assert (shared == size * (size + 1) / 2).all()
print("rank", rank, "of", size, "sees", os.environ["CUDA_VISIBLE_DEVICES"], *here, "uses", here[local], flush=True)
dist.destroy_process_group()
{MAIN_LAST}"""


@pytest.fixture(params=["local", "ray"])
def serving(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Serving]:
    """Local: the machine's GPUs are the controller's. Ray: two raylets, each with its half of them."""
    cluster = None
    if request.param == "ray":
        cluster = RayCluster(tmp_path)
        for node in range(2):
            half = ",".join(str(node * EACH + gpu) for gpu in range(EACH))
            cluster.add(f"n{node}", gpus=EACH, CUDA_VISIBLE_DEVICES=half)
        for name, value in cluster.variables.items():
            monkeypatch.setenv(name, value)
    serving = Serving(tmp_path / "home", "--engine", request.param)
    try:
        yield serving
    finally:
        serving.close()
        if cluster is not None:
            cluster.close()


@needs_two
def test_every_rank_has_its_own_gpu_and_nccl_works_between_nodes(serving: Serving, tmp_path: Path) -> None:
    spec = tmp_path / "gpus.yaml"
    script = tmp_path / "gpus.py"
    script.write_text(SCRIPT)
    spec.write_text(f"name: gpus\nnodes: 2\nresources: {{gpus: {EACH}, cpus: 1}}\ncommand: [python3, {script}]\n")
    job = submit(serving, str(spec))
    reported = sorted(line.split() for line in serving.log(job) if line.startswith("rank "))
    assert [line[:4] for line in reported] == [["rank", str(rank), "of", str(2 * EACH)] for rank in range(2 * EACH)]
    used = [line[-1] for line in reported]
    assert len(set(used)) == 2 * EACH, reported
    visible = [line[5] for line in reported]
    assert all(len(each.split(",")) == EACH for each in visible) and len(set(visible)) == 2, reported
    if serving.options[1] == "local":
        assert visible == [",".join(node["gpus"]) for node in nodes(serving, job) for _ in range(EACH)]


@needs_two
def test_a_training_on_two_nodes_of_gpus(serving: Serving) -> None:
    settings = ["nodes=2", f"resources.gpus={EACH}", "train.worlds=512", "train.iterations=5", "retry.attempts=1"]
    job = submit(serving, "job_specs/cartpole.yaml", *(argument for each in settings for argument in ("--set", each)))
    assert any("captured as CUDA graphs" in line for line in serving.log(job))
    assert [len(node["gpus"]) for node in nodes(serving, job)] == [EACH, EACH]


@needs_two
def test_two_hosts_train_over_tcp_lose_a_rank_and_resume(tmp_path: Path) -> None:
    settings = {"task": "Cartpole", "worlds": 512, "iterations": 60, "every": 20}

    def start(epoch: int, **env: str) -> list[subprocess.Popen[str]]:
        supplied = {**training(tmp_path, epoch=epoch, **settings), "NCCL_DEBUG": "INFO", **env}
        arguments = ["-m", "worker.train"]
        return start_ranks(arguments, 2 * EACH, supplied, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)

    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(two_hosts())
        except OSError as error:
            pytest.skip(f"no network namespaces here: {error}")
        run = Store(tmp_path).open().run("run")
        run.create({"run": "run"})
        raise_epoch(run, 1)
        first = start(1, MUSTER_KILL_AT="30")
        output = [process.communicate(timeout=NOTICED)[0] for process in first]
        assert first[0].returncode == -signal.SIGKILL, output[0][-2000:]
        assert first[1].returncode not in (0, -signal.SIGKILL), "the other host's rank noticed"
        ways = set(re.findall(r" via (\S+)", output[0]))
        assert any(way.startswith("NET/Socket") for way in ways), output[0][-2000:]
        assert not any(way.startswith(("P2P", "SHM")) for way in ways), ways
        assert [checkpoint.iteration for checkpoint in list_checkpoints(run)] == [20]
        raise_epoch(run, 2)
        second = start(2)
        output = [process.communicate(timeout=60 * PATIENCE)[0] for process in second]
        assert [process.returncode for process in second] == [0] * len(second), output[0][-2000:]
        assert "resumed from checkpoint 00000020" in output[0]
        assert list_checkpoints(run)[-1].iteration == 60


def submit(serving: Serving, *arguments: str) -> str:
    """Submit, wait for its end; returns the job id."""
    done = serving.muster("submit", *arguments, "--json")
    assert done.returncode == 0, done.stderr
    job = str(json.loads(done.stdout)["jobId"])
    detail = serving.wait(job, timeout=100)
    assert detail["status"] == "SUCCEEDED", "\n".join([detail["statusReason"], *serving.log(job)[-30:]])
    return job


def nodes(serving: Serving, job: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = serving.detail(job)["attempts"][0]["nodes"]
    return found
